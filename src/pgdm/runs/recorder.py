"""Records training in a run folder, and reports it to a tracker."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pgdm.errors import PgdmError, RenderError
from pgdm.library.progress import Notify
from pgdm.rl.callback import Callback, Progress
from pgdm.rl.learner import Model
from pgdm.rl.trainer import Trainer
from pgdm.runs.files import REPLAY, RESULT
from pgdm.runs.folder import RunFolder
from pgdm.runs.result import RunResult, video_path, write_result
from pgdm.runs.tracker import NullTracker, Tracker

Film = Callable[[Model, Path], Path]
"""Writes an MP4 of a policy and returns its poster."""


class Recorder(Callback):
    """Records training; must be among the trainer's callbacks.

    Args:
        run_dir: folder of the run.
        facts: what the result depends on besides the settings, for ``result.json``.
        open_tracker: opens the tracker of a run folder.
        film: makes a video of an evaluated policy; raises RenderError on failure.
        notify: called with a sentence if a video cannot be made.
    """

    def __init__(
        self,
        run_dir: Path,
        facts: Mapping[str, Any],
        open_tracker: Callable[[RunFolder], Tracker],
        film: Film,
        notify: Notify,
    ) -> None:
        self._run_dir, self._facts, self._film = run_dir, facts, film
        self._open_tracker, self._notify = open_tracker, notify
        self._folder = RunFolder(run_dir)
        self._tracker: Tracker = NullTracker()
        self._model: Model | None = None

    def run(self, trainer: Trainer, resumed: bool) -> RunResult:
        """Train, and record how it ends.

        Args:
            trainer: the trainer; the run folder must already hold the run's settings.
            resumed: whether training starts from a checkpoint; if so, records up to it are kept.

        Raises:
            PgdmError: if the training fails, or its records cannot be written.
        """
        self._folder.log.truncate(trainer.progress.frames if resumed else -1)
        (self._run_dir / RESULT).unlink(missing_ok=True)  # of an earlier attempt
        self._model, self._tracker = trainer.model, self._open_tracker(self._folder)
        status, patience_s = "failed", 60.0
        try:
            outcome = trainer.run()
            ended = outcome.status, outcome.progress, outcome.evaluation
            write_result(self._folder, *ended, self._facts)
            # The replay is removed only now: an unfinished run needs it to resume.
            if outcome.status == "finished" and not self._folder.setting("keep_replay"):
                shutil.rmtree(self._run_dir / REPLAY, ignore_errors=True)
            status = outcome.status
            return RunResult.of(self._run_dir)
        except KeyboardInterrupt:
            status, patience_s = "interrupted", 2.0  # a second Ctrl-C: exit quickly
            raise
        except (PgdmError, OSError, MemoryError) as error:
            write_result(self._folder, "failed", trainer.progress, {}, self._facts, str(error))
            raise
        finally:
            self._tracker.finish(status, patience_s)

    def on_iteration(self, progress: Progress, metrics: dict[str, float]) -> None:
        """Record an iteration."""
        self._record(progress, metrics, "train")

    def on_evaluation(self, progress: Progress, metrics: dict[str, float]) -> None:
        """Record an evaluation, with a video of the policy if the settings say so."""
        self._record(progress, metrics, "eval")
        setting, last = self._folder.setting, progress.frames >= progress.total_frames
        if setting("eval.video") and (last or setting("eval.video_every_eval")):
            self._film_policy(progress)

    def _record(self, progress: Progress, metrics: Mapping[str, float], kind: str) -> None:
        self._folder.log.append(
            metrics,
            frames=progress.frames,
            iteration=progress.iteration,
            time_s=progress.elapsed_s,
            kind=kind,
        )
        self._tracker.log(metrics, progress.frames)

    def _film_policy(self, progress: Progress) -> None:
        assert self._model is not None
        path = video_path(self._run_dir, progress.frames)
        try:
            poster = self._film(self._model, path)
        except RenderError as error:
            self._notify(f"no video: {error}")
            return
        self._tracker.video(path, poster, progress.frames)
