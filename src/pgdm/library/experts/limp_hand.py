"""Retargeting by simulation: a human hand's joint locations pull an unactuated robot hand along.

This is how the published trajectories were made: each point of a robot hand without motors is tied
to a joint of a human hand whose bones are scaled to the robot's lengths. With the object in the
scene this reproduces the published finger joints to 0.06 rad (RMS), with a mean fingertip error of
1.8 mm (`benchmark/retarget.py`).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from pgdm.errors import CorruptAssetError
from pgdm.library.checks.compiled import compiled


@dataclass(frozen=True)
class PulledHand:
    """The points by which a robot hand is pulled."""

    points: tuple[str, ...]
    """Names of the bodies (P,) at the points, in the order of the human hand's joints."""
    parents: tuple[int, ...]
    """Index of each joint's parent in the tree rooted at the wrist; the wrist is its own parent."""
    wrist_anchor_m: tuple[float, float, float]
    """Point tied to the human wrist, in the frame of the first point's body, m."""


ADROIT = PulledHand(
    points=(
        "wrist_point",
        *("ffknuckle_point", "ffmiddle_point", "ffdistal_point"),
        *("mfknuckle_point", "mfmiddle_point", "mfdistal_point"),
        *("lfknuckle_point", "lfmiddle_point", "lfdistal_point"),
        *("rfknuckle_point", "rfmiddle_point", "rfdistal_point"),
        *("thknuckle_point", "thmiddle_point", "thdistal_point"),
    ),
    parents=(0, 0, 1, 2, 0, 4, 5, 0, 7, 8, 0, 10, 11, 0, 13, 14),
    # Measured: in the published trajectories Adroit's first wrist joint is at the human wrist, but
    # bone lengths are measured from the body `wrist_point`, 34 mm away from that joint.
    wrist_anchor_m=(0.0, 0.0, -0.034),
)
"""Adroit's points, as in the simulation behind the published trajectories."""

TIMESTEP_S = 0.004
STEPS = 10
"""Physics steps per frame."""
SETTLING_STEPS = 2000
"""Physics steps on the first frame before the motion begins."""

_PULL_DELAY = 1
"""Number of physics steps at the start of a frame in which the previous frame's targets still
apply: the simulation behind the published trajectories computed forces at the end of a step. With
this delay the mean fingertip error is 1.8 mm, without it 2.4 mm."""

_HAND, _OBJECT, _PULL = "hand/", "object/", "pull"


def bone_scaled(points: np.ndarray, lengths: np.ndarray, parents: tuple[int, ...]) -> np.ndarray:
    """Return a hand's joint locations with new bone lengths and unchanged bone directions.

    Args:
        points: joint locations (N, P, 3) m.
        lengths: length of the bone that ends at each joint (P,) m; the wrist's is ignored.
        parents: index of each joint's parent; must be smaller than the joint's own index. The
            wrist is its own parent.

    Returns:
        Joint locations (N, P, 3) m; the wrist is unchanged.
    """
    result = points.copy()
    for i, parent in enumerate(parents):
        if i != parent:
            bone = points[:, i] - points[:, parent]
            unit = bone / np.linalg.norm(bone, axis=-1, keepdims=True)
            result[:, i] = result[:, parent] + lengths[i] * unit
    return result


