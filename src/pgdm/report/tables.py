"""The report's tables of averages, compared with those of the paper."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from typing import NamedTuple

import numpy as np

from pgdm.report import statistics
from pgdm.report.results import Results, average, known, paper
from pgdm.report.runs import ERROR, ROTATION, SUCCESS, Run
from pgdm.report.settings import Setting
from pgdm.report.statistics import Estimate

NOTHING = Estimate(np.nan, np.nan, np.nan)
_WITH, _WITHOUT = " with pre-grasp", " without pre-grasp"
THRESHOLDS = np.linspace(0.0, 1.0, 51)
"""Thresholds of the performance profile, in success."""


@dataclass(frozen=True)
class Average:
    """A setting's mean over several tasks, each of them a mean over runs."""

    table: str
    """``source``, ``ablation`` or ``baseline``."""
    setting: Setting
    name: str
    """Row of the table: source of pre-grasps, ablation, or method."""
    group: str
    """How its setting differs from those of the other rows, except in what the table varies; only
    rows with equal groups are comparable. Empty if there is no such difference."""
    wanted: Callable[[Run], bool]
    """Returns whether a run belongs to the row, by its task."""
    tasks: tuple[str, ...]
    """Tasks with a finished run."""
    runs: int
    success: Estimate
    error: Estimate
    rotation: Estimate
    same: dict[str, float]
    """The paper's average over the same tasks: ``success`` and ``com_error``. The paper has values
    by task only for PGDM with pre-grasps, each task's own hand and no ablation; in other rows they
    are NaN."""
    paper: dict[str, float] = field(default_factory=dict)
    """The paper's own average: ``success``, ``com_error`` and, if stated, ``ori_error`` and
    ``tasks``; empty if the paper has no such row, as for another method's ablation or
    another hand than the task's own."""
    deviations: tuple[str, ...] = ()
    """Why the row is not comparable with the paper."""

    @property
    def hue(self) -> str:
        """Key of its colour, shared by all groups and by the rows with and without pre-grasp."""
        return self.name.replace(_WITHOUT, _WITH)


class Improvement(NamedTuple):
    """Comparison of a setting with another setting on their shared tasks."""

    chance: Estimate
    """Probability that a run of the setting beats one of the other on a random shared task."""
    tasks: int
    runs: int
    """Number of runs of the setting on the shared tasks."""
    than_runs: int
    """Number of runs of the other setting."""

    @property
    def single(self) -> bool:
        """Whether both settings have a single run per task; the page then shows ``won``."""
        return self.runs == self.than_runs == self.tasks

    @property
    def won(self) -> float:
        """If ``single``: number of tasks on which the setting is better, ties as halves."""
        return self.chance.value * self.tasks


def by_source(results: Results) -> list[Average]:
    """Return Table I: rows by pre-grasp source, for each setting that is `Setting.plain`."""
    rows = []
    for setting in results.settings:
        if setting.plain:
            for source, stated in paper()["by_source"].items():
                group = results.labels[setting] if len(results.settings) > 1 else ""
                rows += _average(results, "source", setting, source, group, stated, _from(source))
    return rows


def by_ablation(results: Results) -> list[Average]:
    """Return the ablations on tcdm30, and the same settings without ablation.

    Empty if there are no ablations.
    """
    ablated = [s for s in results.settings if s.option("ablation") != "none"]
    rests = {setting.rest("ablation") for setting in ablated}
    shown = [setting for setting in results.settings if setting.rest("ablation") in rests]
    groups = _groups(shown, "ablation")
    rows = []
    for setting in shown:
        name, values = setting.option("ablation"), _values(setting, "ablation")
        own = setting.method == "pgdm" and not values
        stated = paper()["by_ablation"].get(name, {}) if own else {}
        args = results, "ablation", setting, name + values, groups[setting], stated, _in_tcdm30
        rows += _average(*args, "ablation")
    return rows


