"""The composition root: wires library, scene, MDP, learner and tracking into one run."""

from __future__ import annotations

import logging
import math
import os
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import harmonic_mean
from typing import Any

from pgdm.config.hands import own_hand
from pgdm.config.saved import check_run_dir, save_config
from pgdm.config.schema import ExperimentCfg
from pgdm.envs.build import EnvBuilder, EnvCfg
from pgdm.envs.film import film_policy
from pgdm.errors import PgdmError, PlanMissingError, RenderError, RunError
from pgdm.library import Library, ensure, ensure_expert
from pgdm.library.provide import Spoken
from pgdm.library.report import Progress as FetchProgress
from pgdm.methods import recipe
from pgdm.paths import restoring
from pgdm.pregrasp.provide import Wanted, ensure_start
from pgdm.rl.callback import Callback, Progress
from pgdm.rl.checkpoint import CheckpointFolder, State
from pgdm.rl.evaluate import Evaluator
from pgdm.rl.trainer import Extras, Outcome, Trainer, TrainerCfg
from pgdm.stop import stoppable
from pgdm.tracking import RunFolder, open_tracker
from pgdm.tracking.provenance import git_revision, versions
from pgdm.tracking.run_folder import (
    ENDED_BY,
    RESULT,
    TIME_LIMIT,
    WRIST_BOUND,
    claimed,
    is_whole,
    read_json,
    write_json,
)
from pgdm.tracking.run_log import RunLog, metrics_of
from pgdm.tracking.tracker import Tracker
from pgdm.wrist import stored as wrist_plans
from pgdm.wrist.stored import WristPlans

_log = logging.getLogger(__name__)

Notify = Callable[[str], None]

REPLAY = "replay"
"""Folder of a run in which an off-policy learner keeps what it saw."""


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
    """MP4 of the last evaluated policy, deterministic."""
    pregrasp_used: str
    """Where episodes started: the configured source, or its fallback."""


def env_builder(
    cfg: ExperimentCfg,
    library: Library,
    notify: Notify = _log.warning,
    progress: FetchProgress | None = None,
) -> EnvBuilder:
    """Compile the task of an experiment; plans its wrist if that is wanted and not done yet.

    Raises:
        PgdmError: see `EnvBuilder` and `WristPlans`.
    """
    return _env_builder(cfg, library, notify, progress or Spoken(notify))


def _env_builder(
    cfg: ExperimentCfg, library: Library, notify: Notify, progress: FetchProgress | None
) -> EnvBuilder:
    start = cfg.pregrasp, cfg.ablation
    plans = WristPlans(library.root, Path(cfg.run_dir), notify, progress, threads(cfg))
    env = EnvCfg(
        cfg.task, cfg.hand, cfg.sim, *start, cfg.obs, cfg.action, cfg.reference, cfg.shaping
    )
    return EnvBuilder(library, env, recipe(cfg.method), plans)


def assets(cfg: ExperimentCfg, notify: Notify, progress: FetchProgress | None = None) -> Library:
    """Open the library with all that an experiment needs in it; fetches or makes what is missing.

    Raises:
        LibraryError: if something is missing and cannot be fetched.
        ConfigError: if the start cannot be made for this hand.
    """
    library = ensure(cfg.task.motion, cfg.offline, notify, progress=progress)
    if recipe(cfg.method).needs_expert:
        library = ensure_expert(cfg.task.motion, cfg.offline, notify, progress=progress)
    start = wanted_start(cfg, library)
    ensure_start(library, start, cfg.offline, notify, progress or Spoken(notify), threads(cfg))
    return library


def wanted_start(cfg: ExperimentCfg, library: Library) -> Wanted:
    """Return which start an experiment wants."""
    return Wanted(cfg.task, cfg.hand, own_hand(cfg, library), cfg.sim, cfg.pregrasp.source)


