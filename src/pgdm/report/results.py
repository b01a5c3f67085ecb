"""All runs of a report, by setting, task and seed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from pgdm.errors import amount
from pgdm.report.runs import STATES, SUCCESS, Run
from pgdm.report.settings import Setting, labels

Array = NDArray[np.float64]


@cache
def paper() -> dict[str, Any]:
    """Return ``paper.yaml``: the paper's averages, and the success of doing nothing."""
    text = resources.files("pgdm.report").joinpath("paper.yaml").read_text(encoding="utf-8")
    return yaml.safe_load(text)


class Results:
    """The runs of a report.

    Args:
        runs: all runs. Of several with equal setting, task and seed only one counts: a finished run
            is preferred, then the longest, then the latest. The others go to ``doubles``.
    """

    def __init__(self, runs: Sequence[Run]) -> None:
        best: dict[tuple[Setting, str, int], Run] = {}
        for run in sorted(runs, key=lambda run: (run.finished, run.frames, run.modified)):
            best[run.setting, run.task, run.seed] = run
        kept = {run.path for run in best.values()}
        self.doubles = [run for run in runs if run.path not in kept]
        found = {run.setting for run in best.values()}
        self.settings = sorted(found, key=lambda s: (len(s.changes), -s.total_frames, s.changes))
        place = {setting: number for number, setting in enumerate(self.settings)}
        self.runs = sorted(best.values(), key=lambda r: (r.task, place[r.setting], r.seed))
        self.labels = labels(self.settings)
        self.tasks = sorted({run.task for run in self.runs})
        self._cells: dict[tuple[Setting, str], list[Run]] = {}
        for run in self.runs:
            self._cells.setdefault((run.setting, run.task), []).append(run)

    def cell(self, setting: Setting, task: str) -> list[Run]:
        """Return the runs of a setting on a task, in any state, sorted by seed."""
        return self._cells.get((setting, task), [])

    def seeds(self, setting: Setting) -> list[int]:
        """Return the seeds that a setting has on any task."""
        return sorted({run.seed for run in self.runs if run.setting == setting})

    def states(self, setting: Setting, task: str) -> dict[int, str]:
        """Return each seed's state on a task; ``missing`` for seeds that only other tasks have."""
        there = {run.seed: run.state for run in self.cell(setting, task)}
        return {seed: there.get(seed, "missing") for seed in self.seeds(setting)}

    def scores(
        self,
        setting: Setting,
        metric: str = SUCCESS,
        wanted: Callable[[Run], bool] = lambda run: True,
    ) -> dict[str, Array]:
        """Return a metric of the finished runs of a setting: task to one value per run.

        Runs for which ``wanted`` is false, or whose value is not finite, are left out.
        """
        found = {}
        for task in self.tasks:
            runs = [run for run in self.cell(setting, task) if run.finished and wanted(run)]
            values = np.array([run.metric(metric) for run in runs])
            if np.isfinite(values).any():
                found[task] = values[np.isfinite(values)]
        return found

    def deviations(self, setting: Setting, *groups: str) -> list[str]:
        """Return why a setting's results are not comparable with the paper's; empty if they are.

        Args:
            setting: the setting.
            groups: config groups whose option the paper's table varies too; their options are no
                deviations.
        """
        found = setting.deviations(*groups)
        wanted = setting.option("pregrasp")
        starts = Counter(r.start for r in self.runs if r.setting == setting and r.start != wanted)
        other = [f"start {start}, not {wanted}: {amount(n, 'run')}" for start, n in starts.items()]
        return found + other

    def counts(self) -> dict[str, int]:
        """Return how many runs are in each state."""
        counter = Counter(run.state for run in self.runs)
        return {state: counter[state] for state in STATES if counter[state]}


def known(run: Run, key: str) -> float:
    """Return the paper's value for a run's task; NaN if the paper reports none."""
    value = run.facts.get(key)
    return float(value) if isinstance(value, int | float) else np.nan


def average(values: Iterable[float]) -> float:
    """Return the mean of the finite values; NaN if there are none."""
    finite = [value for value in values if np.isfinite(value)]
    return float(np.mean(finite)) if finite else np.nan
