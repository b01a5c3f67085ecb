"""Learning curves: one figure with a panel for each task."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
from PIL import Image

from pgdm.config.compose import PAPER_FRAMES
from pgdm.report.figures import DPI, axis_end, colour, png
from pgdm.report.results import Array, Results, known, paper
from pgdm.report.runs import ERROR, SUCCESS, Run

# Inches: a panel, and the axes in it (left, bottom, width, height).
_PANEL = (2.9, 2.2)
_INNER = (0.5, 0.35, 2.25, 1.5)
_LEGEND = 0.2  # height of a line of the legend
_COLUMNS = 5
_POINTS = 200  # maximum number of points of a mean curve
_NAMES = {SUCCESS: "success", ERROR: "COM error, released form [m]"}
_PAPER = {SUCCESS: "paper_success", ERROR: "paper_com_error"}
_GREY = "#888888"


@dataclass(frozen=True)
class _Scale:
    """Maps frames and values to a panel's unit square; the same for all panels."""

    logarithmic: bool
    furthest: float  # frames
    low: float  # lower end of the values, or of their log10 if logarithmic
    high: float

    def __call__(self, frames: Array, values: Array) -> Array:
        """Return points in or just outside the unit square, (N, 2), without non-finite values."""
        y = np.log10(values.clip(10.0**self.low)) if self.logarithmic else values
        places = np.column_stack([frames / self.furthest, (y - self.low) / (self.high - self.low)])
        return places[np.isfinite(places).all(axis=1)].clip(-0.02, 1.02)

    def ticks(self) -> Iterator[tuple[float, str]]:
        """Yield the values of the ticks, each with its label."""
        if self.logarithmic:
            for power in range(round(self.low), round(self.high) + 1):
                yield 10.0**power, f"$10^{{{power}}}$"
        else:
            yield from ((value, f"{value:g}") for value in (0.0, self.high / 2, self.high))


def curves(
    results: Results, metric: str, file: Path, progress: Callable[[int, int], None]
) -> dict[str, bytes]:
    """Draw a metric over frames, a panel for each task, and write them as one PNG.

    A single pair of axes holds all panels, since fifty pairs would take five times as long to draw.

    Args:
        results: the runs.
        metric: ``SUCCESS`` or ``ERROR``.
        file: the PNG.
        progress: called with the number of panels drawn and that of all panels.

    Returns:
        Task to the PNG of its panel.
    """
    columns = min(_COLUMNS, len(results.tasks))
    legend = _LEGEND * (len(results.settings) + 2)
    width = columns * _PANEL[0]
    height = math.ceil(len(results.tasks) / columns) * _PANEL[1] + legend
    figure = Figure((width, height), DPI)
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(0, height), frame_on=False)
    scale = _scale(results, metric)
    corners = {}
    for number, task in enumerate(results.tasks):
        progress(number, len(results.tasks))
        row, column = divmod(number, columns)
        left, top = column * _PANEL[0], row * _PANEL[1]
        corners[task] = round(DPI * left), round(DPI * top)
        _panel(axes, (left, height - top - _PANEL[1]), scale, results, task, metric)
    handles = [Line2D([], [], color=colour(results, s)) for s in results.settings]
    names = [results.labels[s] for s in results.settings]
    title = f"{_NAMES[metric]} over millions of frames"
    figure.legend(handles, names, loc="lower left", title=title, frameon=False, fontsize=8)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    whole = Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3])
    file.write_bytes(png(whole))
    wide, tall = (round(DPI * inches) for inches in _PANEL)
    return {t: png(whole.crop((x, y, x + wide, y + tall))) for t, (x, y) in corners.items()}


