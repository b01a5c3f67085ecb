"""Reconcile a sweep's ledger and its records in MLflow with the run folders."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from pgdm.errors import ConfigError, RunError, SweepError
from pgdm.library.progress import Notify
from pgdm.runs.folder import RunFolder
from pgdm.sweep.ledger import FINISHED, INTERRUPTED, Ledger
from pgdm.sweep.mirror import SweepMirror
from pgdm.sweep.queue import Queue
from pgdm.sweep.status import PLAN, parent, run_ending, settle

if TYPE_CHECKING:  # these load the simulator and torch
    from pgdm.sweep.ledger import Ending
    from pgdm.sweep.plan import Job, Plan


def repaired(folder: Path, queue: Queue | None, notify: Notify) -> Ledger:
    """Return a sweep's ledger after correcting what killed processes left in it and in MLflow.

    A ledger that is missing or empty is rebuilt from the run folders. While a process on
    this machine drives the sweep, nothing else is changed: that process makes the corrections.

    Args:
        folder: folder of the sweep.
        queue: the sweep's jobs in Slurm; None queries Slurm anew.
        notify: called with a sentence if MLflow fails or may not be changed.

    Raises:
        SweepError: if the folder holds no sweep, or its files cannot be used.
    """
    if not (folder / PLAN).exists():
        raise SweepError(f"'{folder}' holds no sweep: it has no {PLAN}")
    ledger = Ledger(folder)
    if not ledger.entries():
        from pgdm.sweep.plan import read_plan

        recall(ledger, read_plan(folder))
    if parent(ledger) is not None:
        return ledger
    dead = [entry.run_dir for entry in settle(ledger, queue)]
    whole = all(state == FINISHED for state in ledger.states().values())
    SweepMirror.correct_all(ledger.folder, dead, FINISHED if whole else INTERRUPTED, notify)
    return ledger


def recall(ledger: Ledger, plan: Plan) -> None:
    """Add a plan's jobs to a ledger; for jobs without attempts, record what their folders hold.

    A folder that is in use or holds another run is ignored.
    """
    ledger.add(plan)
    jobs = {job.key: job for job in plan.jobs}
    for entry in ledger.entries():
        job, folder = jobs.get(entry.key), RunFolder(entry.run_dir)
        if job is None or entry.last is not None or folder.busy or not holds(job):
            continue
        ending = job_ending(job)
        ledger.recall(entry.key, folder.started(), folder.modified(), ending)
        ledger.set_states({entry.key: ending.state})


def job_ending(job: Job) -> Ending:
    """Return the status and progress of a job's run, from its folder."""
    return run_ending(Path(job.cfg.run_dir), job.cfg.total_frames, job.cfg.time_limit_min)


def holds(job: Job) -> bool:
    """Return whether a job's run folder holds the run of this job, and not another run."""
    from pgdm.config.saved import load_config
    from pgdm.sweep.plan import job_key

    try:
        return job_key(load_config(job.cfg.run_dir)) == job.key
    except (RunError, ConfigError):
        return False  # the job's worker reports what is wrong
