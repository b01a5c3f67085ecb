"""Learning curves averaged over tasks, as the paper draws them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from pgdm.errors import amount
from pgdm.report.curves import mean_curve, mean_line
from pgdm.report.figures import NAMES, axis_end, colour, few_ticks, pairs, shades, wrapped
from pgdm.report.results import Array, Results
from pgdm.report.runs import Run
from pgdm.report.tables import Average, by_group

# Inches: axes, everything around them, a line of the legend.
_HEIGHT_IN, _AROUND_IN, _LEGEND_IN = 1.5, 0.7, 0.18
Tasks = Sequence[Sequence[Run]]
"""The runs of each task."""


@dataclass(frozen=True)
class Line:
    """A curve: the mean over tasks."""

    name: str
    """Name in the legend; empty for none."""
    tasks: Tasks
    style: dict[str, Any]
    """Keywords of Matplotlib's ``plot``."""


Panels = dict[str, list[Line]]
"""Title to lines."""


def over_tasks(tasks: Tasks, metric: str) -> tuple[Array, Array]:
    """Return frames, and the mean over tasks of each task's mean over its runs.

    The curve ends where the shortest run does.
    """
    frames, mean, _ = mean_line([mean_curve(runs, metric)[:2] for runs in tasks])
    return frames, mean


def compared(results: Results, rows: Sequence[Average]) -> Figure | None:
    """Draw a line for each row, a panel for each group; None if no group has a shared task.

    Each line averages only the tasks that every row of its group has; otherwise the lines would
    be means over different tasks.
    """
    shade, panels = shades(rows), {}
    for group, own in by_group(rows).items():
        runs = [_runs(results, row) for row in own]
        tasks = _shared(runs)
        if tasks:
            lines = [
                Line(row.name, [found[task] for task in tasks], _style(row, shade[row.setting]))
                for row, found in zip(own, runs, strict=True)
            ]
            kind = "shared task" if len(own) > 1 else "task"
            panels[_title(group, f"mean of {amount(len(tasks), kind)}")] = lines
    return _drawn(panels)


def apart(results: Results, rows: Sequence[Average]) -> set[str]:
    """Return the groups that have no panel because their rows share no task."""
    return {
        group
        for group, own in by_group(rows).items()
        if not _shared([row.tasks for row in own])
        and not _shared([_runs(results, row) for row in own])
    }


def validated(results: Results, rows: Sequence[Average]) -> Figure | None:
    """Draw the mean over each row's tasks, and a thin line for each seed that has all of them."""
    panels = {}
    for row in rows:
        tasks = list(_runs(results, row).values())
        seeds = sorted({run.seed for runs in tasks for run in runs})
        single = [[[run for run in runs if run.seed == s] for runs in tasks] for s in seeds]
        whole = [own for own in single if all(own)] if len(seeds) > 1 else []
        shade = colour(results, row.setting)
        lines = [Line("", own, {"color": shade, "lw": 0.6, "alpha": 0.6}) for own in whole]
        seen = f"; thin: {len(whole)} of {len(seeds)} seeds" if whole else ""
        if tasks:
            mean = Line("", tasks, {"color": shade, "lw": 1.8})
            text = f"mean of {amount(len(tasks), 'task')}{seen}"
            panels[_title(row.group, text)] = [*lines, mean]
    return _drawn(panels)


def _runs(results: Results, row: Average) -> dict[str, list[Run]]:
    """Return the runs of a row to average, by task.

    These are the finished runs of a task or, if there are none, all that have not failed. Runs with
    fewer than two evaluations have no curve and are left out, as are tasks without a curve.
    """
    found = {}
    for task in results.tasks:
        runs = [
            run
            for run in results.cell(row.setting, task)
            if row.wanted(run) and run.state != "failed" and len(run.evaluations["frames"]) > 1
        ]
        if runs:
            found[task] = [run for run in runs if run.finished] or runs
    return found


def _shared(each: Sequence[Collection[str]]) -> list[str]:
    """Return the tasks that occur in every collection."""
    return [task for task in each[0] if all(task in others for others in each)]


def _style(row: Average, shade: Any) -> dict[str, Any]:
    return {"color": shade, "lw": 1.8, "ls": "-" if row.setting.with_pregrasp else "--"}


def _title(group: str, text: str) -> str:
    return wrapped(", ".join(filter(None, (group, text))), 60)


def _drawn(panels: Panels) -> Figure | None:
    """Draw success and error over frames, a pair of axes for each panel."""
    if not panels:
        return None
    styles = {line.name: line.style for lines in panels.values() for line in lines if line.name}
    around_in = _AROUND_IN * len(panels) + _LEGEND_IN * len(styles)
    figure, grid = pairs([_HEIGHT_IN] * len(panels), around_in, sharex="row", sharey="col")
    for column, (metric, name) in enumerate(NAMES.items()):
        most = 0.0
        for (title, lines), pair in zip(panels.items(), grid, strict=True):
            axes = pair[column]
            for line in lines:
                frames, mean = over_tasks(line.tasks, metric)
                axes.plot(frames / 1e6, mean, **line.style)
                most = float(np.nanmax(mean, initial=most))
            few_ticks(axes.xaxis, 4)
            axes.set_xlabel("million frames", fontsize=9)
            axes.set_ylabel(name, fontsize=9)
            pair[0].set_title(title, loc="left", fontsize=9)
        end = axis_end(metric, most)
        axes.set_ylim(-0.02 * end, end)  # room for a line at 0
        few_ticks(axes.yaxis, 4)
    if styles:
        handles = [Line2D([], [], **style) for style in styles.values()]
        figure.legend(handles, styles, loc="outside lower left", fontsize=8, frameon=False)
    return figure
