"""The recipe of an MDP: its named, weighted terms."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from numbers import Real

import torch
from torch import Tensor

from pgdm.errors import ConfigError
from pgdm.mdp.context import StepContext
from pgdm.mdp.metrics import MetricsCfg
from pgdm.paths import check_path_part

_NEVER = 10**15
"""Environment steps after which every schedule has reached its final weight."""
_TRAINING_ONLY = ", training only"


@dataclass(frozen=True)
class RewardTerm:
    """A reward term and its weight."""

    name: str
    weight: float
    value: Callable[[StepContext], Tensor]  # -> (n,) before weighting
    shaping: bool = False
    """Whether the term is used in training only and left out of the metric ``return``."""


@dataclass(frozen=True)
class EndTerm:
    """A reason for an episode to terminate."""

    name: str
    reached: Callable[[StepContext], Tensor]  # -> (n,) bool


@dataclass(frozen=True)
class Measure:
    """A quantity that is recorded at every step and has no effect on training."""

    name: str
    value: Callable[[StepContext], Tensor]  # -> (n,), NaN where not applicable


@dataclass(frozen=True)
class Recipe:
    """Everything that a method may choose in an MDP."""

    rewards: tuple[RewardTerm, ...]
    ends: tuple[EndTerm, ...]
    metrics: MetricsCfg
    schedules: tuple[Callable[[int], dict[str, float]], ...] = ()
    """Each maps environment steps so far to reward weights by term name; called per iteration."""

    measures: tuple[Measure, ...] = ()
    """Recorded under their names, averaged over the steps of an episode."""
    discount: Callable[[StepContext], Tensor] | None = None
    """Extra discount of the rewards after a step, (n,) in [0, 1]; in training only."""
    needs_expert: bool = False
    """Whether terms or measures compare the hand with an expert's."""

    def __post_init__(self) -> None:
        """Check that there are rewards and terminations, and that all terms are valid.

        Terms must have the right class, valid and distinct names, and finite weights.

        Raises:
            ConfigError: if rewards or terminations are missing, or at the first invalid term.
        """
        if not self.rewards or not self.ends:
            raise ConfigError("a recipe needs at least one reward and one termination")
        for kind, terms in (
            (RewardTerm, self.rewards),
            (EndTerm, self.ends),
            (Measure, self.measures),
        ):
            for term in terms:
                if not isinstance(term, kind):
                    raise ConfigError(f"a recipe has {term!r} where a {kind.__name__} is needed")
            names = [term.name for term in terms]
            for name in names:  # MLflow would reject an invalid one, after hours of training
                check_path_part(f"name of a {kind.__name__}", name)
            twice = next((name for name in names if names.count(name) > 1), None)
            if twice is not None:
                raise ConfigError(
                    f"a recipe has the {kind.__name__} '{twice}' twice; names must be "
                    "distinct, as terms are recorded under them"
                )
        for reward in self.rewards:
            if not isinstance(reward.weight, Real) or not math.isfinite(reward.weight):
                raise ConfigError(
                    f"the weight of the reward '{reward.name}' is {reward.weight!r}; it must be a "
                    "finite number"
                )

    def comparing(self, measures: tuple[Measure, ...]) -> Recipe:
        """Return the recipe with additional measures that compare the hand with an expert's."""
        new = tuple(measure for measure in measures if measure not in self.measures)
        return replace(self, measures=(*self.measures, *new), needs_expert=True)

    def check(self, context: StepContext) -> None:
        """Check that every term returns one value per simulation, terminations a bool.

        Raises:
            ConfigError: at the first term that does not.
        """
        terms: dict[str, Callable[[StepContext], Tensor]] = {
            **{f"reward '{term.name}'": term.value for term in self.rewards},
            **{f"termination '{end.name}'": end.reached for end in self.ends},
            **{f"measure '{m.name}'": m.value for m in self.measures},
            **({} if self.discount is None else {"discount": self.discount}),
        }
        for name, term in terms.items():
            value = _called(name, term, context)
            found = getattr(value, "shape", type(value).__name__)
            if not isinstance(value, Tensor) or found != context.t.shape:
                found = f"a {found}" if isinstance(found, str) else f"shape {tuple(found)}"
                raise ConfigError(
                    f"the {name} of this method returns {found}; it must be a tensor of one value "
                    f"per simulation, {tuple(context.t.shape)}"
                )
            if name.startswith("termination") and value.dtype != torch.bool:
                raise ConfigError(
                    f"the {name} of this method returns {value.dtype}; it must be torch.bool"
                )

    def unfinished(self, frames: int) -> list[tuple[str, float, float]]:
        """Return (name, weight, final weight) of rewards whose schedule outlasts ``frames``."""
        last, final = self._scheduled(frames), self._scheduled(_NEVER)
        return [(name, last[name], w) for name, w in final.items() if last[name] != w]

    def table(self) -> list[tuple[str, str, str]]:
        """Return all terms as rows of text: kind, name, weight; empty where a term has none."""
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
        rows += [("termination", end.name, "") for end in self.ends]
        return rows + [("measure", measure.name, "") for measure in self.measures]

    def _scheduled(self, frames: int) -> dict[str, float]:
        return {name: w for schedule in self.schedules for name, w in schedule(frames).items()}


def _called(name: str, term: Callable[[StepContext], Tensor], context: StepContext) -> Tensor:
    try:
        return term(context)
    except TypeError as error:
        if error.__traceback__ is not None and error.__traceback__.tb_next is not None:
            raise  # raised inside the term
        raise ConfigError(
            f"the {name} of this method cannot be called with a StepContext alone: {error}"
        ) from error


def _weight(weight: float, first: float | None) -> str:
    return f"{weight:g}" if first is None else f"{weight:g}, scheduled from {first:g}"
