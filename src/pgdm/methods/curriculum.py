"""Task curriculum: a constant lift bonus, and tracking with a growing weight (paper, App. D)."""

from __future__ import annotations

from dataclasses import dataclass, replace

from pgdm.errors import check_above_zero
from pgdm.mdp.recipe import Recipe
from pgdm.mdp.schedules import Ramp
from pgdm.methods import pgdm
from pgdm.methods.pgdm import MethodCfg


@dataclass(frozen=True)
class RampCfg:
    """How the tracking term's weight grows."""

    ramp_frames: int
    """Duration of the weight's linear growth from 0, environment steps over all simulations."""

    def validate(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: if one is invalid.
        """
        check_above_zero("method.curriculum.ramp_frames", self.ramp_frames)


@dataclass(frozen=True)
class CurriculumCfg(MethodCfg):
    """Settings of PGDM and of the curriculum."""

    curriculum: RampCfg
    """The schedule."""


def add_curriculum(base: Recipe, cfg: RampCfg) -> Recipe:
    """Return the recipe with a tracking term that is ramped up over the first frames."""
    weight = next(term.weight for term in base.rewards if term.name == "tracking")
    return replace(base, schedules=(*base.schedules, Ramp("tracking", weight, cfg.ramp_frames)))


def recipe(cfg: CurriculumCfg) -> Recipe:
    """Return PGDM's terms and the schedule."""
    return add_curriculum(pgdm.recipe(cfg), cfg.curriculum)
