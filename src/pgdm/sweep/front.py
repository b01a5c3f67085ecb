"""What a sweep needs from the command line that started it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Protocol

from pgdm.library.progress import Notify
from pgdm.sweep.ledger import Ledger
from pgdm.sweep.queue import Queue


class View(AbstractContextManager["View"], Protocol):
    """A display of a sweep's state, used as a context manager."""

    def update(self) -> None:
        """Refresh the display, unless that was done a moment ago."""
        ...

    def line(self) -> str:
        """Return the current state in one line."""
        ...

    def failures(self) -> str:
        """Return the failed jobs with the last lines of their logs; empty if there are none."""
        ...


@dataclass(frozen=True)
class Front:
    """What a sweep uses of the command line."""

    notify: Notify
    view: Callable[[str, Ledger, Queue], View]
    """Creates a display from a sweep's name, its ledger and its jobs in Slurm."""
    worker: tuple[str, ...]
    """Command that starts a worker; to be followed by the sweep's folder, the job's key, the number
    of the attempt, the number of threads and, in Slurm, the Slurm job's ID."""
    resume: tuple[str, ...]
    """Command that resumes a sweep; to be followed by the sweep's folder."""
