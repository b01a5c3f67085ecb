"""From the policy's numbers in [-1, 1] to actuator targets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pgdm import rotations
from pgdm.errors import UnknownNameError
from pgdm.motion.reference import ObjectReference
from pgdm.sim.scene import SceneIndex

Act = Callable[[Tensor, Tensor], Tensor]
"""Actions (n, nu) and steps since reset (n,) -> actuator targets (n, nu) float64, m and rad."""

# R, trainers/util: the warm start closes the fingers a little and lowers the wrist's second joint.
WARM_START_OFFSET = 0.2


@dataclass(frozen=True)
class ActionCfg:
    """What an action means (SPEC 1 and 7)."""

    kind: str
    """``absolute``: joint targets (the paper); ``residual``: the wrist follows the motion and the
    policy corrects it."""
    lead_steps: int
    """Residual: steps by which the wrist's target runs ahead, against the servo's lag."""
    residual_scale: float
    """Residual: largest correction as a share of half the actuator's range (0..1)."""
    path_within_limits: bool
    """Residual: whether the wrist's path is brought into the actuators' ranges before it is
    corrected; otherwise no correction moves a joint whose path lies further outside than it
    reaches."""


@dataclass(frozen=True)
class ActionMap:
    """How actions become targets, and the action that a policy's mean should start from."""

    act: Act
    warm_start: Tensor  # (nu,) in [-1, 1]


def normalize(index: SceneIndex, qpos: Tensor) -> Tensor:
    """Return the action (nu,) whose absolute target is the robot's part of qpos (nq,), clipped."""
    low, high = torch.from_numpy(index.ctrl_low), torch.from_numpy(index.ctrl_high)
    joints = qpos[: index.num_actuators]
    return ((joints - 0.5 * (high + low)) / (0.5 * (high - low))).clamp(-1.0, 1.0)


def absolute(
    cfg: ActionCfg, index: SceneIndex, reference: ObjectReference, start: Tensor
) -> ActionMap:
    """Return the paper's map: affine from [-1, 1] to each actuator's control range."""
    low, high = torch.from_numpy(index.ctrl_low), torch.from_numpy(index.ctrl_high)
    middle, half = 0.5 * (high + low), 0.5 * (high - low)
    warm = normalize(index, start)
    warm[1] += WARM_START_OFFSET
    warm[index.num_base_joints :] += WARM_START_OFFSET
    return ActionMap(lambda a, t: a.double().clamp(-1.0, 1.0) * half + middle, warm.clamp(-1, 1))


def wrist_path(index: SceneIndex, reference: ObjectReference, start: Tensor) -> Tensor:
    """Return base joints (T, 6), m and rad, that carry the hand rigidly with the exemplar.

    With D = R(x_k) R(x_0)^-1 the mount's body goes to x_k + D (p_0 - x_0) and turns to D R_0
    (SPEC 7); three slides, then intrinsic X-Y-Z hinges, in the mount's frame.
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


def residual(
    cfg: ActionCfg, index: SceneIndex, reference: ObjectReference, start: Tensor
) -> ActionMap:
    """Return the map in which the exemplar motion moves the wrist and the policy corrects it."""
    base = absolute(cfg, index, reference, start)
    n = index.num_base_joints
    path = wrist_path(index, reference, start)
    low, high = torch.from_numpy(index.ctrl_low), torch.from_numpy(index.ctrl_high)
    reach = cfg.residual_scale * 0.5 * (high - low)[:n]
    if cfg.path_within_limits:
        path = torch.clamp(path, low[:n], high[:n])

    def act(a: Tensor, t: Tensor) -> Tensor:
        target = base.act(a, t)
        ahead = path[(t + cfg.lead_steps).clamp(max=len(reference) - 1)]
        wrist = ahead + reach * a[:, :n].double().clamp(-1.0, 1.0)
        target[:, :n] = torch.clamp(wrist, low[:n], high[:n])
        return target

    warm = base.warm_start.clone()
    warm[:n] = 0.0
    return ActionMap(act, warm)


KINDS: dict[str, Callable[[ActionCfg, SceneIndex, ObjectReference, Tensor], ActionMap]] = {
    "absolute": absolute,
    "residual": residual,
}


def action_map(
    cfg: ActionCfg, index: SceneIndex, reference: ObjectReference, start: Tensor
) -> ActionMap:
    """Return the configured map for a task that starts in qpos ``start`` (nq,).

    Raises:
        UnknownNameError: if there is no such kind.
    """
    if cfg.kind not in KINDS:
        raise UnknownNameError("action kind", cfg.kind, KINDS)
    return KINDS[cfg.kind](cfg, index, reference, start)
