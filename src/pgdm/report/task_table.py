"""The report's table by task."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgdm.report.results import Results, average, known, paper
from pgdm.report.runs import CONTACTS, ERROR, FINGERTIPS, LIFTED, SUCCESS, SUCCESS_MEAN, Run
from pgdm.report.settings import Setting
from pgdm.runs.result import WRIST_BOUND


@dataclass(frozen=True)
class TaskRow:
    """A configuration of runs (`Setting`) on a task; metrics are means over the finished seeds."""

    setting: Setting
    task: str
    source: str
    """Source of the task's pre-grasp in the paper."""
    seeds: dict[int, str]
    """Seed to state."""
    frames: int
    """Frames of the shortest finished run; 0 if none has finished."""
    success: float
    success_mean_action: float
    error: float
    lifted: float
    fingertips: float
    """Mean distance of the fingertips from the expert's, m; NaN if no run recorded it."""
    contacts: float
    """Mean distance of the fingertips from the expert's contact points, m; NaN if not recorded."""
    paper_success: float
    paper_error: float
    null: float
    """Success if the object never moves."""
    rigid_grasp: float
    """Success of a grasp that never slips, with the planned commands; NaN without a wrist plan."""
    comparable: bool
    """Whether the paper's values are comparable with the row's."""

    @property
    def difference(self) -> float:
        """Success minus the paper's."""
        return self.success - self.paper_success

    @property
    def follows(self) -> bool:
        """Whether distances from the expert's hand are known."""
        return bool(np.isfinite([self.fingertips, self.contacts]).any())

    @property
    def planned(self) -> bool:
        """Whether ``rigid_grasp`` is known."""
        return bool(np.isfinite(self.rigid_grasp))

    @property
    def idle(self) -> bool:
        """Whether success, rounded to the four decimals of ``null``, is at most ``null``."""
        return round(self.success, 4) <= self.null

    @property
    def done(self) -> int:
        """Number of finished seeds."""
        return sum(state == "finished" for state in self.seeds.values())


def task_rows(results: Results, setting: Setting) -> list[TaskRow]:
    """Return the table of a setting, a row for each task."""
    rows = []
    comparable = not results.deviations(setting)
    for task in results.tasks:
        runs = results.cell(setting, task)
        if not runs:
            continue
        done = [run for run in runs if run.finished]

        def mean(metric: str, done: list[Run] = done) -> float:
            return average(run.metric(metric) for run in done)

        rows.append(
            TaskRow(
                setting=setting,
                task=task,
                source=str(runs[0].facts.get("pregrasp_source", "?")),
                seeds=results.states(setting, task),
                frames=min((run.frames for run in done), default=0),
                success=mean(SUCCESS),
                success_mean_action=mean(SUCCESS_MEAN),
                error=mean(ERROR),
                lifted=mean(LIFTED),
                fingertips=mean(FINGERTIPS),
                contacts=mean(CONTACTS),
                paper_success=known(runs[0], "paper_success"),
                paper_error=known(runs[0], "paper_com_error"),
                null=paper()["null_policy"].get(task, np.nan),
                rigid_grasp=average(float(run.result.get(WRIST_BOUND, np.nan)) for run in done),
                comparable=comparable,
            )
        )
    return rows
