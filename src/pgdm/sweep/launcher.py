"""The interface between a sweep's driver and the launcher that starts its workers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from pgdm.sweep.ledger import Attempt
from pgdm.sweep.plan import Job
from pgdm.sweep.queue import Queue


@dataclass(frozen=True)
class Assignment:
    """One attempt at a job, to be made by one worker."""

    job: Job
    number: int
    """Number of the attempt."""

    @property
    def id(self) -> tuple[str, int]:
        """Key of the job and number of the attempt."""
        return self.job.key, self.number


@dataclass(frozen=True)
class Ended:
    """How a worker exited."""

    code: int | None
    """Exit code, or the negative number of the signal that killed the worker; None if unknown."""
    error: str | None = None
    """What ended the worker, unless it exited by itself."""
    displaced: bool = False
    """Whether Slurm preempted the worker, its time ran out, or it saved and stopped on a signal.
    Such an attempt does not count towards ``max_attempts`` if the run made progress."""


class Launcher(Protocol):
    """Starts workers, and reports how they exit."""

    slots: int
    """How many jobs run at a time."""
    tick_s: float
    """Interval at which the driver checks the workers, s."""
    stays: bool
    """Whether workers continue when their driver exits."""
    queue: Queue
    """States of the user's jobs in Slurm."""

    def more(self, working: int) -> int:
        """Return how many more jobs may be started while ``working`` jobs run."""
        ...

    def start(self, assignments: Sequence[Assignment]) -> None:
        """Start workers.

        Raises:
            SweepError: if they cannot be started; in that case no worker was.
        """
        ...

    def adopt(self, assignment: Assignment, attempt: Attempt) -> bool:
        """Monitor a worker left by an earlier driver; return False if that is impossible."""
        ...

    def ended(self, assignment: Assignment) -> Ended | None:
        """Return how a worker exited; None while it runs."""
        ...

    def ask(self, assignments: Sequence[Assignment]) -> None:
        """Ask workers to save and stop."""
        ...

    def end(self, patience_s: float) -> None:
        """Stop all workers unless ``stays``; kill those that still run after ``patience_s``."""
        ...
