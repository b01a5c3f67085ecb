"""What a run tells the outside world, and the tracker that tells nobody."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class TrackingCfg:
    """Where a run is mirrored to; its own folder is complete without it."""

    kind: str
    """``mlflow`` or ``none``."""
    uri: str | None
    """Tracking server or database, such as ``http://host:5000`` or ``sqlite:////data/mlflow.db``;
    None: a SQLite file ``mlflow.db`` in the folder of runs."""
    experiment: str
    """Name under which runs are grouped."""


class Tracker(ABC):
    """A mirror of a run. Only ``log`` is mandatory.

    No method may block for long or raise because the mirror is out of reach: the run's folder
    is the truth, and a mirror can be rebuilt from it.
    """

    @abstractmethod
    def log(self, metrics: Mapping[str, float], frames: int) -> None:
        """Record metrics at a number of frames (environment steps, all simulations together)."""

    def video(self, path: Path, poster: Path, frames: int) -> None:  # noqa: B027 (optional)
        """Keep an MP4 of the policy after ``frames`` and its poster picture."""

    def finish(self, status: str, patience_s: float = 60.0) -> None:  # noqa: B027 (optional)
        """Close the record with status ``finished``, ``interrupted`` or ``failed``.

        Called once, last of all, when the run's folder is complete (``result.json`` written):
        what of it is worth a copy is kept. Waits ``patience_s`` at most for what is under way.
        """


class NullTracker(Tracker):
    """Keeps nothing."""

    def log(self, metrics: Mapping[str, float], frames: int) -> None:
        """Do nothing."""
