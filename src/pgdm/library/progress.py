"""Progress of long work, such as a fetch or an import."""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from typing import Protocol, TypeVar

Notify = Callable[[str], None]
"""Receives a message for the user."""

_INTERVAL_S = 5.0
_Item = TypeVar("_Item")


class StepProgress(Protocol):
    """Receives the progress of long work, step by step."""

    def __call__(self, step: str, done: int, total: int) -> None:
        """Report that ``done`` of ``total`` parts (files, bytes, rounds) of ``step`` are finished.

        A total of 0 means that the amount of work is unknown; ``done`` then counts seconds.
        """
        ...


def silent(step: str, done: int, total: int) -> None:
    """Ignore progress."""


def counted(step: str, items: Collection[_Item], progress: StepProgress) -> Iterator[_Item]:
    """Yield the items; report the number done before each item and after the last one."""
    for done, item in enumerate(items):
        progress(step, done, len(items))
        yield item
    progress(step, len(items), len(items))


def stoppable(stop: Callable[[], bool], inner: StepProgress) -> StepProgress:
    """Return a progress listener that raises KeyboardInterrupt once ``stop`` returns True."""

    def progress(step: str, done: int, total: int) -> None:
        if stop():
            raise KeyboardInterrupt
        inner(step, done, total)

    return progress


class ProgressLines:
    """Progress as plain lines, one every few seconds, with an estimate of the time left.

    Args:
        notify: receives the lines.
        interval_s: shortest time between two lines, s.
    """

    def __init__(self, notify: Notify, interval_s: float = _INTERVAL_S) -> None:
        self._notify, self._interval_s = notify, interval_s
        self._step, self._begun, self._first = "", 0.0, 0
        self._reported = time.monotonic()
        self._last = "", 0, 0

    def repeat(self) -> None:
        """Report the last progress of an unfinished step again, if the interval has passed."""
        step, done, total = self._last
        if step and (done < total or not total):
            self(step, done, total)

    def __call__(self, step: str, done: int, total: int) -> None:
        """See :class:`StepProgress`."""
        self._last = step, done, total
        now = time.monotonic()
        if step != self._step:
            self._step, self._begun, self._first = step, now, done
        if now - self._reported < self._interval_s:
            return
        self._reported = now
        if not total:
            self._notify(f"{step}: {done} s")
            return
        if done == self._first:  # too early for an estimate
            self._notify(f"{step}: {now - self._begun:.0f} s" if now > self._begun else step)
            return
        left_s = (total - done) / (done - self._first) * (now - self._begun)
        self._notify(f"{step}: {done / total:.0%}, {left_s:.0f} s left")
