"""The contract between what drives a sweep and what starts its workers."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from pgdm.sweep.ledger import Attempt
from pgdm.sweep.plan import Job
from pgdm.sweep.queue import Queue


@dataclass(frozen=True)
class Assignment:
    """One attempt at a job, done by a process of its own."""

    job: Job
    number: int
    """Number of the attempt."""

    @property
    def id(self) -> tuple[str, int]:
        """Its identity: key of the job and number of the attempt."""
        return self.job.key, self.number


@dataclass(frozen=True)
class Ended:
    """How a worker exited."""

    code: int | None
    """Its exit code, or minus the signal that killed it; None if unknown."""
    error: str | None = None
    """What killed it, if anything did."""
    displaced: bool = False
    """Whether it was preempted or ran out of time, which is no failure."""


class Launcher(Protocol):
    """Starts workers somewhere, and learns how they exit."""

    slots: int
    """How many jobs run at a time."""
    tick_s: float
    """Time between two looks at the workers, s."""
    stays: bool
    """Whether workers continue when their driver exits."""
    queue: Queue
    """States of the workers on a Slurm cluster."""

    def more(self, working: int) -> int:
        """Return how many jobs may be started in addition to those that run."""
        ...

    def start(self, assignments: Sequence[Assignment]) -> None:
        """Start workers.

        Raises:
            SweepError: if they cannot be started; none of them has been.
        """
        ...

    def adopt(self, assignment: Assignment, attempt: Attempt) -> bool:
        """Follow a worker that another driver has left, and return whether that is possible."""
        ...

    def ended(self, assignment: Assignment) -> Ended | None:
        """Return how a worker exited; None while it runs."""
        ...

    def ask(self, assignments: Sequence[Assignment]) -> None:
        """Ask workers to save and stop."""
        ...

    def end(self, patience_s: float) -> None:
        """Stop all workers that do not stay; kill those that take longer than this to save, s."""
        ...
