"""The training loop."""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Protocol

from pgdm.errors import CheckpointError, PgdmError, check_interpreter
from pgdm.rl.algos import build_learner
from pgdm.rl.callback import Callback, Progress
from pgdm.rl.checkpoint import CheckpointFolder, State
from pgdm.rl.evaluate import Policy
from pgdm.rl.learner import AlgoCfg, Model
from pgdm.rl.vec_env import VecEnv

Schedule = Callable[[int], dict[str, float]]
"""Maps environment steps so far to reward weights by term name."""


class Evaluation(Protocol):
    """Anything that evaluates a policy, such as ``Evaluator``."""

    def evaluate(self, policy: Policy, stop: Callable[[], bool]) -> dict[str, float] | None:
        """Return metrics by name, or None if stopped."""
        ...


@dataclass(frozen=True)
class TrainerCfg:
    """Settings of a training run, apart from its environment."""

    algo: AlgoCfg
    """Settings of the learner; their class selects the learner."""
    seed: int
    """The run's seed."""
    total_frames: int
    """Environment steps to train for, rounded up to whole iterations."""
    time_limit_s: float | None
    """Time after which the training finishes early, s, summed over all attempts; None: never."""
    eval_interval_frames: int
    """Environment steps between two evaluations; 0: only before and after the training."""
    checkpoint_interval_s: float
    """Time between two checkpoints, s."""
    device: str
    """Device of the networks, ``cpu`` or ``cuda``."""
    num_threads: int
    """Threads of torch while learning; 0: torch's default."""


@dataclass(frozen=True)
class Extras:
    """Optional parts of a training run; a bare ``Extras()`` trains silently."""

    evaluation: Evaluation | None = None
    """Evaluates the policy."""
    checkpoints: CheckpointFolder | None = None
    """Where states are saved."""
    schedules: Sequence[Schedule] = ()
    """Change reward weights before each iteration."""
    callbacks: Sequence[Callback] = ()
    """Receive the training's events."""
    stop: Callable[[], bool] = lambda: False
    """Polled at safe points; True stops the training as ``interrupted``."""
    replay_folder: Path | None = None
    """Where an off-policy learner stores its replay; None: in memory, so the run cannot resume."""
    metadata: dict[str, Any] = field(default_factory=dict)
    """Plain values stored in each checkpoint, such as the versions of libraries."""


_STATE = {
    **dict.fromkeys(("frames", "iteration", "evaluated_at"), int),
    **dict.fromkeys(("network", "learner", "collector", "last_evaluation", "metadata"), dict),
    "elapsed_s": float,
    "best_score": list,
}
"""Keys of a checkpoint's state, with the types of their values."""
_MISFITS = (
    *(LookupError, ValueError, TypeError, AttributeError, RuntimeError),
    *(AssertionError, ArithmeticError, PgdmError),
)
"""What torch, TorchRL and the simulator raise for states that do not fit."""


def check_state(state: State) -> None:
    """Check what a checkpoint holds.

    Raises:
        CheckpointError: if a part is missing or has a wrong type.
    """
    for name, kind in _STATE.items():
        if not isinstance(state.get(name), kind):
            raise CheckpointError(f"it is not the state of a run: '{name}' is missing or wrong")


@dataclass(frozen=True)
class Outcome:
    """Result of a training run."""

    status: str
    """``finished`` or ``interrupted``."""
    progress: Progress
    """How far the run is."""
    evaluation: dict[str, float]
    """Metrics of the last evaluation; {} without one."""


