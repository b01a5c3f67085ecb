"""Record runs: in their own folder, which is the truth, and in MLflow, which mirrors it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from pgdm.errors import UnknownNameError
from pgdm.tracking.run_folder import RunFolder
from pgdm.tracking.run_log import RunLog
from pgdm.tracking.tracker import NullTracker, Tracker, TrackingCfg

__all__ = [
    "TRACKERS",
    "NullTracker",
    "RunFolder",
    "RunLog",
    "Tracker",
    "TrackingCfg",
    "open_tracker",
]

Facts = Mapping[str, Any]
Builder = Callable[[TrackingCfg, RunFolder, Facts], Tracker]


def _mlflow(cfg: TrackingCfg, folder: RunFolder, facts: Facts) -> Tracker:
    from pgdm.tracking.live import MlflowTracker

    return MlflowTracker(cfg, folder, facts)


TRACKERS: dict[str, Builder] = {"mlflow": _mlflow, "none": lambda *_: NullTracker()}
"""Kind of tracker to what builds it."""


def open_tracker(cfg: TrackingCfg, folder: RunFolder, facts: Facts) -> Tracker:
    """Return the tracker that a configuration asks for.

    Args:
        cfg: which one, and where to.
        folder: the run, with its ``config.yaml`` and, when resumed, the records it continues.
        facts: what the configuration does not tell, see ``run_folder.FACTS``; None where unknown.

    Raises:
        UnknownNameError: if there is no such kind.
    """
    builder = TRACKERS.get(cfg.kind)
    if builder is None:
        raise UnknownNameError("tracking.kind", cfg.kind, TRACKERS)
    return builder(cfg, folder, facts)
