"""Processes, identified by PID and start time, since PIDs are reused."""

from __future__ import annotations

import os
import signal
import socket
from dataclasses import dataclass
from pathlib import Path

_STATE, _THREADS, _STARTED = 0, 17, 19  # positions in /proc/PID/stat after the name
_DEAD = "ZX"
_BOOT = Path("/proc/sys/kernel/random/boot_id")


@dataclass(frozen=True)
class Process:
    """A process, distinguished from all others that ever had its PID."""

    host: str
    pid: int
    born: str
    """Its start time: the machine's boot ID and the clock ticks since boot; empty if unknown."""

    @classmethod
    def of(cls, pid: int) -> Process:
        """Return the process that has this PID on this machine now."""
        return cls(socket.gethostname(), pid, _born(pid))

    @property
    def here(self) -> bool:
        """Whether it is, or was, a process on this machine."""
        return self.host == socket.gethostname()

    @property
    def alive(self) -> bool:
        """Whether it still runs; false for processes on other machines."""
        return self.here and bool(self.born) and _born(self.pid) == self.born

    def signal(self, number: signal.Signals) -> bool:
        """Send a signal, and return whether the process received it."""
        try:
            if self.alive:
                os.kill(self.pid, number)
                return True
        except ProcessLookupError:
            pass
        return False


def _born(pid: int) -> str:
    """Return when a process started; empty if there is no such process, or only a zombie."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        boot = _BOOT.read_text()[:8]
    except OSError:
        return ""
    # The first thread of a killed process may be dead while others still hold files and locks.
    gone = fields[_STATE] in _DEAD and int(fields[_THREADS]) <= 1
    return "" if gone else f"{boot}-{fields[_STARTED]}"
