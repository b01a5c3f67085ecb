"""Workers on this machine: one process per job, as many at a time as cores and memory allow."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Sequence, Set
from dataclasses import dataclass
from pathlib import Path

from pgdm import files
from pgdm.errors import SweepError
from pgdm.memory import free_bytes
from pgdm.sweep.launcher import Assignment, Ended
from pgdm.sweep.ledger import Attempt
from pgdm.sweep.plan import LocalCfg, Plan
from pgdm.sweep.queue import Queue
from pgdm.sweep.status import log_path


@dataclass(frozen=True)
class Room:
    """How jobs share this machine."""

    slots: int
    """Jobs at a time."""
    threads: int
    """Threads of each job whose settings leave ``num_threads`` at 0."""


def room(plan: Plan, launcher: LocalCfg, cores: int, memory_gb: float) -> Room:
    """Return how the jobs of a plan share a machine.

    All jobs of the plan count, whether finished or not.

    Args:
        plan: the jobs.
        launcher: settings of the launcher.
        cores: number of cores of the machine.
        memory_gb: free memory, GB.
    """
    asked = launcher.cores_per_job or max((job.cfg.num_threads for job in plan.jobs), default=0)
    limits = [cores // max(asked, 1), int(memory_gb / launcher.memory_per_job_gb), len(plan.jobs)]
    if launcher.max_jobs:
        limits = [launcher.max_jobs, len(plan.jobs)]
    slots = max(1, min(limits))
    return Room(slots, asked or max(1, cores // slots))


class LocalLauncher:
    """Starts workers on this machine; see ``Launcher``.

    Args:
        plan: the jobs.
        cfg: settings of the launcher.
        worker: command that starts a worker, see ``Front``.
    """

    tick_s, stays = 0.2, False

    def __init__(self, plan: Plan, cfg: LocalCfg, worker: Sequence[str]) -> None:
        shared = room(plan, cfg, len(os.sched_getaffinity(0)), free_bytes() / 1e9)
        self.slots, self._threads = shared.slots, shared.threads
        self._folder, self._worker, self.queue = plan.folder, worker, Queue()
        self._processes: dict[tuple[str, int], subprocess.Popen[bytes]] = {}
        self._asked: set[tuple[str, int]] = set()

    def more(self, working: int) -> int:
        """Return how many slots are free."""
        return self.slots - working

    def start(self, assignments: Sequence[Assignment]) -> None:
        """Start a process for each assignment, or none.

        Raises:
            SweepError: if one cannot be started; those started before it are killed.
        """
        for i, assignment in enumerate(assignments):
            log = log_path(self._folder, assignment.job.name, assignment.number)
            try:
                self._processes[assignment.id] = self._begin(assignment, log)
            except OSError as error:
                for other in assignments[:i]:  # they have only just begun: nothing is lost
                    _kill(self._processes.pop(other.id))
                raise SweepError(
                    f"cannot start the worker of {assignment.job.name}, whose log is {log}: "
                    f"{files.reason(error)}"
                ) from error

    def _begin(self, assignment: Assignment, log: Path) -> subprocess.Popen[bytes]:
        place = [str(self._folder), *map(str, assignment.id), str(self._threads)]
        with open(log, "wb") as output:
            return subprocess.Popen(
                [*self._worker, *place],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C reaches only the driver, which stops workers
            )

    def adopt(self, assignment: Assignment, attempt: Attempt) -> bool:
        """Return False: only the parent of a process learns how it exits."""
        del assignment, attempt
        return False

    def ended(self, assignment: Assignment) -> Ended | None:
        """Return how a process exited."""
        code = self._processes[assignment.id].poll()
        if code is None:
            return None
        del self._processes[assignment.id]
        return Ended(code, f"killed by {signal.Signals(-code).name}" if code < 0 else None)

    def ask(self, assignments: Sequence[Assignment]) -> None:
        """Ask processes to stop."""
        self._ask({assignment.id for assignment in assignments})

    def _ask(self, ids: Set[tuple[str, int]]) -> None:
        """Ask processes once: a second signal would stop them before they have saved."""
        for work_id in ids - self._asked:
            self._processes[work_id].send_signal(signal.SIGTERM)
        self._asked |= ids

    def end(self, patience_s: float) -> None:
        """Stop all processes; kill those that do not exit in time, with their children."""
        if patience_s:
            self._ask(self._processes.keys())
        limit = time.monotonic() + patience_s
        for process in self._processes.values():
            try:
                process.wait(max(limit - time.monotonic(), 0))
            except subprocess.TimeoutExpired:
                _kill(process)


def _kill(process: subprocess.Popen[bytes]) -> None:
    """Kill a worker with its children, and wait until it is gone."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
