"""From the policy's numbers in [-1, 1] to actuator targets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pgdm.errors import ConfigError, UnknownNameError
from pgdm.motion.reference import ObjectReference
from pgdm.sim.scene import SceneIndex
from pgdm.wrist.path import PATHS

Act = Callable[[Tensor, Tensor], Tensor]
"""Actions (n, nu) and steps since reset (n,) -> actuator targets (n, nu) float64, m and rad."""

# R, trainers/util: the warm start closes the fingers a little and lowers the wrist's second joint.
WARM_START_OFFSET = 0.2

PLANNED = "planned"
WRIST_PATHS = (PLANNED, *PATHS)


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
    """Residual: ``planned`` (see `pgdm.wrist.plan`), ``carried``, ``clipped`` or ``feasible`` (see
    `pgdm.wrist.path`)."""
    hold_steps: int
    """Only ``planned``: control steps for which the hand stays at its pre-grasp, so that the
    fingers can close, and then as many to catch up."""

    carry_load: bool
    """Only ``planned``: whether the commands compensate for the object's weight from when the
    exemplar lifts it."""

    @property
    def plans_wrist(self) -> bool:
        """Whether the wrist's commands are planned beforehand."""
        return self.kind == "residual" and self.wrist_path == PLANNED


@dataclass(frozen=True)
class ActionMap:
    """How actions become targets, and the action that a policy's mean should start from."""

    act: Act
    warm_start: Tensor  # (nu,) in [-1, 1]


_Kind = Callable[[ActionCfg, SceneIndex, ObjectReference, Tensor, Tensor | None], ActionMap]


def normalize(index: SceneIndex, qpos: Tensor) -> Tensor:
    """Return the action (nu,) whose absolute target is the robot's part of qpos (nq,), clipped."""
    low, high = torch.from_numpy(index.ctrl_low), torch.from_numpy(index.ctrl_high)
    joints = qpos[: index.num_actuators]
    return ((joints - 0.5 * (high + low)) / (0.5 * (high - low))).clamp(-1.0, 1.0)


def _warm_start(index: SceneIndex, start: Tensor) -> Tensor:
    warm = normalize(index, start)
    warm[1] += WARM_START_OFFSET
    warm[index.num_base_joints :] += WARM_START_OFFSET
    return warm.clamp(-1.0, 1.0)


def absolute(
    cfg: ActionCfg,
    index: SceneIndex,
    reference: ObjectReference,
    start: Tensor,
    commands: Tensor | None,
) -> ActionMap:
    """Return the paper's map: affine from [-1, 1] to each actuator's control range."""
    low, high = torch.from_numpy(index.ctrl_low), torch.from_numpy(index.ctrl_high)
    middle, half = 0.5 * (high + low), 0.5 * (high - low)
    warm = _warm_start(index, start)
    return ActionMap(lambda a, t: a.double().clamp(-1.0, 1.0) * half + middle, warm)


def warm_targets(index: SceneIndex, start: Tensor) -> Tensor:
    """Return the targets (nu,) at which an untrained policy holds the fingers; m and rad."""
    low, high = torch.from_numpy(index.ctrl_low), torch.from_numpy(index.ctrl_high)
    return 0.5 * (high + low) + 0.5 * (high - low) * _warm_start(index, start)


def residual(
    cfg: ActionCfg,
    index: SceneIndex,
    reference: ObjectReference,
    start: Tensor,
    commands: Tensor | None,
) -> ActionMap:
    """Return the map in which the exemplar motion moves the wrist and the policy corrects it."""
    base = absolute(cfg, index, reference, start, None)
    n = index.num_base_joints
    if commands is None and cfg.wrist_path == PLANNED:
        raise ConfigError("action.wrist_path=planned needs the commands of a plan")
    if commands is None:
        path, lead = PATHS[cfg.wrist_path](index, reference, start), cfg.lead_steps
    else:  # they know how the servos lag
        path, lead = torch.cat((commands, commands[-1:])), 0
    low, high = torch.from_numpy(index.ctrl_low), torch.from_numpy(index.ctrl_high)
    reach = cfg.residual_scale * 0.5 * (high - low)[:n]

    def act(a: Tensor, t: Tensor) -> Tensor:
        target = base.act(a, t)
        ahead = path[(t + lead).clamp(max=len(reference) - 1)]
        wrist = ahead + reach * a[:, :n].double().clamp(-1.0, 1.0)
        target[:, :n] = torch.clamp(wrist, low[:n], high[:n])
        return target

    warm = base.warm_start.clone()
    warm[:n] = 0.0
    return ActionMap(act, warm)


KINDS: dict[str, _Kind] = {
    "absolute": absolute,
    "residual": residual,
}


def action_map(
    cfg: ActionCfg,
    index: SceneIndex,
    reference: ObjectReference,
    start: Tensor,
    commands: Tensor | None = None,
) -> ActionMap:
    """Return the configured map for a task that starts in qpos ``start`` (nq,).

    Args:
        cfg: what an action means.
        index: of the scene.
        reference: the exemplar.
        start: qpos (nq,) at the start.
        commands: of the wrist at each step (T-1, 6), m and rad, if it is planned.

    Raises:
        UnknownNameError: if there is no such kind or path.
    """
    if cfg.wrist_path not in WRIST_PATHS:
        raise UnknownNameError("action.wrist_path value", cfg.wrist_path, WRIST_PATHS)
    if cfg.kind not in KINDS:
        raise UnknownNameError("action kind", cfg.kind, KINDS)
    return KINDS[cfg.kind](cfg, index, reference, start, commands)
