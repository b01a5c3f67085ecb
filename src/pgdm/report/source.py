"""Find runs in folders or in an MLflow experiment; a run folder takes precedence over MLflow."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from pgdm import files, paths
from pgdm.errors import RunError, TrackingError
from pgdm.library.progress import StepProgress, counted
from pgdm.report.runs import METRICS, RETURN, SHAPING, Run, planned_run, read_run
from pgdm.runs.files import (
    CONFIG,
    CONFIG_KINDS,
    LOG,
    RESULT,
    VIDEOS,
    fault,
    read_json,
    write_json,
)
from pgdm.runs.folder import ARTIFACTS, FACTS, RunFolder, find_runs
from pgdm.tracking.mlflow import STATUS, connect, one_line_errors, sqlite_file, store_uri

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run as MlflowRun

PLAN = "plan.json"
"""File of a sweep's folder that lists its jobs."""
_PAGE = 1000


@dataclass
class Found:
    """The runs to report on."""

    runs: list[Run] = field(default_factory=list)
    unreadable: dict[str, str] = field(default_factory=dict)
    """Why a run cannot be read, by its folder or by the plan file of its sweep."""
    commands: list[str] = field(default_factory=list)
    """Commands that started the sweeps, if known."""


def find(places: Sequence[str], uri: str | None, out: Path, progress: StepProgress) -> Found:
    """Read all runs of some folders and MLflow experiments.

    Args:
        places: folders, or names of MLflow experiments.
        uri: MLflow store; None: the store in the folder of runs.
        out: folder to which runs are copied from MLflow if this machine lacks their run folders.
        progress: called with the number of runs read so far.

    Raises:
        RunError: if there are no runs.
        TrackingError: if there is no such MLflow experiment.
    """
    found, folders = Found(), {}
    for place in places:
        if Path(place).is_dir():
            here = [*find_runs(Path(place)), *_planned(Path(place), found)]
        else:
            here = _of_experiment(place, uri or store_uri(paths.runs()), out, progress)
        folders |= {folder.path: folder for folder in here if folder.path not in folders}
    for folder in counted("reading runs", folders.values(), progress):
        try:
            begun = (folder.path / CONFIG).exists()
            found.runs.append(read_run(folder) if begun else planned_run(folder))
        except RunError as error:
            found.unreadable[str(folder.path)] = str(error)
    if not folders:
        raise RunError(
            f"no runs in {' '.join(places)}; name a folder that holds some, such as "
            "`pgdm report runs`, or an MLflow experiment; `pgdm-run` starts runs"
        )
    return found


def _planned(root: Path, found: Found) -> Iterator[RunFolder]:
    """Return the runs of the sweeps in a folder, including those that have not started."""
    for file in sorted(Path(f, PLAN) for f, _, names in files.walk(root) if PLAN in names):
        plan = read_json(file)
        found.commands += [str(plan["command"])] if plan.get("command") else []
        jobs = plan.get("jobs", [])
        for job in jobs if isinstance(jobs, list) else [jobs]:
            if isinstance(job, dict) and "config" not in job:
                continue
            config = job["config"] if isinstance(job, dict) else None
            if not isinstance(config, dict) or fault(config, {**CONFIG_KINDS, "run_dir": (str,)}):
                found.unreadable[str(file)] = "it is damaged; the sweep's command writes it again"
                continue
            folder = RunFolder(file.parent / config.get("run_dir", ""))
            if not (folder.path / CONFIG).exists():
                folder.config = config
            yield folder


def check_place(name: str, uri: str | None) -> None:
    """Check that a place is a folder, or that there is an MLflow store that may contain it.

    Raises:
        RunError: if there is neither a folder nor a store.
    """
    file = sqlite_file(uri or store_uri(paths.runs()))
    if not Path(name).is_dir() and file is not None and not file.exists():
        raise RunError(
            f"there is no folder '{name}', and no MLflow store {file} to look for an MLflow "
            "experiment of that name; name a folder of runs, or the store with --uri"
        )


