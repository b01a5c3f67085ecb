"""MLflow, which mirrors run folders."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from pgdm.errors import check_name
from pgdm.runs.folder import RunFolder
from pgdm.runs.tracker import NullTracker, Tracker
from pgdm.tracking.address import chosen

__all__ = ["TRACKERS", "NullTracker", "Tracker", "TrackingCfg", "located", "open_tracker"]


@dataclass(frozen=True)
class TrackingCfg:
    """Where a run is mirrored; the run folder is complete without the mirror."""

    kind: str
    """``mlflow`` or ``none``."""
    uri: str | None
    """Tracking server or database, such as ``http://host:5000`` or ``sqlite:////data/mlflow.db``;
    None: that of ``MLFLOW_TRACKING_URI``, else that of the run's sweep, else the file ``mlflow.db``
    in the folder of runs."""
    experiment: str
    """MLflow experiment that groups the runs."""


Facts = Mapping[str, Any]
Builder = Callable[[TrackingCfg, RunFolder, Facts], Tracker]


def _mlflow(cfg: TrackingCfg, folder: RunFolder, facts: Facts) -> Tracker:
    from pgdm.tracking.live import MlflowTracker

    return MlflowTracker(cfg, folder, facts)


TRACKERS: dict[str, Builder] = {"mlflow": _mlflow, "none": lambda *_: NullTracker()}
"""Kind of tracker to the function that builds it."""


def located(cfg: TrackingCfg, notify: Callable[[str], object]) -> TrackingCfg:
    """Return a configuration with the absolute address of the store that the user names, if any.

    Args:
        cfg: configuration as the user wrote it.
        notify: called with a sentence if the store is that of ``MLFLOW_TRACKING_URI``.

    Raises:
        ConfigError: if MLflow cannot use that store.
    """
    return (
        cfg if cfg.kind != "mlflow" else replace(cfg, uri=chosen(cfg.uri, "tracking.uri", notify))
    )


def open_tracker(cfg: TrackingCfg, folder: RunFolder, facts: Facts) -> Tracker:
    """Return the tracker that a configuration names.

    Args:
        cfg: kind of tracker, and its store.
        folder: the run, with its ``config.yaml`` and, when resumed, its earlier records.
        facts: values of `pgdm.runs.folder.FACTS` before there is a result; None where unknown.

    Raises:
        UnknownNameError: if there is no such kind.
    """
    check_name("tracking.kind", cfg.kind, TRACKERS)
    return TRACKERS[cfg.kind](cfg, folder, facts)
