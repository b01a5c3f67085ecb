"""A Recipe is the named, weighted list of an MDP's terms."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from torch import Tensor

from pgdm.errors import ConfigError
from pgdm.mdp.context import StepContext
from pgdm.mdp.metrics import MetricsCfg

_NEVER = 10**15
"""Frames by which any schedule has come to its end."""
_TRAINING_ONLY = ", training only"


@dataclass(frozen=True)
class RewardTerm:
    """A reward term and its weight."""

    name: str
    weight: float
    value: Callable[[StepContext], Tensor]  # -> (n,) before weighting
    shaping: bool = False
    """Whether it is paid in trainings only, and no part of the task's own return."""


@dataclass(frozen=True)
class EndTerm:
    """A reason for an episode to terminate."""

    name: str
    reached: Callable[[StepContext], Tensor]  # -> (n,) bool


@dataclass(frozen=True)
class Measure:
    """Something that is recorded of every step, and acts on nothing."""

    name: str
    value: Callable[[StepContext], Tensor]  # -> (n,), NaN where it does not apply


@dataclass(frozen=True)
class Recipe:
    """Everything about an MDP that a method may choose."""

    rewards: tuple[RewardTerm, ...]
    ends: tuple[EndTerm, ...]
    metrics: MetricsCfg
    schedules: tuple[Callable[[int], dict[str, float]], ...] = ()
    """From environment steps so far to reward weights by term name, asked before each iteration."""

    measures: tuple[Measure, ...] = ()
    """Recorded for each episode as the mean over its steps, under their names."""
    discount: Callable[[StepContext], Tensor] | None = None
    """By how much the future counts less after a step, (n,) in [0, 1]; trainings only."""
    needs_expert: bool = False
    """Whether terms or measures compare with an expert's hand trajectory."""

    def __post_init__(self) -> None:
        """Check that terms can be told apart by their names.

        Raises:
            ConfigError: if not.
        """
        for terms in (self.rewards, self.ends, self.measures):
            names = [term.name for term in terms]
            twice = next((name for name in names if names.count(name) > 1), None)
            if twice is not None:
                raise ConfigError(
                    f"a recipe has the {type(terms[0]).__name__} '{twice}' twice; give each its "
                    "own name: under it, it is recorded"
                )

    def comparing(self, measures: tuple[Measure, ...]) -> Recipe:
        """Return it with measures that compare with an expert, beside those it has."""
        new = tuple(measure for measure in measures if measure not in self.measures)
        return replace(self, measures=(*self.measures, *new), needs_expert=True)

    def check(self, context: StepContext) -> None:
        """Check that every term gives one value a simulation.

        Raises:
            ConfigError: at the first one that does not.
        """
        values = {f"reward '{term.name}'": term.value(context) for term in self.rewards}
        values |= {f"end '{end.name}'": end.reached(context) for end in self.ends}
        values |= {f"measure '{m.name}'": m.value(context) for m in self.measures}
        if self.discount is not None:
            values["discount"] = self.discount(context)
        for name, value in values.items():
            if value.shape != context.t.shape:
                raise ConfigError(
                    f"the {name} of this method gives values of shape {tuple(value.shape)}; it "
                    f"must be one a simulation, {tuple(context.t.shape)}"
                )

    def unfinished(self, frames: int) -> list[tuple[str, float, float]]:
        """Return (name, weight, final weight) of rewards whose schedule outlasts so many frames."""
        last, final = self._scheduled(frames), self._scheduled(_NEVER)
        return [(name, last[name], w) for name, w in final.items() if last[name] != w]

    def table(self) -> list[tuple[str, str, str]]:
        """Return what is active as rows (kind, name, weight), for people to read."""
        first = self._scheduled(0)
        rows = [
            (
                f"reward{_TRAINING_ONLY if term.shaping else ''}",
                term.name,
                _weight(term.weight, first.get(term.name)),
            )
            for term in self.rewards
        ]
        if self.discount is not None:
            rows.append((f"discount{_TRAINING_ONLY}", "", ""))
        rows += [("end", end.name, "") for end in self.ends]
        return rows + [("measure", measure.name, "") for measure in self.measures]

    def _scheduled(self, frames: int) -> dict[str, float]:
        return {name: w for schedule in self.schedules for name, w in schedule(frames).items()}


def _weight(weight: float, first: float | None) -> str:
    return f"{weight:g}" if first is None else f"{weight:g}, scheduled from {first:g}"
