"""Which process is meant: a number alone is given to another one sooner or later."""

from __future__ import annotations

import os
import signal
import socket
from dataclasses import dataclass
from pathlib import Path

_STATE, _THREADS, _STARTED = 0, 17, 19  # places in /proc/PID/stat behind the name
_DEAD = "ZX"
_BOOT = Path("/proc/sys/kernel/random/boot_id")


@dataclass(frozen=True)
class Process:
    """A process, told from all others that ever had its number."""

    host: str
    pid: int
    born: str
    """When it started: the machine's boot and clock ticks since then; empty if that is unknown."""

    @classmethod
    def of(cls, pid: int) -> Process:
        """Return the process that has the number on this machine now."""
        return cls(socket.gethostname(), pid, _born(pid))

    @property
    def here(self) -> bool:
        """Whether it is, or was, a process of this machine."""
        return self.host == socket.gethostname()

    @property
    def alive(self) -> bool:
        """Whether it is still there; false for processes of other machines."""
        return self.here and bool(self.born) and _born(self.pid) == self.born

    def signal(self, number: signal.Signals) -> bool:
        """Send a signal, and return whether there was somebody to get it."""
        try:
            if self.alive:
                os.kill(self.pid, number)
                return True
        except ProcessLookupError:
            pass
        return False


def _born(pid: int) -> str:
    """Return when a process started; empty if there is none, or only what a dead one leaves."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        boot = _BOOT.read_text()[:8]
    except OSError:
        return ""
    # A killed one's first thread may look dead while others still hold its files and locks.
    gone = fields[_STATE] in _DEAD and int(fields[_THREADS]) <= 1
    return "" if gone else f"{boot}-{fields[_STARTED]}"
