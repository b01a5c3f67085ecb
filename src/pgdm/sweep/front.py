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
    """A display of a sweep; a context."""

    def update(self) -> None:
        """Show the current state, unless that was done a moment ago."""
        ...

    def line(self) -> str:
        """Return the current state in one line."""
        ...

    def failures(self) -> str:
        """Return the failed jobs with the last lines of their logs; empty if there are none."""
        ...


@dataclass(frozen=True)
class Front:
    """The command line, as far as a sweep uses it."""

    notify: Notify
    view: Callable[[str, Ledger, Queue], View]
    """Makes a display from a sweep's name, its ledger and its jobs in Slurm."""
    worker: tuple[str, ...]
    """Command of a worker; the sweep's folder, the job's key, the number of the attempt and the
    threads follow, and in Slurm the ID of its job."""
    resume: tuple[str, ...]
    """Command that resumes a sweep; its folder follows."""
