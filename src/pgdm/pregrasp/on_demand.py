"""Computes the start state that a run asks for, if none is stored and no person is needed.

Three pre-grasp sources qualify: ``mocap``, from a human hand's joints; ``planned``, for a hand that
is not the task's own, obtained in the same way; and ``learned``, once the user has trained a
predictor for the hand. If a reach plan is accepted, the start is the state in which it ends.
"""

from __future__ import annotations

import logging
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path

from pgdm.errors import LibraryError, UnknownNameError
from pgdm.library import Library, Motion, ensure_expert, staging
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.library.files.pregrasp import Pregrasp
from pgdm.library.progress import Notify, StepProgress, silent
from pgdm.library.tasks import REBUILT_EXPERTS
from pgdm.pregrasp.predict import weights
from pgdm.pregrasp.predict.predicted import PredictCfg, predict
from pgdm.pregrasp.reach.plan import (
    BASE_TOLERANCE_M,
    JOINT_TOLERANCE_RAD,
    OBJECT_TOLERANCE_M,
    ReachPlan,
)
from pgdm.pregrasp.reach.planner import plan_reach
from pgdm.pregrasp.retarget.mocap import check, of_task, retarget
from pgdm.pregrasp.retarget.recording import Recording
from pgdm.sim.scene import HandCfg, Scene, SimCfg, TaskCfg, build_scene

DEEPER_M = 0.001
"""A reach plan is rejected if it ends in a penetration deeper than both this and the
pre-grasp's."""
FARTHEST = 3.0
"""A reach plan is rejected if its error exceeds this many times the reach's tolerances."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Wanted:
    """A start state to compute, and the task and hand that it is for."""

    task: TaskCfg
    hand: HandCfg
    """The hand that is used for the task."""
    own_hand: HandCfg
    """The hand that the task was published with."""
    sim: SimCfg
    source: str
    """``pregrasp.source``."""

    @property
    def path(self) -> Path:
        """File of the user's own pre-grasp of this source."""
        return pregrasp_file.path_of(self.task.id, self.hand.name, self.source)

    @property
    def can_be_made(self) -> bool:
        """Whether such a start can be computed if none is stored with the motion."""
        if self.source == "learned":
            return weights.path_of(self.hand.name).is_file()
        return self.source == "mocap" or (self.source == "planned" and self.is_other_hand)

    @property
    def is_other_hand(self) -> bool:
        """Whether the hand is not the task's own; starts stored with the motion then do not fit."""
        return self.hand.name != self.own_hand.name


def ensure_start(
    library: Library,
    wanted: Wanted,
    offline: bool,
    notify: Notify | None = None,
    progress: StepProgress = silent,
    num_threads: int = 0,
) -> None:
    """Compute and store a start state, if it is missing and can be computed.

    If several processes need the same start state, one computes it and the others wait. The result
    depends only on the assets and, for ``learned``, on the predictor.

    Args:
        library: library with the task.
        wanted: the start state to compute.
        offline: never download the human hand's joints.
        notify: receives messages on what is computed and how well it fits; by default the log.
        progress: receives the progress.
        num_threads: number of threads of the simulations; 0 takes one per core. The result does not
            depend on it.

    Raises:
        ConfigError: the hand cannot do the task, there is neither a human hand nor a pre-grasp to
            follow, or no pre-grasp can be predicted for the object.
        SceneError: no predicted pose can be freed from contact, or the simulation diverges.
        CorruptAssetError: the predictor's file is damaged.
        LibraryError: something is missing and cannot be downloaded, or the start cannot be stored.
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
        how = "prediction" if wanted.source == "learned" else "inverse kinematics"
        notify(
            f"no start '{wanted.source}' of {wanted.task.id} with hand {wanted.hand.name} is "
            f"stored yet: computing it once by {how} and a reach plan"
        )
        scene = build_scene(library, wanted.task, wanted.hand, wanted.sim)
        if wanted.source == "learned":
            predictor = weights.read(weights.path_of(wanted.hand.name), wanted.hand.name)
            found = predict(predictor, scene, motion, PredictCfg(), notify, progress, num_threads)
            store(wanted.path, found.pregrasp)
            return
        recording = human_hand(library, wanted, motion, offline, notify)
        progress("inverse kinematics", 0, 1)
        posed = retarget(scene, library, motion, recording)
        check(posed, scene)
        store(wanted.path, with_plan(posed.pregrasp, scene, motion, notify, progress, num_threads))
    fit = "; ".join([posed.fit, *posed.unreachable])
    notify(f"{wanted.path}: from {recording.origin}; {fit}")


def human_hand(
    library: Library, wanted: Wanted, motion: Motion, offline: bool, notify: Notify
) -> Recording:
    """Return the human hand to follow.

    A human hand that the library lacks is downloaded, unless it would have to be rebuilt from
    another package. Without a human hand, the result has the points of the task's own hand in its
    pre-grasp.

    Raises:
        ConfigError: the task has neither a human hand nor a pre-grasp of its own to follow.
        LibraryError: the human hand cannot be downloaded.
    """
    # Hand trajectories that would be rebuilt from another package are not worth the download: the
    # task's own pre-grasp is as good to follow.
    if motion.id not in REBUILT_EXPERTS:
        with suppress(UnknownNameError):
            library = ensure_expert(motion.id, offline, notify, library.root)
    own = build_scene(library, wanted.task, wanted.own_hand, wanted.sim)
    return of_task(library, own, motion)


def with_plan(
    pregrasp: Pregrasp,
    scene: Scene,
    motion: Motion,
    notify: Notify,
    progress: StepProgress = silent,
    num_threads: int = 0,
) -> Pregrasp:
    """Plan the reach to a pre-grasp, and return the pre-grasp with the plan's final state.

    A plan that pushes the object away, or ends in penetration or far from the pre-grasp, is
    rejected: episodes then start at the pre-grasp itself, set kinematically.
    """
    target, count = pregrasp.pose.qpos, num_threads
    plan = plan_reach(scene, target, motion.substeps, num_threads=count, progress=progress)
    off = max(
        plan.base_error_m / BASE_TOLERANCE_M,
        max(plan.base_error_rad, plan.finger_error_rad) / JOINT_TOLERANCE_RAD,
    )
    deep = plan.depth_m > max(plan.target_depth_m, DEEPER_M)
    usable = off <= FARTHEST and plan.object_moved_m < OBJECT_TOLERANCE_M and not deep
    if not usable:
        notify(
            f"the reach plan of {scene.task.id} with hand {scene.hand.name} is rejected "
            f"({'; '.join(plan.failures)}): episodes start at the pre-grasp itself, set "
            "kinematically"
        )
    note = {**pregrasp.note, "reach": _rounded(plan) | {"plan_taken": usable}}
    return replace(pregrasp, reached=plan.state if usable else None, note=note)


def store(path: Path, pregrasp: Pregrasp) -> None:
    """Write a pre-grasp.

    Raises:
        LibraryError: it cannot be written.
    """
    try:
        pregrasp_file.write(path, pregrasp)
    except OSError as error:
        raise LibraryError(f"{path}: cannot be written ({error.strerror or error})") from error


def _rounded(plan: ReachPlan) -> dict[str, float | bool]:
    return {
        "reached": plan.reached,
        "base_error_mm": round(1e3 * plan.base_error_m, 1),
        "base_error_rad": round(plan.base_error_rad, 3),
        "finger_error_rad": round(plan.finger_error_rad, 3),
        "object_moved_mm": round(1e3 * plan.object_moved_m, 2),
        "depth_mm": round(1e3 * plan.depth_m, 2),
    }
