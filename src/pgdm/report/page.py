"""Write the report: a self-contained page, with its tables and figures as files next to it."""

from __future__ import annotations

import base64
import math
import os
import shlex
import time
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

from jinja2 import Environment, PackageLoader, StrictUndefined
from matplotlib.figure import Figure

from pgdm.config.compose import PAPER_FRAMES
from pgdm.errors import RunError, amount
from pgdm.library.progress import StepProgress, counted
from pgdm.report import alike, export, figures, mean_curves, tables
from pgdm.report.additions import additions
from pgdm.report.curves import curves
from pgdm.report.results import Results, paper
from pgdm.report.runs import ERROR, SUCCESS
from pgdm.report.settings import shared
from pgdm.report.source import Found, find
from pgdm.report.statistics import DRAWS, Estimate
from pgdm.report.task_table import task_rows

PAGE = "report.html"
_NONE = "-"


def write_report(
    places: Sequence[str], out: Path, progress: StepProgress, uri: str | None = None
) -> tuple[Path, Results]:
    """Write the report on the runs of some folders and MLflow experiments.

    Args:
        places: folders, or names of MLflow experiments.
        out: folder to write to; created if missing.
        progress: called with each step.
        uri: MLflow store; None: the store in the folder of runs.

    Returns:
        The page's file, and the results in it.

    Raises:
        RunError: if no run can be read, or the folder cannot be written.
        TrackingError: if there is no such MLflow experiment.
    """
    found = find(places, uri, out, progress)
    if not found.runs:
        folder, reason = next(iter(found.unreadable.items()))
        raise RunError(
            f"of {amount(len(found.unreadable), 'run')} none can be read; {folder}: {reason}"
        )
    results = Results(found.runs)
    try:
        out.mkdir(parents=True, exist_ok=True)
        context = _context(results, found, places, out, progress)
        (out / PAGE).write_text(_render(context), encoding="utf-8")
    except OSError as error:
        raise RunError(f"cannot write the report to '{out}': {error.strerror or error}") from error
    return out / PAGE, results


def _context(
    results: Results, found: Found, places: Sequence[str], out: Path, progress: StepProgress
) -> dict[str, Any]:
    by_task = {setting: task_rows(results, setting) for setting in results.settings}
    progress("computing statistics", 0, 1)
    averages = {
        "source": tables.by_source(results),
        "ablation": tables.by_ablation(results),
        "baseline": tables.baselines(results),
    }
    aggregates, better = tables.aggregates(results), tables.improvements(results)
    progress("writing tables", 0, 1)
    export.runs(results, out)
    export.tasks(results, [row for rows in by_task.values() for row in rows], out)
    export.averages(results, [row for rows in averages.values() for row in rows], out)
    export.statistics(results, aggregates, better, out)
    export.curves(results, out)
    pictures = _pictures(results, averages, aggregates, out, progress)
    return {
        "results": results,
        "places": places,
        "now": time.strftime("%Y-%m-%d %H:%M"),
        "counts": results.counts(),
        "mixed": alike.mixed(results),
        "doubles": alike.left_out(results),
        "budgets": Counter(run.budget for run in results.runs),
        "shared": shared(results.settings),
        "deviations": {s: results.deviations(s) for s in results.settings},
        "additions": additions(results),
        "colours": {s: figures.colour(results, s) for s in results.settings},
        "averages": averages,
        "apart": {t: mean_curves.apart(results, averages[t]) for t in ("ablation", "baseline")},
        "by_task": by_task,
        "aggregates": aggregates,
        "better": better,
        "null": paper()["null_policy"],
        "pictures": pictures,
        "films": _films(results, out, progress),
        "provenance": _provenance(results),
        "commands": _commands(results),
        "typed": found.commands,
        "unreadable": found.unreadable,
        "folders": {
            run.path: os.path.relpath(run.path, out.absolute())
            for run in (*results.runs, *results.doubles)
        },
        "paper_frames": PAPER_FRAMES,
        "draws": DRAWS,
        "files": [*export.FILES, *(f"{name}.png" for name in pictures)],
    }


