"""The figures of the report except learning curves, and the thumbnails of its videos."""

from __future__ import annotations

import functools
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from PIL import Image, ImageColor

from pgdm import files
from pgdm.report.results import Results
from pgdm.report.runs import ERROR, SUCCESS
from pgdm.report.settings import Setting
from pgdm.report.statistics import Estimate
from pgdm.report.tables import THRESHOLDS, Average, by_group

# Okabe and Ito's colours, which colour-blind people can distinguish, then darker colours.
COLOURS = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F", "#000000"),
    *("#332288", "#882255", "#999933", "#44AA99", "#117733", "#AA4499", "#661100", "#6699CC"),
)
DPI = 150
NAMES = {SUCCESS: "success", ERROR: "COM error [m]"}
RGBA = tuple[float, float, float, float]
Pairs = tuple[Figure, list[tuple[Axes, Axes]]]
_WIDTH_IN = 5.2
_PALE = 0.45  # opacity without pre-grasps
_CEILINGS = (0.1, 0.2, 0.5, 1.0)  # upper limits of success axes
_THUMB = (240, 180)  # pixels
_SHADES = 12  # number of shades of each colour, for antialiased lines


def colour(results: Results, setting: Setting) -> str:
    """Return a setting's colour; if there are more settings than colours, colours repeat."""
    return COLOURS[results.settings.index(setting) % len(COLOURS)]


def intervals(results: Results, estimates: dict[Setting, Estimate], name: str) -> Figure:
    """Draw an estimate of success for each setting, with its interval."""
    figure, axes = _rows([results.labels[setting] for setting in estimates])
    for row, (setting, (value, low, high)) in enumerate(estimates.items()):
        shade = colour(results, setting)
        axes.plot([low, high], [row, row], color=shade, lw=6, alpha=0.35)
        axes.plot([value], [row], "o", color=shade, ms=5, clip_on=False)
    low, high = axes.get_xlim()
    axes.set_xlim(max(low, 0.0), min(high, 1.0))  # the range of success
    axes.set_xlabel(name, fontsize=9)
    return figure


def profiles(results: Results, found: dict[Setting, list[Estimate]]) -> Figure:
    """Draw performance profiles with their confidence bands."""
    figure, axes = _plain(3.0 + 0.18 * len(found))
    for setting, estimates in found.items():
        value, low, high = np.array(estimates).T
        shade = colour(results, setting)
        axes.plot(THRESHOLDS, value, color=shade, lw=1.8, label=results.labels[setting])
        axes.fill_between(THRESHOLDS, low, high, color=shade, alpha=0.18, lw=0)
    axes.set(xlim=(0, 1), ylim=(0, 1.02))
    axes.set_xlabel("success above", fontsize=9)
    axes.set_ylabel("share of runs", fontsize=9)
    figure.legend(loc="outside lower left", fontsize=8, frameon=False)
    return figure


def bars(rows: Sequence[Average]) -> Figure:
    """Draw success and error of methods as bars, a panel for each group of rows."""
    shade, groups = shades(rows), by_group(rows)
    row_in = _row_in([row.name for row in rows])
    heights = [row_in * len(own) for own in groups.values()]
    figure, grid = pairs(heights, 0.95 * len(groups), sharey="row")
    ends = {
        SUCCESS: axis_end(SUCCESS, _most(row.success for row in rows)),
        ERROR: axis_end(ERROR, _most(row.error for row in rows)),
    }
    for (group, own), pair in zip(groups.items(), grid, strict=True):
        for axes, (metric, end) in zip(pair, ends.items(), strict=True):
            for number, row in enumerate(own):
                value, low, high = row.success if metric == SUCCESS else row.error
                axes.barh(number, value, 0.62, color=shade[row.setting])
                axes.plot([low, high], [number, number], color="#444444", lw=1.2)
            _name_rows(axes, [row.name for row in own])
            axes.set_xlim(0, end)
            few_ticks(axes.xaxis, 3)
            axes.set_xlabel(f"{NAMES[metric]}\n{_extent(own)}", fontsize=9)
        pair[0].set_title(wrapped(group, 45), loc="left", fontsize=9)
    return figure


def shades(rows: Sequence[Average]) -> dict[Setting, RGBA]:
    """Return the rows' colours: a hue for each name, pale without pre-grasps.

    All groups share one legend, so a name has the same hue in every group.
    """
    hues = list(dict.fromkeys(row.hue for row in rows))
    return {
        row.setting: to_rgba(
            COLOURS[hues.index(row.hue) % len(COLOURS)],
            1.0 if row.setting.with_pregrasp else _PALE,
        )
        for row in rows
    }


def axis_end(metric: str, most: float) -> float:
    """Return the upper limit of an axis of success or error for values up to ``most``."""
    if metric == SUCCESS:
        return next((high for high in _CEILINGS if high >= most), most)
    return 1.1 * most or 1.0


