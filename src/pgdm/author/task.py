"""Tasks of the user's: the motion is kept in the library, the settings in the user's folder."""

from __future__ import annotations

import dataclasses
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pgdm import paths
from pgdm.author.motion import CheckedMotion, MotionRequest, make_motion
from pgdm.author.pregrasp import FoundPregrasp, make_pregrasp
from pgdm.config.compose import compose
from pgdm.config.groups import available, conf_dir
from pgdm.config.suites import suites
from pgdm.errors import ConfigError, UnknownNameError, check_name
from pgdm.library import Library, Start
from pgdm.library.authored import own
from pgdm.library.checks.motion import object_joints
from pgdm.library.files import motion as motion_file
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.library.manifest import TaskEntry
from pgdm.library.progress import StepProgress, silent
from pgdm.library.tasks import SUBSTEPS, objects_of
from pgdm.pregrasp.reach import stored as plans
from pgdm.pregrasp.reach.plan import ReachPlan
from pgdm.pregrasp.reach.planner import plan_reach
from pgdm.pregrasp.sources import is_reset_pose, reset_pose
from pgdm.sim.scene import Scene, build_scene

_BOUND = {o for task in ("door-open", "hammer-strike") for o in objects_of(task)}
"""Objects that only fit their own task: attached to the scene, or made of several bodies."""


@dataclass(frozen=True)
class TaskRequest:
    """A task to create."""

    id: str
    """Id of the new task."""
    object: str
    """Library name of the object, the user's or the benchmark's."""
    hand: str
    """Name of the hand."""
    motion: MotionRequest
    pregrasp: str = "mean"
    """See :func:`pgdm.author.pregrasp.make_pregrasp`."""
    replace: bool = False
    """Replace an existing task of that id."""


@dataclass(frozen=True)
class AuthoredTask:
    """A new task."""

    id: str
    scene: Scene
    motion: CheckedMotion
    pregrasp: FoundPregrasp
    plan: ReachPlan | None
    """Reach plan, stored if it reaches the pre-grasp; None if the start is the reset pose."""
    motion_path: Path
    task_path: Path


def task_path(task: str) -> Path:
    """Return the file with the settings of a task of the user's."""
    return paths.inside(paths.user_conf() / "task", task, kind="task", suffix=".yaml")


def author_task(
    request: TaskRequest, library: Library, progress: StepProgress = silent
) -> AuthoredTask:
    """Make a task for ``pgdm-run task=ID``, and plan its reach.

    Args:
        request: the task to create.
        library: library with the object, the hand and the table.
        progress: reports the search for a pre-grasp, its lift tests and the reach plan.

    Raises:
        ConfigError: a name is unknown or taken, an option is wrong, the pre-grasp does not fit, the
            motion is impossible, or the hand cannot follow it.
        SceneError: every pre-grasp that the search found touches something.
        CorruptAssetError: a file is damaged.
        LibraryError: the user's folder cannot be written.
    """
    _check(request, library)
    entry = TaskEntry(request.hand, [request.object], 0, ["mined"])
    scene = task_scene(request, library.promising(request.id, entry))
    body = scene.index.object_body
    motion = make_motion(request.motion, library.object_xml(request.object), scene.model, body)
    poses = motion.poses
    qpos = reset_pose(scene, np.zeros(scene.model.nq))
    qpos[scene.index.num_joints :] = object_joints(scene.model, body, poses)[0]
    found = make_pregrasp(request.pregrasp, scene, qpos, poses, library, progress)
    start = Start(found.qpos, np.zeros(scene.model.nv), None)
    arrays = motion_file.pack(poses.pos, poses.quat, SUBSTEPS, {"mined": start})
    origin = request.motion.keyframes or request.motion.poses
    assert origin is not None  # make_motion needs one
    motion_path = own.add_motion(
        request.id,
        dataclasses.replace(entry, steps=len(poses.pos)),
        arrays,
        [*motion.notes, *found.notes],
        origin.name,
    )
    path = task_path(request.id)
    path.parent.mkdir(parents=True, exist_ok=True)
    with paths.replacing(path) as temp:
        temp.write_text(_text(request, found.source, motion.source), encoding="utf-8")
    if (aside := pregrasp_file.set_aside(request.id)) is not None:
        found.notes.append(f"pre-grasps of the replaced task are kept in {aside}")
    plan = None
    if not is_reset_pose(scene, start.qpos):
        plan = plan_reach(scene, found.qpos, SUBSTEPS, progress=progress)
        if plan.reached:
            plans.store(scene, "mined", found.qpos, plan)
    return AuthoredTask(request.id, scene, motion, found, plan, motion_path, path)


def task_scene(request: TaskRequest, library: Library) -> Scene:
    """Compile the scene of a task that is not stored yet; see ``Library.promising``."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "task" / f"{request.id}.yaml"
        file.parent.mkdir()
        file.write_text(_text(request, "none", "none"), encoding="utf-8")
        cfg = compose([f"task={request.id}"], folder)
    return build_scene(library, cfg.task, cfg.hand, cfg.sim)


def remove_task(task: str) -> Path | None:
    """Remove a task of the user's: its motion and its settings file.

    Returns:
        The folder to which its pre-grasps were moved, or None if it had none.

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
    check_name("hand", request.hand, available("hand"))
    objects = [name for name in library.objects() if name not in _BOUND]
    if request.object not in objects:
        raise UnknownNameError(
            "object for a task of your own",
            request.object,
            objects,
            "'pgdm author object' makes your own",
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
