"""Paths of the wrist along an exemplar motion: base joints at every step, by geometry alone."""

from __future__ import annotations

import numpy as np
import torch
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation
from torch import Tensor

from pgdm import rotations
from pgdm.motion.reference import ObjectReference
from pgdm.sim.scene import SceneIndex

TURN_M = 0.03
"""Metres off the path that count as much as a radian off the carried orientation."""
_STEADY_M = 0.003  # the same for a radian away from the step before, which keeps the path smooth


def carried_path(index: SceneIndex, reference: ObjectReference, start: Tensor) -> Tensor:
    """Return base joints (T, 6), m and rad, that carry the hand rigidly with the exemplar.

    With D = R(x_k) R(x_0)^-1 the mount's body goes to x_k + D (p_0 - x_0) and turns to D R_0
    (SPEC 7); three slides, then intrinsic X-Y-Z hinges, in the mount's frame. Joints may lie
    outside what the base can do.

    Args:
        index: of the scene.
        reference: the exemplar.
        start: qpos (nq,) at the start.
    """
    mount_pos, mount_quat = torch.from_numpy(index.mount_pos), torch.from_numpy(index.mount_quat)
    slides, hinges = start[:3], start[3 : index.num_base_joints]
    p0 = mount_pos + rotations.rotate(mount_quat, slides)
    r0 = rotations.multiply(mount_quat, rotations.from_euler_xyz(hinges))
    turn = rotations.multiply(reference.quat, rotations.conjugate(reference.quat[0]))
    pos = reference.pos + rotations.rotate(turn, (p0 - reference.pos[0]).expand_as(reference.pos))
    to_mount = rotations.conjugate(mount_quat)
    in_mount = rotations.multiply(to_mount, rotations.multiply(turn, r0))
    angles = rotations.unwrap(rotations.to_euler_xyz(in_mount))
    # Start on the branch of the start state itself, which may lie beyond +-pi.
    angles = angles + 2 * torch.pi * torch.round((hinges - angles[0]) / (2 * torch.pi))
    return torch.cat((rotations.rotate(to_mount, pos - mount_pos), angles), -1)


def clipped_path(index: SceneIndex, reference: ObjectReference, start: Tensor) -> Tensor:
    """Return the carried path (T, 6) with each joint brought into its control range."""
    low, high = torch.from_numpy(index.ctrl_low)[:6], torch.from_numpy(index.ctrl_high)[:6]
    return carried_path(index, reference, start).clamp(low, high)


def feasible_path(index: SceneIndex, reference: ObjectReference, start: Tensor) -> Tensor:
    """Return base joints (T, 6) within the control ranges that keep the grasp point on the path.

    The grasp point is where the object's centre of mass is at the start, fixed in the hand. Its
    position comes first, the orientation of the carried path second: one radian counts as much as
    ``TURN_M``. For given hinges the slides follow, so that each step is a bounded least-squares
    problem in three angles, begun where the step before ended.

    Args:
        index: of the scene.
        reference: the exemplar.
        start: qpos (nq,) at the start.
    """
    carried = carried_path(index, reference, start).numpy()
    low, high = index.ctrl_low[:6], index.ctrl_high[:6]
    mount = Rotation.from_quat(index.mount_quat, scalar_first=True)
    targets = mount.inv().apply(reference.pos.numpy() - index.mount_pos)  # in the mount's frame
    grasp = _turn(carried[0, 3:]).inv().apply(targets[0] - carried[0, :3])  # in the hand's
    path = np.empty_like(carried)
    hinges = carried[0, 3:].clip(low[3:], high[3:])
    for k, (target, wanted) in enumerate(zip(targets, carried[:, 3:], strict=True)):
        wanted_turn, before = _turn(wanted), hinges

        def slides(angles: np.ndarray, target: np.ndarray = target) -> np.ndarray:
            return target - _turn(angles).apply(grasp)

        def residual(
            angles: np.ndarray, turn: Rotation = wanted_turn, before: np.ndarray = before
        ) -> np.ndarray:
            needed = slides(angles)
            off = (turn.inv() * _turn(angles)).as_rotvec()
            outside = needed - needed.clip(low[:3], high[:3])
            return np.concatenate((outside, TURN_M * off, _STEADY_M * (angles - before)))

        # Beside the step before also the carried turn itself, so that it is never left for long.
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


def _turn(hinges: np.ndarray) -> Rotation:
    return Rotation.from_euler("XYZ", hinges)


PATHS = {"carried": carried_path, "clipped": clipped_path, "feasible": feasible_path}
"""By the name in ``action.wrist_path``."""
