"""Wrist paths: base joint positions along a motion, computed by geometry alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from pgdm import rotations
from pgdm.motion.reference import ObjectReference
from pgdm.sim.scene import SceneIndex

SLIDES, BASE_JOINTS = 3, 6
"""Joints of the base: three slides, then three intrinsic X-Y-Z hinges. They act in the mount's
frame, which is the frame of the mount body with all base joints at zero."""

TURN_M = 0.03
"""Position error, m, that costs as much as 1 rad between the hand's orientation and that of the
carried path."""
_STEADY_M = 0.003  # position error, m, that costs as much as a hinge change of 1 rad in one step


@dataclass(frozen=True)
class GraspPoint:
    """The point of the hand that, at the start of an episode, is at the motion's first target.

    The object's centre of mass should start there, too.
    """

    offset: np.ndarray  # (3,) m, in the frame of the body that the point is fixed to

    @classmethod
    def at(cls, point: np.ndarray, pos: np.ndarray, orientation: Rotation) -> GraspPoint:
        """Return a point (3,) m fixed to a body at pos (3,) m with the given orientation."""
        return cls(orientation.inv().apply(point - pos))

    def of(self, pos: np.ndarray, orientation: Rotation) -> np.ndarray:
        """Return the point's positions (N, 3) m for N body positions (N, 3) m and orientations."""
        return pos + orientation.apply(self.offset)


def base_orientation(joints: np.ndarray) -> Rotation:
    """Return the mount body's orientations in the mount's frame.

    Args:
        joints: base joint positions (6,) or (N, 6), or a whole qpos.
    """
    return Rotation.from_euler("XYZ", joints[..., SLIDES:BASE_JOINTS])


def carried_path(index: SceneIndex, reference: ObjectReference, start: Tensor) -> Tensor:
    """Return base joint positions (T, 6), m and rad, that move the hand rigidly with the motion.

    The mount body, which starts at position p_0 with rotation R_0, goes to x_k + D_k (p_0 - x_0)
    with rotation D_k R_0, where D_k = R(x_k) R(x_0)^-1 is the object's rotation since the first
    pose. The result may exceed the base's joint limits.

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
    # Shift by full turns so that the first angles match the start's, which may be beyond +-pi.
    angles = angles + 2 * torch.pi * torch.round((hinges - angles[0]) / (2 * torch.pi))
    return torch.cat((rotations.rotate(to_mount, pos - mount_pos), angles), -1)


def clipped_path(index: SceneIndex, reference: ObjectReference, start: Tensor) -> Tensor:
    """Return the carried path (T, 6), each joint clipped to its control range."""
    low, high = torch.from_numpy(index.ctrl_low)[:6], torch.from_numpy(index.ctrl_high)[:6]
    return carried_path(index, reference, start).clamp(low, high)


def feasible_path(index: SceneIndex, reference: ObjectReference, start: Tensor) -> Tensor:
    """Return base joint positions (T, 6), within the control ranges, that follow the motion.

    The grasp point is on target, or as near to it as the ranges allow. Joint ranges are not known
    here: they may end earlier (the third slide of D'Hand and D'Manus stops at -0.1 m, its control
    range is -0.3 to 0.5 m). The planner passes an index narrowed to both, see `pgdm.wrist.search`.

    With x the target position in the mount's frame, o the grasp point in the mount body's frame, a
    the three hinge angles and R(a) their rotation, the slides follow from the hinges:
    s(a) = x - R(a) o. Each step is a least-squares problem in a, bounded by the hinges' ranges,

        min  |s - clip(s)|^2 + |TURN_M log(R_carried^-1 R(a))|^2 + |0.003 (a - a_before)|^2

    in m and rad, where clip limits s to the slides' ranges. Position has priority over the carried
    orientation, and orientation over a small change since the previous step. The solver
    starts once from the previous step's hinges and once from the carried path's; the better result
    is kept.

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
                scipy.optimize.least_squares(
                    residual, begin.clip(low[3:], high[3:]), bounds=(low[3:], high[3:])
                )
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
"""Functions that compute a path, by the path's name in ``action.wrist_path``."""
