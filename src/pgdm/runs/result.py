"""How a run ended: ``result.json``, and whether the run has anything left to do."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import harmonic_mean
from typing import Any

from pgdm.rl.callback import Progress
from pgdm.runs.files import RESULT, VIDEOS, write_json
from pgdm.runs.folder import RunFolder
from pgdm.runs.log import metrics_of
from pgdm.runs.provenance import versions

ENDED_BY, TIME_LIMIT = "ended_by", "time_limit"
"""Key in ``result.json`` of a finished run, and its value if ``time_limit_min`` ended the run. If
the run reached its length instead, the value is ``frames``."""
WRIST_BOUND = "wrist_bound"
"""Key in ``result.json``: the wrist plan's ``rigid_grasp``, 0..1."""


@dataclass(frozen=True)
class RunResult:
    """How a run ended."""

    status: str
    """``finished`` or ``interrupted``."""
    run_dir: Path
    frames: int
    before: dict[str, float]
    """Metrics of the first evaluation."""
    after: dict[str, float]
    """Metrics of the last evaluation."""
    video: Path | None
    """MP4 of the last evaluated policy, with its mean action."""
    pregrasp_used: str
    """Where episodes started: the configured source, or its fallback."""

    @classmethod
    def of(cls, run_dir: Path) -> RunResult:
        """Return the result that is stored in a run folder."""
        folder = RunFolder(run_dir)
        stored = folder.result
        evaluations = [record for record in folder.log.read() if record["kind"] == "eval"]
        return cls(
            status=stored["status"],
            run_dir=run_dir,
            frames=stored["frames"],
            before=metrics_of(evaluations[0]) if evaluations else {},
            after=stored["metrics"],
            video=run_dir / stored["video"] if stored.get("video") else None,
            pregrasp_used=stored["pregrasp_used"],
        )


def is_whole(
    result: Mapping[str, Any], total_frames: int, time_limit_min: float | None = 0.0
) -> bool:
    """Return whether a run is finished and has nothing left to do under the current settings.

    Args:
        result: contents of its ``result.json``.
        total_frames: length that is wanted now, frames.
        time_limit_min: time limit that is wanted now; None: no limit; 0: the limit the run had, so
            that a run which the limit ended has nothing left to do.
    """
    if result.get("status") != "finished":
        return False
    limited = result.get(ENDED_BY) == TIME_LIMIT and time_limit_min is not None
    in_time = not limited or result.get("wall_time_s", 0.0) < 60 * (time_limit_min or 0.0)
    return result.get("frames", 0) >= total_frames or not in_time


@dataclass(frozen=True)
class Reached:
    """Status and progress of a run."""

    status: str
    """``finished``, ``interrupted`` or ``failed``."""
    frames: int
    metrics: dict[str, float]
    """Metrics of the last evaluation; empty if there was none."""
    error: str | None
    """Why the run failed."""


def reached(folder: RunFolder, total_frames: int, time_limit_min: float | None = 0.0) -> Reached:
    """Return a run's status and progress, from its result or, if missing, from its records.

    A run without a result counts as interrupted, and so does a finished run that has more to do
    under the current settings. The arguments are as for `is_whole`.
    """
    result = folder.result
    frames, metrics = result.get("frames"), result.get("metrics")
    if not isinstance(frames, int) or not isinstance(metrics, dict):
        records = folder.log.tail()
        frames = int(records[-1]["frames"]) if records else 0
        evaluations = (metrics_of(r) for r in reversed(records) if r["kind"] == "eval")
        metrics = next(evaluations, {})
    status = "finished" if is_whole(result, total_frames, time_limit_min) else "interrupted"
    if result.get("status") == "failed":
        status = "failed"
    return Reached(status, frames, metrics, result.get("error"))


def video_path(run_dir: Path, frames: int) -> Path:
    """Return the file of the video of the policy after ``frames``."""
    return run_dir / VIDEOS / f"frames_{frames:012d}.mp4"


def write_result(
    folder: RunFolder,
    status: str,
    progress: Progress,
    metrics: Mapping[str, float],
    facts: Mapping[str, Any],
    error: str = "",
) -> None:
    """Write ``result.json``.

    Args:
        folder: folder of the run.
        status: ``finished``, ``interrupted`` or ``failed``.
        progress: progress when the run ended.
        metrics: metrics of the last evaluation; NaN is left out.
        facts: what the result depends on besides the settings, such as hashes of the assets.
        error: why the run failed.
    """
    records = folder.log.read()
    rates = [float(r["train/steps_per_s"]) for r in records if "train/steps_per_s" in r]
    rates = [rate for rate in rates if math.isfinite(rate)]
    total, video = folder.total_frames(), video_path(folder.path, progress.frames)
    ended_by = TIME_LIMIT if progress.frames < total else "frames"
    content = {
        "status": status,
        **({ENDED_BY: ended_by} if status == "finished" else {}),
        "task": folder.setting("task.id"),
        "budget": folder.setting("budget"),
        "frames": progress.frames,
        "total_frames": total,
        # Rounded up, so that it is never below the time limit that ended the run.
        "wall_time_s": math.ceil(10 * progress.elapsed_s) / 10,
        # Speed of collecting and learning only; wall_time_s includes evaluations and videos.
        "steps_per_s": round(harmonic_mean(rates), 1) if rates else 0.0,
        "metrics": {name: value for name, value in metrics.items() if not math.isnan(value)},
        "video": str(video.relative_to(folder.path)) if video.exists() else None,
        **facts,
        "versions": versions(),
        **({"error": error} if error else {}),
    }
    write_json(folder.path / RESULT, content)
