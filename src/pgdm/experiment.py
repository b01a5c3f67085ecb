"""The composition root: wires library, scene, MDP, learner and tracking into one run."""

from __future__ import annotations

import dataclasses
import logging
import os
from collections.abc import Callable, Sequence
from functools import partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from pgdm.config.foreign import trust_method
from pgdm.config.hands import own_hand
from pgdm.config.saved import check_run_dir, save_config
from pgdm.config.schema import ExperimentCfg
from pgdm.envs.build import EnvBuilder, EnvCfg
from pgdm.envs.film import film_policy
from pgdm.library import Library, ensure, ensure_expert
from pgdm.library.progress import Notify, ProgressLines, StepProgress, stoppable
from pgdm.memory import check_fits
from pgdm.methods import recipe
from pgdm.paths import restoring
from pgdm.pregrasp.on_demand import Wanted, ensure_start
from pgdm.rl.callback import Callback
from pgdm.rl.checkpoint import CheckpointFolder, State
from pgdm.rl.evaluate import Evaluator
from pgdm.rl.learner import Model
from pgdm.rl.trainer import Extras, Trainer, TrainerCfg, check_state
from pgdm.runs.files import CHECKPOINTS, DIVERGED, REPLAY, RESULT, RESULT_KINDS, fault, read_json
from pgdm.runs.folder import RunFolder, claimed, holds_run
from pgdm.runs.provenance import check_assets, git_revision, versions
from pgdm.runs.recorder import Recorder
from pgdm.runs.result import WRIST_BOUND, RunResult, is_whole
from pgdm.sim.scene import WARP, build_scene
from pgdm.tracking import located, open_tracker
from pgdm.wrist import stored as wrist_plans
from pgdm.wrist.plan import simulate
from pgdm.wrist.stored import WristPlans

_log = logging.getLogger(__name__)

_LONG_DAYS = 30
"""Expected length of a run above which a note announces it, days."""


def env_builder(
    cfg: ExperimentCfg,
    library: Library,
    notify: Notify = _log.warning,
    progress: StepProgress | None = None,
    plan_wrist: bool = True,
    commands: np.ndarray | None = None,
) -> EnvBuilder:
    """Compile the task of an experiment.

    Args:
        cfg: the experiment.
        library: library with its assets.
        notify: called with a sentence about each slow step or deviation from the settings.
        progress: called with the wrist planner's progress; None reports it to ``notify``.
        plan_wrist: whether to compute a wrist plan that is needed and missing.
        commands: base commands to use instead of a stored wrist plan, (T-1, 6), m and rad.

    Raises:
        PgdmError: see `EnvBuilder` and `WristPlans`.
    """
    listener = (progress or ProgressLines(notify)) if plan_wrist else None
    plans = WristPlans(library.root, Path(cfg.run_dir), notify, listener, threads(cfg))
    if commands is not None:
        plans = partial(simulate, commands=commands)
    parts = (cfg.task, cfg.hand, cfg.sim, cfg.pregrasp, cfg.ablation)
    env = EnvCfg(*parts, cfg.obs, cfg.action, cfg.reference, cfg.used_shaping)
    return EnvBuilder(library, env, recipe(cfg.method), plans)


def assets(cfg: ExperimentCfg, notify: Notify, progress: StepProgress | None = None) -> Library:
    """Open the library; fetch or compute what an experiment needs and the library lacks.

    Raises:
        LibraryError: if something is missing and cannot be fetched.
        ConfigError: if the start state cannot be computed for this hand.
    """
    opened = ensure_expert if recipe(cfg.method).needs_expert else ensure
    library = opened(cfg.task.motion, cfg.offline, notify, progress=progress)
    start = wanted_start(cfg, library)
    ensure_start(
        library, start, cfg.offline, notify, progress or ProgressLines(notify), threads(cfg)
    )
    return library


def wanted_start(cfg: ExperimentCfg, library: Library) -> Wanted:
    """Return the start state that an experiment needs."""
    return Wanted(cfg.task, cfg.hand, own_hand(cfg, library), cfg.sim, cfg.pregrasp.source)


