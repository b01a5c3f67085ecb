"""The user's pre-grasps: planned, recorded, posed by hand, or predicted from the object's mesh.

One file per task, hand and pre-grasp source: ``pregrasps/<task>/<hand>/<source>.npz`` in the user's
folder (:func:`pgdm.paths.user`); plain arrays, never pickled.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pgdm import paths
from pgdm.errors import CorruptAssetError
from pgdm.library.files import motion as motion_file
from pgdm.library.files import npz
from pgdm.library.files.motion import Start

SOURCES = ("planned", "mocap", "teleop", "labeled", "learned")
"""Pre-grasp sources that can be stored in the user's files."""

_NOTE = "note"


@dataclass(frozen=True)
class Pregrasp:
    """A pre-grasp, with the final state of a reach plan if there is one."""

    pose: Start
    """State of the whole scene, set kinematically: hand joints first, then the objects'."""
    reached: Start | None
    """The final state of the reach plan, with its actions; None without a plan."""
    note: Mapping[str, Any]
    """Origin and quality, as JSON values."""
    sha256: str = field(default="", compare=False)
    """Hash of the file it was read from."""

    @property
    def start(self) -> Start:
        """Start state of episodes: ``reached`` if there is a plan, otherwise ``pose``."""
        return self.pose if self.reached is None else self.reached


def path_of(task: str, hand: str, source: str) -> Path:
    """Return the file of the user's pre-grasp from a source; the file may not exist."""
    return paths.inside(paths.user() / "pregrasps", task, hand, source, suffix=".npz")


def find(task: str, hand: str, source: str) -> Pregrasp | None:
    """Return the user's pre-grasp from a source, None if missing.

    Raises:
        CorruptAssetError: the file is damaged.
    """
    path = path_of(task, hand, source)
    return read(path) if path.is_file() else None


def own(task: str, hand: str) -> list[str]:
    """Return the sources from which the user has a pre-grasp of a task and hand."""
    return [source for source in SOURCES if path_of(task, hand, source).is_file()]


def set_aside(task: str) -> Path | None:
    """Rename the folder of the user's pre-grasps of a task because the task has changed.

    Returns:
        The new folder, or None if there were no pre-grasps.
    """
    folder = paths.inside(paths.user() / "pregrasps", task)
    if not folder.is_dir():
        return None
    aside = paths.unused(folder.parent, f"{task}.before")
    folder.rename(aside)
    return aside


def write(path: Path, pregrasp: Pregrasp) -> None:
    """Write a pre-grasp atomically; equal content always gives equal bytes.

    Raises:
        OSError: the file cannot be written.
    """
    arrays = motion_file.pack_start(pregrasp.pose, "pose")
    if pregrasp.reached is not None:
        arrays |= motion_file.pack_start(pregrasp.reached, "reached")
    note = json.dumps(dict(pregrasp.note), sort_keys=True).encode()
    arrays[_NOTE] = np.frombuffer(note, np.uint8)
    path.parent.mkdir(parents=True, exist_ok=True)
    with paths.replacing(path) as temp:
        npz.write_npz(temp, arrays)


def read(path: Path) -> Pregrasp:
    """Read a pre-grasp.

    Raises:
        CorruptAssetError: the file is missing, damaged, or holds invalid values.
    """
    (arrays, digest), label = npz.read_hashed(path), str(path)
    pose = motion_file.start(arrays, "pose", label)
    reached = None
    if "reached_qpos" in arrays:
        reached = motion_file.start(arrays, "reached", label)
    if reached is not None and reached.qpos.shape != pose.qpos.shape:
        raise CorruptAssetError(
            f"{label}: 'pose_qpos' has {pose.qpos.size} positions, 'reached_qpos' has "
            f"{reached.qpos.size}"
        )
    try:
        note = json.loads(np.asarray(arrays[_NOTE], np.uint8).tobytes())
    except (KeyError, ValueError, TypeError) as error:
        raise CorruptAssetError(f"{label}: '{_NOTE}' is missing or not JSON") from error
    if not isinstance(note, dict):
        raise CorruptAssetError(f"{label}: '{_NOTE}' is not a JSON object")
    return Pregrasp(pose, reached, note, digest)
