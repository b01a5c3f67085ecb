"""Workers on this machine: a process for each job, as many at a time as there is room for."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence, Set
from dataclasses import dataclass
from pathlib import Path

from pgdm.sweep.launcher import Ended, Task
from pgdm.sweep.ledger import Attempt
from pgdm.sweep.plan import LocalCfg, Plan
from pgdm.sweep.queue import Queue
from pgdm.sweep.state import log_path


@dataclass(frozen=True)
class Room:
    """How jobs share this machine."""

    slots: int
    """Jobs at a time."""
    threads: int
    """Of each job that does not say so itself."""


def room(plan: Plan, launcher: LocalCfg, cores: int, memory_gb: float) -> Room:
    """Return how the jobs of a plan share a machine.

    It follows from the whole plan, not from what is left of it.

    Args:
        plan: the jobs.
        launcher: limits.
        cores: of the machine.
        memory_gb: free memory, GB.
    """
    asked = launcher.cores_per_job or max((job.cfg.num_threads for job in plan.jobs), default=0)
    limits = [cores // max(asked, 1), int(memory_gb / launcher.memory_per_job_gb), len(plan.jobs)]
    if launcher.max_jobs:
        limits = [launcher.max_jobs, len(plan.jobs)]
    slots = max(1, min(limits))
    return Room(slots, asked or max(1, cores // slots))


def free_memory_gb() -> float:
    """Return how much memory new processes can have, GB."""
    lines = Path("/proc/meminfo").read_text().splitlines()
    fields = dict(line.split(":", 1) for line in lines)
    return int(fields["MemAvailable"].split()[0]) / 1e6


class LocalLauncher:
    """Starts workers on this machine; as ``Launcher`` says.

    Args:
        plan: the jobs.
        cfg: limits.
    """

    tick_s, stays = 0.2, False

    def __init__(self, plan: Plan, cfg: LocalCfg) -> None:
        shared = room(plan, cfg, len(os.sched_getaffinity(0)), free_memory_gb())
        self.slots, self._threads = shared.slots, shared.threads
        self._folder, self.queue = plan.folder, Queue()
        self._processes: dict[tuple[str, int], subprocess.Popen[bytes]] = {}
        self._asked: set[tuple[str, int]] = set()

    def more(self, working: int) -> int:
        """Return how many free places there are."""
        return self.slots - working

    def start(self, tasks: Sequence[Task]) -> None:
        """Start a process for each."""
        for task in tasks:
            place = [str(self._folder), task.job.key, str(task.number), str(self._threads)]
            with open(log_path(self._folder, task.job.name, task.number), "wb") as output:
                self._processes[task.id] = subprocess.Popen(
                    [sys.executable, "-m", "pgdm.cli.worker", *place],
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    start_new_session=True,  # Ctrl-C is for us: we ask the workers
                )

    def adopt(self, task: Task, attempt: Attempt) -> bool:
        """Refuse: only who has started a process learns how it ends."""
        del task, attempt
        return False

    def ended(self, task: Task) -> Ended | None:
        """Return how a process ended."""
        code = self._processes[task.id].poll()
        if code is None:
            return None
        del self._processes[task.id]
        return Ended(code, f"killed by {signal.Signals(-code).name}" if code < 0 else None)

    def ask(self, tasks: Sequence[Task]) -> None:
        """Ask processes to stop."""
        self._ask({task.id for task in tasks})

    def _ask(self, ids: Set[tuple[str, int]]) -> None:
        """Ask processes once: a second signal would end them without saving."""
        for task_id in ids - self._asked:
            self._processes[task_id].send_signal(signal.SIGTERM)
        self._asked |= ids

    def end(self, patience_s: float) -> None:
        """End processes, and what does not end in time with all that it started."""
        if patience_s:
            self._ask(self._processes.keys())
        limit = time.monotonic() + patience_s
        for process in self._processes.values():
            try:
                process.wait(max(limit - time.monotonic(), 0))
            except subprocess.TimeoutExpired:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)
                process.wait()