def foreseen(cfg: ExperimentCfg, library: Library) -> list[str]:
    """Return the `notes` of a run before it starts.

    If assets must be fetched or a start state computed first, return only a note about that.

    Raises:
        ConfigError: if the run's start state is missing and would not be computed, its hand is
            unknown, or too little memory is free.
        SceneError: if the scene does not compile, or the hand violates pgdm's assumptions.
    """
    task = cfg.task.motion
    if holds_run(Path(cfg.run_dir), cfg.resume):
        library = library.serving(RunFolder(Path(cfg.run_dir)).result.get("asset_source"))
    if task not in library.tasks():
        return [f"the assets of '{task}' are not in the library; the run fetches them first"]
    if recipe(cfg.method).needs_expert and task not in library.experts().experts:
        return [f"the run fetches the expert hand trajectory of '{task}' first"]
    start = wanted_start(cfg, library)
    if start.can_be_made and not start.path.is_file():
        build_scene(library, cfg.task, cfg.hand, cfg.sim)  # fail now, not in the run
        return [f"the run computes the '{cfg.pregrasp.source}' start of '{task}' first"]
    missing: list[str] = []
    builder = env_builder(cfg, library, missing.append, plan_wrist=False)
    check_memory(cfg, builder)
    return [*missing, *notes(cfg, builder)]


def notes(cfg: ExperimentCfg, builder: EnvBuilder) -> list[str]:
    """Return sentences on shaping, duration, disk space, late schedules, and deviating settings."""
    late, days = builder.mdp.recipe.unfinished(cfg.total_frames), cfg.usual_days
    return [
        *builder.notes,
        *([f"in training only, {shaping}"] if (shaping := cfg.used_shaping.described()) else []),
        *([f"the training takes about {days:,.0f} days"] if days > _LONG_DAYS else []),
        *(_of_replay(cfg, builder) if cfg.algo.usual_frame_bytes else []),
        *(
            f"the weight of '{name}' reaches only {last:.3g} of {weight:g} in "
            f"{cfg.total_frames:,} frames: its schedule is longer than the run"
            for name, last, weight in late
        ),
    ]


def check_memory(cfg: ExperimentCfg, builder: EnvBuilder) -> None:
    """Check that simulations, evaluation and learner fit into the free memory.

    Raises:
        ConfigError: if they do not; names the setting to change.
    """
    algo = cfg.algo
    learner = algo.memory_bytes(builder.probe, cfg.num_envs)
    builder.check_memory("num_envs", cfg.num_envs)
    builder.check_memory("eval.episodes", cfg.eval.episodes)
    settings = f"algo.hidden={algo.hidden} and algo.steps_per_env={algo.steps_per_env}"
    check_fits(settings, learner, "use smaller ones, or a smaller num_envs")
    builder.check_memory("num_envs", cfg.num_envs, learner)


