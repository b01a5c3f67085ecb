"""Where runs come from: folders, which are the truth, or an MLflow experiment."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import yaml

from pgdm import paths
from pgdm.errors import RunError, TrackingError
from pgdm.report.runs import METRICS, RETURN, Run, planned_run, read_run
from pgdm.tracking.mlflow import STATUS, connect, sqlite_file, store_uri
from pgdm.tracking.run_folder import (
    ARTIFACTS,
    CONFIG,
    FACTS,
    RESULT,
    RunFolder,
    find_runs,
    read_json,
    write_json,
)
from pgdm.tracking.run_log import FILE_NAME

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run as MlflowRun

PLAN = "plan.json"
"""What a sweep keeps of its jobs, in its folder."""
_PAGE = 1000

Progress = Callable[[str, int, int], None]
"""Told what is done now, how many of it are done, and of how many."""


@dataclass
class Found:
    """What there is to report on."""

    runs: list[Run] = field(default_factory=list)
    unreadable: dict[str, str] = field(default_factory=dict)
    """Folder to reason."""
    commands: list[str] = field(default_factory=list)
    """What was typed to start the sweeps, where that is known."""


def find(places: Sequence[str], uri: str | None, out: Path, progress: Progress) -> Found:
    """Read all runs of some folders and MLflow experiments.

    Args:
        places: folders, or names of experiments.
        uri: the MLflow store; None is the one in the folder of runs.
        out: where to put what MLflow has of runs whose folders are not here.
        progress: told how far it is.

    Raises:
        RunError: if there are none.
        TrackingError: if there is no such experiment.
    """
    found, folders = Found(), {}
    for place in places:
        if Path(place).is_dir():
            here = [*find_runs(Path(place)), *_planned(Path(place), found)]
        else:
            here = _of_experiment(place, uri or store_uri(paths.runs()), out, progress)
        folders |= {folder.path: folder for folder in here if folder.path not in folders}
    for number, folder in enumerate(folders.values()):
        progress("reading runs", number, len(folders))
        try:
            begun = (folder.path / CONFIG).exists()
            found.runs.append(read_run(folder) if begun else planned_run(folder))
        except RunError as error:
            found.unreadable[str(folder.path)] = str(error)
    if not folders:
        raise RunError(
            f"no runs in {' '.join(places)}; name a folder that holds some, such as "
            "`pgdm report runs`, or an MLflow experiment; `pgdm-run` makes runs"
        )
    return found


def _planned(root: Path, found: Found) -> Iterator[RunFolder]:
    """Return the runs of the sweeps in a folder, those that have not begun included."""
    for file in sorted(root.rglob(PLAN)):
        plan = read_json(file)
        found.commands += [str(plan["command"])] if plan.get("command") else []
        for config in (job["config"] for job in plan.get("jobs", []) if "config" in job):
            folder = RunFolder(file.parent / config["run_dir"])
            if not (folder.path / CONFIG).exists():
                folder.config = config
            yield folder


def _of_experiment(name: str, uri: str, out: Path, progress: Progress) -> list[RunFolder]:
    """Return the runs of an experiment: their own folders, or else what MLflow has of them."""
    file = sqlite_file(uri)
    if file is not None and not file.exists():
        raise RunError(
            f"there is no folder '{name}', and no MLflow store {file} to look for an experiment "
            "of that name; name a folder of runs, or the store with --uri"
        )
    from mlflow.exceptions import MlflowException

    try:
        client = connect(uri)
        experiment = client.get_experiment_by_name(name)
        if experiment is None:
            known = ", ".join(sorted(e.name for e in client.search_experiments()))
            raise TrackingError(
                f"'{name}' is neither a folder nor an MLflow experiment of {uri}, which has {known}"
            )
        runs = list(_all_runs(client, experiment.experiment_id))
        folders = []
        for number, run in enumerate(runs):
            progress("asking MLflow", number, len(runs))
            tags, own = run.data.tags, RunFolder(Path(run.data.tags["run_dir"]))
            # A folder of that name may be of another run, made on another machine.
            mine = tags.items() >= own.origin().items() or own.link.get("run_id") == run.info.run_id
            here = mine and (own.path / CONFIG).exists()
            folders.append(own if here else RunFolder(_copied(client, run, out / ARTIFACTS)))
    except MlflowException as error:
        raise TrackingError(f"MLflow at {uri}: {str(error).splitlines()[0]}") from error
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
    """Write what MLflow has of a run as a run folder."""
    folder, run_id = place / run.info.run_id, run.info.run_id
    folder.mkdir(parents=True, exist_ok=True)
    now = {key[4:]: text for key, text in run.data.tags.items() if key.startswith("now.")}
    config = _nested({**run.data.params, **now})
    (folder / CONFIG).write_text(yaml.safe_dump(config))
    lines: dict[tuple[str, int], dict[str, Any]] = {}
    for name in (*METRICS, RETURN):
        kind = "train" if name == RETURN else "eval"
        for entry in client.get_metric_history(run_id, name):
            header = {"frames": entry.step, "iteration": 0, "time_s": 0.0, "kind": kind}
            lines.setdefault((kind, entry.step), header)[name] = entry.value
    text = "".join(json.dumps(lines[key]) + "\n" for key in sorted(lines))
    (folder / FILE_NAME).write_text(text)
    status = next((ours for ours, theirs in STATUS.items() if theirs == run.info.status), "failed")
    (folder / RESULT).unlink(missing_ok=True)
    if status != "running":
        frames = max((step for _, step in lines), default=0)
        facts = {fact: run.data.tags[fact] for fact in FACTS if fact in run.data.tags}
        write_json(folder / RESULT, {"status": status, "frames": frames, **facts})
    (folder / "videos").mkdir(exist_ok=True)
    last = sorted(artifact.path for artifact in client.list_artifacts(run_id, "videos"))[-2:]
    for film in last:  # and its poster, which has its name
        there = Path(client.download_artifacts(run_id, film, str(folder)))
        there.replace(folder / "videos" / there.name)
    return folder


def _nested(flat: Mapping[str, str]) -> dict[str, Any]:
    """Return settings as ``run_folder.flatten`` had them before."""
    nested: dict[str, Any] = {}
    for key, text in flat.items():
        *parents, last = key.split(".")
        inner = nested
        for parent in parents:
            inner = inner.setdefault(parent, {})
        try:
            inner[last] = json.loads(text)
        except ValueError:
            inner[last] = text
    return nested