class LimpHand:
    """An unactuated robot hand above the table, with an object placed at prescribed poses.

    Args:
        table: MJCF of the scene.
        hand: MJCF of the hand.
        object_xml: MJCF of the object.
        pulled: the points by which the hand is pulled.

    Raises:
        CorruptAssetError: a model does not compile or lacks a point.
    """

    def __init__(
        self, table: Path, hand: Path, object_xml: Path, pulled: PulledHand = ADROIT
    ) -> None:
        self._pulled = pulled
        label = f"{hand.parent.name} with {object_xml.parent.name}"
        self._model = compiled(table, label, lambda spec: _assemble(spec, hand, object_xml, pulled))
        self._points = [self._model.body(_HAND + name).id for name in pulled.points]
        for i in range(len(pulled.points)):
            # The compiler's anchors depend on the bodies' initial poses; tie their origins instead.
            anchors = self._model.eq(f"{_PULL}{i}").data[:6]
            anchors[:] = 0.0
            if i == 0:
                anchors[:3] = pulled.wrist_anchor_m
        bodies = [self._model.body(i).name for i in self._model.jnt_bodyid]
        self._num_joints = sum(name.startswith(_HAND) for name in bodies)
        self.lengths = self._bone_lengths()
        """Lengths of the robot's bones (P,) m, measured at joint positions of zero."""

    def track(
        self, human_joints: np.ndarray, position: np.ndarray, rotation: np.ndarray
    ) -> np.ndarray:
        """Return the robot's joint positions (N, J), m and rad, one row per frame.

        At the start of each frame the object is placed at the pose of the previous frame; it then
        moves freely until the next frame, as in the simulation behind the published trajectories.
        Joints may exceed their limits, as the pull is stronger than the limit constraints.

        Args:
            human_joints: joint locations of the human hand (N, P, 3) m, world frame.
            position: positions of the object's body (N, 3) m, world frame.
            rotation: orientations of the object's body (N, 4), unit quaternions wxyz.
        """
        targets = bone_scaled(human_joints, self.lengths, self._pulled.parents)
        model, data = self._model, mujoco.MjData(self._model)
        poses = np.concatenate((position, rotation), axis=1)
        result = np.empty((len(targets), self._num_joints))
        data.mocap_pos[:] = targets[0]
        for _ in range(SETTLING_STEPS):
            self._put(data, poses[0])
            mujoco.mj_step(model, data)
        for i, target in enumerate(targets):
            self._put(data, poses[max(i - 1, 0)])
            mujoco.mj_step(model, data, _PULL_DELAY)
            data.mocap_pos[:] = target
            mujoco.mj_step(model, data, STEPS - _PULL_DELAY)
            result[i] = data.qpos[: self._num_joints]
        return result

    def points(self, qpos: np.ndarray) -> np.ndarray:
        """Return the robot's points (N, P, 3) m, world frame, at joint positions (N, J)."""
        data = mujoco.MjData(self._model)
        result = np.empty((len(qpos), len(self._points), 3))
        for i, row in enumerate(qpos):
            data.qpos[: self._num_joints] = row
            mujoco.mj_kinematics(self._model, data)
            result[i] = data.xpos[self._points]
        return result

    def _put(self, data: mujoco.MjData, pose: np.ndarray) -> None:
        data.qpos[self._num_joints :] = pose
        data.qvel[self._num_joints :] = 0.0

    def _bone_lengths(self) -> np.ndarray:
        rest = self.points(np.zeros((1, self._num_joints)))[0]
        return np.linalg.norm(rest - rest[list(self._pulled.parents)], axis=1)


def _assemble(spec: mujoco.MjSpec, hand: Path, object_xml: Path, pulled: PulledHand) -> None:
    for path, prefix in ((hand, _HAND), (object_xml, _OBJECT)):
        part = mujoco.MjSpec.from_file(str(path))
        if prefix == _OBJECT:
            _with_free_joint(part, path)
        spec.attach(part, prefix=prefix, frame=spec.worldbody.add_frame())
    spec.option.timestep = TIMESTEP_S
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    body = mujoco.mjtObj.mjOBJ_BODY
    for i, point in enumerate(pulled.points):
        if spec.body(_HAND + point) is None:
            raise CorruptAssetError(f"{hand}: the hand has no body '{point}'")
        name = f"{_PULL}{i}"
        spec.worldbody.add_body(name=name, mocap=True)
        spec.add_equality(
            name=name,
            type=mujoco.mjtEq.mjEQ_CONNECT,
            objtype=body,
            name1=_HAND + point,
            name2=name,
        )


def _with_free_joint(spec: mujoco.MjSpec, path: Path) -> None:
    """Replace the object's six joints by a free joint, so that its qpos is its pose."""
    body = spec.worldbody.first_body()
    if body is None:
        raise CorruptAssetError(f"{path}: the object has no body")
    for joint in list(body.joints):
        spec.delete(joint)
    body.add_freejoint()
