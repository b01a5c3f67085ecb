"""The plan of a sweep: its jobs, each a checked experiment with a key and a run folder."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pgdm import files
from pgdm.config.foreign import check_method
from pgdm.config.identity import difference, identity, with_added_keys
from pgdm.config.schema import ExperimentCfg
from pgdm.config.strict import build
from pgdm.errors import (
    ConfigError,
    SweepError,
    amount,
    check_above_zero,
    check_at_least,
    check_name,
)
from pgdm.runs.files import write_json
from pgdm.sweep.ledger import run_dir_in
from pgdm.sweep.status import PLAN

FORMAT = 1


@dataclass(frozen=True)
class SweepCfg:
    """How a sweep is named, stored and driven."""

    name: str | None
    """Name of the sweep and of its folder; None derives it from the settings."""
    dir: str | None
    """Folder of the sweep; None is ``runs/sweeps/<name>``."""
    max_attempts: int
    """How many times a job is tried per start of the sweep before it counts as failed."""
    detach: bool
    """Run in the background, and return as soon as the sweep runs there."""
    dry_run: bool
    """Print the plan, and start nothing."""
    most_jobs: int
    """Maximum number of jobs of a sweep."""


@dataclass(frozen=True)
class LocalCfg:
    """How many jobs run side by side on this machine."""

    name: str
    """Which launcher this is: ``local``."""
    max_jobs: int
    """Most jobs at a time; 0: as many as cores and memory allow."""
    cores_per_job: int
    """Threads of each job whose ``num_threads`` is 0. If ``cores_per_job`` is 0, such a job gets
    the largest ``num_threads`` of any job or, if ``num_threads`` is 0 for all jobs, an equal share
    of the cores. Unless ``max_jobs`` is set, the number of jobs at a time is at most the number of
    cores divided by these threads."""
    memory_per_job_gb: float
    """Memory to allow for each job [GB]; not used if ``max_jobs`` is set."""


@dataclass(frozen=True)
class SlurmCfg:
    """What each job gets on a Slurm cluster."""

    name: str
    """Which launcher this is: ``slurm``."""
    partition: str | None
    """Partition; None: the cluster's default."""
    account: str | None
    """Account to charge; None: the user's default."""
    qos: str | None
    """Quality of service; None: the default."""
    constraint: str | None
    """Features that nodes must have; None: any node."""
    time_min: int
    """Time limit of a Slurm job [min]; the job saves shortly before the limit and is requeued."""
    cores_per_job: int
    """Cores of each job, and threads of a job that leaves ``num_threads`` at 0."""
    memory_per_job_gb: float
    """Memory of each job [GB]."""
    gpus_per_job: int
    """GPUs of each job."""
    gres: str | None
    """Other generic resources of each job, such as ``shard:1``."""
    array_parallelism: int
    """Most jobs at a time; 0: as many as Slurm lets run."""
    signal_delay_s: int
    """How long before the time limit a job is asked to save [s]."""
    poll_s: float
    """Time between two queries to Slurm, each for all jobs [s]."""
    setup: list[str]
    """Shell commands that run before each job."""
    additional_parameters: list[str]
    """Further options of sbatch, each ``NAME`` or ``NAME=VALUE``."""


LauncherCfg = LocalCfg | SlurmCfg
LAUNCHERS = {"local": LocalCfg, "slurm": SlurmCfg}

_LEAST_LOCAL = {"max_jobs": 0, "cores_per_job": 0}
_LEAST_SLURM = {
    **{"time_min": 1, "cores_per_job": 1, "signal_delay_s": 1, "poll_s": 1},
    **{"gpus_per_job": 0, "array_parallelism": 0},
}


def read_launcher(choice: str, settings: object) -> LauncherCfg:
    """Return the checked settings of a launcher.

    Args:
        choice: option chosen for ``hydra/launcher``.
        settings: composed settings of the launcher.

    Raises:
        ConfigError: if there is no such launcher, or a setting is wrong.
    """
    check_name("hydra/launcher of pgdm", choice, LAUNCHERS)
    cfg: LauncherCfg = build(LAUNCHERS[choice], settings, "hydra.launcher")
    for key, bound in (_LEAST_LOCAL if isinstance(cfg, LocalCfg) else _LEAST_SLURM).items():
        check_at_least(f"hydra.launcher.{key}", getattr(cfg, key), bound)
    check_above_zero("hydra.launcher.memory_per_job_gb", cfg.memory_per_job_gb)
    if not isinstance(cfg, LocalCfg) and cfg.signal_delay_s >= 60 * cfg.time_min:
        raise ConfigError(
            f"hydra.launcher.signal_delay_s is {cfg.signal_delay_s}, but the time limit "
            f"time_min is only {cfg.time_min} minutes; choose a longer time limit"
        )
    return cfg


@dataclass(frozen=True)
class Job:
    """One experiment of a sweep."""

    key: str
    """16 hex digits, a hash of the experiment's identity and ``total_frames``."""
    name: str
    """What distinguishes the job from the others, such as ``task=cup-pour1 seed=1``."""
    overrides: tuple[str, ...]
    """All overrides of the job, from which its settings can be composed again."""
    cfg: ExperimentCfg
    """The settings; ``cfg.run_dir`` is the run folder, absolute."""


