"""Signals that stop a run: the first at a safe point, the second immediately."""

from __future__ import annotations

import signal
import sys
from types import FrameType

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR2)
STOPPED = tuple(128 + number for number in _SIGNALS)
"""Exit codes of a process stopped by one of these signals, as shells report them."""


class StopRequest:
    """Context manager in which a signal sets a flag that the trainer polls between iterations.

    Signals: Ctrl-C, SIGTERM, and SIGUSR2, which Slurm sends before a job's time is up. Outside the
    main thread Python allows no signal handlers; the flag then stays unset.

    Args:
        patient: whether further signals are ignored: Slurm sends several, and SIGKILL last.
    """

    def __init__(self, patient: bool = False) -> None:
        self._patient = patient
        self.signal: int | None = None
        """The signal received, if any."""
        self._before: dict[int, signal._HANDLER] = {}

    def __call__(self) -> bool:
        """Return whether the run should stop."""
        return self.signal is not None

    @property
    def exit_code(self) -> int:
        """The shell's exit code for the signal received (SIGINT's if none), one of ``STOPPED``."""
        return 128 + (self.signal or signal.SIGINT)

    def __enter__(self) -> StopRequest:
        for number in _SIGNALS:
            try:
                self._before[number] = signal.signal(number, self._on_signal)
            except ValueError:
                return self
        return self

    def __exit__(self, *_: object) -> None:
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
        again = "" if self._patient else " (again: stop immediately)"
        sys.stderr.write(f"\n{how}: saving and stopping at the next safe point{again}\n")
        sys.stderr.flush()
