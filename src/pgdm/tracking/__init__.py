"""Record runs: in their own folder, which is the truth, and in MLflow, which mirrors it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from pgdm.errors import UnknownNameError
from pgdm.tracking.run_log import RunLog
from pgdm.tracking.tracker import NullTracker, Tracker, TrackingCfg

__all__ = ["TRACKERS", "NullTracker", "RunLog", "Tracker", "TrackingCfg", "build_tracker"]

Builder = Callable[[TrackingCfg, Path, Mapping[str, str]], Tracker]


def _mlflow(cfg: TrackingCfg, run_dir: Path, facts: Mapping[str, str]) -> Tracker:
    from pgdm.tracking.live import MlflowTracker

    return MlflowTracker(cfg, run_dir, facts)


TRACKERS: dict[str, Builder] = {"mlflow": _mlflow, "none": lambda *_: NullTracker()}
"""Kind of tracker to what builds it."""


def build_tracker(cfg: TrackingCfg, run_dir: Path, facts: Mapping[str, str]) -> Tracker:
    """Return the tracker that a configuration asks for.

    Args:
        cfg: which one, and where to.
        run_dir: the run's folder; ``config.yaml`` is in it.
        facts: what the configuration does not tell: ``asset_source`` and ``git`` (revision).

    Raises:
        UnknownNameError: if there is no such kind.
    """
    builder = TRACKERS.get(cfg.kind)
    if builder is None:
        raise UnknownNameError("tracking.kind", cfg.kind, TRACKERS)
    return builder(cfg, run_dir, facts)
