"""One experiment as a whole: its parts, and the rules that hold between them."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Annotated

from pgdm.config.strict import ChosenBy, flatten
from pgdm.errors import ConfigError, UnknownNameError
from pgdm.library import expert_file, figures
from pgdm.mdp.actions import KINDS, WRIST_PATHS, ActionCfg
from pgdm.mdp.observations import LAYOUTS, ObsCfg
from pgdm.mdp.shaping import ShapingCfg
from pgdm.methods import METHODS, MethodCfg, config_class, recipe
from pgdm.motion.reference import FRAMES, ReferenceCfg
from pgdm.pregrasp.ablate import AblationCfg
from pgdm.pregrasp.sources import SOURCES, PregraspCfg
from pgdm.rl.algos import ALGOS, algo_class
from pgdm.rl.checkpoint import CheckpointCfg
from pgdm.rl.evaluate import EvalCfg
from pgdm.rl.learner import AlgoCfg
from pgdm.sim.scene import OBJECT_MASSES, HandCfg, SimCfg, TaskCfg
from pgdm.tracking import TRACKERS, TrackingCfg


@dataclass(frozen=True)
class ExperimentCfg:
    """Everything that one run needs to know; made only by ``pgdm.config.store``."""

    task: TaskCfg
    """What is moved along which motion."""
    hand: HandCfg
    """The hand that moves it."""
    pregrasp: PregraspCfg
    """Where an episode starts."""
    method: Annotated[MethodCfg, ChosenBy("name", config_class, tuple(METHODS))]
    """Rewards, ends and metrics."""
    ablation: AblationCfg
    """What is taken away."""
    obs: ObsCfg
    """What the policy sees."""
    action: ActionCfg
    """What an action means."""
    shaping: ShapingCfg
    """What trainings add to reward and ends; evaluations never see it."""
    reference: ReferenceCfg
    """How the stored motion becomes targets."""
    algo: Annotated[AlgoCfg, ChosenBy("learner", algo_class, tuple(ALGOS))]
    """How the policy learns."""
    sim: SimCfg
    """Solver settings."""
    eval: EvalCfg
    """How and how often the policy is measured."""
    checkpoint: CheckpointCfg
    """How often the run is saved."""
    tracking: TrackingCfg
    """Where the run is mirrored to."""
    seed: int
    """The one integer from which every random stream comes, 0 or more."""
    total_frames: int
    """Length of the training, environment steps over all simulations."""
    time_limit_min: float | None
    """Minutes after which it ends with what it has, all attempts together; None: never."""
    num_envs: int
    """Simulations side by side."""
    num_threads: int
    """Threads for simulation and learning; 0 means all cores."""
    device: str
    """Where the learner computes: ``cpu`` or ``cuda``."""
    run_dir: str
    """Folder of the run."""
    resume: str
    """A run that exists: ``auto`` continues it, ``must`` demands one, ``never`` refuses."""
    budget: str
    """Label for reports, such as smoke, reduced or paper."""
    keep_replay: bool
    """Whether an off-policy learner's replay stays in the folder of a run that has finished."""
    offline: bool
    """Whether missing assets are an error instead of being fetched."""

    def validate(self) -> None:
        """Check what no single field can know.

        Raises:
            ConfigError: at the first broken rule; the message has the values and the cure.
        """
        flat = flatten(dataclasses.asdict(self))
        _check_choices(flat)
        _check_ranges(flat)
        self.method.validate()
        self.shaping.validate()
        self.algo.check(self.num_envs)
        self.ablation.check(self.pregrasp.source)
        self._check_hand()
        self._check_expert()
        self._check_placements()
        if self.device.partition(":")[0] not in ("cpu", "cuda"):
            raise UnknownNameError("device", self.device, ("cpu", "cuda"))
        if not self.run_dir.strip():
            raise ConfigError("run_dir is empty; name a folder, or null for the default")
        if not self.budget.strip():
            raise ConfigError("budget is empty; say smoke, reduced or paper")

    def _check_hand(self) -> None:
        hand = self.hand
        wrong = [i for i in hand.fingertips if not 0 <= i < len(hand.points)]
        if wrong:
            raise ConfigError(
                f"hand.fingertips has {wrong[0]}, but hand.points has {len(hand.points)} entries: "
                f"use 0 to {len(hand.points) - 1}"
            )
        if self.action.kind == "residual" and hand.num_base_joints != 6:
            raise ConfigError(
                f"action.kind=residual carries the wrist on 6 base joints, but "
                f"hand '{hand.name}' has hand.num_base_joints {hand.num_base_joints}; "
                f"use action=absolute"
            )

    def _check_expert(self) -> None:
        if not recipe(self.method).needs_expert:
            return
        compares = f"method={self.method.name} compares with an expert"
        instead = "Methods that need none: pgdm, curriculum"
        if self.task.motion not in figures.GRAB_TASKS:
            raise ConfigError(
                f"{compares}, and there is none for the motion '{self.task.motion}' of task "
                f"'{self.task.id}'; motions that have one (suite adroit40): "
                f"{', '.join(figures.GRAB_TASKS)}. {instead}"
            )
        hand = self.hand
        fingertips = tuple(hand.points[i] for i in hand.fingertips)
        if (hand.name, fingertips) != (expert_file.HAND, expert_file.FINGERTIPS):
            raise ConfigError(
                f"{compares}, whose hand is {expert_file.HAND} with the fingertips "
                f"{', '.join(expert_file.FINGERTIPS)}; hand '{hand.name}' with "
                f"{', '.join(fingertips) or 'none'} cannot follow it. {instead}"
            )

    def _check_placements(self) -> None:
        if not self.task.objects:
            raise ConfigError("task.objects is empty; name at least one object of the library")
        for i, placement in enumerate(self.task.placements):
            for name, size in (("pos_m", 3), ("quat", 4)):
                value = getattr(placement, name)
                if value is not None and len(value) != size:
                    raise ConfigError(
                        f"task.placements[{i}].{name} has {len(value)} numbers, not {size}"
                    )
            if placement.quat is not None and sum(q * q for q in placement.quat) == 0:
                raise ConfigError(f"task.placements[{i}].quat is zero; no rotation is 1, 0, 0, 0")