def foreseen(cfg: ExperimentCfg, library: Library) -> list[str]:
    """Return what a run would say of itself, as far as nothing is to be fetched or made first.

    Raises:
        ConfigError: if its start is missing, and would not be made.
    """
    task = cfg.task.motion
    if task not in library.tasks():
        return [f"the assets of '{task}' are not here yet"]
    if recipe(cfg.method).needs_expert and task not in library.experts().experts:
        return [f"the expert hand trajectory of '{task}' is fetched first"]
    start = wanted_start(cfg, library)
    if start.can_be_made and not start.path.is_file():
        return [f"the start '{cfg.pregrasp.source}' of '{task}' is made first"]
    try:
        return notes(cfg, _env_builder(cfg, library, _log.warning, progress=None))
    except PlanMissingError as missing:
        # Nothing else that a run says depends on the wrist's path.
        other = replace(cfg, action=replace(cfg.action, wrist_path="clipped"))
        return [str(missing), *notes(cfg, _env_builder(other, library, _log.warning, None))]


def notes(cfg: ExperimentCfg, builder: EnvBuilder) -> list[str]:
    """Return warnings where a run deviates from its configuration, and the disk it takes."""
    late = builder.mdp.recipe.unfinished(cfg.total_frames)
    return [
        *builder.notes,
        *([f"in trainings only, {told}"] if (told := cfg.shaping.described()) else []),
        *(_of_replay(cfg, builder) if cfg.algo.usual_frame_bytes else []),
        *(
            f"the weight of '{name}' only comes to {last:.3g} of {weight:g} in "
            f"{cfg.total_frames:,} frames: its schedule is longer than the run"
            for name, last, weight in late
        ),
    ]


def _of_replay(cfg: ExperimentCfg, builder: EnvBuilder) -> list[str]:
    disk = cfg.algo.disk_bytes(builder.make(1, 1), cfg.num_envs, cfg.total_frames)
    kept = "it is kept" if cfg.keep_replay else "removed when the run has finished"
    note = f"the replay takes {disk / 1e9:.2f} GB of disk; {kept}"
    if cfg.budget == "paper":
        note += f" ({cfg.total_frames:,} frames; +experiment=fast trains for 300,000 frames)"
    return [note]


def threads(cfg: ExperimentCfg) -> int:
    """Return the number of threads to use."""
    return cfg.num_threads or len(os.sched_getaffinity(0))


def run_experiment(
    cfg: ExperimentCfg,
    callbacks: Sequence[Callback] = (),
    stop: Callable[[], bool] = lambda: False,
    notify: Notify = _log.info,
) -> RunResult:
    """Train, evaluate and record one experiment in its run folder, or go on with it.

    Args:
        cfg: the experiment.
        callbacks: listeners, such as a progress bar.
        stop: asked at safe points; True saves and ends the run as ``interrupted``.
        notify: told in a sentence what takes time or differs from what was asked.

    Raises:
        PgdmError: if the run cannot start, go on or be saved.
    """
    run_dir = Path(cfg.run_dir)
    check_run_dir(cfg)
    progress = stoppable(stop, Spoken(notify))
    library = assets(cfg, notify, progress)
    with claimed(run_dir):
        builder = env_builder(cfg, library, notify, progress)
        return Run(cfg, builder, run_dir, notify).train(callbacks, stop)


def check_assets(
    metadata: dict[str, Any], builder: EnvBuilder, where: Path, notify: Notify
) -> None:
    """Check that a checkpoint was made with the assets that are there now.

    Raises:
        RunError: if not; names what differs.
    """
    for text in builder.differences(metadata):
        raise RunError(
            f"{where} was made with {text}; restore the library (pgdm assets list), or start anew "
            "in another run_dir"
        )
    before, now = metadata.get("versions", {}), versions()
    for package in ("mujoco", "torch"):
        if before.get(package) != now[package]:
            notify(
                f"{where} was made with {package} {before.get(package)}, this is {now[package]}: "
                "what follows is no longer equal to the bit"
            )


