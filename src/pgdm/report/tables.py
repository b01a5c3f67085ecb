"""The report's tables of averages, set beside those of the paper."""

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
"""Of the performance profile, in success."""


@dataclass(frozen=True)
class Average:
    """One setting over several tasks: the mean of the tasks' means."""

    table: str
    """``source``, ``ablation`` or ``baseline``."""
    setting: Setting
    name: str
    """Row of the table: source of pre-grasps, ablation, or method."""
    group: str
    """What its setting differs in besides; only rows of one group compare. Empty: all do."""
    wanted: Callable[[Run], bool]
    """Tells the runs on the tasks that it is of."""
    tasks: tuple[str, ...]
    """Those on which a run has finished."""
    runs: int
    success: Estimate
    error: Estimate
    rotation: Estimate
    same: dict[str, float]
    """The paper's figures of the same tasks, averaged: ``success`` and ``com_error``; NaN where
    the row is not what they are of, PGDM as it stands."""
    paper: dict[str, float] = field(default_factory=dict)
    """The paper's own average: ``success``, ``com_error``, and ``tasks`` where it says so; empty
    where the row is none of the paper's: another method's ablation, other values, another hand."""
    deviations: tuple[str, ...] = ()
    """Why it cannot be set against the paper's."""

    @property
    def hue(self) -> str:
        """What has one hue in all groups: its name, whether with or without pre-grasps."""
        return self.name.replace(_WITHOUT, _WITH)


class Improvement(NamedTuple):
    """How a setting fares against another one on the tasks that both have."""

    chance: Estimate
    tasks: int
    runs: int
    """The setting's on these tasks."""
    than_runs: int
    """The other one's."""

    @property
    def single(self) -> bool:
        """Whether each has one run a task, so that tasks are counted and nothing is probable."""
        return self.runs == self.than_runs == self.tasks

    @property
    def won(self) -> float:
        """Tasks on which the setting is better, ties as halves, if it is ``single``."""
        return self.chance.value * self.tasks


def by_source(results: Results) -> list[Average]:
    """Return Table I: each setting with the plain method and pre-grasps, by their source."""
    rows = []
    for setting in results.settings:
        if setting.plain:
            for source, figures in paper()["by_source"].items():
                group = results.labels[setting] if len(results.settings) > 1 else ""
                rows += _average(results, "source", setting, source, group, figures, _from(source))
    return rows


def by_ablation(results: Results) -> list[Average]:
    """Return the ablations on tcdm30, and what each would be without; empty if there are none."""
    ablated = [s for s in results.settings if s.option("ablation") != "none"]
    rests = {setting.rest("ablation") for setting in ablated}
    shown = [setting for setting in results.settings if setting.rest("ablation") in rests]
    groups = _groups(shown, "ablation")
    rows = []
    for setting in shown:
        name, values = setting.option("ablation"), _values(setting, "ablation")
        own = setting.method == "pgdm" and not values
        figures = paper()["by_ablation"].get(name, {}) if own else {}
        args = results, "ablation", setting, name + values, groups[setting], figures, _in_tcdm30
        rows += _average(*args, "ablation")
    return rows


def baselines(results: Results) -> list[Average]:
    """Return methods with and without pre-grasps on tcdm30; empty if there is only one kind."""
    settings = [s for s in results.settings if s.option("ablation") == "none"]
    if len({(s.method, s.with_pregrasp) for s in settings}) < 2:
        return []
    kinds = {s: ("method",) if s.with_pregrasp else ("method", "pregrasp") for s in settings}
    groups = _groups(settings, "method", "pregrasp")
    rows = []
    for setting, same in kinds.items():
        figures = paper()["by_ablation"]["none"] if setting.plain else {}
        name = setting.method + (_WITH if setting.with_pregrasp else _WITHOUT)
        name += _values(setting, "method")
        name += "".join(f", {c}" for c in setting.within("pregrasp") if c != "pregrasp=none")
        args = results, "baseline", setting, name, groups[setting], figures, _in_tcdm30
        rows += _average(*args, *same)
    return rows


def by_group(rows: Iterable[Average]) -> dict[str, list[Average]]:
    """Return the rows that compare with one another, by what their settings differ in besides."""
    found: dict[str, list[Average]] = {}
    for row in rows:
        found.setdefault(row.group, []).append(row)
    return found


def aggregates(results: Results) -> dict[Setting, tuple[Estimate, list[Estimate], int, int]]:
    """Return for each setting: interquartile mean, profile, tasks, runs; where any has finished."""
    found = {}
    for setting in results.settings:
        scores = list(results.scores(setting).values())
        if scores:
            profile = statistics.profile(scores, THRESHOLDS)
            count = sum(len(task) for task in scores)
            found[setting] = statistics.iqm(scores), profile, len(scores), count
    return found


def improvements(results: Results) -> dict[tuple[Setting, Setting], Improvement]:
    """Return for each two settings with shared tasks how the first fares against the second."""
    found = {}
    for a, b in combinations(results.settings, 2):
        x, y = results.scores(a), results.scores(b)
        shared = [task for task in x if task in y]
        if shared:
            args = [x[task] for task in shared], [y[task] for task in shared]
            runs = (sum(len(task) for task in side) for side in args)
            found[a, b] = Improvement(statistics.improvement(*args), len(shared), *runs)
    return found


def _groups(settings: Sequence[Setting], *put_aside: str) -> dict[Setting, str]:
    """Return what tells settings apart besides some config groups; all empty if nothing does."""
    rests = {setting: setting.rest(*put_aside) for setting in settings}
    if len(set(rests.values())) < 2:
        return dict.fromkeys(settings, "")
    shared = set.intersection(*map(set, rests.values()))
    own = {s: ", ".join(c for c in rest if c not in shared) for s, rest in rests.items()}
    return {setting: text or "no further change" for setting, text in own.items()}


def _values(setting: Setting, group: str) -> str:
    """Return what a setting changes within a config group, as an end of a row's name."""
    own = [c.split("=", 1) for c in setting.changes if c.startswith(f"{group}.")]
    return "".join(f", {key.rpartition('.')[2]}={value}" for key, value in own)


def _average(
    results: Results,
    table: str,
    setting: Setting,
    name: str,
    group: str,
    figures: dict[str, float],
    wanted: Callable[[Run], bool],
    *same: str,
) -> Iterator[Average]:
    """Give the row, if any run has finished."""
    scores = results.scores(setting, SUCCESS, wanted)
    if not scores:
        return

    def estimate(metric: str) -> Estimate:
        values = list(results.scores(setting, metric, wanted).values())
        return statistics.mean(values) if values else NOTHING

    def stated(figure: str) -> float:
        first = [results.cell(setting, task)[0] for task in scores]
        own = setting.plain and setting.own_hand
        return average(known(run, figure) for run in first) if own else np.nan

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
        same={"success": stated("paper_success"), "com_error": stated("paper_com_error")},
        paper=figures if setting.own_hand else {},
        deviations=tuple(results.deviations(setting, *same)),
    )


def _from(source: str) -> Callable[[Run], bool]:
    """Return what tells the tasks of a row of Table I; those beyond the paper's 50 are in none."""

    def wanted(run: Run) -> bool:
        own = run.facts.get("pregrasp_source")
        return np.isfinite(known(run, "paper_success")) and source in ("all", own)

    return wanted


def _in_tcdm30(run: Run) -> bool:
    return run.facts.get("tcdm30") is True
