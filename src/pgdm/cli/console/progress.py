"""Progress of a run: a live line on a terminal, plain lines elsewhere."""

from __future__ import annotations

import math
import time
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn

from pgdm.rl import callback

if TYPE_CHECKING:
    from pgdm.rl.trainer import Trainer

PLAIN_INTERVAL_S = 10.0
"""Time between two plain lines."""


class ProgressView(callback.Callback):
    """Shows frames, speed, success, return and the remaining time.

    Args:
        title: label of the live line, such as the task.
        console: where to print; on a terminal a single line is updated.
    """

    def __init__(self, title: str, console: Console) -> None:
        self._title, self._console = title, console
        self._first_frames, self._first_s = 0, 0.0
        self._printed_s = -math.inf
        self._bar: Progress | None = None
        self._shown: dict[str, float] = {}

    def on_start(self, trainer: Trainer) -> None:
        """Start the display at the frame where the training starts or resumes."""
        done = trainer.progress
        self._first_frames, self._first_s = done.frames, time.monotonic()
        if self._console.is_terminal:
            columns = (
                TextColumn("{task.description}"),
                BarColumn(20),
                TextColumn("{task.fields[at]}"),
            )
            self._bar = Progress(*columns, console=self._console, transient=True)
            self._bar.add_task(self._title, total=done.total_frames, completed=done.frames, at="")
            self._bar.start()

    def on_iteration(self, progress: callback.Progress, metrics: dict[str, float]) -> None:
        """Show the metrics of the iteration; missing ones keep their last value."""
        self._shown |= {name: value for name, value in metrics.items() if math.isfinite(value)}
        text = self._line(progress)
        if self._bar is not None:
            self._bar.update(self._bar.task_ids[0], completed=progress.frames, at=text)
        elif time.monotonic() - self._printed_s >= PLAIN_INTERVAL_S:
            self._printed_s = time.monotonic()
            self._print(text)

    def on_evaluation(self, progress: callback.Progress, metrics: dict[str, float]) -> None:
        """Show the success of the policy."""
        parts = []
        for kind in ("sampled", "deterministic"):
            success = metrics.get(f"eval_{kind}/success", math.nan)
            lifted = metrics.get(f"eval_{kind}/lifted", math.nan)
            # If the motion never rises, nothing can count as lifted.
            held = f", lifted {lifted:.0%}" if math.isfinite(lifted) else ""
            parts.append(f"{kind} success {success:.1%}{held}")
        self._print(f"evaluation at {progress.frames:,} frames: {'; '.join(parts)}")

    def on_end(self, progress: callback.Progress, status: str) -> None:
        """Remove the live line."""
        if self._bar is not None:
            self._bar.stop()
            self._bar = None
        self._print(f"{status} at {progress.frames:,} frames, {duration(progress.elapsed_s)}")

    def _print(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)

    def _line(self, progress: callback.Progress) -> str:
        parts = [f"{progress.frames:,}/{progress.total_frames:,} frames"]
        speed = self._shown.get("train/steps_per_s")
        parts += [] if speed is None else [f"{speed:,.0f} steps/s"]
        success = self._shown.get("train/success")
        parts += [] if success is None else [f"success {success:.1%}"]
        gained = self._shown.get("train/return")
        parts += [] if gained is None else [f"return {gained:.1f}"]
        return " | ".join([*parts, f"{self._left(progress)} left"])

    def _left(self, progress: callback.Progress) -> str:
        """Return the remaining time at the pace of this process, pauses included."""
        done = progress.frames - self._first_frames
        if done <= 0:
            return "?"
        pace = (time.monotonic() - self._first_s) / done
        return duration(pace * max(progress.total_frames - progress.frames, 0))


def duration(seconds: float) -> str:
    """Return a time as hours, minutes and seconds, such as ``1:02:03`` or ``2:03``."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"
