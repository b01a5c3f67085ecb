"""What training adds to a task's reward (``shaping=...``), and evaluations leave out."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import numpy as np

from pgdm.report.results import Results, average
from pgdm.report.runs import RETURN, SHAPING, Run
from pgdm.report.settings import Setting


@dataclass(frozen=True)
class Addition:
    """Mean episode of a setting's finished runs, over the last tenth of the training."""

    setting: Setting
    added: float
    """Sum of the added rewards; NaN if none is recorded, as when only the discount differs."""
    own: float
    """Return: sum of the task's own rewards."""


def additions(results: Results) -> dict[str, list[Addition]]:
    """Return what training adds, as runs record it in words, with the settings that have it."""
    found: dict[str, list[Addition]] = {}
    for setting in results.settings:
        runs = [run for run in results.runs if run.setting == setting]
        words = Counter(str(text) for run in runs if (text := run.result.get("shaping")))
        for text, _ in words.most_common(1):  # pgdm's wording has changed; the meaning is the same
            done = [run for run in runs if run.finished]
            added, own = (average(_late(run, name) for run in done) for name in (SHAPING, RETURN))
            found.setdefault(text, []).append(Addition(setting, added, own))
    return found


def _late(run: Run, name: str) -> float:
    if not run.training:
        return np.nan
    return average(run.training[name][run.training["frames"] >= 0.9 * run.frames])
