"""A run as the report needs it, read once from its folder."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgdm.report.settings import Setting, setting_of
from pgdm.runs.files import VIDEOS
from pgdm.runs.folder import RunFolder
from pgdm.runs.log import Record, metrics_of
from pgdm.runs.result import ENDED_BY, TIME_LIMIT

SUCCESS = "eval_sampled/success"
"""Success with sampled actions, as in the paper."""
SUCCESS_MEAN = "eval_deterministic/success"
"""Success with the mean action."""
ERROR = "eval_sampled/com_error_released"
ROTATION = "eval_sampled/ori_error"
LIFTED = "eval_sampled/lifted"
FINGERTIPS = "eval_sampled/hand_error_m"
"""Distance of the fingertips from the expert's; only methods that follow an expert record it."""
CONTACTS = "eval_sampled/contact_distance_m"
"""Distance of the fingertips from the expert's contact points."""
METRICS = (
    SUCCESS,
    SUCCESS_MEAN,
    ERROR,
    "eval_deterministic/com_error_released",
    ROTATION,
    LIFTED,
    "eval_deterministic/lifted",
    FINGERTIPS,
    CONTACTS,
)
RETURN = "train/return"
SHAPING = "train/shaping"
"""Sum of the rewards that training adds to an episode; only runs with such rewards record it."""
MISSING = "missing"
"""State of a run that a sweep has planned but not started."""
STATES = ("finished", "running", "interrupted", "failed", MISSING)
TRAIN_POINTS = 100
"""Approximate number of points of a training curve."""

Curve = dict[str, NDArray[np.float64]]


@dataclass(frozen=True)
class Run:
    """One run."""

    path: Path
    """Its folder, absolute."""
    state: str
    """One of ``STATES``."""
    setting: Setting
    """Everything but task and seed."""
    task: str
    seed: int
    frames: int
    """Frames completed."""
    budget: str
    facts: Mapping[str, Any]
    """Facts about the task, from the configuration: ``paper_success``, ``pregrasp_source``..."""
    result: Mapping[str, Any]
    """``result.json``; empty if the run has not written it."""
    metrics: Mapping[str, float]
    """Metrics of the last evaluation; values that are NaN are left out."""
    evaluations: Curve
    """``frames`` and each of ``METRICS``, arrays of shape (E,) for E evaluations."""
    training: Curve
    """``frames``, ``RETURN`` and ``SHAPING``, arrays of about ``TRAIN_POINTS`` values; may be
    empty."""
    video: Path | None
    """The last video; its poster is the PNG of the same name."""
    modified: float
    """Time of the last write, s since the epoch."""

    def metric(self, name: str) -> float:
        """Return a metric of the last evaluation; NaN if there is none."""
        return self.metrics.get(name, math.nan)

    @property
    def finished(self) -> bool:
        """Whether the run is finished; only finished runs count in averages."""
        return self.state == "finished"

    @property
    def start(self) -> str:
        """Source of the start state that was used: the requested source, or its fallback."""
        return str(self.result.get("pregrasp_used", self.setting.option("pregrasp")))


def read_run(folder: RunFolder) -> Run:
    """Read a run.

    Raises:
        RunError: if its configuration or its records cannot be read.
    """
    records = folder.log.thinned(TRAIN_POINTS)
    evaluations = [record for record in records if record["kind"] == "eval"]
    trained = [record for record in records if RETURN in record]
    last = max((int(record["frames"]) for record in records), default=0)
    stored = folder.result.get("metrics") or {}
    return _run(
        folder,
        state=folder.status(),
        frames=int(folder.result.get("frames", last)),
        metrics=dict(stored) or (metrics_of(evaluations[-1]) if evaluations else {}),
        evaluations=_curve(evaluations, METRICS),
        training=_curve(trained, (RETURN, SHAPING)),
        video=max((folder.path / VIDEOS).glob("frames_*.mp4"), default=None),
    )


def planned_run(folder: RunFolder) -> Run:
    """Return a run that a sweep has planned: so far it has only a configuration."""
    empty = {"frames": 0, "metrics": {}, "video": None}
    return _run(folder, state=MISSING, evaluations=_curve((), METRICS), training={}, **empty)


def _run(folder: RunFolder, **known: Any) -> Run:
    config = folder.config
    facts = config.get("task")
    facts = facts if isinstance(facts, dict) else {}
    return Run(
        path=folder.path,
        setting=setting_of(config, folder.result.get(ENDED_BY) == TIME_LIMIT),
        task=str(facts.get("id", "?")),
        seed=int(config.get("seed", 0)),
        budget=str(config.get("budget", "?")),
        facts=facts,
        result=folder.result,
        modified=folder.modified(),
        **known,
    )


def _curve(records: Iterable[Record], names: Iterable[str]) -> Curve:
    rows = sorted(records, key=lambda record: record["frames"])
    return {
        name: np.array([float(row.get(name, math.nan)) for row in rows])
        for name in ("frames", *names)
    }
