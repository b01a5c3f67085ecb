"""One experiment as a whole: its parts, and the rules that hold between them."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Annotated

from pgdm.config.ranges import check_ranges
from pgdm.config.strict import ChosenBy
from pgdm.errors import ConfigError, UnknownNameError, amount
from pgdm.library.files import expert as expert_file
from pgdm.library.tasks import MOCAP_TASKS
from pgdm.mdp.actions import KINDS, WRIST_PATHS, ActionCfg
from pgdm.mdp.observations import LAYOUTS, ObsCfg
from pgdm.mdp.shaping import ShapingCfg
from pgdm.methods import METHODS, MethodCfg, config_class, recipe
from pgdm.motion.reference import FRAMES, ReferenceCfg
from pgdm.paths import check_path_part
from pgdm.pregrasp.ablation.ablate import AblationCfg
from pgdm.pregrasp.sources import SOURCES, PregraspCfg
from pgdm.rl.algos import ALGOS, algo_class
from pgdm.rl.checkpoint import CheckpointCfg
from pgdm.rl.evaluate import EvalCfg
from pgdm.rl.learner import AlgoCfg
from pgdm.runs.config_file import dotted
from pgdm.sim.scene import ENGINES, OBJECT_MASSES, HandCfg, SimCfg, TaskCfg
from pgdm.tracking import TRACKERS, TrackingCfg


@dataclass(frozen=True)
class ExperimentCfg:
    """All settings of one run, composed by ``pgdm.config.compose`` or read from a file."""

    task: TaskCfg
    """The object and the motion it follows."""
    hand: HandCfg
    """The hand that manipulates the object."""
    pregrasp: PregraspCfg
    """Where an episode starts."""
    method: Annotated[MethodCfg, ChosenBy("name", config_class, tuple(METHODS))]
    """Rewards, terminations, measures, schedules and settings of the metrics."""
    ablation: AblationCfg
    """What the ablation removes."""
    obs: ObsCfg
    """What the policy sees."""
    action: ActionCfg
    """How actions become actuator targets."""
    shaping: ShapingCfg
    """Changes to reward and discount in training, never in evaluation."""
    reference: ReferenceCfg
    """How the stored motion becomes targets."""
    algo: Annotated[AlgoCfg, ChosenBy("learner", algo_class, tuple(ALGOS))]
    """The learner and its settings."""
    sim: SimCfg
    """Physics engine, solver and object masses."""
    eval: EvalCfg
    """How and how often the policy is evaluated."""
    checkpoint: CheckpointCfg
    """How often the run is saved, and how many checkpoints are kept."""
    tracking: TrackingCfg
    """Where the run is mirrored."""
    seed: int
    """The one integer from which all random streams are derived, 0 or more."""
    total_frames: int
    """Length of the training, frames: control steps summed over all simulations."""
    time_limit_min: float | None
    """Wall time in minutes, summed over all attempts, after which training ends early; None: no
    limit."""
    num_envs: int
    """Parallel simulations."""
    num_threads: int
    """Threads for simulation and learning; 0: all cores."""
    device: str
    """Where the learner computes: ``cpu``, ``cuda`` or ``cuda:N``."""
    run_dir: str
    """Folder of the run."""
    resume: str
    """Whether an existing run is resumed. ``auto`` resumes it, or starts a new one; ``must`` fails
    if there is none; ``never`` fails if there is one."""
    budget: str
    """Label for reports, such as smoke, reduced or paper."""
    keep_replay: bool
    """Whether an off-policy learner's replay stays in the folder of a finished run."""
    offline: bool
    """Whether missing assets are an error instead of being fetched."""

    @property
    def used_shaping(self) -> ShapingCfg:
        """The shaping, without what does not apply.

        That is the grasp term if episodes do not start at an intact pre-grasp, and the error of the
        wrist plan if there is none.
        """
        intact = self.pregrasp.source != "none" and not self.ablation.changes_start
        shaping = self.shaping if intact else replace(self.shaping, grasp_weight=0.0)
        return shaping if self.action.plans_wrist else replace(shaping, beyond_plan=False)

    def validate(self) -> None:
        """Check names, choices and ranges of single fields, and the rules that hold between fields.

        Raises:
            ConfigError: at the first broken rule; the message has the values and a remedy.
        """
        flat = dotted(self)
        for key in ("task.id", "task.motion", "hand.name", "algo.name"):
            check_path_part(key, flat[key])
        for name in self.task.objects:
            check_path_part("task.objects", name)
        _check_choices(flat)
        check_ranges(flat)
        self.method.validate()
        self.shaping.validate()
        self.algo.check(self.num_envs)
        self._check_time()
        self.ablation.check(self.pregrasp.source)
        self._check_hand()
        self._check_expert()
        self._check_placements()
        if not re.fullmatch("cpu|cuda(:[0-9]+)?", self.device):
            raise UnknownNameError("device", self.device, ("cpu", "cuda", "cuda:N"))
        if not self.run_dir.strip():
            raise ConfigError("run_dir is empty; name a folder, or null for the default")
        if not self.budget.strip():
            raise ConfigError("budget is empty; use smoke, reduced or paper")

    @property
    def usual_days(self) -> float:
        """Length of the training at the learner's usual speed, days."""
        return self.total_frames / self.algo.usual_steps_per_s / 86_400

    def _check_time(self) -> None:
        if self.time_limit_min is None and self.usual_days > _MOST_DAYS:
            raise ConfigError(
                f"total_frames={self.total_frames:,} would take about {self.usual_days / 365:,.0f} "
                f"years at the usual {self.algo.usual_steps_per_s:,.0f} steps/s; choose fewer "
                "frames, or set time_limit_min"
            )

    def _check_hand(self) -> None:
        hand = self.hand
        wrong = [i for i in hand.fingertips if not 0 <= i < len(hand.points)]
        if wrong:
            raise ConfigError(
                f"hand.fingertips has {wrong[0]}, but hand.points has "
                f"{amount(len(hand.points), 'entry', 'entries')}: use 0 to {len(hand.points) - 1}"
            )
        if self.obs.layout == "relative" and not hand.points:
            raise ConfigError(
                "obs=relative has the object's pose relative to the first of hand.points, which is "
                "empty; name the hand's wrist there, or use obs=released"
            )

        if self.shaping.grasp_weight and not hand.fingertips:
            raise ConfigError(
                "shaping.grasp_weight rewards fingertips that stay on the object, and "
                "hand.fingertips is empty; name them there, or use shaping=soft_end"
            )

    def _check_expert(self) -> None:
        if not recipe(self.method).needs_expert:
            return
        compares = f"method={self.method.name} compares with an expert"
        instead = "Methods that need none: pgdm, curriculum"
        if self.task.motion not in MOCAP_TASKS:
            raise ConfigError(
                f"{compares}, and there is none for the motion '{self.task.motion}' of task "
                f"'{self.task.id}'; motions that have one (suite adroit40): "
                f"{', '.join(MOCAP_TASKS)}. {instead}"
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
                        f"task.placements[{i}].{name} has "
                        f"{amount(len(value), 'number')}, not {size}"
                    )
            if placement.quat is not None and sum(q * q for q in placement.quat) == 0:
                raise ConfigError(
                    f"task.placements[{i}].quat is zero; without rotation it is 1, 0, 0, 0"
                )


