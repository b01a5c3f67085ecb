"""Ctrl-C and SIGTERM: the first asks the run to stop at a safe point, the second ends it."""

from __future__ import annotations

import signal
import sys
from types import FrameType, TracebackType


class StopRequest:
    """Within ``with``, a signal sets a flag that the trainer looks at between iterations.

    Outside the main thread Python refuses signal handlers; the flag then stays unset.
    """

    def __init__(self) -> None:
        self.signal: int | None = None
        """The signal that came, if any."""
        self._before: dict[int, signal._HANDLER] = {}

    def __call__(self) -> bool:
        """Return whether the run should stop."""
        return self.signal is not None

    @property
    def exit_code(self) -> int:
        """The shell's code for a process that was stopped by this signal: 130 or 143."""
        return 128 + (self.signal or signal.SIGINT)

    def __enter__(self) -> StopRequest:
        for number in (signal.SIGINT, signal.SIGTERM):
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
            raise KeyboardInterrupt
        self.signal = number
        how = "Ctrl-C" if number == signal.SIGINT else "SIGTERM"
        sys.stderr.write(
            f"\n{how}: saving and stopping at the next safe point (again: stop at once)\n"
        )
        sys.stderr.flush()
