"""The training loop."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from pgdm.errors import CheckpointError
from pgdm.rl.algos import build_learner
from pgdm.rl.callback import Callback, Progress
from pgdm.rl.checkpoint import CheckpointFolder, State
from pgdm.rl.collector import Collector
from pgdm.rl.evaluate import Policy
from pgdm.rl.learner import AlgoCfg, Model
from pgdm.rl.vec_env import VecEnv
from pgdm.seeding import torch_stream

Schedule = Callable[[int], dict[str, float]]
"""From environment steps so far to reward weights by term name."""


class Evaluation(Protocol):
    """Anything that measures a policy, such as ``Evaluator``."""

    def evaluate(self, policy: Policy, stop: Callable[[], bool]) -> dict[str, float] | None:
        """Return metrics by name, or None if ``stop`` said to give up."""
        ...


@dataclass(frozen=True)
class TrainerCfg:
    """A training, apart from its environment."""

    algo: AlgoCfg
    """Settings of the learner, whose class chooses it."""
    seed: int
    """The run's seed."""
    total_frames: int
    """Environment steps to train for; the last iteration is completed."""
    time_limit_s: float | None
    """Time after which it ends with what it has, s, all attempts together; None: never."""
    eval_interval_frames: int
    """Environment steps between two evaluations; 0: only at the start and the end."""
    checkpoint_interval_s: float
    """Time between two checkpoints, s."""
    device: str
    """Where the networks are, ``cpu`` or ``cuda``."""
    num_threads: int
    """Threads of torch while learning; 0: as many as torch takes by itself."""


@dataclass(frozen=True)
class Extras:
    """What a training may have besides; a bare ``Extras()`` trains in silence."""

    evaluation: Evaluation | None = None
    """Measures the policy."""
    checkpoints: CheckpointFolder | None = None
    """Where states are kept."""
    schedules: Sequence[Schedule] = ()
    """Change reward weights before each iteration."""
    callbacks: Sequence[Callback] = ()
    """Listen."""
    stop: Callable[[], bool] = lambda: False
    """Asked at safe points; True ends the training as ``interrupted``."""
    replay_folder: Path | None = None
    """Where an off-policy learner keeps what it saw; None: in memory, and not to be resumed."""
    metadata: dict[str, Any] = field(default_factory=dict)
    """Plain values stored in each checkpoint, such as what identifies the run."""


@dataclass(frozen=True)
class Outcome:
    """How a training ended."""

    status: str
    """``finished`` or ``interrupted``."""
    progress: Progress
    """How far it came."""
    evaluation: dict[str, float]
    """Metrics of the last evaluation; {} if there was none."""


