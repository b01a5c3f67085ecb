"""A sweep on this machine: a process for each job, as many at a time as there is room for."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path

from filelock import FileLock, Timeout

from pgdm.config.strict import build
from pgdm.errors import ConfigError, SweepError
from pgdm.stop import StopRequest
from pgdm.sweep.driver import Driver, Room
from pgdm.sweep.ledger import Ledger
from pgdm.sweep.plan import LocalCfg, Plan, SweepCfg, record
from pgdm.sweep.state import LOGS, parent
from pgdm.tracking.run_folder import read_json, write_json

LAUNCH = "launch.json"
"""How the sweep was started last, beside its plan."""
OUTPUT = "sweep.log"
"""What a sweep in the background prints, among the logs."""
LOCK = ".lock"
_POLL_S = 0.1

Notify = Callable[[str], None]


def room(plan: Plan, launcher: LocalCfg, cores: int, memory_gb: float) -> Room:
    """Return how the jobs of a plan share a machine.

    It follows from the whole plan, not from what is left of it.

    Args:
        plan: the jobs.
        launcher: limits.
        cores: of the machine.
        memory_gb: free memory, GB.
    """
    asked = launcher.cores_per_job or max((job.cfg.num_threads for job in plan.jobs), default=0)
    limits = [cores // max(asked, 1), int(memory_gb / launcher.memory_per_job_gb), len(plan.jobs)]
    if launcher.max_jobs:
        limits = [launcher.max_jobs, len(plan.jobs)]
    slots = max(1, min(limits))
    return Room(slots, asked or max(1, cores // slots))


def free_memory_gb() -> float:
    """Return how much memory new processes can have, GB."""
    lines = Path("/proc/meminfo").read_text().splitlines()
    fields = dict(line.split(":", 1) for line in lines)
    return int(fields["MemAvailable"].split()[0]) / 1e6


def run_sweep(plan: Plan, sweep: SweepCfg, launcher: LocalCfg, notify: Notify) -> int:
    """Do what is left of a sweep, and return the exit code.

    0: every job is finished; 1: not every one; 130 or 143: stopped by a signal.

    Args:
        plan: the jobs; its folder may hold them in any state.
        sweep: how often a job is tried, and whether to stay in the background.
        launcher: how many at a time.
        notify: told in a sentence what people should know.

    Raises:
        SweepError: if another process is at it, the folder holds a sweep with other settings, or
            cannot be used.
    """
    plan.folder.joinpath(LOGS).mkdir(parents=True, exist_ok=True)
    with held(plan):
        record(plan)
        write_json(plan.folder / LAUNCH, {"sweep": asdict(sweep), "launcher": asdict(launcher)})
        if not sweep.detach:
            shared = room(plan, launcher, len(os.sched_getaffinity(0)), free_memory_gb())
            with StopRequest() as stop:
                return Driver(plan, sweep.max_attempts, shared, notify).run(stop)
    return _detach(plan, notify)


def launched(plan: Plan) -> tuple[SweepCfg, LocalCfg]:
    """Return how a sweep was started last.

    Raises:
        SweepError: if that is not known.
    """
    known = read_json(plan.folder / LAUNCH)
    try:
        return build(SweepCfg, known["sweep"]), build(LocalCfg, known["launcher"])
    except (KeyError, ConfigError) as error:
        raise SweepError(
            f"{plan.folder / LAUNCH} does not say how the sweep was started; start it by its own "
            f"command: {plan.command}"
        ) from error


@contextlib.contextmanager
def held(plan: Plan) -> Iterator[None]:
    """Keep other processes from driving the sweep.

    Raises:
        SweepError: if another process does already.
    """
    lock = FileLock(plan.folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        other = parent(Ledger(plan.folder))
        who = f"process {other.pid}" if other else "another process"
        raise SweepError(
            f"sweep '{plan.name}' is run by {who} already; see it with pgdm sweep watch "
            f"{plan.folder}, end it with pgdm sweep cancel {plan.folder}"
        ) from error
    try:
        yield
    finally:
        lock.release()


def _detach(plan: Plan, notify: Notify) -> int:
    """Start the sweep again in a session of its own, and see it off."""
    output = plan.folder / LOGS / OUTPUT
    code = "import sys; from pgdm.cli.main import main; sys.exit(main())"
    with open(output, "ab") as log:
        child = subprocess.Popen(
            [sys.executable, "-c", code, "sweep", "resume", str(plan.folder)],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    ledger = Ledger(plan.folder)
    while (driver := parent(ledger)) is None or driver.pid != child.pid:
        if (ended := child.poll()) is not None:
            if ended:
                raise SweepError(f"the sweep ended at once; {output} tells why")
            break
        time.sleep(_POLL_S)
    notify(
        f"sweep '{plan.name}' goes on in the background (process {child.pid})\n"
        f"  watch it: pgdm sweep watch {plan.folder}\n"
        f"  end it:   pgdm sweep cancel {plan.folder}"
    )
    return 0
