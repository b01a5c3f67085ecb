"""From the policy's output in [-1, 1] to actuator targets."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pgdm.errors import ConfigError, check_name
from pgdm.motion.reference import ObjectReference
from pgdm.sim.scene import SceneIndex
from pgdm.wrist.path import PATHS

# The released code's warm start bends wrist and fingers a little, and moves the second slide.
WARM_START_OFFSET = 0.2

KINDS = ("absolute", "residual")
PLANNED = "planned"
WRIST_PATHS = (PLANNED, *PATHS)


@dataclass(frozen=True)
class ActionCfg:
    """What an action means."""

    kind: str
    """``absolute``: joint position targets (the paper); ``residual``: the base follows the
    exemplar motion and the policy adds a correction."""
    lead_steps: int
    """Residual without a wrist plan: control steps by which the base's command leads the motion, to
    offset servo lag."""
    residual_scale: float
    """Residual: largest correction as a fraction of the half-range of each base joint (0..1)."""
    residual_power: float
    """Residual: power of the action's magnitude to which the correction is proportional; 1: the
    correction is linear, 2: small actions correct little, an action of 1 as much as before."""
    wrist_path: str
    """Residual: ``planned`` (see `pgdm.wrist.plan`), ``carried``, ``clipped`` or ``feasible`` (see
    `pgdm.wrist.path`)."""
    hold_steps: int
    """Only ``planned``: control steps for which the hand stays at its pre-grasp while the fingers
    close. The hand then catches up with the motion in as many steps."""

    carry_load: bool
    """Only ``planned``: whether the commands compensate for the object's weight once the motion
    lifts it."""

    @property
    def plans_wrist(self) -> bool:
        """Whether the base's commands are planned before training."""
        return self.kind == "residual" and self.wrist_path == PLANNED


@dataclass(frozen=True)
class WristPrior:
    """Targets of the b base joints at each step, which a residual action corrects; m and rad."""

    path: Tensor  # (T, b)
    lead_steps: int
    largest: Tensor  # (b,) correction at an action of 1
    power: float
    low: Tensor  # (b,) control range
    high: Tensor  # (b,)

    def targets(self, action: Tensor, t: Tensor) -> Tensor:
        """Return targets (n, b) for the base's part of an action, (n, b), at steps t (n,)."""
        ahead = self.path[(t + self.lead_steps).clamp(max=len(self.path) - 1)]
        if self.power != 1:
            action = action.sign() * action.abs() ** self.power
        return torch.clamp(ahead + self.largest * action, self.low, self.high)


@dataclass(frozen=True)
class ActionMap:
    """How actions become targets, and the action at which a policy's mean should start."""

    middle: Tensor  # (nu,) of each actuator's control range, m and rad
    half: Tensor  # (nu,) half-width of that range
    warm_start: Tensor  # (nu,) in [-1, 1]
    wrist: WristPrior | None = None

    def act(self, action: Tensor, t: Tensor) -> Tensor:
        """Return actuator targets (n, nu) float64, m and rad.

        Args:
            action: (n, nu), clipped to [-1, 1].
            t: (n,) steps since reset.
        """
        action = action.double().clamp(-1.0, 1.0)
        target = action * self.half + self.middle
        if self.wrist is not None:
            base = self.wrist.low.numel()
            target[:, :base] = self.wrist.targets(action[:, :base], t)
        return target


def _range(index: SceneIndex) -> tuple[Tensor, Tensor]:
    """Return middle and half-width of each actuator's control range, (nu,) m and rad."""
    low, high = torch.from_numpy(index.ctrl_low), torch.from_numpy(index.ctrl_high)
    return 0.5 * (high + low), 0.5 * (high - low)


def normalize(index: SceneIndex, qpos: Tensor) -> Tensor:
    """Return the absolute action (nu,) with the driven joints' positions as targets, clipped."""
    middle, half = _range(index)
    return ((qpos[index.driven] - middle) / half).clamp(-1.0, 1.0)


def _warm_start(index: SceneIndex, start: Tensor) -> Tensor:
    warm = normalize(index, start)
    warm[1] += WARM_START_OFFSET
    warm[index.num_base_joints :] += WARM_START_OFFSET
    return warm.clamp(-1.0, 1.0)


def _absolute(index: SceneIndex, start: Tensor) -> ActionMap:
    middle, half = _range(index)
    return ActionMap(middle, half, _warm_start(index, start))


def warm_targets(index: SceneIndex, start: Tensor) -> Tensor:
    """Return the actuator targets (nu,) of an absolute action map's warm start, m and rad."""
    middle, half = _range(index)
    return middle + half * _warm_start(index, start)


def _residual(
    cfg: ActionCfg,
    index: SceneIndex,
    reference: ObjectReference,
    start: Tensor,
    commands: Tensor | None,
) -> ActionMap:
    base = _absolute(index, start)
    n = index.num_base_joints
    if commands is None and cfg.wrist_path == PLANNED:
        raise ConfigError("action.wrist_path=planned needs the base commands of a wrist plan")
    if commands is None:
        path, lead = PATHS[cfg.wrist_path](index, reference, start), cfg.lead_steps
    else:  # planned commands already compensate for the servo lag
        path, lead = torch.cat((commands, commands[-1:])), 0
    low, high = torch.from_numpy(index.ctrl_low)[:n], torch.from_numpy(index.ctrl_high)[:n]
    largest = cfg.residual_scale * 0.5 * (high - low)
    warm = base.warm_start.clone()
    warm[:n] = 0.0
    prior = WristPrior(path, lead, largest, cfg.residual_power, low, high)
    return replace(base, warm_start=warm, wrist=prior)


def action_map(
    cfg: ActionCfg,
    index: SceneIndex,
    reference: ObjectReference,
    start: Tensor,
    commands: Tensor | None = None,
) -> ActionMap:
    """Return the configured map for a task that starts at qpos ``start``.

    Absolute (the paper): target = middle + half * a, with middle and half-width of each actuator's
    control range. Warm start (released code): the action whose targets are the start's joint
    positions, plus 0.2 on entry 1 and on every entry from 6 on, clipped to [-1, 1].

    Residual (pgdm's own): the same for the fingers; with the wrist path b, the base joints are
    commanded to b(min(t + lead_steps, T-1)) + residual_scale * half * sign(a) |a|^residual_power,
    clipped to their ranges. The commands of a wrist plan have no lead. The warm start is 0 for the
    base.

    Args:
        cfg: settings of the action.
        index: index of the scene.
        reference: the exemplar motion.
        start: qpos (nq,) at the start.
        commands: base targets of the wrist plan at each step, (T-1, 6) m and rad, if any.

    Raises:
        UnknownNameError: if there is no such kind or path.
        ConfigError: if the wrist path is ``planned`` and ``commands`` is missing.
    """
    check_name("action.wrist_path value", cfg.wrist_path, WRIST_PATHS)
    check_name("action kind", cfg.kind, KINDS)
    if cfg.kind == "absolute":
        return _absolute(index, start)
    return _residual(cfg, index, reference, start, commands)
