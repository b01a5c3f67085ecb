"""Events of a training run that callbacks receive."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pgdm.rl.trainer import Trainer


@dataclass(frozen=True)
class Progress:
    """How far a training run is."""

    frames: int
    """Environment steps so far, summed over all simulations."""
    total_frames: int
    """Environment steps after which the training is finished."""
    iteration: int
    """Iterations (collect and learn) so far."""
    elapsed_s: float
    """Time spent on the run, s, evaluations included, summed over all attempts."""


class Callback:
    """Does nothing on any event; override those of interest."""

    def on_start(self, trainer: Trainer) -> None:
        """Before the first step of a new or resumed run."""

    def on_iteration(self, progress: Progress, metrics: dict[str, float]) -> None:
        """After each iteration, with its ``train/`` metrics."""

    def on_evaluation(self, progress: Progress, metrics: dict[str, float]) -> None:
        """After each evaluation, with its ``eval_sampled/`` and ``eval_deterministic/`` metrics."""

    def on_checkpoint(self, progress: Progress, path: Path) -> None:
        """After each checkpoint is written to ``path``."""

    def on_end(self, progress: Progress, status: str) -> None:
        """At the very end; status is ``finished``, ``interrupted`` or ``failed``."""
