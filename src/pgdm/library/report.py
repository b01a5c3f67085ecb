"""What an import or a fetch has to say."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol


class Progress(Protocol):
    """Told how far a long piece of work is."""

    def __call__(self, step: str, done: int, total: int) -> None:
        """Say that ``done`` of ``total`` parts (files or bytes) of ``step`` are done.

        With a total of 0 nobody knows how much there is, and ``done`` are seconds.
        """
        ...


def silent(step: str, done: int, total: int) -> None:
    """Ignore progress."""


@dataclass(frozen=True)
class Report:
    """Result of filling the library from one source."""

    source: str
    """``checkout`` or ``registry``."""
    tasks: list[str]
    """Task ids that are now in the library from this source."""
    defects: list[str]
    """What was wrong in the source's files and how it was read."""
    left_out: dict[str, str]
    """What the source should have but lacks, with the reason."""
