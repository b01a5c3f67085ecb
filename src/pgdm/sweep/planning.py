"""From composed settings to a plan: everything is checked here, before anything starts."""

from __future__ import annotations

import dataclasses
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from omegaconf import DictConfig, OmegaConf

from pgdm import paths
from pgdm.config.identity import default_run_dir
from pgdm.config.schema import ExperimentCfg
from pgdm.config.store import from_dict_config
from pgdm.errors import ConfigError
from pgdm.sweep.plan import Job, Plan, SweepCfg, job_key
from pgdm.sweep.studies import NOT_IN_A_NAME

Composed = tuple[tuple[str, ...], DictConfig]
"""Overrides of a job, and the settings that they lead to."""


def make_plan(
    composed: Sequence[Composed], sweep: SweepCfg, name: str, command: str
) -> tuple[Plan, list[str]]:
    """Check the settings of every job, and return the plan and what people should know of it.

    Args:
        composed: the jobs.
        sweep: settings of the sweep.
        name: its name if ``sweep.name`` has none.
        command: what was typed.

    Raises:
        ConfigError: if the settings of a job are wrong, or jobs would get into each other's way.
    """
    name = name if sweep.name is None else sweep.name
    if not re.fullmatch(r"\w[\w.+-]*", name):
        raise ConfigError(f"sweep.name '{name}' is no name for a folder; use letters, digits, _.+-")
    if sweep.max_attempts < 1:
        raise ConfigError(f"sweep.max_attempts is {sweep.max_attempts}; it must be at least 1")
    folder = (paths.runs() / "sweeps" / name if sweep.dir is None else Path(sweep.dir)).absolute()
    jobs: dict[str, Job] = {}
    notes = []
    for (overrides, settings), job_name in zip(composed, _names(composed), strict=True):
        cfg = _placed(_checked(settings, job_name), folder)
        job = Job(job_key(cfg), job_name, overrides, cfg)
        if job.key in jobs:
            same = " ".join(jobs[job.key].overrides)
            notes.append(f"'{' '.join(overrides)}' would repeat '{same}', and is left out")
        else:
            jobs[job.key] = job
    _check_folders(list(jobs.values()))
    return Plan(name, folder, tuple(jobs.values()), command), notes


def _names(composed: Sequence[Composed]) -> list[str]:
    """Return what tells each job from the others, also from those of other commands."""
    given = [
        {key.lstrip("+"): value for key, _, value in (o.partition("=") for o in overrides)}
        for overrides, _ in composed
    ]
    typed = dict.fromkeys(key for one in given for key in one)
    varied = [key for key in typed if len({one.get(key) for one in given}) > 1]
    others = [key for key in varied if key.partition(".")[0] not in NOT_IN_A_NAME]
    names = []
    for one, (_, settings) in zip(given, composed, strict=True):
        # Not yet checked: there may be neither.
        ends = {
            "task": OmegaConf.select(settings, "task.id"),
            "seed": OmegaConf.select(settings, "seed"),
        } | one
        keys = ["task", *(key for key in others if key in one), "seed"]
        names.append(" ".join(f"{key}={ends[key]}" for key in keys))
    return names


def _checked(settings: DictConfig, name: str) -> ExperimentCfg:
    try:
        return from_dict_config(settings)
    except ConfigError as error:
        raise ConfigError(f"{error} (in the run {name}; none was started)") from error


def _placed(cfg: ExperimentCfg, folder: Path) -> ExperimentCfg:
    """Give a run its place in the folder of the sweep, unless it was given one."""
    default = default_run_dir(cfg)
    if cfg.run_dir == default:
        inner = Path(default).relative_to("runs")
        return dataclasses.replace(cfg, run_dir=str(folder / "runs" / "-".join(inner.parts)))
    return dataclasses.replace(cfg, run_dir=str(Path(cfg.run_dir).absolute()))


def _check_folders(jobs: Sequence[Job]) -> None:
    used = Counter(job.cfg.run_dir for job in jobs)
    shared = [run_dir for run_dir, times in used.items() if times > 1]
    if shared:
        raise ConfigError(
            f"several of the runs would share run_dir '{shared[0]}' (none was started); leave "
            "run_dir out, or make it differ: run_dir=out/${seed}"
        )
