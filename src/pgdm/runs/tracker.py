"""Trackers mirror a run folder elsewhere; `pgdm.tracking` has the one for MLflow."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from pathlib import Path


class Tracker(ABC):
    """A mirror of a run. Only ``log`` is mandatory.

    No method may block for long or raise because the mirror is unreachable: the run folder is the
    record, and the mirror can be rebuilt from it.
    """

    @abstractmethod
    def log(self, metrics: Mapping[str, float], frames: int) -> None:
        """Record metrics at a number of frames (control steps, all simulations together)."""

    def video(self, path: Path, poster: Path, frames: int) -> None:  # noqa: B027 (optional)
        """Keep an MP4 of the policy after ``frames``, and its poster picture."""

    def finish(self, status: str, patience_s: float = 60.0) -> None:  # noqa: B027 (optional)
        """Close the mirror with status ``finished``, ``interrupted`` or ``failed``.

        Called once, when nothing more is written to the run folder, so that its files can be
        copied. Must return within ``patience_s``.
        """


class NullTracker(Tracker):
    """Keeps nothing."""

    def log(self, metrics: Mapping[str, float], frames: int) -> None:
        """Do nothing."""
