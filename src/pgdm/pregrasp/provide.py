"""Making the start that a run asks for, where there is none and it can be made by itself.

Three can: ``mocap``, from a human hand's joints; ``planned`` of a hand that is not the task's own:
the same pre-grasp with the state in which a reach plan ends there; and ``learned``, where the user
has trained a predictor for the hand.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from pgdm.errors import LibraryError, UnknownNameError
from pgdm.library import Library, Motion, ensure_expert, pregrasp_file, rebuild, staging
from pgdm.library.pregrasp_file import Pregrasp
from pgdm.library.report import Progress, silent
from pgdm.pregrasp.mocap import Retargeted, check, of_task, retarget
from pgdm.pregrasp.predict import weights
from pgdm.pregrasp.predict.predicted import PredictCfg, predict
from pgdm.pregrasp.reach import plan_reach
from pgdm.pregrasp.reach_plan import (
    BASE_TOLERANCE_M,
    JOINT_TOLERANCE_RAD,
    OBJECT_TOLERANCE_M,
    ReachPlan,
)
from pgdm.pregrasp.recording import Recording
from pgdm.sim.scene import HandCfg, Scene, SimCfg, TaskCfg, build_scene

Notify = Callable[[str], None]

DEEPER_M = 0.001
"""A plan that ends deeper in something than this is not taken."""
FARTHEST = 3.0
"""Nor one that ends farther from the pre-grasp than so many times the reach's tolerances."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Wanted:
    """Which start is wanted, and of what."""

    task: TaskCfg
    hand: HandCfg
    """The hand that is to take the task up."""
    own_hand: HandCfg
    """The task's own hand."""
    sim: SimCfg
    source: str
    """``pregrasp.source``."""

    @property
    def path(self) -> Path:
        """Where the user's own start of this kind lies."""
        return pregrasp_file.path_of(self.task.id, self.hand.name, self.source)

    @property
    def can_be_made(self) -> bool:
        """Whether such a start is made by itself where none is stored with the motion."""
        if self.source == "learned":
            return weights.path_of(self.hand.name).is_file()
        return self.source == "mocap" or (self.source == "planned" and self.is_other_hand)

    @property
    def is_other_hand(self) -> bool:
        """Whether the hand is not the task's own: no start stored with the motion is for it."""
        return self.hand.name != self.own_hand.name


def ensure_start(
    library: Library,
    wanted: Wanted,
    offline: bool,
    notify: Notify | None = None,
    progress: Progress = silent,
    num_threads: int = 0,
) -> None:
    """Make and store a start that is wanted, if there is none and it can be made.

    Of several processes one makes it and the others wait. The same assets give the same start.

    Args:
        library: with the task.
        wanted: which start.
        offline: never fetch the human hand's joints.
        notify: told in a sentence what is made, and how well it fits; by default the log is.
        progress: told how far it is.
        num_threads: for the reach planner; 0 takes one per core. The result does not depend on it.

    Raises:
        ConfigError: the hand cannot take up the task.
        SceneError: no predicted hand can be made free of contact.
        CorruptAssetError: the predictor's file is damaged.
        LibraryError: something is missing and cannot be fetched, or the start cannot be stored.
    """
    notify = notify or _log.warning
    if not wanted.can_be_made or wanted.path.is_file():
        return
    motion = library.motion(wanted.task.motion)
    if not wanted.is_other_hand and wanted.source in motion.starts:
        return
    with staging.making(wanted.path, notify):
        if wanted.path.is_file():  # another process was first
            return
        way = "a prediction" if wanted.source == "learned" else "inverse kinematics"
        notify(
            f"no start '{wanted.source}' of {wanted.task.id} with hand {wanted.hand.name} is "
            f"stored yet: making it once by {way} and a reach plan"
        )
        scene = build_scene(library, wanted.task, wanted.hand, wanted.sim)
        if wanted.source == "learned":
            predictor = weights.read(weights.path_of(wanted.hand.name), wanted.hand.name)
            guess = predict(predictor, scene, motion, PredictCfg(), notify, progress, num_threads)
            store(wanted.path, guess.pregrasp)
            return
        recording = human_hand(library, wanted, motion, offline, notify)
        progress("inverse kinematics", 0, 1)
        made = retarget(scene, library, motion, recording)
        check(made, scene)
        reached = with_plan(made.pregrasp, scene, motion, notify, progress, num_threads)
        store(wanted.path, reached)
    notify(f"{wanted.path}: from {recording.origin}; {told(made)}")


def human_hand(
    library: Library, wanted: Wanted, motion: Motion, offline: bool, notify: Notify
) -> Recording:
    """Return the human hand to follow, fetched if the library can have it but does not.

    Raises:
        ConfigError: the task has neither a human hand nor a pre-grasp of its own to follow.
        LibraryError: it cannot be fetched.
    """
    # What is only rebuilt from another package is not fetched for a start: the task's own
    # pre-grasp is as near.
    if motion.id not in rebuild.TASKS:
        with suppress(UnknownNameError):
            library = ensure_expert(motion.id, offline, notify, library.root)
    own = build_scene(library, wanted.task, wanted.own_hand, wanted.sim)
    return of_task(library, own, motion)


def with_plan(
    pregrasp: Pregrasp,
    scene: Scene,
    motion: Motion,
    notify: Notify,
    progress: Progress = silent,
    num_threads: int = 0,
) -> Pregrasp:
    """Return a pre-grasp with the state in which a reach plan ends there.

    A plan that pushes the object away, ends in something or far from the pre-grasp is not taken:
    then an episode starts at the pose itself, set.
    """

    def tell(done: int, rounds: int, cost: float) -> None:
        progress("reach plan", done, rounds)

    plan = plan_reach(
        scene, pregrasp.pose.qpos, motion.substeps, num_threads=num_threads, progress=tell
    )
    off = max(
        plan.base_error_m / BASE_TOLERANCE_M,
        max(plan.base_error_rad, plan.finger_error_rad) / JOINT_TOLERANCE_RAD,
    )
    deep = plan.depth_m > max(plan.target_depth_m, DEEPER_M)
    usable = off <= FARTHEST and plan.object_moved_m < OBJECT_TOLERANCE_M and not deep
    figures = _figures(plan) | {"plan_taken": usable}
    if not usable:
        notify(
            f"the reach plan of {scene.task.id} with hand {scene.hand.name} is not taken "
            f"({'; '.join(plan.failures)}): episodes start at the pre-grasp itself, set "
            "kinematically"
        )
    return replace(
        pregrasp,
        reached=plan.state if usable else None,
        note={**pregrasp.note, "reach": figures},
    )


def store(path: Path, pregrasp: Pregrasp) -> None:
    """Write a pre-grasp.

    Raises:
        LibraryError: it cannot be written.
    """
    try:
        pregrasp_file.write(path, pregrasp)
    except OSError as error:
        raise LibraryError(f"{path}: cannot be written ({error.strerror or error})") from error


def told(made: Retargeted) -> str:
    """Return how well a pre-grasp fits, for people."""
    return "; ".join([made.fit, *made.unreachable])


def _figures(plan: ReachPlan) -> dict[str, float | bool]:
    return {
        "reached": plan.reached,
        "base_error_mm": round(1e3 * plan.base_error_m, 1),
        "base_error_rad": round(plan.base_error_rad, 3),
        "finger_error_rad": round(plan.finger_error_rad, 3),
        "object_moved_mm": round(1e3 * plan.object_moved_m, 2),
        "depth_mm": round(1e3 * plan.depth_m, 2),
    }