def _of_replay(cfg: ExperimentCfg, builder: EnvBuilder) -> list[str]:
    disk = cfg.algo.disk_bytes(builder.probe, cfg.num_envs, cfg.total_frames)
    then = "is kept" if cfg.keep_replay else "is removed when the run has finished"
    note = f"the replay takes {disk / 1e9:.2f} GB of disk space and {then}"
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
    """Train, evaluate and record one experiment in its run folder, or resume it there.

    Args:
        cfg: the experiment.
        callbacks: listeners, such as a progress bar.
        stop: polled at safe points; True saves the run and ends it as ``interrupted``.
        notify: called with a sentence about each slow step or deviation from the settings.

    Raises:
        PgdmError: if the run cannot start, be resumed or be saved.
    """
    run_dir = Path(cfg.run_dir)
    trust_method({"method": {"name": cfg.method.name}})
    check_run_dir(cfg)
    cfg = dataclasses.replace(cfg, tracking=located(cfg.tracking, notify))
    progress = stoppable(stop, ProgressLines(notify))
    library = assets(cfg, notify, progress)
    with claimed(run_dir):
        checkpoints = CheckpointFolder(run_dir / CHECKPOINTS, cfg.checkpoint.keep_last)
        state = checkpoints.latest(check_state)
        if state is not None:
            library = library.serving(state["metadata"].get("asset_source"))
        builder = env_builder(cfg, library, notify, progress)
        if state is not None and _has_finished(cfg, builder, state, notify):
            return RunResult.of(run_dir)
        check_memory(cfg, builder)
        for note in notes(cfg, builder):
            notify(note)
        if state is not None:
            check_assets(state["metadata"], builder, run_dir, notify)
        recorder = _recorder(cfg, builder, notify)
        with restoring(run_dir / REPLAY):  # if starting fails, free the reserved disk space
            trainer = _trainer(cfg, builder, checkpoints, (recorder, *callbacks), stop)
            if state is not None:
                state = checkpoints.latest(trainer.load_state_dict)
                notify(f"resuming {run_dir} at {trainer.progress.frames:,} frames")
        save_config(cfg, run_dir)
        if builder.wrist is not None:
            wrist_plans.write(run_dir / wrist_plans.FILE, builder.wrist, builder.wrist_problem)
        return recorder.run(trainer, resumed=state is not None)


def _has_finished(cfg: ExperimentCfg, builder: EnvBuilder, state: State, notify: Notify) -> bool:
    """Return whether a run has nothing left to do, and its last checkpoint still exists."""
    run_dir = Path(cfg.run_dir)
    stored = read_json(run_dir / RESULT)
    if fault(stored, RESULT_KINDS):
        return False  # the result is missing or malformed: write it again
    whole = is_whole(stored, cfg.total_frames, cfg.time_limit_min)
    if not (whole and int(state["frames"]) >= stored["frames"]):
        return False
    notify(f"{run_dir} is finished already; its result:")
    for difference in builder.differences(stored):
        notify(f"note: it was trained with {difference}")
    return True


def _trainer(
    cfg: ExperimentCfg,
    builder: EnvBuilder,
    checkpoints: CheckpointFolder,
    callbacks: Sequence[Callback],
    stop: Callable[[], bool],
) -> Trainer:
    run_dir, make, count = Path(cfg.run_dir), builder.make, threads(cfg)
    episodes = cfg.eval.episodes
    evaluator = Evaluator(
        lambda n: make(n, min(n, count), cfg.seed, "eval"),
        episodes,
        # Without randomness in the task all deterministic episodes are the same.
        episodes if cfg.task.randomize else 1,
        cfg.seed,
    )
    settings = TrainerCfg(
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
        checkpoints=checkpoints,
        schedules=builder.mdp.recipe.schedules,
        callbacks=callbacks,
        stop=stop,
        replay_folder=run_dir / REPLAY,
        metadata={**builder.facts(), "versions": versions()},
    )
    dump_dir = run_dir / DIVERGED
    env = make(cfg.num_envs, count, cfg.seed, dump_dir=dump_dir, device=cfg.device)
    return Trainer(env, settings, extras)


def _recorder(cfg: ExperimentCfg, builder: EnvBuilder, notify: Notify) -> Recorder:
    facts: dict[str, Any] = dict(builder.facts())
    if shaping := cfg.used_shaping.described():
        facts["shaping"] = shaping
    facts["git"] = git_revision()
    if cfg.sim.engine == WARP:
        facts["engine"] = f"MuJoCo Warp {version('mujoco-warp')}, float32, {cfg.device}"
    if builder.wrist is not None:
        facts[WRIST_BOUND] = builder.wrist.rigid_grasp

    def film(model: Model, path: Path) -> Path:
        env = builder.make(1, 1, cfg.seed, "eval", auto_reset=False)
        return film_policy(env, lambda obs: model.act(obs, deterministic=True), path)

    run_dir, tracking = Path(cfg.run_dir), cfg.tracking
    return Recorder(run_dir, facts, lambda run: open_tracker(tracking, run, facts), film, notify)
