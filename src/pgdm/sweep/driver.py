"""The driver of a sweep: one process that starts the workers and records how each ended."""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

from pgdm.errors import SweepError
from pgdm.runs.folder import RunFolder
from pgdm.stop import STOPPED, StopRequest
from pgdm.sweep.front import Front
from pgdm.sweep.launcher import Assignment, Ended, Launcher
from pgdm.sweep.ledger import (
    CANCELLED,
    FAILED,
    FINISHED,
    INTERRUPTED,
    RUNNING,
    WAITING,
    Attempt,
    Ending,
    Entry,
    Ledger,
)
from pgdm.sweep.mirror import SweepMirror
from pgdm.sweep.plan import Job, Plan
from pgdm.sweep.processes import Process
from pgdm.sweep.repair import holds, job_ending, recall
from pgdm.sweep.status import NAME, PARENT, SLOTS, is_alive, log_path, run_ending, settle

_STOP_S = 60.0
"""How long workers may take to save when the driver fails."""
_RETRY_S = 60.0
"""How long to wait before trying again if jobs could not be started while others run."""


@dataclass
class _Worker:
    """A process that works on a job, or waits in Slurm to do so."""

    assignment: Assignment
    frames: int
    """Frames that the run had completed when this driver started or adopted the worker."""
    asked: bool = False
    """Whether the worker was asked to stop."""


def status_of(states: Collection[str], stopped: bool) -> str:
    """Return the status of a sweep from the states of all its jobs, also of those not retried.

    Args:
        states: of all jobs of the sweep.
        stopped: whether the driver was stopped before its jobs were finished.
    """
    if all(state == FINISHED for state in states):
        return FINISHED
    return INTERRUPTED if stopped or WAITING in states else FAILED


