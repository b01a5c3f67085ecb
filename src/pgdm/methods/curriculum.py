"""Task curriculum: first only the lift pays, then the tracking as well (P App., SPEC 3)."""

from __future__ import annotations

from dataclasses import dataclass, replace

from pgdm.mdp.recipe import Recipe
from pgdm.mdp.schedules import Ramp
from pgdm.methods import pgdm
from pgdm.methods.pgdm import MethodCfg, check_above_zero


@dataclass(frozen=True)
class RampCfg:
    """How the tracking term's weight grows."""

    ramp_frames: int
    """Environment steps over all simulations in which it goes from 0 to its value, linearly."""

    def validate(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: at the first one that cannot be right.
        """
        check_above_zero("method.curriculum.ramp_frames", self.ramp_frames)


@dataclass(frozen=True)
class CurriculumCfg(MethodCfg):
    """PGDM's settings and those of the curriculum."""

    curriculum: RampCfg
    """The schedule."""

    def validate(self) -> None:
        """Check the numbers; see ``MethodCfg``."""
        super().validate()
        self.curriculum.validate()


def add_curriculum(base: Recipe, cfg: RampCfg) -> Recipe:
    """Return a recipe whose tracking term comes in over the first frames of a training."""
    weight = next(term.weight for term in base.rewards if term.name == "tracking")
    return replace(base, schedules=(*base.schedules, Ramp("tracking", weight, cfg.ramp_frames)))


def recipe(cfg: CurriculumCfg) -> Recipe:
    """Return PGDM's terms and the schedule."""
    return add_curriculum(pgdm.recipe(cfg), cfg.curriculum)
