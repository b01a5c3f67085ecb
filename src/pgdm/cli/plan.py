"""A sweep before it starts: planned, shown, and handed to its launcher."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence

from rich.console import Console
from rich.table import Table

from pgdm import paths
from pgdm.cli.compose import Composed
from pgdm.cli.train import notify
from pgdm.config.strict import build
from pgdm.errors import ConfigError, UnknownNameError
from pgdm.library import open_library
from pgdm.sweep.estimate import Estimate, estimate
from pgdm.sweep.foresee import foresee
from pgdm.sweep.launch import run_sweep
from pgdm.sweep.plan import LAUNCHERS, LauncherCfg, LocalCfg, Plan, SweepCfg, check_fits
from pgdm.sweep.planning import make_plan

_WIDE = 200  # columns where nobody's terminal sets them
_MOST_NOTES = 3


def run_planned(composed: Composed, name: str, command: str) -> int:
    """Plan a sweep, show the plan, do it, and return the exit code.

    Args:
        composed: its jobs.
        name: its name if ``sweep.name`` has none.
        command: what was typed.

    Raises:
        PgdmError: if a job's settings are wrong, or the sweep's folder holds another sweep.
    """
    sweep = build(SweepCfg, composed.jobs[0][1].sweep, "sweep")
    launcher = _launcher(composed)
    plan, notes = make_plan(composed.jobs, sweep, name, command)
    check_fits(plan)
    for note in [*notes[:_MOST_NOTES], *(["..."] if len(notes) > _MOST_NOTES else [])]:
        notify(f"note: {note}")
    for note in foresee((job.cfg for job in plan.jobs), open_library()):
        notify(f"note: {note}")
    _show(plan, estimate(plan, paths.runs()))
    if sweep.dry_run:
        print("nothing was started (sweep.dry_run)")
        return 0
    return run_sweep(plan, sweep, launcher, notify)


def _launcher(composed: Composed) -> LauncherCfg:
    choice = composed.launcher_choice
    if choice not in LAUNCHERS:
        raise UnknownNameError("hydra/launcher of pgdm", choice, LAUNCHERS)
    launcher: LauncherCfg = build(LAUNCHERS[choice], composed.launcher, "hydra.launcher")
    least = (
        {"max_jobs": 0, "cores_per_job": 0}
        if isinstance(launcher, LocalCfg)
        else {"time_min": 1, "cores_per_job": 1, "signal_delay_s": 1, "poll_s": 1}
        | {"gpus_per_job": 0, "array_parallelism": 0}
    )
    for key, bound in least.items():
        if (value := getattr(launcher, key)) < bound:
            raise ConfigError(f"hydra.launcher.{key} is {value}; it must be at least {bound}")
    if (memory := launcher.memory_per_job_gb) <= 0:
        raise ConfigError(f"hydra.launcher.memory_per_job_gb is {memory}; it must be above 0")
    if not isinstance(launcher, LocalCfg) and launcher.signal_delay_s >= 60 * launcher.time_min:
        raise ConfigError(
            f"hydra.launcher.signal_delay_s is {launcher.signal_delay_s}, and the time limit "
            f"time_min only {launcher.time_min} minutes; choose a longer one"
        )
    return launcher


def _show(plan: Plan, cost: Estimate) -> None:
    console = Console() if sys.stdout.isatty() else Console(width=_WIDE)
    table = Table(box=None, show_header=False, title=f"sweep {plan.name}", title_justify="left")
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for key, value in _rows(plan, cost):
        table.add_row(key, value)
    console.print(table, markup=False)
    # Not through rich: a path must stay whole on its line.
    print(f"folder: {plan.folder}")


def _rows(plan: Plan, cost: Estimate) -> list[tuple[str, str]]:
    cfgs = [job.cfg for job in plan.jobs]
    tasks = _each(cfg.task.id for cfg in cfgs)
    choices = {
        "method": [cfg.method.name for cfg in cfgs],
        "ablation": [cfg.ablation.name for cfg in cfgs],
        "pregrasp": [cfg.pregrasp.source for cfg in cfgs],
        "algo": [cfg.algo.name for cfg in cfgs],
        "action": [cfg.action.kind for cfg in cfgs],
        "obs": [cfg.obs.layout for cfg in cfgs],
        "budget": [cfg.budget for cfg in cfgs],
    }
    state = [f"{cost.finished} finished", f"{cost.begun} begun"]
    total = sum(cfg.total_frames for cfg in cfgs)
    lengths = " or ".join(f"{n:,}" for n in sorted({cfg.total_frames for cfg in cfgs}))
    speed = f"{cost.steps_per_s:,.0f} steps/s"
    source = (
        f"{speed}, measured in {cost.measured_runs} earlier runs"
        if cost.measured_runs
        else f"{speed}, which is assumed: no earlier run like these lies in {paths.runs()}"
    )
    disk = max(cfg.total_frames * cfg.algo.usual_frame_bytes for cfg in cfgs) / 1e9
    kept = "kept" if any(cfg.keep_replay for cfg in cfgs) else "until it has finished"
    replay = [("disk", f"about {disk:.1f} GB for the replay of a job, {kept}")]
    return [
        ("jobs", f"{len(cfgs)} ({', '.join(state)})"),
        ("tasks", f"{len(tasks)}: {_some(tasks)}"),
        ("seeds", _some(_each(str(cfg.seed) for cfg in cfgs))),
        ("settings", ", ".join(f"{k} {'|'.join(_each(v))}" for k, v in choices.items())),
        ("differ in", _some(_differing(plan))),
        ("frames", f"{lengths} a job, {total:,} in all, {cost.frames_left:,} to do"),
        ("time", f"about {_span(cost.hours)} of training, one job after the other at {source}"),
        *(replay if disk else []),
    ]


def _differing(plan: Plan) -> list[str]:
    """Return the keys in which the names of the jobs differ."""
    words = {word for job in plan.jobs for word in job.name.split()}
    keys = [word.partition("=")[0] for word in words]
    return sorted({key for key in keys if keys.count(key) > 1}) or ["nothing"]


def _each(values: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(values))


def _some(values: Sequence[str]) -> str:
    shown = values if len(values) <= 6 else [*values[:5], f"... {values[-1]}"]
    return ", ".join(shown)


def _span(hours: float) -> str:
    return f"{hours:,.1f} hours" if hours >= 1 else f"{hours * 60:.0f} minutes"