def _pictures(
    results: Results,
    averages: Mapping[str, Sequence[tables.Average]],
    aggregates: export.Aggregates,
    out: Path,
    progress: StepProgress,
) -> dict[str, Any]:
    """Draw all figures; return data URLs by figure name, or by figure name and task."""
    found: dict[str, Any] = {}
    if any(len(run.evaluations["frames"]) for run in results.runs):
        for name, metric in (("curves", SUCCESS), ("curves_error", ERROR)):
            panels = curves(
                *(results, metric, out / f"{name}.png"),
                lambda done, of, name=name: progress(f"drawing {name}", done, of),
            )
            found[name] = {task: _data(panel) for task, panel in panels.items()}
    progress("drawing statistics", 0, 1)
    drawn: dict[str, Figure | None] = {}
    if aggregates:
        iqms = {setting: iqm for setting, (iqm, *_) in aggregates.items()}
        shares = {setting: profile for setting, (_, profile, *_) in aggregates.items()}
        drawn["iqm"] = figures.intervals(results, iqms, "interquartile mean of success")
        drawn["profiles"] = figures.profiles(results, shares)
    every = [row for row in averages["source"] if row.name == "all"]
    drawn["mean_curves"] = mean_curves.validated(results, every)
    drawn["ablations_curves"] = mean_curves.compared(results, averages["ablation"])
    if averages["baseline"]:
        drawn["baselines"] = figures.bars(averages["baseline"])
    drawn["baselines_curves"] = mean_curves.compared(results, averages["baseline"])
    for name, figure in drawn.items():
        if figure:
            found[name] = _data(figures.saved(figure, out / f"{name}.png"))
    return found


def _films(results: Results, out: Path, progress: StepProgress) -> list[dict[str, Any]]:
    """Return the videos with thumbnails; the first of each task and setting has ``leads`` set."""
    found, seen = [], set()
    for run in counted("reading posters", results.runs, progress):
        small = run.video and figures.thumbnail(run.video.with_suffix(".png"))
        if run.video and small:
            address = quote(os.path.relpath(run.video, out.absolute()))
            cell = run.setting, run.task
            film = {"run": run, "picture": _data(small, "jpeg"), "address": address}
            found.append(film | {"leads": cell not in seen})
            seen.add(cell)
    return found


def _provenance(results: Results) -> list[tuple[str, list[tuple[str, int]]]]:
    """Return versions and assets behind the runs: each fact, with the runs counted by its value."""
    facts: dict[str, Counter[str]] = {}
    for run in results.runs:
        of_run = {
            "git revision": run.result.get("git"),
            "assets": run.result.get("asset_source"),
            "start": run.result.get("pregrasp_used"),
            "expert hand": run.result.get("expert_hand"),
            "engine of the training": run.result.get("engine", "C MuJoCo, float64"),
            **run.result.get("versions", {}),
        }
        for name, value in of_run.items():
            if value is not None:
                facts.setdefault(name, Counter())[str(value)] += 1
    return [(name, counter.most_common()) for name, counter in facts.items()]


def _commands(results: Results) -> list[str]:
    """Return the commands that reproduce the runs, one per setting.

    A command has every seed for every task, so it starts further runs if tasks differ in seeds.
    """
    found = []
    for setting in results.settings:
        tasks = [task for task in results.tasks if results.cell(setting, task)]
        seeds = results.seeds(setting)
        words = [f"task={','.join(tasks)}", f"seed={','.join(map(str, seeds))}"]
        words += [f"total_frames={setting.total_frames}", *setting.changes]
        many = " -m" if len(tasks) * len(seeds) > 1 else ""
        found.append(f"pgdm-run{many} {' '.join(map(shlex.quote, words))}")
    return found


def _render(context: dict[str, Any]) -> str:
    environment = Environment(
        loader=PackageLoader("pgdm.report", "."),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "percent": lambda value, digits=1: _shown(value, f".{digits}%"),
        "points": lambda value: _shown(100 * value, "+.1f"),
        "metres": lambda value: _shown(value, ".2e"),
        "centimetres": lambda value: _shown(100 * value, ".1f"),
        "radians": lambda value: _shown(value, ".2f"),
        "between": _between,
        "frames": _frames,
    }
    return environment.get_template("page.html").render(context)


def _shown(value: float, form: str) -> str:
    return format(value, form) if isinstance(value, int | float) and value == value else _NONE


def _between(estimate: Estimate, form: str = ".1%") -> str:
    """Return a confidence interval as text; empty if there is none."""
    if math.isnan(estimate.low):
        return ""
    return f"[{estimate.low:{form}}, {estimate.high:{form}}]"


def _frames(count: int) -> str:
    return f"{count / 1e6:.3g}M" if count >= 1_000_000 else f"{count:,}"


def _data(picture: bytes, kind: str = "png") -> str:
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode()}"
