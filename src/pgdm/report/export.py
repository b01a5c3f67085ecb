"""All numbers of the page as CSV files, and the data from which they were computed."""

from __future__ import annotations

import csv
import math
import os
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from pgdm.report.results import Results
from pgdm.report.runs import METRICS, RETURN, SHAPING
from pgdm.report.settings import Setting
from pgdm.report.statistics import Estimate
from pgdm.report.tables import THRESHOLDS, Average, Improvement
from pgdm.report.task_table import TaskRow

FILES = ("runs.csv", "tasks.csv", "averages.csv", "statistics.csv", "profiles.csv", "curves.csv")

FACTS = (
    "asset_source",
    "wall_time_s",
    "git",
    "ablation_distance_mm",
    "ablation_retreat_mm",
    "ablation_finger_error_rad",
    "ablation_depth_mm",
)
"""Keys of ``result.json`` in ``runs.csv``; only runs with an ablation have ``ablation_...``."""

Aggregates = dict[Setting, tuple[Estimate, list[Estimate], int, int]]
Improvements = dict[tuple[Setting, Setting], Improvement]


def runs(results: Results, out: Path) -> None:
    """Write ``runs.csv``: the last evaluation of each run, the source of all tables."""
    head = ["task", "setting", "seed", "state", "counted", "frames", "total_frames", "budget"]
    rows = [
        [
            *(run.task, results.labels[run.setting], run.seed, run.state),
            *("yes" if run.finished else "no", run.frames, run.setting.total_frames, run.budget),
            run.start,
            *(run.result.get(fact, "") for fact in FACTS),
            *(run.metric(name) for name in METRICS),
            os.path.relpath(run.path, out.absolute()),
        ]
        for run in results.runs
    ]
    _write(out / "runs.csv", [*head, "start", *FACTS, *METRICS, "folder"], rows)


def tasks(results: Results, rows: Iterable[TaskRow], out: Path) -> None:
    """Write ``tasks.csv``: the table by task."""
    head = ["task", "setting", "pregrasp_source", "seeds_finished", "seeds", "frames", "success"]
    head += ["success_mean_action", "com_error_released", "lifted", "hand_error_m"]
    head += ["contact_distance_m", "paper_success", "paper_com_error", "difference"]
    head += ["null_success", "wrist_bound", "comparable_with_paper"]
    table = [
        [
            *(row.task, results.labels[row.setting], row.source, row.done),
            " ".join(f"{seed}:{state}" for seed, state in row.seeds.items()),
            *(row.frames, row.success, row.success_mean_action, row.error, row.lifted),
            *(row.fingertips, row.contacts),
            *(row.paper_success, row.paper_error, row.difference, row.null, row.rigid_grasp),
            "yes" if row.comparable else "no",
        ]
        for row in rows
    ]
    _write(out / "tasks.csv", head, table)


def averages(results: Results, rows: Iterable[Average], out: Path) -> None:
    """Write ``averages.csv``: Table I, ablations and baselines."""
    head = ["table", "setting", "row", "tasks", "runs"]
    for name in ("success", "com_error_released", "ori_error"):
        head += [name, f"{name}_low", f"{name}_high"]
    head += ["paper_success", "paper_com_error", "paper_ori_error", "paper_success_same_tasks"]
    head += ["paper_com_error_same_tasks", "not_comparable_because"]
    table = [
        [
            *(row.table, results.labels[row.setting], row.name, len(row.tasks), row.runs),
            *(*row.success, *row.error, *row.rotation),
            *(row.paper.get(name, "") for name in ("success", "com_error", "ori_error")),
            *(row.same["success"], row.same["com_error"], "; ".join(row.deviations)),
        ]
        for row in rows
    ]
    _write(out / "averages.csv", head, table)


def statistics(results: Results, found: Aggregates, better: Improvements, out: Path) -> None:
    """Write ``statistics.csv`` and ``profiles.csv``."""
    labels = results.labels
    head = ["statistic", "setting", "than", "value", "low", "high", "tasks", "runs", "than_runs"]
    table: list[list[Any]] = [
        ["interquartile_mean", labels[setting], "", *iqm, tasks, runs, ""]
        for setting, (iqm, _, tasks, runs) in found.items()
    ]
    for (a, b), (chance, *counts) in better.items():
        table.append(["improvement", labels[a], labels[b], *chance, *counts])
    _write(out / "statistics.csv", head, table)
    shares = [
        [labels[setting], round(float(threshold), 4), *estimate]
        for setting, (_, profile, _, _) in found.items()
        for threshold, estimate in zip(THRESHOLDS, profile, strict=True)
    ]
    _write(out / "profiles.csv", ["setting", "success_above", "share", "low", "high"], shares)


def curves(results: Results, out: Path) -> None:
    """Write ``curves.csv``: every evaluation, and return and shaping in training, thinned."""
    table, trained = [], (RETURN, SHAPING)
    for run in results.runs:
        who = [run.task, results.labels[run.setting], run.seed]
        columns = [run.evaluations[name].tolist() for name in ("frames", *METRICS)]
        for frames, *values in zip(*columns, strict=True):
            table.append([*who, "eval", int(frames), *values, *[""] * len(trained)])
        if run.training:
            columns = [run.training[name].tolist() for name in ("frames", *trained)]
            blank = [""] * len(METRICS)
            for frames, *values in zip(*columns, strict=True):
                table.append([*who, "train", int(frames), *blank, *values])
    head = ["task", "setting", "seed", "kind", "frames", *METRICS, *trained]
    _write(out / "curves.csv", head, table)


def _write(file: Path, head: Sequence[str], rows: Iterable[Sequence[Any]]) -> None:
    """Write a table; unknown values stay empty."""
    with open(file, "w", newline="", encoding="utf-8") as stream:
        writer = csv.writer(stream)
        writer.writerow(head)
        writer.writerows([_cell(value) for value in row] for row in rows)


def _cell(value: Any) -> Any:
    if isinstance(value, float):  # NumPy's too
        return f"{value:.6g}" if math.isfinite(value) else ""
    return value