class Run(Callback):
    """One experiment in its folder; as a callback it records what the trainer does.

    Args:
        cfg: the experiment.
        builder: its compiled task.
        run_dir: its folder.
        notify: told in a sentence what people should know.
    """

    def __init__(
        self, cfg: ExperimentCfg, builder: EnvBuilder, run_dir: Path, notify: Notify
    ) -> None:
        self.cfg, self.builder, self.dir, self._notify = cfg, builder, run_dir, notify
        self._log = RunLog(run_dir / "metrics.jsonl")
        self._checkpoints = CheckpointFolder(run_dir / "checkpoints", cfg.checkpoint.keep_last)
        shaping = {"shaping": told} if (told := cfg.shaping.described()) else {}
        self._facts = {**builder.facts(), **shaping, "git": git_revision()}
        self._tracker: Tracker | None = None
        self._trainer: Trainer | None = None

    def train(self, callbacks: Sequence[Callback], stop: Callable[[], bool]) -> RunResult:
        """Train to the end, or until ``stop``."""
        state = self._checkpoints.latest()
        stored = read_json(self.dir / RESULT)
        if state is not None and self._ended(state, stored):
            self._notify(f"{self.dir} is finished already; its result:")
            for text in self.builder.differences(stored):
                self._notify(f"note: it was made with {text}")
            return self._stored_result(stored)
        for note in notes(self.cfg, self.builder):
            self._notify(note)
        if state is not None:
            check_assets(state["metadata"], self.builder, self.dir, self._notify)
        with restoring(self.dir / REPLAY):  # a start that is refused leaves no reserved room
            trainer = self._make_trainer((self, *callbacks), stop)
            if state is not None:
                trainer.load_state_dict(state)
                self._notify(f"continuing {self.dir} at {state['frames']:,} frames")
        save_config(self.cfg, self.dir)
        if (plan := self.builder.wrist) is not None:
            wrist_plans.write(self.dir / wrist_plans.FILE, plan, self.builder.wrist_problem)
        self._log.truncate(trainer.progress.frames if state is not None else -1)
        (self.dir / RESULT).unlink(missing_ok=True)  # it tells of an earlier end, not of this one
        self._trainer = trainer
        self._tracker = open_tracker(self.cfg.tracking, RunFolder(self.dir), self._facts)
        status, patience_s = "failed", 60.0
        try:
            outcome = trainer.run()
            status = outcome.status
            return self._finish(outcome)
        except KeyboardInterrupt:
            status, patience_s = "interrupted", 2.0  # who asks a second time wants to go now
            raise
        except (PgdmError, OSError, MemoryError) as error:
            self._write_result("failed", trainer.progress, {}, str(error))
            raise
        finally:
            self._tracker.finish(status, patience_s)

    def _ended(self, state: State, stored: dict[str, Any]) -> bool:
        """Return whether a run had come to its end, and its last checkpoint is still there."""
        whole = is_whole(stored, self.cfg.total_frames, self.cfg.time_limit_min)
        return whole and int(state["frames"]) >= stored["frames"]

    def on_iteration(self, progress: Progress, metrics: dict[str, float]) -> None:
        """Record an iteration."""
        self._record(progress, metrics, "train")

    def on_evaluation(self, progress: Progress, metrics: dict[str, float]) -> None:
        """Record an evaluation, and film it if asked."""
        self._record(progress, metrics, "eval")
        last = progress.frames >= progress.total_frames
        if self.cfg.eval.video and (last or self.cfg.eval.video_every_eval):
            self._film(progress)

    def _make_trainer(self, callbacks: Sequence[Callback], stop: Callable[[], bool]) -> Trainer:
        cfg, make = self.cfg, self.builder.make
        count = threads(cfg)
        env = make(cfg.num_envs, count, cfg.seed, dump_dir=self.dir / "diverged")
        episodes = cfg.eval.episodes
        evaluator = Evaluator(
            lambda n: make(n, min(n, count), cfg.seed, "eval"),
            episodes,
            # Without randomness in the task all deterministic episodes are the same.
            episodes if cfg.task.randomize else 1,
            cfg.seed,
        )
        trainer_cfg = TrainerCfg(
            algo=cfg.algo,
            seed=cfg.seed,
            total_frames=cfg.total_frames,
            time_limit_s=None if cfg.time_limit_min is None else 60 * cfg.time_limit_min,
            eval_interval_frames=cfg.eval.interval_frames,
            checkpoint_interval_s=cfg.checkpoint.interval_s,
            device=cfg.device,
            num_threads=count,
        )
        extras = Extras(
            evaluation=evaluator,
            checkpoints=self._checkpoints,
            schedules=self.builder.mdp.recipe.schedules,
            callbacks=callbacks,
            stop=stop,
            replay_folder=self.dir / REPLAY,
            metadata={**self.builder.facts(), "versions": versions()},
        )
        return Trainer(env, trainer_cfg, extras)

    def _record(self, progress: Progress, metrics: dict[str, float], kind: str) -> None:
        assert self._tracker is not None
        self._log.append(
            metrics,
            frames=progress.frames,
            iteration=progress.iteration,
            time_s=progress.elapsed_s,
            kind=kind,
        )
        self._tracker.log(metrics, progress.frames)

    def _film(self, progress: Progress) -> None:
        assert self._trainer is not None and self._tracker is not None
        path = self._video(progress)
        model = self._trainer.model
        env = self.builder.make(1, 1, self.cfg.seed, "eval", auto_reset=False)
        try:
            poster = film_policy(env, lambda obs: model.act(obs, deterministic=True), path)
        except RenderError as error:
            self._notify(f"no video: {error}")
            return
        self._tracker.video(path, poster, progress.frames)

    def _video(self, progress: Progress) -> Path:
        return self.dir / "videos" / f"frames_{progress.frames:012d}.mp4"

    def _finish(self, outcome: Outcome) -> RunResult:
        self._write_result(outcome.status, outcome.progress, outcome.evaluation)
        # Only now: until the run counts as finished, the same command goes on with its replay.
        if outcome.status == "finished" and not self.cfg.keep_replay:
            shutil.rmtree(self.dir / REPLAY, ignore_errors=True)
        return self._stored_result(read_json(self.dir / RESULT))

    def _write_result(
        self, status: str, progress: Progress, metrics: dict[str, float], error: str = ""
    ) -> None:
        rates = [
            float(r["train/steps_per_s"]) for r in self._log.read() if "train/steps_per_s" in r
        ]
        video = self._video(progress)
        ended_by = TIME_LIMIT if progress.frames < self.cfg.total_frames else "frames"
        write_json(
            self.dir / RESULT,
            {
                "status": status,
                **({ENDED_BY: ended_by} if status == "finished" else {}),
                "task": self.cfg.task.id,
                "budget": self.cfg.budget,
                "frames": progress.frames,
                "total_frames": self.cfg.total_frames,
                # Rounded up: never below the limit of time that ended the run.
                "wall_time_s": math.ceil(10 * progress.elapsed_s) / 10,
                # Of collecting and learning; wall_time_s has evaluations and films too.
                "steps_per_s": round(harmonic_mean(rates), 1) if rates else 0.0,
                "metrics": {k: v for k, v in metrics.items() if v == v},
                "video": str(video.relative_to(self.dir)) if video.exists() else None,
                **self._facts,
                **({WRIST_BOUND: self.builder.wrist.bound} if self.builder.wrist else {}),
                "versions": versions(),
                **({"error": error} if error else {}),
            },
        )

    def _stored_result(self, stored: dict[str, Any]) -> RunResult:
        evaluations = [r for r in self._log.read() if r["kind"] == "eval"]
        before = metrics_of(evaluations[0]) if evaluations else {}
        video = stored.get("video")
        return RunResult(
            status=stored["status"],
            run_dir=self.dir,
            frames=stored["frames"],
            before=before,
            after=stored["metrics"],
            video=self.dir / video if video else None,
            pregrasp_used=stored["pregrasp_used"],
        )
