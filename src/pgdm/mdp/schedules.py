"""Schedules: from environment steps so far to reward weights."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Ramp:
    """A reward weight that grows linearly: weight * min(1, steps so far / frames).

    It depends on the environment steps alone, so a resumed run, or a run with another number of
    simulations, has the same weight after the same number of steps.
    """

    term: str
    """Name of the reward term."""
    weight: float
    """Final weight."""
    frames: int
    """Length of the ramp, environment steps over all simulations."""

    def __call__(self, frames: int) -> dict[str, float]:
        """Return the weight after ``frames`` environment steps, by the term's name."""
        return {self.term: self.weight * min(1.0, frames / self.frames)}
