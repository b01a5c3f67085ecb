"""The report's small pictures: statistics, and frames of films."""

from __future__ import annotations

import functools
import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image, ImageColor

from pgdm.report.results import Results
from pgdm.report.settings import Setting
from pgdm.report.statistics import Estimate
from pgdm.report.tables import THRESHOLDS, Average

# Okabe and Ito's colours, which colour-blind people can tell apart, then darker ones.
COLOURS = (
    *("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#7F7F7F", "#000000"),
    *("#332288", "#882255", "#999933", "#44AA99"),
)
DPI = 150
_WIDTH_IN = 5.2
_THUMB = (240, 180)  # pixels of a film's picture
_SHADES = 12  # of a colour in a drawing: lines have soft edges


def colour(results: Results, setting: Setting) -> str:
    """Return a setting's colour; after all of them they begin again."""
    return COLOURS[results.settings.index(setting) % len(COLOURS)]


def intervals(results: Results, estimates: dict[Setting, Estimate], name: str) -> Figure:
    """Draw one estimate a setting, with its interval."""
    figure, axes = _rows([results.labels[setting] for setting in estimates])
    for row, (setting, (value, low, high)) in enumerate(estimates.items()):
        shade = colour(results, setting)
        axes.plot([low, high], [row, row], color=shade, lw=6, alpha=0.35)
        axes.plot([value], [row], "o", color=shade, ms=5)
    axes.set_xlabel(name, fontsize=9)
    return figure


def profiles(results: Results, found: dict[Setting, list[Estimate]]) -> Figure:
    """Draw performance profiles with their bands."""
    figure, axes = _plain(3.0 + 0.18 * len(found))
    for setting, estimates in found.items():
        value, low, high = np.array(estimates).T
        shade = colour(results, setting)
        axes.plot(THRESHOLDS, value, color=shade, lw=1.8, label=results.labels[setting])
        axes.fill_between(THRESHOLDS, low, high, color=shade, alpha=0.18, lw=0)
    axes.set(xlim=(0, 1), ylim=(0, 1.02))
    axes.set_xlabel("success of more than", fontsize=9)
    axes.set_ylabel("share of runs", fontsize=9)
    figure.legend(loc="outside lower left", fontsize=8, frameon=False)
    return figure


def bars(results: Results, rows: Sequence[Average]) -> Figure:
    """Draw success of methods with (full) and without (pale) pre-grasps."""
    figure, axes = _rows([", ".join(filter(None, (row.name, row.group))) for row in rows])
    for number, row in enumerate(rows):
        value, low, high = row.success
        alpha = 1.0 if row.setting.with_pregrasp else 0.45
        axes.barh(number, value, 0.62, color=colour(results, row.setting), alpha=alpha)
        axes.plot([low, high], [number, number], color="#444444", lw=1.2)
    axes.set_xlim(0, 1)
    axes.set_xlabel("success, mean of tasks", fontsize=9)
    return figure


def _plain(height_in: float) -> tuple[Figure, Axes]:
    figure = Figure((_WIDTH_IN, height_in), DPI, layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.tick_params(labelsize=9, length=2)
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes


def _rows(names: Sequence[str]) -> tuple[Figure, Axes]:
    """Return axes with a named row for each, the first on top."""
    wrapped = [_wrapped(name) for name in names]
    lines = max(1 + text.count("\n") for text in wrapped)
    figure, axes = _plain(0.6 + (0.2 + 0.16 * lines) * len(names))
    axes.set_yticks(range(len(names)), wrapped)
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_axisbelow(True)
    axes.grid(axis="x", lw=0.4, alpha=0.5)
    return figure, axes


def _wrapped(name: str, width: int = 26) -> str:
    lines = [""]
    for part in name.split(", "):
        glued = f"{lines[-1]}, {part}" if lines[-1] else part
        lines = [*lines[:-1], glued] if len(glued) <= width else [*lines, part]
    return "\n".join(line for line in lines if line)


def saved(figure: Figure, file: Path) -> bytes:
    """Write a figure as PNG and return it."""
    figure.savefig(file)
    return file.read_bytes()


def thumbnail(poster: Path) -> bytes | None:
    """Return a film's picture, made small, as JPEG; None if it cannot be read."""
    try:
        with Image.open(poster) as picture:
            small = picture.convert("RGB")
            small.thumbnail(_THUMB)
    except OSError:
        return None
    stream = io.BytesIO()
    small.save(stream, "JPEG", quality=80)
    return stream.getvalue()


def png(picture: Image.Image) -> bytes:
    """Return a drawing as PNG with few colours, a quarter of the size."""
    stream = io.BytesIO()
    picture.quantize(palette=_palette(), dither=Image.Dither.NONE).save(stream, "PNG")
    return stream.getvalue()


@functools.cache
def _palette() -> Image.Image:
    """Return greys and each of the colours, thinned by white in steps.

    A palette made from a drawing itself leaves out what little of it a short curve is.
    """
    shares = np.linspace(1.0, 0.0, _SHADES, endpoint=False)[:, None, None]
    colours = np.array([ImageColor.getrgb(c) for c in COLOURS])
    greys = np.linspace(0, 255, _SHADES)[:, None].repeat(3, axis=1)
    shades = (255 + shares * (colours - 255)).reshape(-1, 3)
    palette = Image.new("P", (1, 1))
    palette.putpalette(np.concatenate((greys, shades)).round().astype(np.uint8).tobytes())
    return palette
