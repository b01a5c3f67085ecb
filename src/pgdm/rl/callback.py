"""Moments of a training that others can listen to."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pgdm.rl.trainer import Trainer


@dataclass(frozen=True)
class Progress:
    """How far a training has come."""

    frames: int
    """Environment steps so far, all simulations together."""
    total_frames: int
    """Where it ends."""
    iteration: int
    """Iterations (collect and learn) so far."""
    elapsed_s: float
    """Time spent on the training, s, all attempts together."""


class Callback:
    """Does nothing at each moment; override those of interest."""

    def on_start(self, trainer: Trainer) -> None:
        """Before the first step, of a fresh training or of one that goes on."""

    def on_iteration(self, progress: Progress, metrics: dict[str, float]) -> None:
        """After each iteration, with its ``train/`` metrics."""

    def on_evaluation(self, progress: Progress, metrics: dict[str, float]) -> None:
        """After each evaluation, with its ``eval_sampled/`` and ``eval_deterministic/`` metrics."""

    def on_checkpoint(self, progress: Progress, path: Path) -> None:
        """After each checkpoint file."""

    def on_end(self, progress: Progress, status: str) -> None:
        """Last of all; status is ``finished``, ``interrupted`` or ``failed``."""
