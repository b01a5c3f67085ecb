"""What the report needs of each run, read from its folder once."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pgdm.report.settings import Setting, setting_of
from pgdm.tracking.run_folder import ENDED_BY, TIME_LIMIT, RunFolder
from pgdm.tracking.run_log import Record, metrics_of

SUCCESS = "eval_sampled/success"
"""The paper's success: actions are sampled."""
SUCCESS_MEAN = "eval_deterministic/success"
"""The same with the policy's mean action."""
ERROR = "eval_sampled/com_error_released"
ROTATION = "eval_sampled/ori_error"
LIFTED = "eval_sampled/lifted"
FINGERTIPS = "eval_sampled/hand_error_m"
"""How far fingertips are from the expert's; only methods that follow one record it."""
CONTACTS = "eval_sampled/contact_distance_m"
"""The same of its contact points."""
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
MISSING = "missing"
"""State of a run that was planned and has not begun."""
STATES = ("finished", "running", "interrupted", "failed", MISSING)
TRAIN_POINTS = 100
"""Points of a run's training curve, about."""

Curve = dict[str, NDArray[np.float64]]


@dataclass(frozen=True)
class Run:
    """One run."""

    path: Path
    """Its folder, absolute."""
    state: str
    """One of ``STATES``."""
    setting: Setting
    """Everything of it but task and seed."""
    task: str
    seed: int
    frames: int
    """Environment steps done."""
    budget: str
    facts: Mapping[str, Any]
    """Of the task, from the configuration: ``paper_success``, ``pregrasp_source``, ``tcdm30``..."""
    result: Mapping[str, Any]
    """``result.json``; empty if the run has not ended in good order."""
    metrics: Mapping[str, float]
    """Of the last evaluation; what is not finite is left out."""
    evaluations: Curve
    """``frames`` and each of ``METRICS``, all (E,)."""
    training: Curve
    """``frames`` and ``RETURN``, (about TRAIN_POINTS,)."""
    video: Path | None
    """The last film; its poster lies beside it, as PNG."""
    modified: float
    """When it last wrote something, s since the epoch."""

    def metric(self, name: str) -> float:
        """Return a metric of the last evaluation; NaN if there is none."""
        return self.metrics.get(name, math.nan)

    @property
    def finished(self) -> bool:
        """Whether the run came to its end; only such runs count in averages."""
        return self.state == "finished"

    @property
    def start(self) -> str:
        """Where its episodes started: the source asked for, or the one that was there instead."""
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
        training=_curve(trained, (RETURN,)),
        video=max((folder.path / "videos").glob("frames_*.mp4"), default=None),
    )


def planned_run(folder: RunFolder) -> Run:
    """Return a run that has only a configuration yet."""
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
