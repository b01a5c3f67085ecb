"""The report's table of single tasks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgdm.report.results import Results, average, known, paper
from pgdm.report.runs import CONTACTS, ERROR, FINGERTIPS, LIFTED, SUCCESS, SUCCESS_MEAN, Run
from pgdm.report.settings import Setting
from pgdm.tracking.run_folder import WRIST_BOUND


@dataclass(frozen=True)
class TaskRow:
    """One setting on one task; means over the seeds that finished."""

    setting: Setting
    task: str
    source: str
    """Where the task's pre-grasp came from."""
    seeds: dict[int, str]
    """Seed to state."""
    frames: int
    """Fewest environment steps of a finished run; 0 if none has finished."""
    success: float
    success_mean_action: float
    error: float
    lifted: float
    fingertips: float
    """Their mean distance from the expert's, m; NaN where no run recorded it."""
    contacts: float
    """That from its contact points."""
    paper_success: float
    paper_error: float
    null: float
    """Success if the object never moves."""
    bound: float
    """Success of the hand alone on its planned way; NaN where no wrist was planned."""
    comparable: bool
    """Whether the paper's figures were made the same way."""

    @property
    def difference(self) -> float:
        """Success less the paper's."""
        return self.success - self.paper_success

    @property
    def follows(self) -> bool:
        """Whether it is known how far the hand was from the expert's."""
        return bool(np.isfinite([self.fingertips, self.contacts]).any())

    @property
    def planned(self) -> bool:
        """Whether the bound is known."""
        return bool(np.isfinite(self.bound))

    @property
    def idle(self) -> bool:
        """Whether doing nothing is as good; its success is known to four digits."""
        return round(self.success, 4) <= self.null

    @property
    def done(self) -> int:
        """How many seeds have finished."""
        return sum(state == "finished" for state in self.seeds.values())


def task_rows(results: Results, setting: Setting) -> list[TaskRow]:
    """Return the table of one setting, a row a task."""
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
                bound=average(float(run.result.get(WRIST_BOUND, np.nan)) for run in done),
                comparable=comparable,
            )
        )
    return rows
