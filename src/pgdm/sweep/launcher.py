"""What drives a sweep and what starts its workers: the contract between the two."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from pgdm.sweep.ledger import Attempt
from pgdm.sweep.plan import Job
from pgdm.sweep.queue import Queue


@dataclass(frozen=True)
class Task:
    """One attempt at a job, to be made by a process of its own."""

    job: Job
    number: int
    """Of the attempt."""

    @property
    def id(self) -> tuple[str, int]:
        """What tells it from all others."""
        return self.job.key, self.number


@dataclass(frozen=True)
class Ended:
    """How a worker ended."""

    code: int | None
    """Its exit code, or minus the signal that ended it; None if nobody knows."""
    error: str | None = None
    """What ended it, if it was not itself."""
    displaced: bool = False
    """Whether it had to make room: that is no failure."""


class Launcher(Protocol):
    """Starts workers somewhere, and knows how they end."""

    slots: int
    """How many jobs run at a time."""
    tick_s: float
    """How often to look after the workers, s."""
    stays: bool
    """Whether workers go on when their driver ends."""
    queue: Queue
    """Where workers of a Slurm cluster stand."""

    def more(self, working: int) -> int:
        """Return how many jobs may be started beside those that are at work."""
        ...

    def start(self, tasks: Sequence[Task]) -> None:
        """Start workers.

        Raises:
            SweepError: if they cannot be started; none of them has been.
        """
        ...

    def adopt(self, task: Task, attempt: Attempt) -> bool:
        """Look after a worker that another driver has left, and return whether that is possible."""
        ...

    def ended(self, task: Task) -> Ended | None:
        """Return how a worker ended; None while it is at work."""
        ...

    def ask(self, tasks: Sequence[Task]) -> None:
        """Ask workers to save and stop."""
        ...

    def end(self, patience_s: float) -> None:
        """End all workers that do not stay: let them save first, but not longer than this."""
        ...
