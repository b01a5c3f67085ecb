"""Wrist paths along an exemplar motion: base joint positions at each step, by geometry alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from torch import Tensor

from pgdm import rotations
from pgdm.motion.reference import ObjectReference
from pgdm.sim.scene import SceneIndex

SLIDES, BASE_JOINTS = 3, 6
"""The base: three slides, then three intrinsic X-Y-Z hinges, in the mount's frame, which is that of
the mount body at base joints of zero."""

TURN_M = 0.03
"""Metres off the path that cost as much as a radian off the carried orientation."""
_STEADY_M = 0.003  # m that cost as much as a radian away from the step before: a smooth path


@dataclass(frozen=True)
class GraspPoint:
    """The point of the hand where the object's centre of mass is at the start."""

    offset: np.ndarray  # (3,) m, in the frame of the body it is fixed to

    @classmethod
    def at(cls, point: np.ndarray, pos: np.ndarray, orientation: Rotation) -> GraspPoint:
        """Return a point (3,) m as fixed to a body at pos (3,) m with an orientation."""
        return cls(orientation.inv().apply(point - pos))

    def of(self, pos: np.ndarray, orientation: Rotation) -> np.ndarray:
        """Return where the point is for bodies at pos (N, 3) m with N orientations, (N, 3) m."""
        return pos + orientation.apply(self.offset)


def base_orientation(joints: np.ndarray) -> Rotation:
    """Return orientations in the mount's frame at base joint positions (6,), (N, 6) or a qpos."""
    return Rotation.from_euler("XYZ", joints[..., SLIDES:BASE_JOINTS])


def carried_path(index: SceneIndex, reference: ObjectReference, start: Tensor) -> Tensor:
    """Return base joint positions (T, 6), m and rad, that move the hand rigidly with the motion.

    With D_k = R(x_k) R(x_0)^-1 the mount body goes to x_k + D_k (p_0 - x_0) and is rotated
    to D_k R_0. Joint positions may be beyond the limits of the base.

    Args:
        index: index of the scene.
        reference: the exemplar motion.
        start: qpos (nq,) at the start.
    """
    mount_pos, mount_quat = torch.from_numpy(index.mount_pos), torch.from_numpy(index.mount_quat)
    slides, hinges = start[:3], start[3 : index.num_base_joints]
    p0 = mount_pos + rotations.rotate(mount_quat, slides)
    r0 = rotations.multiply(mount_quat, rotations.from_euler_xyz(hinges))
    moved = rotations.multiply(reference.quat, rotations.conjugate(reference.quat[0]))  # D_k
    pos = reference.pos + rotations.rotate(moved, (p0 - reference.pos[0]).expand_as(reference.pos))
    to_mount = rotations.conjugate(mount_quat)
    in_mount = rotations.multiply(to_mount, rotations.multiply(moved, r0))
    angles = rotations.unwrap(rotations.to_euler_xyz(in_mount))
    # Begin on the branch of the start itself, which may be beyond +-pi.
    angles = angles + 2 * torch.pi * torch.round((hinges - angles[0]) / (2 * torch.pi))
    return torch.cat((rotations.rotate(to_mount, pos - mount_pos), angles), -1)


def clipped_path(index: SceneIndex, reference: ObjectReference, start: Tensor) -> Tensor:
    """Return the carried path (T, 6), each joint clipped to its control range."""
    low, high = torch.from_numpy(index.ctrl_low)[:6], torch.from_numpy(index.ctrl_high)[:6]
    return carried_path(index, reference, start).clamp(low, high)


def feasible_path(index: SceneIndex, reference: ObjectReference, start: Tensor) -> Tensor:
    """Return base joint positions (T, 6) that keep the grasp point on the motion.

    They are within the control ranges.

    With x the target in the mount's frame, o the grasp point in the hand's, a the three hinge
    angles and R(a) their rotation, the slides follow from the hinges: s(a) = x - R(a) o. Each step
    is a bounded least-squares problem in a,

        min  |s - clip(s)|^2 + |TURN_M log(R_carried^-1 R(a))|^2 + |0.003 (a - a_before)|^2

    in m and rad: position first, then the carried orientation, then little change from step to
    step. It is solved from the step before and from the carried hinges; the better result is kept.

    Args:
        index: index of the scene.
        reference: the exemplar motion.
        start: qpos (nq,) at the start.
    """
    carried = carried_path(index, reference, start).numpy()
    low, high = index.ctrl_low[:6], index.ctrl_high[:6]
    mount = Rotation.from_quat(index.mount_quat, scalar_first=True)
    targets = mount.inv().apply(reference.pos.numpy() - index.mount_pos)  # (T, 3) m
    grasp = GraspPoint.at(targets[0], carried[0, :3], base_orientation(carried[0])).offset
    path = np.empty_like(carried)
    hinges = carried[0, 3:].clip(low[3:], high[3:])
    for k, (target, wanted) in enumerate(zip(targets, carried[:, 3:], strict=True)):
        wanted_rotation, before = _rotation(wanted), hinges

        def slides(angles: np.ndarray, target: np.ndarray = target) -> np.ndarray:
            return target - _rotation(angles).apply(grasp)

        def residual(
            angles: np.ndarray, goal: Rotation = wanted_rotation, before: np.ndarray = before
        ) -> np.ndarray:
            needed = slides(angles)
            off = (goal.inv() * _rotation(angles)).as_rotvec()
            outside = needed - needed.clip(low[:3], high[:3])
            return np.concatenate((outside, TURN_M * off, _STEADY_M * (angles - before)))

        found = min(
            (
                least_squares(residual, begin.clip(low[3:], high[3:]), bounds=(low[3:], high[3:]))
                for begin in (before, wanted)
            ),
            key=lambda result: result.cost,
        )
        hinges = found.x
        path[k] = np.concatenate((slides(hinges).clip(low[:3], high[:3]), hinges))
    return torch.from_numpy(path)


def _rotation(hinges: np.ndarray) -> Rotation:
    return Rotation.from_euler("XYZ", hinges)


PATHS = {"carried": carried_path, "clipped": clipped_path, "feasible": feasible_path}
"""Path by its name in ``action.wrist_path``."""
