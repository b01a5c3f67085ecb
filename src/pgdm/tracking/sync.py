"""Rebuild MLflow from run folders: they are the truth, it is a mirror."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pgdm.errors import RunError, TrackingError
from pgdm.tracking.mlflow import (
    PARENT_TAG,
    STATUS,
    SYNCED,
    Mirror,
    Store,
    find_run,
    store_uri,
)
from pgdm.tracking.run_folder import RunFolder, find_runs
from pgdm.tracking.run_log import metrics_of
from pgdm.tracking.thin import Point, points

if TYPE_CHECKING:
    from mlflow.entities import Run

EXPERIMENT = "pgdm"
"""Where runs go whose configuration names no experiment."""

History = dict[str, dict[int, float]]
"""Metric to value at each step."""


@dataclass(frozen=True)
class Synced:
    """What was done about one run."""

    folder: RunFolder
    action: str
    """``created``, ``completed``, ``rebuilt``, ``unchanged``, ``running`` or ``unreadable``."""
    reason: str = ""


def sync(
    root: Path, uri: str | None = None, notify: Callable[[Synced], None] = lambda _: None
) -> list[Synced]:
    """Make MLflow show every run of a folder as its own records do.

    Doing it again changes nothing. A run that goes on is left to its own process; a run whose
    records MLflow contradicts is made anew there, and the wrong one moved to MLflow's trash.

    Args:
        root: folder of runs.
        uri: store to fill; None: the one in a run's configuration, or ``mlflow.db`` in ``root``.
        notify: told of each run.

    Raises:
        TrackingError: if a store cannot be used.
    """
    from mlflow.exceptions import MlflowException

    stores: dict[tuple[str, str], Store] = {}
    done = []
    for folder in find_runs(root):
        try:
            place = uri or folder.setting("tracking.uri") or store_uri(root)
            key = (str(place), str(folder.setting("tracking.experiment") or EXPERIMENT))
            if key not in stores:
                stores[key] = Store.open(*key)
            outcome = sync_run(stores[key], folder)
        except RunError as error:
            outcome = Synced(folder, "unreadable", str(error))
        except (MlflowException, OSError) as error:
            reason = (str(error).splitlines() or [type(error).__name__])[0]
            raise TrackingError(f"MLflow at {place}, run {folder.path}: {reason}") from error
        notify(outcome)
        done.append(outcome)
    return done


def sync_run(store: Store, folder: RunFolder) -> Synced:
    """Make MLflow show one run as its own records do."""
    run = find_run(store, folder)
    status = folder.status()
    if run is not None and status == "running":
        return Synced(folder, "running")
    fingerprint = folder.fingerprint()
    action = "created" if run is None else "completed"
    wanted = points(folder, folder.log.read())
    if run is not None and _complete(run, folder, fingerprint):
        action, wanted = "unchanged", []
    elif run is not None:
        there = history(store, run)
        if _contradicts(there, folder):
            store.client.delete_run(run.info.run_id)
            run, action = None, "rebuilt"
        else:
            wanted = lacking(wanted, there)
    mirror = Mirror(store, folder, run)
    mirror.log(wanted)
    if run is None:
        mirror.posters()
    if action != "unchanged":
        mirror.link({})
        mirror.describe({SYNCED: fingerprint})
        mirror.set_status(status, folder.modified())
    mirror.artifacts()
    return Synced(folder, action)


def _complete(run: Run, folder: RunFolder, fingerprint: str) -> bool:
    """Return whether a run has all records of a folder, its status and its parent."""
    tags, parent = run.data.tags, folder.parent().get("run_id")
    nested = parent in (None, tags.get(PARENT_TAG))
    told = run.info.status == STATUS[folder.status()]
    return nested and told and tags.get(SYNCED) == fingerprint


def history(store: Store, run: Run) -> History:
    """Return what a run shows: the last value of each metric at each step."""
    found: History = {}
    for name in run.data.metrics:
        entries = store.client.get_metric_history(run.info.run_id, name)
        found[name] = {e.step: e.value for e in sorted(entries, key=lambda e: e.timestamp)}
    return found


def lacking(wanted: list[Point], there: History) -> list[Point]:
    """Return the points without the metrics that are there."""
    return [
        (step, at, {name: value for name, value in m.items() if step not in there.get(name, {})})
        for step, at, m in wanted
    ]


def _contradicts(there: History, folder: RunFolder) -> bool:
    """Return whether MLflow shows something that the run's records do not say."""
    truth = {
        (name, int(record["frames"])): value
        for record in folder.log.read()
        for name, value in metrics_of(record).items()
    }
    return any(
        truth.get((name, step)) != value
        for name, steps in there.items()
        for step, value in steps.items()
    )