def baselines(results: Results) -> list[Average]:
    """Return methods with and without pre-grasps on tcdm30.

    Empty if all settings have the same method and either all or none have pre-grasps.
    """
    settings = [s for s in results.settings if s.option("ablation") == "none"]
    if len({(s.method, s.with_pregrasp) for s in settings}) < 2:
        return []
    kinds = {s: ("method",) if s.with_pregrasp else ("method", "pregrasp") for s in settings}
    groups = _groups(settings, "method", "pregrasp")
    rows = []
    for setting, same in kinds.items():
        stated = paper()["by_ablation"]["none"] if setting.plain else {}
        name = setting.method + (_WITH if setting.with_pregrasp else _WITHOUT)
        name += _values(setting, "method")
        name += "".join(f", {c}" for c in setting.within("pregrasp") if c != "pregrasp=none")
        args = results, "baseline", setting, name, groups[setting], stated, _in_tcdm30
        rows += _average(*args, *same)
    return rows


def by_group(rows: Iterable[Average]) -> dict[str, list[Average]]:
    """Return the rows by group; only rows of one group are comparable."""
    found: dict[str, list[Average]] = {}
    for row in rows:
        found.setdefault(row.group, []).append(row)
    return found


def aggregates(results: Results) -> dict[Setting, tuple[Estimate, list[Estimate], int, int]]:
    """Return interquartile mean, profile, tasks and runs of each setting with a finished run."""
    found = {}
    for setting in results.settings:
        scores = list(results.scores(setting).values())
        if scores:
            profile = statistics.profile(scores, THRESHOLDS)
            count = sum(len(task) for task in scores)
            found[setting] = statistics.iqm(scores), profile, len(scores), count
    return found


def improvements(results: Results) -> dict[tuple[Setting, Setting], Improvement]:
    """Compare the first setting with the second for each pair of settings that share tasks."""
    found = {}
    for a, b in combinations(results.settings, 2):
        x, y = results.scores(a), results.scores(b)
        shared = [task for task in x if task in y]
        if shared:
            args = [x[task] for task in shared], [y[task] for task in shared]
            runs = (sum(len(task) for task in side) for side in args)
            found[a, b] = Improvement(statistics.improvement(*args), len(shared), *runs)
    return found


def _groups(settings: Sequence[Setting], *ignored: str) -> dict[Setting, str]:
    """Return how settings differ outside some config groups; all empty if they do not."""
    rests = {setting: setting.rest(*ignored) for setting in settings}
    if len(set(rests.values())) < 2:
        return dict.fromkeys(settings, "")
    shared = set.intersection(*map(set, rests.values()))
    own = {s: ", ".join(c for c in rest if c not in shared) for s, rest in rests.items()}
    return {setting: text or "no further change" for setting, text in own.items()}


def _values(setting: Setting, group: str) -> str:
    """Return a setting's changes within a config group, as a suffix of a row's name."""
    own = [c.split("=", 1) for c in setting.changes if c.startswith(f"{group}.")]
    return "".join(f", {key.rpartition('.')[2]}={value}" for key, value in own)


def _average(
    results: Results,
    table: str,
    setting: Setting,
    name: str,
    group: str,
    stated: dict[str, float],
    wanted: Callable[[Run], bool],
    *groups: str,
) -> Iterator[Average]:
    """Yield the row if any of its runs has finished."""
    scores = results.scores(setting, SUCCESS, wanted)
    if not scores:
        return

    def estimate(metric: str) -> Estimate:
        values = list(results.scores(setting, metric, wanted).values())
        return statistics.mean(values) if values else NOTHING

    def same(key: str) -> float:
        first = [results.cell(setting, task)[0] for task in scores]
        own = setting.plain and setting.own_hand
        return average(known(run, key) for run in first) if own else np.nan

    yield Average(
        table=table,
        setting=setting,
        name=name,
        group=group,
        wanted=wanted,
        tasks=tuple(scores),
        runs=sum(len(values) for values in scores.values()),
        success=estimate(SUCCESS),
        error=estimate(ERROR),
        rotation=estimate(ROTATION),
        same={"success": same("paper_success"), "com_error": same("paper_com_error")},
        paper=stated if setting.own_hand else {},
        deviations=tuple(results.deviations(setting, *groups)),
    )


def _from(source: str) -> Callable[[Run], bool]:
    """Return a predicate for a row of Table I: runs of the paper's tasks with this source."""

    def wanted(run: Run) -> bool:
        own = run.facts.get("pregrasp_source")
        return np.isfinite(known(run, "paper_success")) and source in ("all", own)

    return wanted


def _in_tcdm30(run: Run) -> bool:
    return run.facts.get("tcdm30") is True
