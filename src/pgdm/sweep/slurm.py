"""Workers as jobs of a Slurm cluster: one job array for all that are started together.

An attempt is one Slurm job. A worker that is preempted or runs out of time saves and, if it
has made progress, has Slurm requeue the same job; after a node failure Slurm does so by itself. In
both cases the attempt continues without a driver.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
from collections.abc import Sequence
from typing import Any

from pgdm.errors import SweepError
from pgdm.stop import STOPPED
from pgdm.sweep.launcher import Assignment, Ended
from pgdm.sweep.ledger import Attempt, Ledger
from pgdm.sweep.plan import Plan, SlurmCfg
from pgdm.sweep.queue import GONE, Queue, cancel
from pgdm.sweep.status import LOGS, log_path

_OUTPUT = "slurm"
"""Folder inside the log folder with submitit's files and the output of Slurm's jobs."""
_PASSED_ON = ("partition", "account", "qos", "constraint", "gres", "signal_delay_s")
_DISPLACED = ("PREEMPTED", "TIMEOUT")
_EXITED = ("COMPLETED", "FAILED")
_SILENT_S = 3600.0
"""How long Slurm may be unreachable before the driver gives up."""


def check_slurm() -> None:
    """Check that Slurm is installed on this machine.

    Raises:
        SweepError: if sbatch, srun or squeue is not on PATH.
    """
    for name in ("sbatch", "srun", "squeue"):
        if shutil.which(name) is None:
            raise SweepError(
                f"hydra/launcher=slurm needs Slurm's {name}, which is not on PATH; start the sweep "
                "on a login node of the cluster, or choose hydra/launcher=local"
            )


def parameters(cfg: SlurmCfg, name: str, at_once: int) -> dict[str, Any]:
    """Return submitit's parameters of an array of jobs.

    Args:
        cfg: what each job gets.
        name: name of the array in Slurm.
        at_once: how many of the array's jobs may run at a time.
    """
    more = [option.partition("=") for option in cfg.additional_parameters]
    return {
        "job_name": name,
        **{key: getattr(cfg, key) for key in _PASSED_ON},
        "time": cfg.time_min,
        "cpus_per_task": cfg.cores_per_job,
        "mem": f"{round(cfg.memory_per_job_gb * 1024)}MB",
        "gpus_per_node": cfg.gpus_per_job or None,
        "array_parallelism": at_once,
        "setup": cfg.setup or None,
        "stderr_to_stdout": True,
        "wckey": None,
        # Since Slurm 22.05 srun does not inherit cpus_per_task from sbatch: it would give one core.
        "srun_args": [f"--cpus-per-task={cfg.cores_per_job}"],
        "additional_parameters": {"requeue": True} | {k: v or True for k, _, v in more},
    }


class SlurmLauncher:
    """Starts workers as Slurm's jobs; see ``Launcher``.

    Args:
        plan: the jobs.
        cfg: what each job gets.
        worker: command that starts a worker, see ``Front``.
    """

    tick_s, stays = 1.0, True

    def __init__(self, plan: Plan, cfg: SlurmCfg, worker: Sequence[str]) -> None:
        self._plan, self._cfg, self._worker = plan, cfg, worker
        self._ledger = Ledger(plan.folder)
        self.slots = cfg.array_parallelism or len(plan.jobs)
        self.queue = Queue(cfg.poll_s)
        self._slurm_ids: dict[tuple[str, int], str] = {}

    def more(self, working: int) -> int:
        """Return how many jobs may be submitted: all, or none if ``slots`` jobs are working.

        Slurm enforces that limit within an array, and this method across arrays.
        """
        return len(self._plan.jobs) if working < self.slots else 0

    def start(self, assignments: Sequence[Assignment]) -> None:
        """Submit the jobs as one array."""
        from submitit import SlurmExecutor
        from submitit.core.utils import FailedJobError, FailedSubmissionError

        output = self._plan.folder / LOGS / _OUTPUT
        executor = SlurmExecutor(output)
        at_once = self.slots - len(self._slurm_ids)
        executor.update_parameters(**parameters(self._cfg, self._plan.name, at_once))
        folder, threads = str(self._plan.folder), str(self._cfg.cores_per_job)
        commands = [(*self._worker, folder, t.job.key, str(t.number), threads) for t in assignments]
        try:
            jobs = executor.map_array(_become, commands)
        except (FailedJobError, FailedSubmissionError) as error:
            raise SweepError(f"Slurm refused the jobs: {_reason(str(error))}") from error
        new = {assignment.id: job.job_id for assignment, job in zip(assignments, jobs, strict=True)}
        self._ledger.submitted(new)
        self._slurm_ids |= new
        for assignment, job in zip(assignments, jobs, strict=True):
            log = log_path(self._plan.folder, assignment.job.name, assignment.number)
            log.unlink(missing_ok=True)
            log.symlink_to(os.path.relpath(job.paths.stdout, log.parent))
        self.queue.forget()

    def adopt(self, assignment: Assignment, attempt: Attempt) -> bool:
        """Follow a job that is in Slurm already; return False if the attempt has no Slurm job."""
        if attempt.slurm_id is None:
            return False
        self._slurm_ids[assignment.id] = attempt.slurm_id
        return True

    def ended(self, assignment: Assignment) -> Ended | None:
        """Return how one of Slurm's jobs exited; cancel a job that Slurm will never start.

        Raises:
            SweepError: if Slurm has been unreachable for an hour.
        """
        slurm_id = self._slurm_ids[assignment.id]
        found = self.queue.find(slurm_id)
        if self.queue.silent_s > _SILENT_S:
            raise SweepError(
                f"squeue has failed for {_SILENT_S / 60:.0f} minutes; run the same command again "
                "when Slurm is back (the jobs do not need this process)"
            )
        if found.alive and not found.stuck:
            return None
        del self._slurm_ids[assignment.id]
        if found.stuck:
            cancel([slurm_id])
            return Ended(None, f"Slurm will never start its job {slurm_id}: {found.reason}")
        if found.state in _EXITED:
            return Ended(found.exit_code, displaced=found.exit_code in STOPPED)
        if found.state == GONE:
            return Ended(None, f"Slurm has no job {slurm_id} any more")
        why = f" ({found.reason})" if found.reason not in ("", "None") else ""
        error = f"ended by Slurm: job {slurm_id} is {found.state}{why}"
        return Ended(None, error, found.state in _DISPLACED)

    def ask(self, assignments: Sequence[Assignment]) -> None:
        """Have Slurm cancel jobs; running ones save."""
        cancel(self._slurm_ids[assignment.id] for assignment in assignments)

    def end(self, patience_s: float) -> None:
        """Stop nothing: Slurm's jobs continue without a driver."""
        del patience_s


def _reason(text: str) -> str:
    """Return sbatch's error messages."""
    lines = [line for line in text.splitlines() if line.startswith("sbatch: error: ")]
    return " ".join(line.removeprefix("sbatch: error: ") for line in lines) or text


def _become(command: tuple[str, ...]) -> None:
    """Replace this process, a Slurm job, with a worker, so that Slurm sees its exit code."""
    from submitit import JobEnvironment

    # Ignore signals until the run handles them: before that there is nothing to save. submitit's
    # handlers would requeue the job without saving, and log even in the middle of an import.
    for number in (signal.SIGUSR2, signal.SIGTERM, signal.SIGCONT):
        signal.signal(number, signal.SIG_IGN)  # inherited by the worker
    sys.stdout.flush()
    sys.stderr.flush()
    os.execv(command[0], [*command, JobEnvironment().job_id])
