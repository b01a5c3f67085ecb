"""Drives the jobs of a sweep from one process: starts workers, sees how they end, starts others."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pgdm.config.saved import load_config
from pgdm.errors import ConfigError, RunError
from pgdm.stop import StopRequest
from pgdm.sweep.ledger import (
    CANCELLED,
    FAILED,
    FINISHED,
    INTERRUPTED,
    RUNNING,
    WAITING,
    Ending,
    Entry,
    Ledger,
)
from pgdm.sweep.mirror import SweepMirror
from pgdm.sweep.plan import Job, Plan, job_key
from pgdm.sweep.processes import Process
from pgdm.sweep.state import NAME, PARENT, SLOTS, log_path, rows, settle, stand, works
from pgdm.sweep.view import SweepView, failures
from pgdm.tracking.run_folder import RunFolder

_TICK_S = 0.2
_STOP_S = 60.0
"""How long workers may take to save when the sweep itself fails."""
_STOPPED = (128 + signal.SIGINT, 128 + signal.SIGTERM)

Notify = Callable[[str], None]


@dataclass(frozen=True)
class Room:
    """How jobs share this machine."""

    slots: int
    """Jobs at a time."""
    threads: int
    """Of each job that does not say so itself."""


@dataclass
class _Worker:
    """A process at work on a job."""

    job: Job
    number: int
    """Of the attempt."""
    process: subprocess.Popen[bytes]
    asked: bool = False
    """Whether it was asked to stop."""

    def ask(self) -> None:
        """Ask it to save and stop, once: a second signal would end it without saving."""
        if not self.asked:
            self.process.send_signal(signal.SIGTERM)
        self.asked = True

    def kill(self) -> None:
        """End it at once, with all that it started."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()


