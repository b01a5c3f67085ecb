"""Workers as jobs of a Slurm cluster: one array for all that are started together.

An attempt is one of Slurm's jobs. A worker that has to make room (its time is up, its node is
wanted) saves and has Slurm queue the same job again; what Slurm itself queues again, after a node
failed, goes on in the same way. So the attempt goes on as well, and needs no driver for it.
"""

from __future__ import annotations

import importlib
import os
import shutil
import signal
import sys
from collections.abc import Sequence
from typing import Any

from pgdm.errors import SweepError
from pgdm.stop import STOPPED
from pgdm.sweep.launcher import Ended, Task
from pgdm.sweep.ledger import Attempt, Ledger
from pgdm.sweep.plan import Plan, SlurmCfg
from pgdm.sweep.queue import GONE, Queue, cancel
from pgdm.sweep.state import LOGS, log_path

_OUTPUT = "slurm"
"""Folder among the logs with what submitit needs, and what Slurm's jobs print."""
_DISPLACED = ("PREEMPTED", "TIMEOUT")
_ITSELF = ("COMPLETED", "FAILED")
_SILENT_S = 3600.0
"""How long Slurm may not answer before the driver gives up."""


def check_slurm() -> None:
    """Check that there is a Slurm to talk to.

    Raises:
        SweepError: if not.
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
        name: of the array in Slurm.
        at_once: how many of it may run at a time.
    """
    more = [option.partition("=") for option in cfg.additional_parameters]
    return {
        "job_name": name,
        "partition": cfg.partition,
        "account": cfg.account,
        "qos": cfg.qos,
        "constraint": cfg.constraint,
        "time": cfg.time_min,
        "cpus_per_task": cfg.cores_per_job,
        "mem": f"{round(cfg.memory_per_job_gb * 1024)}MB",
        "gpus_per_node": cfg.gpus_per_job or None,
        "gres": cfg.gres,
        "array_parallelism": at_once,
        "signal_delay_s": cfg.signal_delay_s,
        "setup": cfg.setup or None,
        "stderr_to_stdout": True,
        "wckey": None,
        # Since Slurm 22.05 srun no longer takes this over from sbatch, and would give one core.
        "srun_args": [f"--cpus-per-task={cfg.cores_per_job}"],
        "additional_parameters": {"requeue": True} | {k: v or True for k, _, v in more},
    }


class SlurmLauncher:
    """Starts workers as Slurm's jobs; as ``Launcher`` says.

    Args:
        plan: the jobs.
        cfg: what each gets.
    """

    tick_s, stays = 1.0, True

    def __init__(self, plan: Plan, cfg: SlurmCfg) -> None:
        self._plan, self._cfg, self._ledger = plan, cfg, Ledger(plan.folder)
        self.slots = cfg.array_parallelism or len(plan.jobs)
        self.queue = Queue(cfg.poll_s)
        self._slurm_ids: dict[tuple[str, int], str] = {}

    def more(self, working: int) -> int:
        """Return how many jobs may be handed over: all, or none while Slurm has enough.

        Slurm holds the bound within an array; beside others, the driver has to.
        """
        return len(self._plan.jobs) if working < self.slots else 0

    def start(self, tasks: Sequence[Task]) -> None:
        """Hand one array over to Slurm."""
        from submitit import SlurmExecutor
        from submitit.core.utils import FailedJobError, FailedSubmissionError

        output = self._plan.folder / LOGS / _OUTPUT
        executor = SlurmExecutor(output)
        at_once = self.slots - len(self._slurm_ids)
        executor.update_parameters(**parameters(self._cfg, self._plan.name, at_once))
        folder, threads = str(self._plan.folder), str(self._cfg.cores_per_job)
        places = [(folder, t.job.key, str(t.number), threads) for t in tasks]
        try:
            jobs = executor.map_array(_work, places)
        except (FailedJobError, FailedSubmissionError) as error:
            raise SweepError(f"Slurm refused the jobs: {_reason(str(error))}") from error
        new = {task.id: job.job_id for task, job in zip(tasks, jobs, strict=True)}
        self._ledger.submitted(new)
        self._slurm_ids |= new
        for task, job in zip(tasks, jobs, strict=True):
            log = log_path(self._plan.folder, task.job.name, task.number)
            log.unlink(missing_ok=True)
            log.symlink_to(os.path.relpath(job.paths.stdout, log.parent))
        self.queue.forget()

    def adopt(self, task: Task, attempt: Attempt) -> bool:
        """Look after a job that is in Slurm already."""
        if attempt.slurm_id is None:
            return False
        self._slurm_ids[task.id] = attempt.slurm_id
        return True

    def ended(self, task: Task) -> Ended | None:
        """Return how one of Slurm's jobs ended.

        Raises:
            SweepError: if Slurm has not answered for long.
        """
        slurm_id = self._slurm_ids[task.id]
        found = self.queue.find(slurm_id)
        if self.queue.silent_s > _SILENT_S:
            raise SweepError(
                f"squeue has failed for {_SILENT_S / 60:.0f} minutes; start the same command again "
                "when Slurm is back: the jobs do not need this process"
            )
        if found.alive and not found.stuck:
            return None
        del self._slurm_ids[task.id]
        if found.stuck:
            cancel([slurm_id])
            return Ended(None, f"Slurm would never start its job {slurm_id}: {found.reason}")
        if found.state in _ITSELF:
            return Ended(found.exit_code, displaced=found.exit_code in STOPPED)
        if found.state == GONE:
            return Ended(None, f"Slurm knows nothing of its job {slurm_id}")
        why = f" ({found.reason})" if found.reason not in ("", "None") else ""
        error = f"ended by Slurm: job {slurm_id} is {found.state}{why}"
        return Ended(None, error, found.state in _DISPLACED)

    def ask(self, tasks: Sequence[Task]) -> None:
        """Have Slurm end jobs; those that run save."""
        cancel(self._slurm_ids[task.id] for task in tasks)

    def end(self, patience_s: float) -> None:
        """End nothing: Slurm's jobs go on by themselves."""
        del patience_s


def _reason(text: str) -> str:
    """Return what sbatch complains of."""
    lines = [line for line in text.splitlines() if line.startswith("sbatch: error: ")]
    return " ".join(line.removeprefix("sbatch: error: ") for line in lines) or text


def _work(place: tuple[str, ...]) -> None:
    """Be a worker; runs as one of Slurm's jobs."""
    from submitit import JobEnvironment

    # Until the run listens there is nothing to save. submitit would queue the job again without
    # saving, and logs signals wherever the program is, even half way through an import.
    for number in (signal.SIGUSR2, signal.SIGTERM, signal.SIGCONT):
        signal.signal(number, signal.SIG_IGN)
    # By its name, as on this machine: it lies above.
    worker = importlib.import_module("pgdm.cli.worker")
    # Slurm is told the truth: submitit would take any return for success.
    if code := worker.main([*place, JobEnvironment().job_id]):
        sys.exit(code)
