"""What a plan will cost, from what is done already and how fast earlier runs were."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from pgdm.errors import RunError
from pgdm.sweep.ledger import FINISHED
from pgdm.sweep.plan import Job, Plan
from pgdm.sweep.state import stand
from pgdm.tracking.run_folder import RESULT, RunFolder, find_runs, read_json

_NEWEST = 50
"""So many earlier runs are asked at most."""


@dataclass(frozen=True)
class Estimate:
    """How much is left of a plan."""

    finished: int
    """Jobs that are finished."""
    begun: int
    """Jobs that were begun, and go on."""
    frames_left: int
    """Environment steps to do."""
    steps_per_s: float
    """Of one job at a time, collecting and learning."""
    measured_runs: int
    """Earlier runs that the speed was measured in; 0: it is assumed."""

    @property
    def hours(self) -> float:
        """Time for what is left, one job after the other [h]."""
        return self.frames_left / self.steps_per_s / 3600


def estimate(plan: Plan, root: Path) -> Estimate:
    """Look at the run folders of a plan, and at the earlier runs below a folder.

    Args:
        plan: the jobs.
        root: folder of runs.
    """
    done = [_frames_done(job) for job in plan.jobs]
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
    """Return how far a job is; at most its last frame but one as long as it has not ended well."""
    total = job.cfg.total_frames
    try:
        found = stand(Path(job.cfg.run_dir), total, job.cfg.time_limit_min)
    except RunError:  # starting it will tell
        return 0
    return total if found.state == FINISHED else min(found.frames or 0, total - 1)


def _speeds(plan: Plan, root: Path) -> list[float]:
    """Return the steps a second of the earlier runs that are most like the plan's."""
    runs = [run for run in find_runs(root) if (run.path / RESULT).exists()]
    runs.sort(key=lambda run: (run.path / RESULT).stat().st_mtime)
    rows = []
    for run in runs[-_NEWEST:]:
        speed = read_json(run.path / RESULT).get("steps_per_s")
        if isinstance(speed, int | float) and speed > 0:
            rows.append((_kind(run), float(speed)))
    kinds = {
        (j.cfg.algo.name, j.cfg.num_envs, j.cfg.device, j.cfg.action.kind, j.cfg.task.id)
        for j in plan.jobs
    }
    # The same task or not, but never another algorithm, width or device.
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