def _of_experiment(name: str, uri: str, out: Path, progress: StepProgress) -> list[RunFolder]:
    """Return the runs of an MLflow experiment: their run folders, or copies made from MLflow."""
    check_place(name, uri)
    with one_line_errors(f"MLflow at {uri}"):
        client = connect(uri)
        experiment = client.get_experiment_by_name(name)
        if experiment is None:
            known = ", ".join(sorted(e.name for e in client.search_experiments()))
            raise TrackingError(
                f"'{name}' is neither a folder nor an MLflow experiment of {uri}, which has {known}"
            )
        runs = list(_all_runs(client, experiment.experiment_id))
        folders = []
        for run in counted("asking MLflow", runs, progress):
            tags, own = run.data.tags, RunFolder(Path(run.data.tags["run_dir"]))
            # A folder of that name may belong to another run, from another machine.
            mine = tags.items() >= own.origin().items() or own.link.get("run_id") == run.info.run_id
            here = mine and (own.path / CONFIG).exists()
            folders.append(own if here else RunFolder(_copied(client, run, out / ARTIFACTS)))
    return folders


def _all_runs(client: MlflowClient, experiment_id: str) -> Iterator[MlflowRun]:
    token = None
    while True:
        page = client.search_runs([experiment_id], max_results=_PAGE, page_token=token)
        for run in page:
            tags = run.data.tags
            if "run_dir" in tags and tags.get("kind") != "sweep":
                yield run
        token = page.token
        if not token:
            return


def _copied(client: MlflowClient, run: MlflowRun, place: Path) -> Path:
    """Write what MLflow has of a run as a run folder, and return it."""
    run_id = run.info.run_id
    folder = paths.inside(place, run_id, kind=f"the run id of {run.info.run_name!r} in MLflow")
    folder.mkdir(parents=True, exist_ok=True)
    now = {key[4:]: text for key, text in run.data.tags.items() if key.startswith("now.")}
    config = _nested({**run.data.params, **now})
    (folder / CONFIG).write_text(yaml.safe_dump(config))
    lines: dict[tuple[str, int], dict[str, Any]] = {}
    for name in (*METRICS, RETURN, SHAPING):
        kind = "train" if name in (RETURN, SHAPING) else "eval"
        for entry in client.get_metric_history(run_id, name):
            header = {"frames": entry.step, "iteration": 0, "time_s": 0.0, "kind": kind}
            lines.setdefault((kind, entry.step), header)[name] = entry.value
    text = "".join(json.dumps(lines[key]) + "\n" for key in sorted(lines))
    (folder / LOG).write_text(text)
    status = next((ours for ours, theirs in STATUS.items() if theirs == run.info.status), "failed")
    (folder / RESULT).unlink(missing_ok=True)
    if status != "running":
        frames = max((step for _, step in lines), default=0)
        facts = {fact: run.data.tags[fact] for fact in FACTS if fact in run.data.tags}
        write_json(folder / RESULT, {"status": status, "frames": frames, **facts})
    (folder / VIDEOS).mkdir(exist_ok=True)
    last = sorted(artifact.path for artifact in client.list_artifacts(run_id, VIDEOS))[-2:]
    for film in last:  # the last video, and its poster of the same name
        paths.inside(Path(), *Path(film).parts, kind="a file in MLflow")
        there = Path(client.download_artifacts(run_id, film, str(folder)))
        there.replace(folder / VIDEOS / there.name)
    return folder


def _nested(flat: Mapping[str, str]) -> dict[str, Any]:
    """Undo `pgdm.runs.config_file.dotted`."""
    nested: dict[str, Any] = {}
    for key, text in flat.items():
        *parents, last = key.split(".")
        inner = nested
        for parent in parents:
            below = inner.setdefault(parent, {})
            inner = below if isinstance(below, dict) else {}  # the parent key has a value as well
        try:
            inner[last] = files.parse_json(text.encode())
        except ValueError:
            inner[last] = text
    return nested
