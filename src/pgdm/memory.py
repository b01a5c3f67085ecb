"""Free memory of this machine, and a check that something fits into it."""

from __future__ import annotations

import resource
from pathlib import Path

from pgdm.errors import ConfigError

# Limit of a container's memory, in both versions of Linux's control groups.
_CONTAINER = ("/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory/memory.limit_in_bytes")


def free_bytes() -> int:
    """Return an estimate of the memory this process can still allocate, bytes."""
    lines = Path("/proc/meminfo").read_text().splitlines()
    fields = dict(line.split(":", 1) for line in lines)
    free = [int(fields["MemAvailable"].split()[0]) * 1024]
    limits = [Path(limit).read_text().strip() for limit in _CONTAINER if Path(limit).is_file()]
    free += [int(limit) for limit in limits if limit != "max"]
    limit_bytes, _ = resource.getrlimit(resource.RLIMIT_AS)  # ulimit -v
    if limit_bytes != resource.RLIM_INFINITY:
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        free.append(limit_bytes - pages * resource.getpagesize())
    return max(min(free), 0)


def check_fits(what: str, needed_bytes: float, cure: str) -> None:
    """Check that something fits into the free memory; if it did not, Linux would kill the process.

    Args:
        what: what needs the memory: the setting with its value.
        needed_bytes: lower bound of the memory needed.
        cure: what to do if it does not fit.

    Raises:
        ConfigError: if it does not; names both amounts.
    """
    if needed_bytes > (free := free_bytes()):
        raise ConfigError(
            f"{what}: this takes at least {needed_bytes / 1e9:,.1f} GB of memory, and "
            f"{free / 1e9:,.1f} GB are free; {cure}"
        )
