"""Thins a run's points for MLflow, whose pages get slow with many; the run folder keeps all."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from pgdm.runs.folder import RunFolder
from pgdm.runs.log import Record, metrics_of

MAX_POINTS = 1500
"""Approximate maximum number of points of a metric, evaluations not counted."""

Point = tuple[int, int, dict[str, float]]
"""Frames, time in ms since the epoch, and finite metrics by name."""


class Thin:
    """Passes about ``MAX_POINTS`` points of a run at most, plus every evaluation.

    Args:
        total_frames: the run's length, frames.
    """

    def __init__(self, total_frames: int) -> None:
        self._stride = max(1, total_frames // MAX_POINTS)
        self._bucket = -1

    def passes(self, frames: int, metrics: Mapping[str, float]) -> bool:
        """Return whether to mirror this point; points must come in the order of frames."""
        bucket, before = frames // self._stride, self._bucket
        self._bucket = bucket
        return bucket != before or any(name.startswith("eval") for name in metrics)


def points(folder: RunFolder, records: Iterable[Record]) -> list[Point]:
    """Return those points of a run's records that are mirrored to MLflow."""
    thin, start = Thin(folder.total_frames()), folder.started()
    found = []
    for record in records:
        frames, metrics = int(record["frames"]), metrics_of(record)
        if metrics and thin.passes(frames, metrics):
            at = int(1000 * (start + float(record.get("time_s", 0.0))))
            found.append((frames, at, metrics))
    return found
