"""Ends of an episode (SPEC 1, Reward and end): one flag a simulation."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from pgdm.mdp.context import StepContext


@dataclass(frozen=True)
class TerminationCfg:
    """When an episode ends early."""

    max_object_error_m: float
    """Distance of the object from its target at which the episode ends, m."""


def object_lost(c: StepContext, max_error_m: float) -> Tensor:
    """Return whether the object is ``max_error_m`` or more away from its target, (n,) bool."""
    return c.object_error >= max_error_m


def motion_ended(c: StepContext) -> Tensor:
    """Return whether the motion is over, (n,) bool: a true terminal in R, nothing follows it."""
    return c.t >= c.last_t


def hand_lost(c: StepContext, space: str, form: str, max_error: float, grace_steps: int) -> Tensor:
    """Return whether the hand is further than ``max_error`` from the expert's, (n,) bool.

    Never in the first ``grace_steps`` steps: some stored pre-grasps begin beyond the limit.
    ``space`` and ``form`` are those of `StepContext.hand_error`.
    """
    return (c.t > grace_steps) & (c.hand_error(space, form) > max_error)
