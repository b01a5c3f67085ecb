"""Start a sweep, in this process or in the background."""

from __future__ import annotations

import contextlib
import subprocess
import time
from collections.abc import Iterator
from dataclasses import asdict

from filelock import FileLock, Timeout

from pgdm.config.strict import build
from pgdm.errors import ConfigError, SweepError
from pgdm.runs.files import read_json, write_json
from pgdm.stop import StopRequest
from pgdm.sweep.driver import Driver
from pgdm.sweep.front import Front
from pgdm.sweep.launcher import Launcher
from pgdm.sweep.ledger import Ledger
from pgdm.sweep.local import LocalLauncher
from pgdm.sweep.plan import LAUNCHERS, LauncherCfg, LocalCfg, Plan, SweepCfg, record
from pgdm.sweep.slurm import SlurmLauncher, check_slurm
from pgdm.sweep.status import LOGS, parent

LAUNCH = "launch.json"
"""File in the sweep's folder that records how the sweep was last started."""
OUTPUT = "sweep.log"
"""File in the log folder with the output of a sweep that runs in the background."""
LOCK = ".lock"
_POLL_S = 0.1


def run_sweep(plan: Plan, sweep: SweepCfg, launcher: LauncherCfg, front: Front) -> int:
    """Run the unfinished jobs of a sweep, and return the exit code.

    0: every job is finished, or the sweep runs in the background; 1: some jobs are not finished;
    130, 140 or 143: stopped by SIGINT (Ctrl-C), SIGUSR2 or SIGTERM.

    Args:
        plan: the jobs, some of which may have been started before.
        sweep: how many times a job is tried, and whether to run in the background.
        launcher: where the jobs run, and how many at a time.
        front: the command line.

    Raises:
        SweepError: if another process drives the sweep, the folder holds a sweep with other
            settings or cannot be used, the background process fails to start, Slurm is not
            installed or refuses the jobs, or squeue has failed for an hour.
    """
    if not isinstance(launcher, LocalCfg):
        check_slurm()
    plan.folder.joinpath(LOGS).mkdir(parents=True, exist_ok=True)
    with held(plan):
        record(plan)
        write_json(plan.folder / LAUNCH, {"sweep": asdict(sweep), "launcher": asdict(launcher)})
        if not sweep.detach:
            with StopRequest() as stop:
                starts = _launcher(plan, launcher, front)
                return Driver(plan, sweep.max_attempts, starts, front).run(stop)
    return _detach(plan, front)


def _launcher(plan: Plan, cfg: LauncherCfg, front: Front) -> Launcher:
    if isinstance(cfg, LocalCfg):
        return LocalLauncher(plan, cfg, front.worker)
    return SlurmLauncher(plan, cfg, front.worker)


def launched(plan: Plan) -> tuple[SweepCfg, LauncherCfg]:
    """Return the settings with which a sweep was last started.

    Raises:
        SweepError: if they were not recorded.
    """
    known = read_json(plan.folder / LAUNCH)
    try:
        launcher = known["launcher"]
        return build(SweepCfg, known["sweep"]), build(LAUNCHERS[launcher["name"]], launcher)
    except (KeyError, ConfigError) as error:
        raise SweepError(
            f"{plan.folder / LAUNCH} does not record how the sweep was started; start it with its "
            f"original command: {plan.command}"
        ) from error


@contextlib.contextmanager
def held(plan: Plan) -> Iterator[None]:
    """Hold the sweep's lock, so that no other process drives the sweep.

    Raises:
        SweepError: if another process holds the lock.
    """
    lock = FileLock(plan.folder / LOCK)
    try:
        lock.acquire(timeout=0)
    except Timeout as error:
        other = parent(Ledger(plan.folder))
        who = f"process {other.pid}" if other else "another process"
        raise SweepError(
            f"sweep '{plan.name}' is already run by {who}; watch it with pgdm sweep watch "
            f"{plan.folder}, stop it with pgdm sweep cancel {plan.folder}"
        ) from error
    try:
        yield
    finally:
        lock.release()


def _detach(plan: Plan, front: Front) -> int:
    """Start the sweep in a background process, and return once it runs."""
    output = plan.folder / LOGS / OUTPUT
    with open(output, "ab") as log:
        child = subprocess.Popen(
            [*front.resume, str(plan.folder)],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=log,
            start_new_session=True,
        )
    ledger = Ledger(plan.folder)
    while (driver := parent(ledger)) is None or driver.pid != child.pid:
        if (ended := child.poll()) is not None:
            if ended:
                raise SweepError(f"the sweep failed to start; see {output}")
            break
        time.sleep(_POLL_S)
    front.notify(
        f"sweep '{plan.name}' runs in the background (process {child.pid})\n"
        f"  watch it: pgdm sweep watch {plan.folder}\n"
        f"  stop it:  pgdm sweep cancel {plan.folder}"
    )
    return 0
