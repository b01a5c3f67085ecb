"""Runs side by side: settings that differ, results, and curves on one axis."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pgdm.config.identity import changes_result
from pgdm.report.runs import ERROR, LIFTED, RETURN, SUCCESS, SUCCESS_MEAN, Run, read_run
from pgdm.runs.config_file import dotted
from pgdm.runs.folder import RunFolder

ALSO = ("total_frames", "num_threads", "device")
"""Settings that are compared even though they do not change what a run computes."""
RESULTS = {
    "success, sampled": SUCCESS,
    "success, mean action": SUCCESS_MEAN,
    "lifted": LIFTED,
    "COM error [m]": ERROR,
}
"""Name in the table -> metric of the last evaluation."""


class Comparison:
    """Two or more runs.

    Args:
        folders: folders of the runs.

    Raises:
        RunError: if a run cannot be read.
    """

    def __init__(self, folders: Sequence[RunFolder]) -> None:
        self.runs: list[Run] = [read_run(folder) for folder in folders]
        shared = os.path.commonpath([run.path.parent for run in self.runs])
        self.names = [os.path.relpath(run.path, shared) for run in self.runs]
        """Paths of the run folders, relative to the folder that contains all of them."""
        self._settings = [dotted(folder.config) for folder in folders]

    def differences(self) -> dict[str, list[Any]]:
        """Return the settings that differ: key to the value in each run, None if it is missing.

        Compared are the settings that change what a run computes, and those in ``ALSO``.
        """
        keys = sorted({key for settings in self._settings for key in settings})
        rows = {key: [settings.get(key) for settings in self._settings] for key in keys}
        return {
            key: values
            for key, values in rows.items()
            if (changes_result(key) or key in ALSO) and any(v != values[0] for v in values)
        }

    def results(self) -> dict[str, list[str]]:
        """Return the results as texts: name to the value of each run."""
        found = {
            "state": [run.state for run in self.runs],
            "frames": [f"{run.frames:,}" for run in self.runs],
            "minutes": [_minutes(run) for run in self.runs],
        }
        for name, metric in RESULTS.items():
            found[name] = [_number(run.metric(metric), metric) for run in self.runs]
        return found

    def draw(self, file: Path) -> None:
        """Plot success and training return over frames into a PNG, all runs on the same axes."""
        from pgdm.report.figures import COLOURS, DPI, line_axes

        figure, panels = line_axes({"success, sampled": (0, 1), "training return": None})
        for number, (name, run) in enumerate(zip(self.names, self.runs, strict=True)):
            style = {"color": COLOURS[number % len(COLOURS)], "lw": 1.6}
            panels[0].plot(run.evaluations["frames"], run.evaluations[SUCCESS], label=name, **style)
            if RETURN in run.training:
                panels[1].plot(run.training["frames"], run.training[RETURN], **style)
        figure.legend(loc="outside lower left", fontsize=8, frameon=False)
        figure.savefig(file, dpi=DPI)


def _number(value: float, metric: str) -> str:
    if value != value:
        return "-"
    return f"{value:.4f}" if metric == ERROR else f"{value:.1%}"


def _minutes(run: Run) -> str:
    seconds = run.result.get("wall_time_s")
    return "-" if seconds is None else f"{seconds / 60:.1f}"
