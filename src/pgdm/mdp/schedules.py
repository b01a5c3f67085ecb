"""Schedules: from environment steps so far to reward weights."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Ramp:
    """A reward term's weight that grows linearly from 0.

    It depends on the frames alone, so a training that was resumed, or that has another number of
    simulations, has the same weights at the same frames.
    """

    term: str
    """The term."""
    weight: float
    """Its weight from then on."""
    frames: int
    """Environment steps, over all simulations, until then."""

    def __call__(self, frames: int) -> dict[str, float]:
        """Return the weight after so many environment steps, by the term's name."""
        return {self.term: self.weight * min(1.0, frames / self.frames)}
