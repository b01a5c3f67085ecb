"""The motions that come with the program: keyframes and starts, compiled into source ``animated``.

``keyframes/<task>.yaml`` names hand and object, has the keyframes as :mod:`pgdm.library.animate`
reads them, and where hand and object start: joint numbers that tools/animated_starts.py found.
"""

from __future__ import annotations

import datetime
import hashlib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import yaml

from pgdm.errors import CorruptAssetError
from pgdm.library import animate, figures, motion_file, staging
from pgdm.library import manifest as manifests
from pgdm.library.animate import Animation
from pgdm.library.catalog import Library
from pgdm.library.check import compiled
from pgdm.library.manifest import FileEntry, Manifest, TaskEntry
from pgdm.library.motion_file import Start

FOLDER = Path(__file__).parent / "keyframes"
TASKS = tuple(sorted(path.stem for path in FOLDER.glob("*.yaml")))
"""Tasks whose motion comes with the program."""

LICENCE = "MIT"
PLACE = np.array([0.0, 0.0, 0.2])
"""Where the tasks' settings place the object body at joints zero, m."""

_FORMAT = 1  # raise it where the same keyframes give another motion


@dataclass(frozen=True)
class AnimatedTask:
    """A task's keyframes and start."""

    id: str
    hand: str
    object: str
    animation: Animation
    hand_joints: np.ndarray = field(repr=False)
    """(nu,) m and rad: the pre-grasp."""
    object_joints: np.ndarray = field(repr=False)
    """(6,) m and rad, where it rests."""


def read(task: str) -> AnimatedTask:
    """Read a task's file.

    Raises:
        CorruptAssetError: the installation is damaged.
    """
    path = FOLDER / f"{task}.yaml"
    try:
        content: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
        start = content.pop("start")
        hand, name = str(content.pop("hand")), str(content.pop("object"))
        joints = {key: np.array(start[key], np.float64) for key in ("hand", "object")}
    except (OSError, yaml.YAMLError, KeyError, TypeError, ValueError, AttributeError) as error:
        raise CorruptAssetError(f"{path}: damaged ({error}); install pgdm anew") from error
    animation = animate.animation(content, str(path))
    return AnimatedTask(task, hand, name, animation, joints["hand"], joints["object"])


def origin() -> str:
    """Return what the source is made of; it changes with any of the keyframes."""
    digest = hashlib.sha256(str(_FORMAT).encode())
    for task in TASKS:
        digest.update((FOLDER / f"{task}.yaml").read_bytes())
    return f"keyframes that come with pgdm, SHA-256 {digest.hexdigest()}"


def is_current(library: Library) -> bool:
    """Return whether the library has these motions, made of these keyframes."""
    manifest = library.sources().get(staging.ANIMATED)
    return manifest is not None and manifest.origin == origin()


def fill(root: Path, library: Library) -> None:
    """Compile all of them into the library, for a caller who holds its lock.

    Args:
        root: the library's folder.
        library: the library, with hands and objects in it.

    Raises:
        LibraryError: an object is missing.
        CorruptAssetError: a file is damaged.
    """
    files: dict[str, FileEntry] = {}
    tasks: dict[str, TaskEntry] = {}
    with staging.replacing(root, staging.ANIMATED) as folder:
        for task in TASKS:
            made = read(task)
            arrays = motion_arrays(made, library)
            path = folder / "motions" / f"{task}.npz"
            motion_file.write(path, arrays)
            digest, size = manifests.sha256_of(path), path.stat().st_size
            files[f"motions/{task}.npz"] = FileEntry(
                digest, size, f"keyframes/{task}.yaml", LICENCE
            )
            steps = len(arrays["object_translation"])
            tasks[task] = TaskEntry(made.hand, [made.object], steps, ["mined"])
        now = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
        content = Manifest(staging.ANIMATED, origin(), now, files=files, tasks=tasks)
        manifests.write(folder, content)


def motion_arrays(task: AnimatedTask, library: Library) -> dict[str, np.ndarray]:
    """Return a task's motion as arrays of the library's form."""
    pos, quat = task.animation.at(*_resting(task, library.object_xml(task.object)))
    qpos = np.concatenate((task.hand_joints, task.object_joints))
    start = Start(qpos, np.zeros(len(qpos)), None)
    return motion_file.pack(pos, quat, figures.SUBSTEPS, {"mined": start})


def _resting(task: AnimatedTask, object_xml: Path) -> tuple[np.ndarray, np.ndarray]:
    """Return centre of mass (3,) m and orientation (4,) wxyz of the object at its start."""

    def place(spec: mujoco.MjSpec) -> None:
        spec.body("object").pos = PLACE

    model = compiled(object_xml, task.object, place)
    data = mujoco.MjData(model)
    data.qpos[:] = task.object_joints
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    body = model.body("object").id
    return data.xipos[body].copy(), data.xquat[body].copy()
