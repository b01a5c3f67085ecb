"""Contacts of a human hand: distances of the fingers' last bones from an object's convex parts.

The recordings have the joint locations of a hand but not its fingertips. A finger's last bone is
therefore assumed to start at its last joint (DIP, distal interphalangeal), in the direction of the
bone before it (which starts at PIP, the proximal one). The bones' length, their radii and the
contact distance are our choice; docs/assets.md has the results.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from pgdm.errors import CorruptAssetError
from pgdm.library.checks.compiled import compiled
from pgdm.library.files.expert import FINGERS

BONE_M = 0.02
"""Length of a finger's last bone."""

RADII_M = np.array([0.008, 0.008, 0.007, 0.008, 0.009])
"""Radius of each finger's last bone, in the order of `FINGERS`."""

CONTACT_M = 0.008
"""A finger closer than this is in contact, if the recording flags the hand as in contact."""

CLOSE_M = 0.005
"""The share of poses at which a finger is closer than this is reported."""

_THIN_M = 1e-6
"""Radius of the capsule from which distances are measured: almost zero, so that the closest point
is well defined where the finger overlaps the object."""
_FAR_M = 10.0  # larger distances are not measured
_BODY = 1  # an object is one body, child of the world


@dataclass(frozen=True)
class Contacts:
    """Distances of five fingers from an object, at T poses."""

    points: np.ndarray
    """Closest points of the object (T, 5, 3) m, in the frame of its body."""
    distances: np.ndarray
    """Distances of the fingers' surfaces from the object (T, 5) m, negative where they overlap."""

    def in_contact(self, touching: np.ndarray) -> np.ndarray:
        """Return whether each finger is in contact (T, 5), given the hand's contact flags (T,)."""
        return (self.distances < CONTACT_M) & touching[:, None]


def bones(human_joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return start (T, 5, 3) m and unit direction (T, 5, 3) of the fingers' last bones.

    Args:
        human_joints: joint locations (T, 16, 3) m, MANO order: a finger's second joint is PIP, its
            third DIP.
    """
    fingers = human_joints[:, 1:].reshape(len(human_joints), len(FINGERS), 3, 3)
    pip, dip = fingers[:, :, 1], fingers[:, :, 2]
    along = dip - pip
    return dip, along / np.linalg.norm(along, axis=-1, keepdims=True)


def measure(
    xml: Path, position: np.ndarray, rotation: np.ndarray, human_joints: np.ndarray
) -> Contacts:
    """Measure the fingers' distances from the collision geoms of an object.

    Args:
        xml: the library's model of the object.
        position: positions of the origin of its body (T, 3) m, world frame.
        rotation: orientations of its body (T, 4), unit quaternions wxyz.
        human_joints: joint locations (T, 16, 3) m, MANO order, world frame.

    Raises:
        CorruptAssetError: the object has no collision geom.
    """
    model, probe, parts = _with_capsule(xml)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    origin, home = data.xpos[_BODY].copy(), data.xmat[_BODY].reshape(3, 3)
    start, along = bones(human_joints)
    points = np.empty((len(position), len(FINGERS), 3))
    distances = np.empty(points.shape[:2])
    flat, ends = np.empty(9), np.empty(6)
    for t in range(len(position)):
        mujoco.mju_quat2Mat(flat, rotation[t])
        to_body = flat.reshape(3, 3).T
        for f in range(len(FINGERS)):
            middle = start[t, f] + 0.5 * BONE_M * along[t, f]
            data.geom_xpos[probe] = origin + home @ to_body @ (middle - position[t])
            data.geom_xmat[probe] = _frame(home @ to_body @ along[t, f])
            nearest = _FAR_M
            for part in parts:
                distance = mujoco.mj_geomDistance(model, data, probe, part, nearest, ends)
                if distance < nearest:
                    nearest, points[t, f] = distance, home.T @ (ends[3:] - origin)
            distances[t, f] = nearest + _THIN_M - RADII_M[f]
    return Contacts(points, distances)


def _with_capsule(xml: Path) -> tuple[mujoco.MjModel, int, list[int]]:
    """Compile the object with a capsule; return the model and the geom ids of capsule and parts."""
    capsule, size = mujoco.mjtGeom.mjGEOM_CAPSULE, [_THIN_M, 0.5 * BONE_M, 0.0]
    model = compiled(
        xml,
        xml.parent.name,
        lambda spec: spec.worldbody.add_geom(name="bone", type=capsule, size=size),
    )
    solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
    parts = np.flatnonzero(solid & (model.geom_bodyid == _BODY)).tolist()
    if not parts:
        raise CorruptAssetError(f"{xml}: the object has no collision geom")
    return model, model.geom("bone").id, parts


def _frame(axis: np.ndarray) -> np.ndarray:
    """Return a rotation matrix (9,) whose third column, a capsule's axis, is the given vector."""
    quat, matrix = np.empty(4), np.empty(9)
    mujoco.mju_quatZ2Vec(quat, axis)
    mujoco.mju_quat2Mat(matrix, quat)
    return matrix
