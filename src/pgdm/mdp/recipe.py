"""A Recipe is the named, weighted list of an MDP's terms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from torch import Tensor

from pgdm.mdp.context import StepContext
from pgdm.mdp.metrics import MetricsCfg


@dataclass(frozen=True)
class RewardTerm:
    """A reward term and its weight."""

    name: str
    weight: float
    value: Callable[[StepContext], Tensor]  # -> (n,) before weighting


@dataclass(frozen=True)
class EndTerm:
    """A reason for an episode to terminate."""

    name: str
    reached: Callable[[StepContext], Tensor]  # -> (n,) bool


@dataclass(frozen=True)
class Recipe:
    """Everything about an MDP that a method may choose."""

    rewards: tuple[RewardTerm, ...]
    ends: tuple[EndTerm, ...]
    metrics: MetricsCfg
    schedules: tuple[Callable[[int], dict[str, float]], ...] = ()
    """From environment steps so far to reward weights by term name, asked before each iteration."""

    def table(self) -> list[tuple[str, str, str]]:
        """Return what is active as rows (kind, name, weight), for people to read."""
        rows = [("reward", term.name, f"{term.weight:g}") for term in self.rewards]
        return rows + [("end", term.name, "") for term in self.ends]