def _panel(
    axes: Axes,
    corner: tuple[float, float],
    scale: _Scale,
    results: Results,
    task: str,
    metric: str,
) -> None:
    """Draw a task's panel with its lower left corner at a point, in inches."""
    origin = np.array([corner[0] + _INNER[0], corner[1] + _INNER[1]])
    size = np.array(_INNER[2:])

    def place(frames: Array, values: Array) -> Array:
        return origin + size * scale(frames, values)

    thin, thick, bands, shades = [], [], [], []
    for setting in results.settings:
        runs = [run for run in results.cell(setting, task) if len(run.evaluations["frames"])]
        if not runs:
            continue
        shade = colour(results, setting)
        lines = [place(run.evaluations["frames"], run.evaluations[metric]) for run in runs]
        thin += [(line, shade) for line in lines if len(runs) > 1]
        frames, mean, spread = mean_curve([r for r in runs if r.finished] or runs, metric)
        thick.append(place(frames, mean))
        shades.append(shade)
        upper, lower = place(frames, mean + spread), place(frames, mean - spread)
        bands.append(np.concatenate([upper, lower[::-1]]))
    axes.add_collection(PolyCollection(bands, facecolors=shades, alpha=0.18, linewidths=0))
    axes.add_collection(
        LineCollection([t[0] for t in thin], colors=[t[1] for t in thin], linewidths=0.6, alpha=0.6)
    )
    axes.add_collection(LineCollection(thick, colors=shades, linewidths=1.6))
    ends = np.array([0.0, scale.furthest])
    for value, style in _levels(results, task, metric):
        x, y = place(ends, np.array([value, value])).T
        axes.plot(x, y, color=_GREY, lw=0.9, ls=style)
    _frame(axes, place, scale)
    x, y = origin + size * (0.5, 1.06)
    axes.text(x, y, task, fontsize=9, ha="center")


def _levels(results: Results, task: str, metric: str) -> Iterator[tuple[float, str]]:
    """Yield the reference values of a task, each with the style of its line."""
    null = paper()["null_policy"].get(task)
    if metric == SUCCESS and null is not None:
        yield null, ":"
    runs = [run for setting in results.settings for run in results.cell(setting, task)]
    value = known(runs[0], _PAPER[metric])
    if max(run.frames for run in runs) >= PAPER_FRAMES and np.isfinite(value):
        yield value, "--"


def _frame(axes: Axes, place: Callable[[Array, Array], Array], scale: _Scale) -> None:
    """Draw the axes of a panel with their ticks."""
    values = list(scale.ticks())
    low, high = values[0][0], values[-1][0]
    corner = place(np.array([0.0, 0.0, scale.furthest]), np.array([high, low, low]))
    axes.plot(corner[:, 0], corner[:, 1], color="black", lw=0.7)
    for value, text in values:
        x, y = place(np.array([0.0]), np.array([value]))[0]
        axes.text(x - 0.06, y, text, fontsize=8, ha="right", va="center")
    for millions in MaxNLocator(4).tick_values(0, scale.furthest / 1e6):
        if 0 <= millions <= scale.furthest / 1e6:
            x, y = place(np.array([1e6 * millions]), np.array([low]))[0]
            axes.text(x, y - 0.06, f"{millions:g}", fontsize=8, ha="center", va="top")


def _scale(results: Results, metric: str) -> _Scale:
    furthest = max(run.evaluations["frames"].max(initial=1.0) for run in results.runs)
    values = np.concatenate([run.evaluations[metric] for run in results.runs])
    if metric == SUCCESS:
        levels = [v for task in results.tasks for v, _ in _levels(results, task, metric)]
        most = max([*values[np.isfinite(values)], *levels], default=1.0)
        return _Scale(False, furthest, 0.0, axis_end(metric, most))
    powers = np.log10(values[np.isfinite(values) & (values > 0)])
    low, high = math.floor(powers.min(initial=-1.0)), math.ceil(powers.max(initial=-2.0))
    return _Scale(True, furthest, low, max(high, low + 1))


def mean_curve(runs: Sequence[Run], metric: str) -> tuple[Array, Array, Array]:
    """Return frames, mean and standard deviation over runs, up to the end of the shortest."""
    return mean_line([(run.evaluations["frames"], run.evaluations[metric]) for run in runs])


def mean_line(lines: Sequence[tuple[Array, Array]]) -> tuple[Array, Array, Array]:
    """Return frames, mean and standard deviation of curves, up to the end of the shortest.

    Args:
        lines: frames and values of each curve; values in between are interpolated linearly.
    """
    last = min(frames[-1] for frames, _ in lines)
    every = np.unique(np.concatenate([frames for frames, _ in lines]))
    every = every[every <= last]
    every = every[np.linspace(0, len(every) - 1, min(len(every), _POINTS)).astype(int)]
    values = np.array([np.interp(every, *line) for line in lines])
    spread = values.std(axis=0, ddof=1) if len(lines) > 1 else np.zeros(len(every))
    return every, values.mean(axis=0), spread