_CHOICES: dict[str, tuple[str, ...]] = {
    "pregrasp.source": SOURCES,
    "pregrasp.fallback": SOURCES,
    "obs.layout": tuple(LAYOUTS),
    "action.kind": tuple(KINDS),
    "action.wrist_path": WRIST_PATHS,
    "reference.frame": FRAMES,
    "hand.gravity_compensation": ("all", "base"),
    "sim.object_mass": OBJECT_MASSES,
    "tracking.kind": tuple(TRACKERS),
    "resume": ("auto", "never", "must"),
}

# Lowest value allowed.
_AT_LEAST: dict[str, int] = {
    "seed": 0,
    "total_frames": 1,
    "num_envs": 1,
    "num_threads": 0,
    "hand.num_base_joints": 0,
    "hand.num_wrist_joints": 0,
    "action.lead_steps": 0,
    "action.hold_steps": 0,
    "action.residual_scale": 0,
    "algo.value_coef": 0,
    "algo.entropy_coef": 0,
    "algo.steps_per_env": 1,
    "algo.minibatch_size": 1,
    "algo.epochs": 1,
    "algo.batch_size": 1,
    "algo.critics": 1,
    "algo.updates_per_step": 1,
    "algo.actor_interval": 1,
    "algo.warmup_steps": 1,
    "algo.target_entropy_frames": 1,
    "sim.solver_iterations": 1,
    "sim.noslip_iterations": 0,
    "eval.episodes": 1,
    "eval.interval_frames": 0,
    "checkpoint.keep_last": 1,
}
_ABOVE_ZERO = (
    "time_limit_min",
    "task.timestep_s",
    "algo.learning_rate",
    "algo.adam_eps",
    "algo.clip",
    "algo.max_grad_norm",
    "algo.observation_clip",
    "algo.reward_scale",
    "algo.temperature_init",
    "checkpoint.interval_s",
)
_SHARES = ("algo.gamma", "algo.gae_lambda", "algo.target_rate")


def _check_choices(flat: dict[str, object]) -> None:
    for key, valid in _CHOICES.items():
        # The strict types have refused None where it means nothing.
        if flat[key] is not None and flat[key] not in valid:
            raise UnknownNameError(f"{key} value", str(flat[key]), valid)


def _check_ranges(flat: dict[str, object]) -> None:
    numbers = {k: v for k, v in flat.items() if isinstance(v, int | float)}
    # Each learner has numbers of its own.
    for key, low in _AT_LEAST.items():
        if numbers.get(key, low) < low:
            raise ConfigError(f"{key} is {numbers[key]}; it must be at least {low}")
    for key in _ABOVE_ZERO:
        if numbers.get(key, 1) <= 0:
            raise ConfigError(f"{key} is {numbers[key]}; it must be above 0")
    for key in _SHARES:
        if not 0 <= numbers.get(key, 0) <= 1:
            raise ConfigError(f"{key} is {numbers[key]}; it must be between 0 and 1")
    hidden = flat["algo.hidden"]
    if isinstance(hidden, list) and any(width < 1 for width in hidden):
        raise ConfigError(f"algo.hidden is {hidden}; every width must be at least 1")


def check_device(device: str) -> None:
    """Check that this machine has the device; a run that is only looked at may need none.

    Raises:
        ConfigError: if it has not.
    """
    if device.startswith("cuda"):
        # Asked only here: looking for a GPU takes time, and most runs use none.
        import torch

        if not torch.cuda.is_available():
            raise ConfigError(f"device is {device}, but torch finds no GPU here; use device=cpu")
