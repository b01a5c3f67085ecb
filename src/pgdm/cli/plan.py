"""Plan a sweep, print the plan, and pass it to the launcher."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from rich.table import Table

from pgdm import paths
from pgdm.cli.console.screen import bars, notify, tables
from pgdm.cli.console.sweep_table import span
from pgdm.cli.jobs import Asked
from pgdm.cli.sweep import FRONT
from pgdm.config.groups import GROUPS
from pgdm.config.strict import build
from pgdm.errors import amount
from pgdm.library import open_library
from pgdm.runs.config_file import dotted
from pgdm.sweep.estimate import Estimate, estimate
from pgdm.sweep.foresee import foresee
from pgdm.sweep.launch import run_sweep
from pgdm.sweep.plan import Plan, SweepCfg, check_fits, read_launcher
from pgdm.sweep.planning import make_plan

_MOST_NOTES = 3


def run_planned(asked: Asked, name: str, command: str) -> int:
    """Plan a sweep, show the plan, carry it out, and return the exit code.

    Args:
        asked: the sweep's jobs and launcher.
        name: the sweep's name if ``sweep.name`` is null.
        command: the command line that was typed.

    Raises:
        PgdmError: if a job's settings are wrong, or the sweep's folder holds another sweep.
    """
    sweep = build(SweepCfg, asked.jobs[0][1].get("sweep"), "sweep")
    launcher = read_launcher(asked.launcher_choice, asked.launcher)
    with bars(patience_s=2.0) as progress:
        plan, notes = make_plan(asked.jobs, sweep, name, command, progress)
        check_fits(plan)
        expected = foresee([job.cfg for job in plan.jobs], open_library(), progress)
        cost = estimate(plan, paths.runs(), progress)
    for note in [*notes[:_MOST_NOTES], *(["..."] if len(notes) > _MOST_NOTES else [])]:
        notify(f"note: {note}")
    for note in expected:
        notify(f"note: {note}")
    _show(plan, cost)
    if sweep.dry_run:
        print("nothing was started (sweep.dry_run)")
        return 0
    return run_sweep(plan, sweep, launcher, FRONT)


def _show(plan: Plan, cost: Estimate) -> None:
    table = Table(box=None, show_header=False, title=f"sweep {plan.name}", title_justify="left")
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for key, value in _rows(plan, cost):
        table.add_row(key, value)
    tables().print(table, markup=False)
    # Not printed with rich, which would wrap a long path.
    print(f"folder: {plan.folder}")


def _rows(plan: Plan, cost: Estimate) -> list[tuple[str, str]]:
    cfgs = [job.cfg for job in plan.jobs]
    tasks = _each(cfg.task.id for cfg in cfgs)
    flat = [dotted(cfg) for cfg in cfgs]
    choices = {
        group: _each(settings[key] for settings in flat)
        for group, key in {**GROUPS, "budget": "budget"}.items()
        if group not in ("reference", "hand")
    }
    state = [f"{cost.finished} finished", f"{cost.begun} begun"]
    total = sum(cfg.total_frames for cfg in cfgs)
    lengths = " or ".join(f"{n:,}" for n in sorted({cfg.total_frames for cfg in cfgs}))
    speed = f"{cost.steps_per_s:,.0f} steps/s"
    source = (
        f"{speed}, measured in {amount(cost.measured_runs, 'earlier run')}"
        if cost.measured_runs
        else f"{speed}, which is assumed: there is no earlier run like these"
    )
    disk = max(cfg.total_frames * cfg.algo.usual_frame_bytes for cfg in cfgs) / 1e9
    kept = "kept" if any(cfg.keep_replay for cfg in cfgs) else "until it has finished"
    replay = [("disk", f"about {disk:.1f} GB for the replay of a job, {kept}")]
    return [
        ("jobs", f"{len(cfgs)} ({', '.join(state)})"),
        ("tasks", f"{len(tasks)}: {_some(tasks)}"),
        ("seeds", _some(_each(str(cfg.seed) for cfg in cfgs))),
        ("settings", ", ".join(f"{k} {'|'.join(v)}" for k, v in choices.items())),
        ("differ in", _some(_differing(plan))),
        ("frames", f"{lengths} a job, {total:,} in all, {cost.frames_left:,} left"),
        (
            "time",
            f"about {span(3600 * cost.hours)} of training if jobs run one by one at {source}",
        ),
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