@dataclass(frozen=True)
class Plan:
    """A sweep before it starts."""

    name: str
    """Name of the sweep."""
    folder: Path
    """Absolute folder of the sweep; holds ``plan.json``, ``ledger.sqlite``, ``logs/`` and runs."""
    jobs: tuple[Job, ...]
    """No two have the same key."""
    command: str
    """The command line as typed."""


def job_key(cfg: ExperimentCfg) -> str:
    """Return 16 hex digits, equal for experiments of equal identity and ``total_frames``."""
    # A key includes total_frames; an identity omits it: a longer run may resume a shorter one.
    whole = identity(cfg) | {"total_frames": cfg.total_frames}
    return hashlib.sha256(json.dumps(whole, sort_keys=True).encode()).hexdigest()[:16]


def record(plan: Plan) -> None:
    """Add the jobs of a plan to those in its ``plan.json``.

    Raises:
        SweepError: as for ``check_fits``.
    """
    jobs = {job.key: job for job in (*check_fits(plan), *plan.jobs)}
    write_plan(dataclasses.replace(plan, jobs=tuple(jobs.values())))


def check_fits(plan: Plan) -> tuple[Job, ...]:
    """Return the jobs already recorded in a plan's folder, checked for changed settings.

    Raises:
        SweepError: as for ``read_plan``, or if a job of the same name had other settings; the
            message lists the differences of the first such job.
    """
    if not (plan.folder / PLAN).exists():
        return ()
    known = read_plan(plan.folder).jobs
    before = {job.name: job for job in known}
    changed = [(before[j.name], j) for j in plan.jobs if j.key != before.get(j.name, j).key]
    if changed:
        (old, new), others = changed[0], len(changed) - 1
        whole = [("total_frames", old.cfg.total_frames, new.cfg.total_frames)]
        changes = difference(old.cfg, new.cfg) + [f"{k}: {a} -> {b}" for k, a, b in whole if a != b]
        if others:
            changes.append(f"other settings also in {amount(others, 'more job')}")
        raise SweepError(
            f"sweep '{plan.name}' in '{plan.folder}' was planned with other settings ({new.name}: "
            f"{'; '.join(changes)}); choose another sweep.name, or the settings it was planned with"
        )
    return known


def write_plan(plan: Plan) -> None:
    """Write ``plan.json`` into the folder of the sweep, atomically."""
    jobs = [
        {
            "key": job.key,
            "name": job.name,
            "overrides": list(job.overrides),
            "config": dataclasses.asdict(job.cfg) | {"run_dir": run_dir_in(plan.folder, job)},
        }
        for job in plan.jobs
    ]
    whole = {"format": FORMAT, "name": plan.name, "command": plan.command, "jobs": jobs}
    plan.folder.mkdir(parents=True, exist_ok=True)
    write_json(plan.folder / PLAN, whole)


def read_plan(folder: Path) -> Plan:
    """Read the plan of a sweep.

    Raises:
        SweepError: if the folder holds no sweep, or its plan is damaged or of another version.
    """
    folder = folder.absolute()
    with _opened(folder) as whole:
        jobs = tuple(_job(entry, folder) for entry in whole["jobs"])
        return Plan(whole["name"], folder, jobs, whole["command"])


def read_job(folder: Path, key: str) -> Job:
    """Read one job of a sweep's plan by its key.

    Raises:
        SweepError: as for ``read_plan``, or if the plan has no such job.
    """
    folder = folder.absolute()
    with _opened(folder) as whole:
        for entry in whole["jobs"]:
            if entry["key"] == key:
                return _job(entry, folder)
    raise SweepError(f"the plan of {folder} has no job {key}; run the sweep's command again")


@contextmanager
def _opened(folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the content of ``plan.json``; raise errors in it as a SweepError that explains them."""
    file = folder / PLAN
    try:
        whole = files.read_json(file)
        if whole["format"] != FORMAT:
            raise SweepError(
                f"{file} has the format of another pgdm version; choose another sweep.name"
            )
        yield whole
    except FileNotFoundError as error:
        raise SweepError(f"'{folder}' holds no sweep: it has no {PLAN}") from error
    except OSError as error:
        raise SweepError(f"cannot read {file}: {files.reason(error)}") from error
    except ConfigError as error:
        raise SweepError(
            f"{file} does not fit the settings of this pgdm ({error}); choose another sweep.name"
        ) from error
    except (ValueError, LookupError, TypeError) as error:
        raise SweepError(
            f"{file} is damaged ({error}); remove it, and plan the sweep again"
        ) from error


def _job(entry: Mapping[str, Any], folder: Path) -> Job:
    config = with_added_keys(entry["config"])
    check_method(config, str(folder / PLAN))
    cfg = build(ExperimentCfg, config | {"run_dir": str(folder / config["run_dir"])})
    return Job(entry["key"], entry["name"], tuple(entry["overrides"]), cfg)