class Trainer:
    """Trains a policy on an environment, with the learner that ``cfg.algo`` is for.

    Everything that is random comes from named streams of ``cfg.seed``, and ``state_dict`` holds
    all that the next iteration depends on: a training that was stopped and restored equals one
    that never stopped, to the bit.

    Args:
        env: what to act in.
        cfg: settings.
        extras: evaluation, checkpoints, schedules, callbacks, stop flag.

    Raises:
        ConfigError: if the minibatches do not come out even.
    """

    def __init__(self, env: VecEnv, cfg: TrainerCfg, extras: Extras | None = None) -> None:
        self.env, self.cfg, self.extras = env, cfg, extras or Extras()
        self._learner = build_learner(
            env,
            cfg.algo,
            cfg.seed,
            cfg.total_frames,
            cfg.device,
            cfg.num_threads,
            self.extras.replay_folder,
        )
        self._collector = Collector(
            env, self._learner, cfg.algo.steps_per_env, torch_stream(cfg.seed, "actions")
        )
        self._frames, self._iteration, self._elapsed_s = 0, 0, 0.0
        self._total_frames = cfg.total_frames
        self._evaluated_at = -1
        self._last_evaluation: dict[str, float] = {}
        self._best_score: list[float] = []
        self._restored = False
        self._clock = self._saved_at = time.monotonic()
        self._saved_state: tuple[int, int] | None = None

    @property
    def model(self) -> Model:
        """The policy that is measured."""
        return self._learner.model

    @property
    def progress(self) -> Progress:
        """How far the training has come."""
        return Progress(self._frames, self._total_frames, self._iteration, self._elapsed_s)

    def run(self) -> Outcome:
        """Train until ``total_frames``, or until the stop flag.

        Raises:
            RunError: if a reward, observation, loss or gradient is not finite.
            CheckpointError: if a checkpoint cannot be written.
        """
        status = "failed"
        self._start()
        try:
            status = self._loop()
        finally:
            self._tell(lambda callback: callback.on_end(self.progress, status))
        return Outcome(status, self.progress, self._last_evaluation)

    def _loop(self) -> str:
        while True:
            self._advance_clock()
            if self.cfg.time_limit_s is not None and self._elapsed_s >= self.cfg.time_limit_s:
                self._total_frames = min(self._total_frames, self._frames)
            if self._evaluation_due():
                self._evaluate()
            if self.extras.stop():
                self._save()
                return "interrupted"
            if self._frames >= self._total_frames:
                self._save()
                return "finished"
            if time.monotonic() - self._saved_at >= self.cfg.checkpoint_interval_s:
                self._save()
            self._iterate()

    def _iterate(self) -> None:
        """Collect one rollout and learn from it."""
        weights: dict[str, float] = {}
        for schedule in self.extras.schedules:
            weights |= schedule(self._frames)
        self.env.set_weights(weights)
        start = time.monotonic()
        rollout = self._collector.collect()
        metrics = rollout.metrics() | self._learner.learn(rollout)
        metrics |= {f"weight/{name}": weight for name, weight in weights.items()}
        metrics["steps_per_s"] = self._collector.frames / (time.monotonic() - start)
        self._frames += self._collector.frames
        self._iteration += 1
        self._advance_clock()
        named = {f"train/{name}": value for name, value in metrics.items()}
        self._tell(lambda callback: callback.on_iteration(self.progress, named))

    def _evaluation_due(self) -> bool:
        if self.extras.evaluation is None or self._evaluated_at == self._frames:
            return False
        if self._evaluated_at < 0 or self._frames >= self._total_frames:
            return True
        interval = self.cfg.eval_interval_frames
        return interval > 0 and self._frames // interval > self._evaluated_at // interval

    def _evaluate(self) -> None:
        assert self.extras.evaluation is not None
        metrics = self.extras.evaluation.evaluate(self.model, self.extras.stop)
        if metrics is None:  # stopped: done again when the training is resumed
            return
        self._evaluated_at, self._last_evaluation = self._frames, metrics
        self._advance_clock()
        score = [metrics.get(f"eval_sampled/{name}", 0.0) for name in ("success", "return")]
        if score > self._best_score:
            self._best_score = score
            if self.extras.checkpoints is not None:
                path = self.extras.checkpoints.save_best(self.state_dict())
                self._tell(lambda callback: callback.on_checkpoint(self.progress, path))
        if self._frames >= self._total_frames:
            self._save()  # before anybody who listens can fail
        self._tell(lambda callback: callback.on_evaluation(self.progress, metrics))

    def _save(self) -> None:
        """Write a checkpoint, unless the last one says the same."""
        self._saved_at = time.monotonic()
        state = (self._frames, self._evaluated_at)
        if self.extras.checkpoints is None or state == self._saved_state:
            return
        self._advance_clock()
        path = self.extras.checkpoints.save(self.state_dict(), self._frames)
        self._saved_state = state
        self._tell(lambda callback: callback.on_checkpoint(self.progress, path))

    def _start(self) -> None:
        if not self._restored:
            self._collector.reset()
        self._clock = self._saved_at = time.monotonic()
        self._tell(lambda callback: callback.on_start(self))

    def _advance_clock(self) -> None:
        now = time.monotonic()
        self._elapsed_s += now - self._clock
        self._clock = now

    def _tell(self, moment: Callable[[Callback], None]) -> None:
        for callback in self.extras.callbacks:
            moment(callback)

    def state_dict(self) -> State:
        """Return all that the rest of the training depends on, tensors and plain values only."""
        return {
            "network": self._learner.model.cfg.as_dict(),
            "learner": self._learner.state_dict(),
            "collector": self._collector.state_dict(),
            "frames": self._frames,
            "iteration": self._iteration,
            "elapsed_s": self._elapsed_s,
            "evaluated_at": self._evaluated_at,
            "last_evaluation": self._last_evaluation,
            "best_score": self._best_score,
            "metadata": self.extras.metadata,
        }

    def load_state_dict(self, state: State) -> None:
        """Go on from where ``state_dict`` was taken.

        Raises:
            CheckpointError: if the state is of other networks or lacks a part.
        """
        mine, other = self._learner.model.cfg.as_dict(), state.get("network", {})
        wrong = [name for name in mine if mine[name] != other.get(name)]
        if wrong:
            raise CheckpointError(
                f"the checkpoint is of another network: {wrong[0]} is {other.get(wrong[0])} there "
                f"and {mine[wrong[0]]} here; continue with the same settings or in another run_dir"
            )
        try:
            self._learner.load_state_dict(state["learner"])
            self._collector.load_state_dict(state["collector"])
            self._frames, self._iteration = state["frames"], state["iteration"]
            self._elapsed_s, self._evaluated_at = state["elapsed_s"], state["evaluated_at"]
            self._last_evaluation = dict(state["last_evaluation"])
            self._best_score = list(state["best_score"])
        except (KeyError, ValueError, RuntimeError) as error:
            raise CheckpointError(f"the checkpoint does not fit this run: {error}") from error
        self._restored, self._saved_state = True, (self._frames, self._evaluated_at)
