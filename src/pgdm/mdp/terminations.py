"""Terminations: reasons for an episode to terminate, one flag per simulation.

All are true terminal states: nothing is bootstrapped after them. Truncation (a diverged
simulation) is decided in `pgdm.envs.batch_env`.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pgdm.mdp.context import StepContext


@dataclass(frozen=True)
class TerminationCfg:
    """When an episode terminates early."""

    max_object_error_m: float
    """Distance of the object from its target at which the episode terminates, m."""


def object_lost(c: StepContext, max_error_m: float) -> Tensor:
    """Return e >= max_error_m, (n,) bool, with the object error e [m].

    Released code; the paper (Sec. III-A) terminates at e > omega.
    """
    return c.object_error >= max_error_m


def motion_ended(c: StepContext) -> Tensor:
    """Return t >= T-1, (n,) bool: the last pose of the motion was reached.

    Terminal in the released code; time is part of the observation.
    """
    return c.t >= c.last_t


def hand_lost(c: StepContext, space: str, form: str, max_error: float, grace_steps: int) -> Tensor:
    """Return d > max_error, (n,) bool, with the hand error d (DeepMimic; paper, App. D).

    False in the first ``grace_steps`` steps: in some mined pre-grasps d exceeds ``max_error``.
    ``space`` and ``form`` choose d, see `StepContext.hand_error`.
    """
    return (c.t > grace_steps) & (c.hand_error(space, form) > max_error)
