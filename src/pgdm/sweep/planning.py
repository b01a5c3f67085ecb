"""Turn composed settings into a plan; every job is checked before any starts."""

from __future__ import annotations

import dataclasses
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pgdm import paths
from pgdm.config.compose import checked
from pgdm.config.schema import ExperimentCfg
from pgdm.errors import ConfigError, check_at_least
from pgdm.library.progress import StepProgress, silent
from pgdm.sweep.expand import Composed
from pgdm.sweep.plan import Job, Plan, SweepCfg, job_key
from pgdm.sweep.studies import NOT_IN_A_NAME
from pgdm.tracking import located


def make_plan(
    composed: Sequence[Composed],
    sweep: SweepCfg,
    name: str,
    command: str,
    progress: StepProgress = silent,
) -> tuple[Plan, list[str]]:
    """Check the settings of every job, and return the plan and notes for the user.

    Args:
        composed: overrides and settings of each job.
        sweep: settings of the sweep.
        name: name of the sweep if ``sweep.name`` is null.
        command: the command line as typed.
        progress: called with the number of jobs checked so far.

    Raises:
        ConfigError: if the settings of the sweep or of a job are wrong, or jobs would share a run
            folder.
    """
    name = name if sweep.name is None else sweep.name
    paths.check_path_part("sweep.name", name)
    check_at_least("sweep.max_attempts", sweep.max_attempts, 1)
    folder = (paths.runs() / "sweeps" / name if sweep.dir is None else Path(sweep.dir)).absolute()
    jobs: dict[str, Job] = {}
    notes: list[str] = []
    stores: list[str] = []  # notes on the MLflow store, one per job
    for (overrides, settings), job_name in zip(composed, _names(composed), strict=True):
        cfg = _placed(_checked(settings, job_name), settings.get("run_dir"), folder)
        cfg = dataclasses.replace(cfg, tracking=located(cfg.tracking, stores.append))
        job = Job(job_key(cfg), job_name, overrides, cfg)
        progress("checking the runs", len(jobs) + len(notes), len(composed))
        if job.key in jobs:
            same = " ".join(jobs[job.key].overrides)
            notes.append(f"'{' '.join(overrides)}' repeats '{same}', and is left out")
        else:
            jobs[job.key] = job
    _check_folders(list(jobs.values()))
    return Plan(name, folder, tuple(jobs.values()), command), [*dict.fromkeys(stores), *notes]


def _names(composed: Sequence[Composed]) -> list[str]:
    """Return each job's name: task, the overrides that differ between jobs, and seed.

    Of the keys in ``NOT_IN_A_NAME``, a name has only task and seed.
    """
    given = [
        {key.lstrip("+"): value for key, _, value in (o.partition("=") for o in overrides)}
        for overrides, _ in composed
    ]
    typed = dict.fromkeys(key for one in given for key in one)
    varied = [key for key in typed if len({one.get(key) for one in given}) > 1]
    others = [key for key in varied if key.partition(".")[0] not in NOT_IN_A_NAME]
    names = []
    for one, (_, settings) in zip(given, composed, strict=True):
        # The settings are not checked yet: task and seed may be missing.
        task = settings.get("task")
        ends = {
            "task": task.get("id") if isinstance(task, dict) else None,
            "seed": settings.get("seed"),
        } | one
        keys = ["task", *(key for key in others if key in one), "seed"]
        names.append(" ".join(f"{key}={ends[key]}" for key in keys))
    return names


def _checked(settings: Mapping[str, Any], name: str) -> ExperimentCfg:
    try:
        return checked(settings)
    except ConfigError as error:
        raise ConfigError(f"{error} (in the run {name}; none was started)") from error


def _placed(cfg: ExperimentCfg, run_dir: str | None, folder: Path) -> ExperimentCfg:
    """Place a run in the folder of the sweep, unless the user has set ``run_dir``."""
    if run_dir is None:
        inner = Path(cfg.run_dir).relative_to("runs")  # the default run_dir
        return dataclasses.replace(cfg, run_dir=str(folder / "runs" / "-".join(inner.parts)))
    return dataclasses.replace(cfg, run_dir=str(Path(run_dir).absolute()))


def _check_folders(jobs: Sequence[Job]) -> None:
    used = Counter(job.cfg.run_dir for job in jobs)
    shared = [run_dir for run_dir, times in used.items() if times > 1]
    if shared:
        raise ConfigError(
            f"several of the runs would share run_dir '{shared[0]}' (none was started); leave "
            "run_dir out, or make it differ: run_dir=out/${seed}"
        )
