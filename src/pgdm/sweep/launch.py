"""A sweep from its plan to its exit code, here or in the background."""

from __future__ import annotations

import contextlib
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict

from filelock import FileLock, Timeout

from pgdm.config.strict import build
from pgdm.errors import ConfigError, SweepError
from pgdm.stop import StopRequest
from pgdm.sweep.driver import Driver
from pgdm.sweep.launcher import Launcher
from pgdm.sweep.ledger import Ledger
from pgdm.sweep.local import LocalLauncher
from pgdm.sweep.plan import LAUNCHERS, LauncherCfg, LocalCfg, Plan, SweepCfg, record
from pgdm.sweep.slurm import SlurmLauncher, check_slurm
from pgdm.sweep.state import LOGS, parent
from pgdm.tracking.run_folder import read_json, write_json

LAUNCH = "launch.json"
"""How the sweep was started last, beside its plan."""
OUTPUT = "sweep.log"
"""What a sweep in the background prints, among the logs."""
LOCK = ".lock"
_POLL_S = 0.1

Notify = Callable[[str], None]


def run_sweep(plan: Plan, sweep: SweepCfg, launcher: LauncherCfg, notify: Notify) -> int:
    """Do what is left of a sweep, and return the exit code.

    0: every job is finished; 1: not every one; 130 or 143: stopped by a signal.

    Args:
        plan: the jobs; its folder may hold them in any state.
        sweep: how often a job is tried, and whether to stay in the background.
        launcher: where they run, and how many at a time.
        notify: told in a sentence what people should know.

    Raises:
        SweepError: if another process is at it, the folder holds a sweep with other settings, or
            cannot be used; or there is no Slurm here, or it refuses the jobs.
    """
    if not isinstance(launcher, LocalCfg):
        check_slurm()
    plan.folder.joinpath(LOGS).mkdir(parents=True, exist_ok=True)
    with held(plan):
        record(plan)
        write_json(plan.folder / LAUNCH, {"sweep": asdict(sweep), "launcher": asdict(launcher)})
        if not sweep.detach:
            with StopRequest() as stop:
                starts = _launcher(plan, launcher)
                return Driver(plan, sweep.max_attempts, starts, notify).run(stop)
    return _detach(plan, notify)


def _launcher(plan: Plan, cfg: LauncherCfg) -> Launcher:
    return LocalLauncher(plan, cfg) if isinstance(cfg, LocalCfg) else SlurmLauncher(plan, cfg)


def launched(plan: Plan) -> tuple[SweepCfg, LauncherCfg]:
    """Return how a sweep was started last.

    Raises:
        SweepError: if that is not known.
    """
    known = read_json(plan.folder / LAUNCH)
    try:
        launcher = known["launcher"]
        return build(SweepCfg, known["sweep"]), build(LAUNCHERS[launcher["name"]], launcher)
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
