"""The motions that come with pgdm, compiled from keyframes into the library source ``animated``.

``keyframes/<task>.yaml`` names hand and object, and has the keyframes (see
:mod:`pgdm.library.files.keyframes`) and the joint positions of the start state, found by
tools/animated_starts.py.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import yaml

from pgdm.errors import CorruptAssetError
from pgdm.library import manifest as manifests
from pgdm.library import staging
from pgdm.library.catalog import Library
from pgdm.library.files import motion as motion_file
from pgdm.library.files.motion import Start
from pgdm.library.manifest import FileEntry, Manifest, TaskEntry
from pgdm.library.tasks import SUBSTEPS

if TYPE_CHECKING:
    import mujoco

    from pgdm.library.files.keyframes import Animation

FOLDER = Path(__file__).parent / "keyframes"
TASKS = tuple(sorted(path.stem for path in FOLDER.glob("*.yaml")))
"""Tasks whose motion comes with pgdm."""

LICENCE = "MIT"
PLACE = np.array([0.0, 0.0, 0.2])
"""Position of the object's body at joint positions of zero, as in the tasks' settings (m)."""

_FORMAT = 1  # increase when a change of the code makes the same keyframes give another motion


@dataclass(frozen=True)
class AnimatedTask:
    """A task's keyframes and start state."""

    id: str
    hand: str
    object: str
    animation: Animation
    hand_joints: np.ndarray = field(repr=False)
    """(n,) hand joint positions, m and rad: the pre-grasp."""
    object_joints: np.ndarray = field(repr=False)
    """(6,) object joint positions, m and rad: the object at rest on the table."""


def read(task: str) -> AnimatedTask:
    """Read a task's file.

    Raises:
        CorruptAssetError: the file is missing or damaged.
        ConfigError: its keyframes are wrong.
    """

    path = FOLDER / f"{task}.yaml"
    try:
        content: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
        start = content.pop("start")
        hand, name = str(content.pop("hand")), str(content.pop("object"))
        joints = {key: np.array(start[key], np.float64) for key in ("hand", "object")}
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise CorruptAssetError(f"{path}: damaged ({error}); reinstall pgdm") from error
    from pgdm.library.files import keyframes

    animation = keyframes.animation(content, str(path))
    return AnimatedTask(task, hand, name, animation, joints["hand"], joints["object"])


def origin() -> str:
    """Return the origin, with a hash of all keyframe files, for the source's manifest."""
    digest = hashlib.sha256(str(_FORMAT).encode())
    for task in TASKS:
        digest.update((FOLDER / f"{task}.yaml").read_bytes())
    return f"keyframes that come with pgdm, SHA-256 {digest.hexdigest()}"


def is_current(library: Library) -> bool:
    """Return whether the library has the motions of the current keyframes."""
    manifest = library.sources().get(staging.ANIMATED)
    return manifest is not None and manifest.origin == origin()


def fill(root: Path, library: Library) -> None:
    """Compile all motions into the library; the caller must hold the library's lock.

    Args:
        root: the library's folder.
        library: the same library, opened; it provides the objects.

    Raises:
        UnknownNameError: the library lacks an object.
        LibraryError: the library has neither ``checkout`` nor ``registry``.
        CorruptAssetError: an object or a keyframe file is damaged.
    """
    files: dict[str, FileEntry] = {}
    tasks: dict[str, TaskEntry] = {}
    with staging.replacing_folder(root, staging.ANIMATED) as folder:
        for task in TASKS:
            animated = read(task)
            arrays = motion_arrays(animated, library)
            path = folder / "motions" / f"{task}.npz"
            motion_file.write(path, arrays)
            files[f"motions/{task}.npz"] = FileEntry.of(path, f"keyframes/{task}.yaml", LICENCE)
            steps = len(arrays["object_translation"])
            tasks[task] = TaskEntry(animated.hand, [animated.object], steps, ["mined"])
        content = Manifest(staging.ANIMATED, origin(), manifests.now(), files=files, tasks=tasks)
        manifests.write(folder, content)


def motion_arrays(task: AnimatedTask, library: Library) -> dict[str, np.ndarray]:
    """Return a task's motion as the arrays of its file."""
    pos, quat = task.animation.at(*_resting(task, library.object_xml(task.object)))
    qpos = np.concatenate((task.hand_joints, task.object_joints))
    start = Start(qpos, np.zeros(len(qpos)), None)
    return motion_file.pack(pos, quat, SUBSTEPS, {"mined": start})


def _resting(task: AnimatedTask, object_xml: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return centre of mass (3,) m and orientation (4,) wxyz of the object at the start, world."""
    import mujoco

    from pgdm.library.checks.compiled import compiled

    def place(spec: mujoco.MjSpec) -> None:
        spec.body("object").pos = PLACE

    model = compiled(object_xml, task.object, place)
    data = mujoco.MjData(model)
    data.qpos[:] = task.object_joints
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    body = model.body("object").id
    return data.xipos[body].copy(), data.xquat[body].copy()