def pairs(heights_in: Sequence[float], more_in: float, **shared: Any) -> Pairs:
    """Return axes for success and error side by side, a pair for each height.

    Args:
        heights_in: heights of the axes, inches.
        more_in: total height of everything around them, inches.
        shared: ``sharex`` and ``sharey`` of Matplotlib's ``subplots``.
    """
    figure = _figure(sum(heights_in) + more_in)
    figure.set_layout_engine("constrained", w_pad=0.1)  # else the last tick's label is cut off
    grid = figure.subplots(len(heights_in), 2, squeeze=False, height_ratios=heights_in, **shared)
    for axes in grid.flat:
        _bare(axes)
    return figure, [tuple(pair) for pair in grid]


def few_ticks(axis: Axis, most: int) -> None:
    """Put ticks at round values, with short labels and at most ``most`` intervals."""
    axis.set_major_locator(MaxNLocator(most, steps=[1, 2, 5, 10]))
    axis.set_major_formatter("{x:g}")


def wrapped(name: str, width: int = 26) -> str:
    """Return a name broken at its commas into lines of up to ``width`` characters if possible."""
    lines = [""]
    for part in name.split(", "):
        glued = f"{lines[-1]}, {part}" if lines[-1] else part
        lines = [*lines[:-1], glued] if len(glued) <= width else [*lines, part]
    return "\n".join(line for line in lines if line)


def _most(estimates: Iterable[Estimate]) -> float:
    return float(np.nanmax([0.0, *np.concatenate(list(estimates))]))


def _extent(rows: Sequence[Average]) -> str:
    """Return a text: how many tasks a group's bars average, and how long all its runs are."""
    counts = [len(row.tasks) for row in rows]
    least, most = min(counts), max(counts)
    number = f"{least}" if least == most else f"{least} to {most}"
    lines = [f"mean of {number} task{'s' if most > 1 else ''}"]
    if len({row.tasks for row in rows}) > 1:
        lines = [f"{lines[0]},", "which differ"]
    return "\n".join([*lines, f"{rows[0].setting.total_frames:,} frames"])


def _figure(height_in: float) -> Figure:
    figure = Figure((_WIDTH_IN, height_in), DPI, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def _bare(axes: Axes) -> None:
    axes.tick_params(labelsize=9, length=2)
    axes.spines[["top", "right"]].set_visible(False)


def _plain(height_in: float) -> tuple[Figure, Axes]:
    figure = _figure(height_in)
    axes = figure.add_subplot()
    _bare(axes)
    return figure, axes


def _rows(names: Sequence[str]) -> tuple[Figure, Axes]:
    """Return axes with a row for each name, the first on top."""
    figure, axes = _plain(0.6 + _row_in(names) * len(names))
    _name_rows(axes, names)
    return figure, axes


def _row_in(names: Sequence[str]) -> float:
    """Return the height of each row, inches."""
    return 0.2 + 0.16 * max(1 + wrapped(name).count("\n") for name in names)


def _name_rows(axes: Axes, names: Sequence[str]) -> None:
    axes.set_yticks(range(len(names)), [wrapped(name) for name in names])
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_axisbelow(True)
    axes.grid(axis="x", lw=0.4, alpha=0.5)


def line_axes(panels: dict[str, tuple[float, float] | None]) -> tuple[Figure, list[Axes]]:
    """Return a figure and its axes, one below the other.

    Args:
        panels: y-range of each panel by its label; None: chosen to fit the data.
    """
    figure = _figure(2.2 * len(panels) + 0.6)
    drawn = list(figure.subplots(len(panels), sharex=True, squeeze=False)[:, 0])
    for axes, (label, extent) in zip(drawn, panels.items(), strict=True):
        _bare(axes)
        axes.grid(lw=0.4, alpha=0.5)
        axes.set_ylabel(label, fontsize=9)
        if extent is not None:
            axes.set_ylim(extent)
    drawn[-1].set_xlabel("frames", fontsize=9)
    return figure, drawn


def saved(figure: Figure, file: Path) -> bytes:
    """Write a figure as PNG and return it."""
    figure.savefig(file)
    return file.read_bytes()


def thumbnail(poster: Path) -> bytes | None:
    """Return a thumbnail of a video's poster as JPEG; None if it cannot be read."""
    try:
        with Image.open(io.BytesIO(files.read_bytes(poster))) as picture:
            small = picture.convert("RGB")
            small.thumbnail(_THUMB)
    except OSError:
        return None
    stream = io.BytesIO()
    small.save(stream, "JPEG", quality=80)
    return stream.getvalue()


def png(picture: Image.Image) -> bytes:
    """Return a figure as PNG with a small palette, which makes it a quarter of the size."""
    stream = io.BytesIO()
    picture.quantize(palette=_palette(), dither=Image.Dither.NONE).save(stream, "PNG")
    return stream.getvalue()


@functools.cache
def _palette() -> Image.Image:
    """Return a palette of greys, and of each colour in steps towards white.

    A palette derived from the figure itself would miss the colour of a short curve.
    """
    shares = np.linspace(1.0, 0.0, _SHADES, endpoint=False)[:, None, None]
    colours = np.array([ImageColor.getrgb(c) for c in COLOURS])
    greys = np.linspace(0, 255, _SHADES)[:, None].repeat(3, axis=1)
    shades = (255 + shares * (colours - 255)).reshape(-1, 3)
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.concatenate((greys, shades)).round().astype(np.uint8).tobytes())
    return palette