_MOST_DAYS = 100 * 365
"""Longest training without a time limit."""

_CHOICES: dict[str, tuple[str, ...]] = {
    "pregrasp.source": SOURCES,
    "pregrasp.fallback": SOURCES,
    "obs.layout": tuple(LAYOUTS),
    "action.kind": tuple(KINDS),
    "action.wrist_path": WRIST_PATHS,
    "reference.frame": FRAMES,
    "hand.gravity_compensation": ("all", "base"),
    "sim.engine": ENGINES,
    "sim.object_mass": OBJECT_MASSES,
    "tracking.kind": tuple(TRACKERS),
    "resume": ("auto", "never", "must"),
}


def _check_choices(flat: dict[str, object]) -> None:
    for key, valid in _CHOICES.items():
        # Keys that must not be null have been checked before.
        if flat[key] is not None and flat[key] not in valid:
            raise UnknownNameError(f"{key} value", str(flat[key]), valid)


def check_device(device: str) -> None:
    """Check that this machine has the device. Stored runs can be read without it.

    Raises:
        ConfigError: if the machine lacks it; the message names the GPUs that it has.
    """
    if device.startswith("cuda"):
        # Imported only here: looking for a GPU takes time, and most runs use none.
        import torch

        if not torch.cuda.is_available():
            raise ConfigError(f"device is {device}, but torch finds no GPU here; use device=cpu")
        have = [f"cuda:{i}" for i in range(torch.cuda.device_count())]
        if device not in ("cuda", *have):
            raise ConfigError(
                f"device is {device}, which torch does not find here; valid: {', '.join(have)}"
            )