class Driver:
    """Drives a plan; the caller keeps other drivers away.

    Args:
        plan: the jobs.
        max_attempts: how often a job is tried.
        room: how many run at a time.
        notify: told in a sentence what people should know.
    """

    def __init__(self, plan: Plan, max_attempts: int, room: Room, notify: Notify) -> None:
        self._plan, self._max_attempts, self._room, self._notify = plan, max_attempts, room, notify
        self._jobs = {job.key: job for job in plan.jobs}
        self._ledger = Ledger(plan.folder)
        self._mirror = SweepMirror.of(plan, notify)
        self._view = SweepView(plan.name, self._ledger)
        self._tries: Counter[str] = Counter()
        self._workers: list[_Worker] = []
        self._left_over: list[Entry] = []
        self._told_busy: set[str] = set()

    def run(self, stop: StopRequest) -> int:
        """Work until nothing is left, or until ``stop``; return the exit code."""
        self._prepare()
        try:
            with self._view:
                self._loop(stop)
        except KeyboardInterrupt:
            for worker in self._workers:
                worker.asked = True
                worker.kill()
            self._reap()
        finally:
            self._end()
        states = self._ledger.states()
        whole = all(states[key] == FINISHED for key in self._jobs)
        stopped = stop() and not whole
        self._mirror.close(FINISHED if whole else INTERRUPTED if stopped else FAILED)
        self._notify(self._view.line())
        if text := failures(rows(self._ledger)):
            self._notify(text)
        return stop.exit_code if stopped else int(not whole)

    def _prepare(self) -> None:
        """Bring the ledger to what the run folders tell, and MLflow to a start."""
        ledger, me = self._ledger, Process.of(os.getpid())
        recall(ledger, self._plan)
        ledger.set_fact(NAME, self._plan.name)
        ledger.set_fact(SLOTS, self._room.slots)
        ledger.set_fact(PARENT, [me.host, me.pid, me.born])
        self._mirror.open(self._plan)
        for entry in settle(ledger):
            self._mirror.correct(entry.run_dir)
        states: dict[str, str] = {}
        for entry in ledger.entries():
            if entry.last is not None and entry.last.state == RUNNING:
                self._left_over.append(entry)
                states[entry.key] = RUNNING
            elif entry.key in self._jobs:
                states[entry.key] = self._first_state(entry)
        ledger.set_states(states)

    def _first_state(self, entry: Entry) -> str:
        """Return whether a job is finished or waits; the folder decides, not the ledger."""
        done = stand(entry.run_dir, entry.total_frames).state == FINISHED
        known = entry.state == FINISHED or (done and _holds(self._jobs[entry.key]))
        return FINISHED if done and known else WAITING

    def _loop(self, stop: StopRequest) -> None:
        while True:
            self._reap()
            if stop():
                self._left_over.clear()  # they have been stopping since their own driver went
            self._take_over()
            states = self._ledger.states()
            for worker in self._workers:
                if stop() or states[worker.job.key] == CANCELLED:
                    worker.ask()
            waiting = [j for j in self._plan.jobs if states[j.key] == WAITING and not stop()]
            for job in waiting:
                if len(self._workers) + len(self._left_over) >= self._room.slots:
                    break
                if self._is_free(job):
                    self._start(job)
            if not self._workers and not self._left_over and not waiting:
                return
            self._view.update()
            time.sleep(_TICK_S)

    def _is_free(self, job: Job) -> bool:
        """Return whether nobody else works in a job's folder; tell about it once."""
        busy = RunFolder(Path(job.cfg.run_dir)).busy
        if busy and job.key not in self._told_busy:
            self._told_busy.add(job.key)
            self._notify(f"{job.name}: another process is using {job.cfg.run_dir}; waiting for it")
        return not busy

    def _start(self, job: Job) -> None:
        """Start a process for a job."""
        self._mirror.adopt(job)
        if self._tries[job.key] >= self._max_attempts:
            self._tries[job.key] = 0  # somebody asked for it anew
        self._tries[job.key] += 1
        number = self._ledger.begin(job.key, Process.of(os.getpid()))
        place = [str(self._plan.folder), job.key, str(number), str(self._room.threads)]
        with open(log_path(self._plan.folder, job.name, number), "wb") as output:
            process = subprocess.Popen(
                [sys.executable, "-m", "pgdm.cli.worker", *place],
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C is for us: we ask the workers
            )
        self._workers.append(_Worker(job, number, process))

    def _reap(self) -> None:
        """See which workers have ended, and how."""
        for worker in [w for w in self._workers if w.process.poll() is not None]:
            self._workers.remove(worker)
            job, key = worker.job, worker.job.key
            ending = self._ending(worker)
            self._ledger.end(key, worker.number, ending)
            if worker.process.returncode != 0:
                self._mirror.correct(Path(job.cfg.run_dir))
            if ending.state == FINISHED or self._ledger.states()[key] == CANCELLED:
                state = FINISHED if ending.state == FINISHED else CANCELLED
            elif worker.asked:
                state = INTERRUPTED
            else:
                state = WAITING if self._tries[key] < self._max_attempts else FAILED
                self._notify(f"{job.name}: attempt {worker.number} {ending.state}: {ending.error}")
            self._ledger.set_states({key: state})

    def _ending(self, worker: _Worker) -> Ending:
        """Return how an attempt ended, by what run folder, exit code and log tell."""
        code, cfg = worker.process.returncode, worker.job.cfg
        found = stand(Path(cfg.run_dir), cfg.total_frames)
        if found.state == FINISHED and _holds(worker.job):
            state, error = FINISHED, None
        elif code < 0:
            state = INTERRUPTED if worker.asked else FAILED
            error = f"killed by {signal.Signals(-code).name}"
        elif code in _STOPPED or code == 0:
            state, error = INTERRUPTED, "stopped from outside"
        else:
            log = log_path(self._plan.folder, worker.job.name, worker.number)
            state, error = FAILED, _last_error(log)
        return Ending(state, code, found.frames, found.metrics, error)

    def _take_over(self) -> None:
        """Take over the jobs whose workers a killed driver left, once these have ended."""
        for entry in list(self._left_over):
            assert entry.last is not None
            if works(entry.last, entry.run_dir):
                continue
            self._left_over.remove(entry)
            ending = stand(entry.run_dir, entry.total_frames)
            self._ledger.end(entry.key, entry.last.number, ending)
            self._mirror.correct(entry.run_dir)
            if ending.state == FINISHED or entry.key not in self._jobs:
                self._ledger.set_states({entry.key: ending.state})
            elif self._ledger.states()[entry.key] != CANCELLED:
                self._ledger.set_states({entry.key: WAITING})

    def _end(self) -> None:
        """Leave no worker behind, whatever went wrong."""
        for worker in self._workers:
            worker.ask()
        limit = time.monotonic() + _STOP_S
        for worker in self._workers:
            try:
                worker.process.wait(max(limit - time.monotonic(), 0))
            except subprocess.TimeoutExpired:
                worker.kill()


def recall(ledger: Ledger, plan: Plan) -> None:
    """Note a plan's jobs in a ledger, and of those it does not know yet what their folders tell."""
    ledger.add(plan)
    jobs = {job.key: job for job in plan.jobs}
    for entry in ledger.entries():
        job, folder = jobs.get(entry.key), RunFolder(entry.run_dir)
        if job is None or entry.last is not None or folder.busy or not _holds(job):
            continue
        ending = stand(entry.run_dir, entry.total_frames)
        ledger.recall(entry.key, folder.started(), folder.modified(), ending)
        ledger.set_states({entry.key: ending.state})


def _holds(job: Job) -> bool:
    """Return whether a job's folder holds its run, and no other one."""
    try:
        return job_key(load_config(job.cfg.run_dir)) == job.key
    except (RunError, ConfigError):
        return False  # its worker says what is wrong


def _last_error(log: Path) -> str:
    """Return the last error that a log tells, or its last line."""
    lines = [line for line in log.read_text(errors="replace").splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("error: ")]
    return (errors or lines or ["it printed nothing"])[-1].removeprefix("error: ")
