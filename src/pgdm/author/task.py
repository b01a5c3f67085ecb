"""One more task of the user's: its motion into the library, its file into the user's settings."""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pgdm import paths
from pgdm.author.motion import CheckedMotion, MotionRequest, make_motion
from pgdm.author.pregrasp import FoundPregrasp, make_pregrasp
from pgdm.config.groups import available, conf_dir
from pgdm.config.store import compose
from pgdm.config.suites import suites
from pgdm.errors import ConfigError, UnknownNameError
from pgdm.library import Library, Start, figures, motion_file, names, own, pregrasp_file
from pgdm.library.manifest import TaskEntry
from pgdm.library.motion_checks import object_joints
from pgdm.library.report import Progress, silent
from pgdm.pregrasp import plans
from pgdm.pregrasp.reach import plan_reach
from pgdm.pregrasp.reach_plan import ReachPlan
from pgdm.sim.scene import Scene, build_scene

_BOUND = {o for task in ("door-open", "hammer-strike") for o in names.objects_of(task)}
"""Objects made for one task: they hang on something, or are of several bodies."""


@dataclass(frozen=True)
class TaskRequest:
    """What is asked for."""

    id: str
    """Id of the new task."""
    object: str
    """Library name of its object, the user's own or the benchmark's."""
    hand: str
    """Hand that plays it."""
    motion: MotionRequest
    pregrasp: str = "mean"
    """See :func:`pgdm.author.pregrasp.make_pregrasp`."""
    replace: bool = False
    """Make a task anew that is there already."""


@dataclass(frozen=True)
class AuthoredTask:
    """A new task."""

    id: str
    scene: Scene
    motion: CheckedMotion
    pregrasp: FoundPregrasp
    plan: ReachPlan | None
    """That was tried to bring the hand there; None for the reset pose. Stored if it reaches."""
    motion_path: Path
    task_path: Path


def task_path(task: str) -> Path:
    """Return where the settings of a task of the user's lie."""
    return paths.user_conf() / "task" / f"{task}.yaml"


def author_task(
    request: TaskRequest, library: Library, progress: Progress = silent
) -> AuthoredTask:
    """Make a task of the user's own, which ``pgdm-run task=ID`` finds.

    Args:
        request: what is asked for.
        library: with the object, the hand and the table.
        progress: told how far the search of a pre-grasp is.

    Raises:
        ConfigError: a name is unknown or taken, or the motion cannot be carried.
        CorruptAssetError: a file is damaged.
        LibraryError: the user's folder cannot be written.
    """
    _check(request, library)
    entry = TaskEntry(request.hand, [request.object], 0, ["mined"])
    scene = task_scene(request, library.promising(request.id, entry))
    body = scene.index.object_body
    motion = make_motion(request.motion, library.object_xml(request.object), scene.model, body)
    poses = motion.poses
    qpos = np.zeros(scene.model.nq)
    qpos[scene.model.nu :] = object_joints(scene.model, body, poses)[0]
    found = make_pregrasp(request.pregrasp, scene, qpos, poses, library, progress)
    start = Start(found.qpos, np.zeros(scene.model.nv), None)
    arrays = motion_file.pack(poses.pos, poses.quat, figures.SUBSTEPS, {"mined": start})
    origin = request.motion.keyframes or request.motion.poses
    assert origin is not None  # make_motion needs one
    motion_path = own.add_motion(
        request.id,
        dataclasses.replace(entry, steps=len(poses.pos)),
        lambda file: motion_file.write(file, arrays),
        [*motion.notes, *found.notes],
        origin.name,
    )
    path = task_path(request.id)
    path.parent.mkdir(parents=True, exist_ok=True)
    with paths.replacing(path) as temp:
        temp.write_text(_text(request, found.source, motion.source), encoding="utf-8")
    if (aside := pregrasp_file.set_aside(request.id)) is not None:
        found.notes.append(f"pre-grasps of the task that was replaced are set aside in {aside}")
    plan = None if start.is_reset_pose(scene.model.nu) else _reached(scene, found.qpos, progress)
    if plan is not None and plan.reached:
        plans.store(scene, "mined", found.qpos, plan)
    return AuthoredTask(request.id, scene, motion, found, plan, motion_path, path)


def _reached(scene: Scene, qpos: np.ndarray, progress: Progress) -> ReachPlan:
    """Plan the hand's way to the pre-grasp (nq,)."""

    def tell(done: int, rounds: int, cost: float) -> None:
        progress("reach plan", done, rounds)

    return plan_reach(scene, qpos, figures.SUBSTEPS, progress=tell)


def task_scene(request: TaskRequest, library: Library) -> Scene:
    """Compile the scene that the task's file will give; the library promises its motion."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "task" / f"{request.id}.yaml"
        file.parent.mkdir()
        file.write_text(_text(request, "none", "none"), encoding="utf-8")
        cfg = compose([f"task={request.id}"], folder)
    return build_scene(library, cfg.task, cfg.hand, cfg.sim)


def remove_task(task: str) -> Path | None:
    """Remove a task of the user's: its motion and its file.

    Returns:
        Where its pre-grasps are set aside, or None if there are none.

    Raises:
        UnknownNameError: the user has no such task.
    """
    own.remove(task)
    task_path(task).unlink(missing_ok=True)
    return pregrasp_file.set_aside(task)


def _check(request: TaskRequest, library: Library) -> None:
    shipped = [path.stem for path in (conf_dir() / "task").glob("*.yaml")]
    own.check_task_name(request.id, [*shipped, *suites()], request.replace)
    if request.id not in own.read().tasks and task_path(request.id).exists():
        raise ConfigError(
            f"task id '{request.id}' is taken by your file {task_path(request.id)}; choose another"
        )
    if request.hand not in available("hand"):
        raise UnknownNameError("hand", request.hand, available("hand"))
    objects = [name for name in library.objects() if name not in _BOUND]
    if request.object not in objects:
        raise UnknownNameError(
            "object for a task of one's own",
            request.object,
            objects,
            "'pgdm author object' makes new ones",
        )


def _text(request: TaskRequest, pregrasp_source: str, trajectory_source: str) -> str:
    return f"""# {request.hand} with {request.object}; made by 'pgdm author task'.
defaults:
  - _tcdm
  - _self_
  - override /hand@_global_.hand: {request.hand}

id: {request.id}
objects: [{request.object}]
pregrasp_source: {pregrasp_source}
trajectory_source: {trajectory_source}
tcdm30: false
paper_success: null
paper_com_error: null
"""
