"""Estimate the remaining time of a plan from its progress and the speed of earlier runs."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from pgdm.errors import RunError
from pgdm.library.progress import StepProgress, silent
from pgdm.runs.files import RESULT, read_json
from pgdm.runs.folder import RunFolder, find_runs
from pgdm.sweep.ledger import FINISHED
from pgdm.sweep.plan import Job, Plan
from pgdm.sweep.repair import job_ending

_NEWEST = 50
"""How many of the newest earlier runs to look at."""


@dataclass(frozen=True)
class Estimate:
    """The remaining work of a plan."""

    finished: int
    """Number of finished jobs."""
    begun: int
    """Number of jobs that were begun and will resume."""
    frames_left: int
    """Frames left, over all jobs."""
    steps_per_s: float
    """Training speed of one job, collection and learning included [frames/s]."""
    measured_runs: int
    """Number of earlier runs from which the speed is taken; 0 if it is assumed."""

    @property
    def hours(self) -> float:
        """Remaining time if the jobs run one after the other [h]."""
        return self.frames_left / self.steps_per_s / 3600


def estimate(plan: Plan, root: Path, progress: StepProgress = silent) -> Estimate:
    """Estimate the remaining work from the run folders of a plan and from earlier runs.

    Args:
        plan: the jobs.
        root: folder in which earlier runs are looked for.
        progress: called with the number of jobs looked at so far.
    """
    done = []
    for job in plan.jobs:
        progress("reading the jobs' run folders", len(done), len(plan.jobs))
        done.append(_frames_done(job))
    left = [max(0, job.cfg.total_frames - d) for job, d in zip(plan.jobs, done, strict=True)]
    speeds = _speeds(plan, root)
    return Estimate(
        finished=left.count(0),
        begun=sum(bool(d and n) for d, n in zip(done, left, strict=True)),
        frames_left=sum(left),
        steps_per_s=median(speeds or [job.cfg.algo.usual_steps_per_s for job in plan.jobs]),
        measured_runs=len(speeds),
    )


def _frames_done(job: Job) -> int:
    """Return the frames that a job has completed: ``total_frames`` only if it is finished."""
    total = job.cfg.total_frames
    try:
        found = job_ending(job)
    except RunError:  # the job's worker reports the error
        return 0
    return total if found.state == FINISHED else min(found.frames or 0, total - 1)


def _speeds(plan: Plan, root: Path) -> list[float]:
    """Return the speeds, in frames/s, of the earlier runs most similar to those of the plan."""
    runs = [run for run in find_runs(root) if (run.path / RESULT).exists()]
    runs.sort(key=lambda run: (run.path / RESULT).stat().st_mtime)
    rows = []
    for run in runs[-_NEWEST:]:
        speed = read_json(run.path / RESULT).get("steps_per_s")
        if isinstance(speed, int | float) and 0 < speed < math.inf:
            rows.append((_kind(run), float(speed)))
    kinds = {
        (j.cfg.algo.name, j.cfg.num_envs, j.cfg.device, j.cfg.action.kind, j.cfg.task.id)
        for j in plan.jobs
    }
    # Task and action kind may differ; algorithm, number of simulations and device may not.
    for length in (5, 4, 3):
        alike = {kind[:length] for kind in kinds}
        found = [speed for kind, speed in rows if kind[:length] in alike]
        if found:
            return found
    return []


def _kind(run: RunFolder) -> tuple[Any, ...]:
    try:
        keys = ("algo.name", "num_envs", "device", "action.kind", "task.id")
        return tuple(run.setting(key) for key in keys)
    except RunError:
        return ()
