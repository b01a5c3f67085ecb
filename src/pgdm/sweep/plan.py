"""What a sweep is to do: its jobs, each a checked experiment with an identity and a folder."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pgdm.config.identity import difference, identity, with_added_keys
from pgdm.config.schema import ExperimentCfg
from pgdm.config.strict import build
from pgdm.errors import ConfigError, SweepError
from pgdm.tracking.run_folder import write_json

FILE = "plan.json"
"""The plan in the folder of its sweep."""
FORMAT = 1


@dataclass(frozen=True)
class SweepCfg:
    """How a sweep is named, kept and driven."""

    name: str | None
    """Name of the sweep and of its folder; None makes one from the settings."""
    dir: str | None
    """Folder of the sweep; None is ``runs/sweeps/<name>``."""
    max_attempts: int
    """How often a job is tried, each time the sweep is started, before it counts as failed."""
    detach: bool
    """Go on in the background, and return at once."""
    dry_run: bool
    """Print the plan, and start nothing."""


@dataclass(frozen=True)
class LocalCfg:
    """How many jobs run side by side on this machine."""

    name: str
    """Which launcher this is: ``local``."""
    max_jobs: int
    """Most jobs at a time; 0 is as many as cores and memory allow."""
    cores_per_job: int
    """Threads of each job; 0 divides the cores by the jobs."""
    memory_per_job_gb: float
    """Memory to reckon with for each job [GB]."""


@dataclass(frozen=True)
class SlurmCfg:
    """What each job gets on a Slurm cluster."""

    name: str
    """Which launcher this is: ``slurm``."""
    partition: str | None
    """None is the cluster's default."""
    account: str | None
    """Account to charge; None is the user's default."""
    qos: str | None
    """Quality of service; None is the default."""
    constraint: str | None
    """Features that nodes must have; None takes any node."""
    time_min: int
    """Time limit; at the limit a job saves, and goes on under the next one [min]."""
    cores_per_job: int
    """Cores, and threads, of each job."""
    memory_per_job_gb: float
    """Memory of each job [GB]."""
    gpus_per_job: int
    """GPUs of each job."""
    gres: str | None
    """Other generic resources of each job, such as ``shard:1``."""
    array_parallelism: int
    """Most jobs at a time; 0 is as many as Slurm lets run."""
    signal_delay_s: int
    """How long before the time limit a job is told to save [s]."""
    poll_s: float
    """Time between two questions to Slurm, one for all jobs [s]."""
    setup: list[str]
    """Shell commands before each job."""
    additional_parameters: list[str]
    """Further options of sbatch, each ``NAME`` or ``NAME=VALUE``."""


LauncherCfg = LocalCfg | SlurmCfg
LAUNCHERS = {"local": LocalCfg, "slurm": SlurmCfg}


@dataclass(frozen=True)
class Job:
    """One experiment of a sweep."""

    key: str
    """16 hex digits that follow from everything that changes the result."""
    name: str
    """What tells it from the others, such as ``task=cup-pour1 seed=1``."""
    overrides: tuple[str, ...]
    """All of its overrides, enough to make it again."""
    cfg: ExperimentCfg
    """The experiment; ``cfg.run_dir`` is its own folder, absolute."""


@dataclass(frozen=True)
class Plan:
    """A sweep before it starts."""

    name: str
    """Name of the sweep."""
    folder: Path
    """Folder of the sweep, absolute: ``plan.json``, ``ledger.sqlite``, ``logs/``, and its runs."""
    jobs: tuple[Job, ...]
    """What is to be done; no two have the same key."""
    command: str
    """What was typed."""


def job_key(cfg: ExperimentCfg) -> str:
    """Return 16 hex digits that two experiments share if they come to the same result."""
    # The length belongs to a result, though a longer run may go on in a shorter one's folder.
    whole = identity(cfg) | {"total_frames": cfg.total_frames}
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()[:16]


def record(plan: Plan) -> None:
    """Write ``plan.json`` with the jobs of a plan beside those that it has already.

    Raises:
        SweepError: as ``check_fits``.
    """
    jobs = {job.key: job for job in (*check_fits(plan), *plan.jobs)}
    write_plan(dataclasses.replace(plan, jobs=tuple(jobs.values())))


def check_fits(plan: Plan) -> tuple[Job, ...]:
    """Return the jobs that the folder of a plan has already; none of them may have changed.

    Raises:
        SweepError: if a job of the same name had other settings; the message is the difference.
    """
    if not (plan.folder / FILE).exists():
        return ()
    known = read_plan(plan.folder).jobs
    before = {job.name: job for job in known}
    changed = [(before[j.name], j) for j in plan.jobs if j.key != before.get(j.name, j).key]
    if changed:
        (old, new), others = changed[0], len(changed) - 1
        whole = [("total_frames", old.cfg.total_frames, new.cfg.total_frames)]
        changes = difference(old.cfg, new.cfg) + [f"{k}: {a} -> {b}" for k, a, b in whole if a != b]
        raise SweepError(
            f"sweep '{plan.name}' in '{plan.folder}' was made with other settings ({new.name}: "
            f"{'; '.join(changes)}{f'; {others} more differ too' if others else ''}); choose "
            "another sweep.name, or the settings it was made with"
        )
    return known


def write_plan(plan: Plan) -> None:
    """Write ``plan.json`` into the folder of the sweep, whole or not at all."""
    jobs = [
        {
            "key": job.key,
            "name": job.name,
            "overrides": list(job.overrides),
            "config": dataclasses.asdict(job.cfg) | {"run_dir": _shown(job.cfg.run_dir, plan)},
        }
        for job in plan.jobs
    ]
    whole = {"format": FORMAT, "name": plan.name, "command": plan.command, "jobs": jobs}
    plan.folder.mkdir(parents=True, exist_ok=True)
    write_json(plan.folder / FILE, whole)


def _shown(run_dir: str, plan: Plan) -> str:
    """Return a run's folder as the file names it, so that a sweep may be moved as a whole."""
    path = Path(run_dir)
    return str(path.relative_to(plan.folder) if path.is_relative_to(plan.folder) else path)


def read_plan(folder: Path) -> Plan:
    """Read the plan of a sweep.

    Raises:
        SweepError: if the folder holds no sweep, or its plan is damaged or of another version.
    """
    folder = folder.absolute()
    file = folder / FILE
    try:
        whole = json.loads(file.read_text(encoding="utf-8"))
        known = whole["format"] == FORMAT
        jobs = tuple(_job(entry, folder) for entry in whole["jobs"]) if known else ()
        plan = Plan(whole["name"], folder, jobs, whole["command"])
    except FileNotFoundError as error:
        raise SweepError(f"'{folder}' holds no sweep: it has no {FILE}") from error
    except ConfigError as error:
        raise SweepError(
            f"{file} was made by a pgdm with other settings ({error}); choose another sweep.name"
        ) from error
    except (ValueError, LookupError, TypeError) as error:
        raise SweepError(f"{file} is damaged ({error}); remove it to plan anew") from error
    if not known:
        raise SweepError(f"{file} has a format of another pgdm; choose another sweep.name")
    return plan


def _job(entry: Mapping[str, Any], folder: Path) -> Job:
    config = with_added_keys(entry["config"])
    cfg = build(ExperimentCfg, config | {"run_dir": str(folder / config["run_dir"])})
    return Job(entry["key"], entry["name"], tuple(entry["overrides"]), cfg)