class Driver:
    """Drives a plan; the caller must hold the sweep's lock.

    Args:
        plan: the jobs.
        max_attempts: how many times this driver tries a job before the job counts as failed;
            see also ``Ended.displaced``.
        launcher: starts workers.
        front: shows the sweep's state to the user.
    """

    def __init__(self, plan: Plan, max_attempts: int, launcher: Launcher, front: Front) -> None:
        self._plan, self._max_attempts, self._notify = plan, max_attempts, front.notify
        self._launcher = launcher
        self._jobs = {job.key: job for job in plan.jobs}
        self._ledger = Ledger(plan.folder)
        self._mirror = SweepMirror.of(plan, front.notify)
        self._view = front.view(plan.name, self._ledger, launcher.queue)
        self._tries: Counter[str] = Counter()
        self._workers: list[_Worker] = []
        self._left_over: list[Entry] = []
        self._reported_busy: set[str] = set()
        self._not_before_s = 0.0

    def run(self, stop: StopRequest) -> int:
        """Work until nothing is left, or until ``stop``; return the exit code."""
        self._prepare()
        try:
            with self._view:
                self._loop(stop)
        except KeyboardInterrupt:
            for worker in self._workers:
                worker.asked = True
            self._launcher.end(0.0)
            self._reap()
        finally:
            self._launcher.end(_STOP_S)
        states = self._ledger.states()
        whole = all(states[key] == FINISHED for key in self._jobs)
        stopped = stop() and not whole
        self._mirror.close(status_of(states.values(), stopped))
        self._notify(self._view.line())
        if text := self._view.failures():
            self._notify(text)
        if self._workers:
            self._notify(
                "the jobs continue without this process; run the same command to monitor them "
                f"again, or pgdm sweep cancel {self._plan.folder} to stop them"
            )
        return stop.exit_code if stopped else int(not whole)

    def _prepare(self) -> None:
        """Reconcile the ledger with the run folders, and open the sweep's MLflow run."""
        ledger, me = self._ledger, Process.of(os.getpid())
        recall(ledger, self._plan)
        ledger.set_fact(NAME, self._plan.name)
        ledger.set_fact(SLOTS, self._launcher.slots)
        ledger.set_fact(PARENT, [me.host, me.pid, me.born])
        self._mirror.open(self._plan)
        for entry in settle(ledger, self._launcher.queue):
            self._mirror.correct(entry.run_dir)
        states: dict[str, str] = {}
        for entry in ledger.entries():
            if entry.last is not None and entry.last.state == RUNNING:
                self._adopt(entry, entry.last)
                states[entry.key] = RUNNING
            elif entry.key in self._jobs:
                states[entry.key] = self._first_state(entry)
        ledger.set_states(states)

    def _adopt(self, entry: Entry, attempt: Attempt) -> None:
        """Monitor a worker left by an earlier driver, or else only wait until it is gone."""
        job = self._jobs.get(entry.key)
        if job is not None and self._launcher.adopt(
            assignment := Assignment(job, attempt.number), attempt
        ):
            self._tries[job.key] += 1
            self._workers.append(_Worker(assignment, _frames(job)))
        else:
            self._left_over.append(entry)

    def _first_state(self, entry: Entry) -> str:
        """Return FINISHED or WAITING.

        A job is finished only if its run folder says so. In addition, the ledger must say so, or
        the folder must hold the run of this very job.
        """
        job = self._jobs[entry.key]
        done = job_ending(job).state == FINISHED
        known = entry.state == FINISHED or (done and holds(job))
        return FINISHED if done and known else WAITING

    def _loop(self, stop: StopRequest) -> None:
        while True:
            self._reap()
            if stop() and self._launcher.stays:
                return
            if stop():
                self._left_over.clear()  # local workers stop by themselves when their driver dies
            self._take_over()
            states = self._ledger.states()
            self._ask(
                [w for w in self._workers if stop() or states[w.assignment.job.key] == CANCELLED]
            )
            waiting = [j for j in self._plan.jobs if states[j.key] == WAITING and not stop()]
            more = self._launcher.more(len(self._workers) + len(self._left_over))
            if time.monotonic() >= self._not_before_s:
                self._start(list(islice(filter(self._is_free, waiting), max(more, 0))))
            if not self._workers and not self._left_over and not waiting:
                return
            self._view.update()
            time.sleep(self._launcher.tick_s)

    def _ask(self, workers: Sequence[_Worker]) -> None:
        """Ask workers to save and stop, unless they were asked before."""
        if assignments := [worker.assignment for worker in workers if not worker.asked]:
            self._launcher.ask(assignments)
        for worker in workers:
            worker.asked = True

    def _is_free(self, job: Job) -> bool:
        """Return whether a job's run folder is free; report once if another process uses it."""
        busy = RunFolder(Path(job.cfg.run_dir)).busy
        if busy and job.key not in self._reported_busy:
            self._reported_busy.add(job.key)
            self._notify(f"{job.name}: another process is using {job.cfg.run_dir}; waiting for it")
        return not busy

    def _start(self, jobs: Sequence[Job]) -> None:
        """Start workers for jobs."""
        if not jobs:
            return
        me = Process.of(os.getpid())
        for job in jobs:
            self._mirror.adopt(job)
        assignments = [Assignment(job, self._ledger.begin(job.key, me)) for job in jobs]
        try:
            self._launcher.start(assignments)
        except SweepError as error:
            self._refused(assignments, error)
            return
        for assignment in assignments:
            if self._tries[assignment.job.key] >= self._max_attempts:
                self._tries[assignment.job.key] = 0  # `pgdm sweep retry` reset the job
            self._tries[assignment.job.key] += 1
            self._workers.append(_Worker(assignment, _frames(assignment.job)))

    def _refused(self, assignments: Sequence[Assignment], error: SweepError) -> None:
        """Record that workers could not be started; try again later if others run, else raise."""
        for assignment in assignments:
            found = job_ending(assignment.job)
            self._ledger.end(*assignment.id, replace(found, state=FAILED, error=str(error)))
        self._ledger.set_states({assignment.job.key: WAITING for assignment in assignments})
        if not self._workers:
            raise error
        self._notify(f"{error}; trying again in {_RETRY_S:.0f} s")
        self._not_before_s = time.monotonic() + _RETRY_S

    def _reap(self) -> None:
        """Record how each worker that has exited ended, and update the state of its job."""
        found = [(worker, self._launcher.ended(worker.assignment)) for worker in self._workers]
        for worker, ended in found:
            if ended is None:
                continue
            self._workers.remove(worker)
            job, key = worker.assignment.job, worker.assignment.job.key
            ending = self._ending(worker, ended)
            self._ledger.end(*worker.assignment.id, ending)
            if ended.code != 0 or ending.state != FINISHED:
                self._mirror.correct(Path(job.cfg.run_dir))
            if ended.displaced and (ending.frames or 0) > worker.frames:
                self._tries[key] -= 1
            if ending.state == FINISHED or self._ledger.states()[key] == CANCELLED:
                state = FINISHED if ending.state == FINISHED else CANCELLED
            elif worker.asked:
                state = INTERRUPTED
            else:
                state = WAITING if self._tries[key] < self._max_attempts else FAILED
                number = worker.assignment.number
                self._notify(f"{job.name}: attempt {number} {ending.state}: {ending.error}")
            self._ledger.set_states({key: state})

    def _ending(self, worker: _Worker, ended: Ended) -> Ending:
        """Return how an attempt ended, according to run folder, exit code and log."""
        code, job = ended.code, worker.assignment.job
        found = job_ending(job)
        if found.state == FINISHED and holds(job):
            state, error = FINISHED, None
        elif ended.error is not None:
            state = INTERRUPTED if worker.asked or ended.displaced else FAILED
            error = ended.error
        elif code in STOPPED:
            state, error = INTERRUPTED, "stopped by a signal"
        elif code == 0:
            state, error = FAILED, f"exited with code 0, but its run {_left(job, found)}"
        else:
            log = log_path(self._plan.folder, job.name, worker.assignment.number)
            state, error = FAILED, _last_error(log)
        return Ending(state, code, found.frames, found.metrics, error)

    def _take_over(self) -> None:
        """Take over the jobs of an earlier driver whose workers have exited by now."""
        for entry in list(self._left_over):
            assert entry.last is not None
            if is_alive(entry.last, entry.run_dir, self._launcher.queue):
                continue
            self._left_over.remove(entry)
            ending = run_ending(entry.run_dir, entry.total_frames)
            self._ledger.end(entry.key, entry.last.number, ending)
            self._mirror.correct(entry.run_dir)
            if ending.state == FINISHED or entry.key not in self._jobs:
                self._ledger.set_states({entry.key: ending.state})
            elif self._ledger.states()[entry.key] != CANCELLED:
                self._ledger.set_states({entry.key: WAITING})


def _frames(job: Job) -> int:
    """Return the number of frames that a job's run has completed."""
    return job_ending(job).frames or 0


def _left(job: Job, found: Ending) -> str:
    """Return why a job's run does not count as finished, in words that follow "its run"."""
    if found.state == FINISHED:
        return f"folder {job.cfg.run_dir} holds another run"
    return f"is unfinished: {found.frames or 0:,} of {job.cfg.total_frames:,} frames"


def _last_error(log: Path) -> str:
    """Return the last error message of a log; if it has none, the last line.

    Lines that start with ``error: `` are error messages.
    """
    text = log.read_text(errors="replace") if log.exists() else ""
    lines = [line for line in text.splitlines() if line.strip()]
    errors = [line for line in lines if line.startswith("error: ")]
    return (errors or lines or ["it printed nothing"])[-1].removeprefix("error: ")
