"""From the policy's numbers in [-1, 1] to actuator targets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pgdm.errors import UnknownNameError
from pgdm.motion.reference import ObjectReference
from pgdm.sim.scene import SceneIndex
from pgdm.wrist.path import PATHS

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
    wrist_path: str
    """Residual: ``carried``, ``clipped`` or ``feasible``; see `pgdm.wrist.path`."""


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


def residual(
    cfg: ActionCfg, index: SceneIndex, reference: ObjectReference, start: Tensor
) -> ActionMap:
    """Return the map in which the exemplar motion moves the wrist and the policy corrects it."""
    base = absolute(cfg, index, reference, start)
    n = index.num_base_joints
    path = PATHS[cfg.wrist_path](index, reference, start)
    low, high = torch.from_numpy(index.ctrl_low), torch.from_numpy(index.ctrl_high)
    reach = cfg.residual_scale * 0.5 * (high - low)[:n]

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
        UnknownNameError: if there is no such kind or path.
    """
    if cfg.wrist_path not in PATHS:
        raise UnknownNameError("action.wrist_path value", cfg.wrist_path, PATHS)
    if cfg.kind not in KINDS:
        raise UnknownNameError("action kind", cfg.kind, KINDS)
    return KINDS[cfg.kind](cfg, index, reference, start)
