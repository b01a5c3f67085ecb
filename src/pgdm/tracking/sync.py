"""Rebuild MLflow from run folders, which hold the complete records."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from pgdm.errors import ConfigError, RunError, TrackingError, amount
from pgdm.runs.folder import RunFolder, check_links, find_runs
from pgdm.runs.log import metrics_of
from pgdm.tracking.address import chosen
from pgdm.tracking.mlflow import (
    PARENT_TAG,
    STATUS,
    SYNCED,
    Mirror,
    Store,
    find_run,
    one_line_errors,
    store_uri,
)
from pgdm.tracking.thin import Point, points

if TYPE_CHECKING:
    from mlflow.entities import Run

EXPERIMENT = "pgdm"
"""MLflow experiment of runs whose configuration names none."""

_log = logging.getLogger(__name__)

History = dict[str, dict[int, float]]
"""Metric to value at each step."""


@dataclass(frozen=True)
class Synced:
    """What was done for one run."""

    folder: RunFolder
    action: str
    """``created``, ``completed``, ``rebuilt``, ``unchanged``, ``running``, ``unreadable``, or
    ``failed``: MLflow cannot be used."""
    reason: str = ""


def sync(
    root: Path, uri: str | None = None, notify: Callable[[Synced], None] = lambda _: None
) -> list[Synced]:
    """Make MLflow show every run below a folder as recorded in its run folder.

    A second call changes nothing. A running run is left to its own process, unless MLflow does not
    have it yet. If MLflow contradicts a run's records, its MLflow run is moved to MLflow's trash
    and created again.

    Args:
        root: folder of runs.
        uri: store to fill; None: that of ``MLFLOW_TRACKING_URI``, or ``mlflow.db`` in ``root``.
            A store named in a run's settings is ignored, since somebody else may have made the run.
        notify: called after each run; a run that cannot be synced does not stop the others.

    Raises:
        ConfigError: if ``uri`` or ``MLFLOW_TRACKING_URI`` is not an MLflow store.
        TrackingError: after all runs, if some could not be synced.
    """
    stores: dict[tuple[str, str], Store | TrackingError] = {}
    done, place = [], chosen(uri, "--uri", _log.warning) or store_uri(root)
    for folder in find_runs(root):
        try:
            check_links(folder.path)
            experiment = str(folder.setting("tracking.experiment") or EXPERIMENT)
            store = _opened(stores, place, experiment)
            with one_line_errors(f"MLflow at {place}, run {folder.path}"):
                outcome = sync_run(store, folder)
        except RunError as error:
            outcome = Synced(folder, "unreadable", str(error))
        except (ConfigError, TrackingError) as error:
            outcome = Synced(folder, "failed", str(error))
        notify(outcome)
        done.append(outcome)
    if failed := [one.reason for one in done if one.action == "failed"]:
        raise TrackingError(
            f"{len(failed)} of {amount(len(done), 'run')} could not be synced: {failed[0]}; "
            "pgdm runs sync --uri URI names another store"
        )
    return done


def _opened(stores: dict[tuple[str, str], Store | TrackingError], uri: str, name: str) -> Store:
    """Return a store, opened only once; an unreachable store is not tried again."""
    if (uri, name) not in stores:
        try:
            with one_line_errors(f"MLflow at {uri}"):
                stores[uri, name] = Store.open(uri, name)
        except TrackingError as error:
            stores[uri, name] = error
    found = stores[uri, name]
    if isinstance(found, TrackingError):
        raise found
    return found


def sync_run(store: Store, folder: RunFolder) -> Synced:
    """Make MLflow show one run as recorded in its folder."""
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
    """Return whether an MLflow run has all records of a folder, its status and its parent."""
    tags, parent = run.data.tags, folder.parent().get("run_id")
    nested = parent in (None, tags.get(PARENT_TAG))
    same_status = run.info.status == STATUS[folder.status()]
    return nested and same_status and tags.get(SYNCED) == fingerprint


def history(store: Store, run: Run) -> History:
    """Return the records of an MLflow run: the last value of each metric at each step."""
    found: History = {}
    for name in run.data.metrics:
        entries = store.client.get_metric_history(run.info.run_id, name)
        found[name] = {e.step: e.value for e in sorted(entries, key=lambda e: e.timestamp)}
    return found


def lacking(wanted: list[Point], there: History) -> list[Point]:
    """Return the points, each without those of its metrics that MLflow already has."""
    return [
        (step, at, {name: value for name, value in m.items() if step not in there.get(name, {})})
        for step, at, m in wanted
    ]


def _contradicts(there: History, folder: RunFolder) -> bool:
    """Return whether MLflow shows a value that is not in the run's records."""
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