class Trainer:
    """Trains a policy on an environment, with the learner that ``cfg.algo`` selects.

    All randomness comes from named streams of ``cfg.seed``, and ``state_dict`` holds all that the
    next iteration depends on: a run that was stopped and resumed equals one that never
    stopped, bit-exactly.

    Args:
        env: environment to train in.
        cfg: settings.
        extras: evaluation, checkpoints, schedules, callbacks, stop flag.

    Raises:
        ConfigError: if the learner's settings are invalid or do not fit the number of simulations.
        RunError: if the files of the replay cannot be created, for example on a full disk.
    """

    def __init__(self, env: VecEnv, cfg: TrainerCfg, extras: Extras | None = None) -> None:
        check_interpreter()
        from tensordict.nn import TensorDictModule  # torchrl takes 2 s to import

        from pgdm.rl.collector import RolloutCollector

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
        self._collector = RolloutCollector(
            env,
            TensorDictModule(self._learner.explore, ["observation"], ["action", "loc"]),
            frames_per_batch=env.num_envs * cfg.algo.steps_per_env,
            seed=cfg.seed,
            learner=self._learner,
        )
        self._frames, self._iteration, self._elapsed_s = 0, 0, 0.0
        self._total_frames = cfg.total_frames
        self._evaluated_at = -1
        self._last_evaluation: dict[str, float] = {}
        self._best_score: list[float] = []
        self._clock = self._saved_at = time.monotonic()
        self._saved_state: tuple[int, int] | None = None

    @property
    def model(self) -> Model:
        """The policy that is trained and evaluated."""
        return self._learner.model

    @property
    def progress(self) -> Progress:
        """How far the run is."""
        return Progress(self._frames, self._total_frames, self._iteration, self._elapsed_s)

    def run(self) -> Outcome:
        """Train until ``total_frames``, the time limit or the stop flag.

        Raises:
            RunError: if a reward, observation, loss, gradient or weight is not finite.
            CheckpointError: if a checkpoint cannot be written.
        """
        status = "failed"
        self._start()
        try:
            status = self._loop()
        finally:
            self._notify(lambda callback: callback.on_end(self.progress, status))
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
        rollout = self._collector.rollout()
        metrics = self._collector.metrics | self._learner.learn(rollout)
        metrics |= {f"weight/{name}": weight for name, weight in weights.items()}
        passed_s = time.monotonic() - start  # 0 if the clock stands still
        metrics["steps_per_s"] = rollout.numel() / passed_s if passed_s > 0 else math.nan
        self._frames += rollout.numel()
        self._iteration += 1
        self._advance_clock()
        named = {f"train/{name}": value for name, value in metrics.items()}
        self._notify(lambda callback: callback.on_iteration(self.progress, named))

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
        if metrics is None:  # stopped: the resumed run repeats the evaluation
            return
        self._evaluated_at, self._last_evaluation = self._frames, metrics
        self._advance_clock()
        score = [metrics.get(f"eval_sampled/{name}", 0.0) for name in ("success", "return")]
        if score > self._best_score:
            self._best_score = score
            if self.extras.checkpoints is not None:
                path = self.extras.checkpoints.save_best(self.state_dict())
                self._notify(lambda callback: callback.on_checkpoint(self.progress, path))
        if self._frames >= self._total_frames:
            self._save()  # before any callback can fail
        self._notify(lambda callback: callback.on_evaluation(self.progress, metrics))

    def _save(self) -> None:
        """Write a checkpoint, unless the last one holds the same state."""
        self._saved_at = time.monotonic()
        state = (self._frames, self._evaluated_at)
        if self.extras.checkpoints is None or state == self._saved_state:
            return
        self._advance_clock()
        path = self.extras.checkpoints.save(self.state_dict(), self._frames)
        self._saved_state = state
        self._notify(lambda callback: callback.on_checkpoint(self.progress, path))

    def _start(self) -> None:
        self._clock = self._saved_at = time.monotonic()
        self._notify(lambda callback: callback.on_start(self))

    def _advance_clock(self) -> None:
        now = time.monotonic()
        self._elapsed_s += now - self._clock
        self._clock = now

    def _notify(self, moment: Callable[[Callback], None]) -> None:
        for callback in self.extras.callbacks:
            moment(callback)

    def state_dict(self) -> State:
        """Return all that the rest of the training depends on, tensors and plain values only."""
        collector = dict(self._collector.state_dict())
        del collector["frames"]  # between iterations it equals the trainer's
        return {
            "network": asdict(self._learner.model.cfg),
            "learner": self._learner.state_dict(),
            "collector": collector,
            "frames": self._frames,
            "iteration": self._iteration,
            "elapsed_s": self._elapsed_s,
            "evaluated_at": self._evaluated_at,
            "last_evaluation": self._last_evaluation,
            "best_score": self._best_score,
            "metadata": self.extras.metadata,
        }

    def load_state_dict(self, state: State) -> None:
        """Continue from ``state_dict``.

        Raises:
            CheckpointError: if the state is incomplete or belongs to other networks.
        """
        check_state(state)
        mine, other = asdict(self._learner.model.cfg), state["network"]
        wrong = [name for name in mine if mine[name] != other.get(name)]
        if wrong:
            raise CheckpointError(
                f"the checkpoint is of another network: {wrong[0]} is {other.get(wrong[0])} there "
                f"and {mine[wrong[0]]} here; resume with the same settings or use another run_dir"
            )
        try:
            self._learner.load_state_dict(state["learner"])
            collector = state["collector"] | {"frames": state["frames"]}
            self._collector.load_state_dict(OrderedDict(collector))
            self._frames, self._iteration = state["frames"], state["iteration"]
            self._elapsed_s, self._evaluated_at = state["elapsed_s"], state["evaluated_at"]
            self._last_evaluation = dict(state["last_evaluation"])
            self._best_score = list(state["best_score"])
        except _MISFITS as error:
            reason = f"{type(error).__name__}: {error!s:.200}"
            raise CheckpointError(f"the checkpoint does not fit this run ({reason})") from error
        self._saved_state = (self._frames, self._evaluated_at)
