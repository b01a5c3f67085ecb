"""Learning curves averaged over tasks, as the paper draws them."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from pgdm.report.curves import mean_curve, mean_line
from pgdm.report.figures import NAMES, axis_end, colour, few_ticks, pairs, shades, wrapped
from pgdm.report.results import Array, Results
from pgdm.report.runs import Run
from pgdm.report.tables import Average, by_group

# Inches: a drawing, what is around it, each line of the legend.
_HEIGHT_IN, _AROUND_IN, _LEGEND_IN = 1.5, 0.7, 0.18
Tasks = Sequence[Sequence[Run]]
"""Each task's runs."""


@dataclass(frozen=True)
class Line:
    """A mean over tasks."""

    name: str
    """In the legend; empty for none."""
    tasks: Tasks
    style: dict[str, Any]
    """Matplotlib's."""


Panels = dict[str, list[Line]]
"""Title to lines."""


def over_tasks(tasks: Tasks, metric: str) -> tuple[Array, Array]:
    """Return frames, and the mean over tasks of each task's mean over its runs.

    It goes as far as all of the runs have come.
    """
    frames, mean, _ = mean_line([mean_curve(runs, metric)[:2] for runs in tasks])
    return frames, mean


def compared(results: Results, rows: Sequence[Average]) -> Figure | None:
    """Draw a line for each row, by groups; None if in none of them a task is everywhere.

    Lines over different tasks would tell of the tasks, so only those count that a whole group has.
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
            count = _count(tasks)
            many = f"the {count} that all have" if len(own) > 1 else count
            panels[_title(group, f"mean of {many}")] = lines
    return _drawn(panels)


def apart(results: Results, rows: Sequence[Average]) -> set[str]:
    """Return the groups whose rows share no task, which is why they have no curve."""
    return {
        group
        for group, own in by_group(rows).items()
        if not _shared([row.tasks for row in own])
        and not _shared([_runs(results, row) for row in own])
    }


def validated(results: Results, rows: Sequence[Average]) -> Figure | None:
    """Draw the mean over each row's tasks, and of each seed that has them all, thin."""
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
            panels[_title(row.group, f"mean of {_count(tasks)}{seen}")] = [*lines, mean]
    return _drawn(panels)


def _runs(results: Results, row: Average) -> dict[str, list[Run]]:
    """Return the runs of each of a row's tasks that have a curve.

    Finished ones, or where there are none those that may go on.
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
    """Return the tasks that all have."""
    return [task for task in each[0] if all(task in others for others in each)]


def _style(row: Average, shade: Any) -> dict[str, Any]:
    return {"color": shade, "lw": 1.8, "ls": "-" if row.setting.with_pregrasp else "--"}


def _count(tasks: Sequence[Any]) -> str:
    return f"{len(tasks)} task{'s' if len(tasks) > 1 else ''}"


def _title(group: str, text: str) -> str:
    return wrapped(", ".join(filter(None, (group, text))), 60)


def _drawn(panels: Panels) -> Figure | None:
    """Draw success and error over frames."""
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
        axes.set_ylim(-0.02 * end, end)  # the axis would hide a line at 0
        few_ticks(axes.yaxis, 4)
    if styles:
        handles = [Line2D([], [], **style) for style in styles.values()]
        figure.legend(handles, styles, loc="outside lower left", fontsize=8, frameon=False)
    return figure
