"""Signals that ask a run to stop: the first at a safe point, the second at once."""

from __future__ import annotations

import signal
import sys
from collections.abc import Callable
from types import FrameType, TracebackType
from typing import Protocol

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR2)
STOPPED = tuple(128 + number for number in _SIGNALS)
"""Exit codes of what has stopped because it was asked to, as a shell tells them."""


class StopRequest:
    """Within ``with``, a signal sets a flag that the trainer looks at between iterations.

    Ctrl-C, SIGTERM, and SIGUSR2, which Slurm sends before a job's time is up. Outside the main
    thread Python refuses signal handlers; the flag then stays unset.

    Args:
        patient: whether further signals change nothing: Slurm sends several, and SIGKILL last.
    """

    def __init__(self, patient: bool = False) -> None:
        self._patient = patient
        self.signal: int | None = None
        """The signal that came, if any."""
        self._before: dict[int, signal._HANDLER] = {}

    def __call__(self) -> bool:
        """Return whether the run should stop."""
        return self.signal is not None

    @property
    def exit_code(self) -> int:
        """The shell's code for a process that was stopped by this signal, one of ``STOPPED``."""
        return 128 + (self.signal or signal.SIGINT)

    def __enter__(self) -> StopRequest:
        for number in _SIGNALS:
            try:
                self._before[number] = signal.signal(number, self._on_signal)
            except ValueError:
                return self
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if self.signal is not None:
            if self._patient:
                return
            raise KeyboardInterrupt
        self.signal = number
        how = "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name
        again = "" if self._patient else " (again: stop at once)"
        sys.stderr.write(f"\n{how}: saving and stopping at the next safe point{again}\n")
        sys.stderr.flush()


class Listener(Protocol):
    """Told how far something long is."""

    def __call__(self, step: str, done: int, total: int) -> None:
        """Hear that ``done`` of ``total`` are done of a step."""
        ...


def stoppable(stop: Callable[[], bool], inner: Listener) -> Listener:
    """Return a progress listener that lets what it listens to end at a stop request.

    What was downloaded by then stays for the next time.
    """

    def progress(step: str, done: int, total: int) -> None:
        if stop():
            raise KeyboardInterrupt
        inner(step, done, total)

    return progress
