"""Pre-grasps of the user's own: made by the reach planner, from recordings, by hand, by a model.

One file for each task, hand and source: ``pregrasps/<task>/<hand>/<source>.npz`` in the user's
folder (:func:`pgdm.paths.user`); plain arrays, never pickled.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pgdm import paths
from pgdm.errors import CorruptAssetError
from pgdm.library import motion_file, safe_npz
from pgdm.library.motion_file import Start

SOURCES = ("planned", "mocap", "teleop", "labeled", "learned")
"""Where a pre-grasp of the user's own may come from."""

_NOTE = "note"


@dataclass(frozen=True)
class Pregrasp:
    """A pre-grasp with the state in which a reach plan ended there, if one was made."""

    pose: Start
    """The pre-grasp as it was asked for, kinematic: whole scene, hand first, then the objects."""
    reached: Start | None
    """The state in which the plan really ends, with the plan's actions; None if there is none."""
    note: Mapping[str, Any]
    """How it was made and how good it is; plain JSON."""
    sha256: str = field(default="", compare=False)
    """Hash of the file it was read from."""

    @property
    def start(self) -> Start:
        """Where an episode starts."""
        return self.pose if self.reached is None else self.reached


def path_of(task: str, hand: str, source: str) -> Path:
    """Return where the user's own pre-grasp of a source lies, or would lie."""
    return paths.user() / "pregrasps" / task / hand / f"{source}.npz"


def find(task: str, hand: str, source: str) -> Pregrasp | None:
    """Return the user's own pre-grasp, or None where there is none.

    Raises:
        CorruptAssetError: the file is damaged.
    """
    path = path_of(task, hand, source)
    return read(path) if path.is_file() else None


def own(task: str, hand: str) -> list[str]:
    """Return of which sources the user has a pre-grasp."""
    return [source for source in SOURCES if path_of(task, hand, source).is_file()]


def set_aside(task: str) -> Path | None:
    """Give the user's pre-grasps of a task another place, as they fit it no more.

    Returns:
        Where they are now, or None if there were none.
    """
    folder = paths.user() / "pregrasps" / task
    if not folder.is_dir():
        return None
    aside = next(
        path
        for i in itertools.count(1)
        if not (path := folder.with_name(f"{task}.before-{i}")).exists()
    )
    folder.rename(aside)
    return aside


def write(path: Path, pregrasp: Pregrasp) -> None:
    """Write a pre-grasp, whole or not at all; the same content always gives the same bytes.

    Raises:
        OSError: it cannot be written.
    """
    arrays = motion_file.pack_start(pregrasp.pose, "pose")
    if pregrasp.reached is not None:
        arrays |= motion_file.pack_start(pregrasp.reached, "reached")
    note = json.dumps(dict(pregrasp.note), sort_keys=True).encode()
    arrays[_NOTE] = np.frombuffer(note, np.uint8)
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]
    path.parent.mkdir(parents=True, exist_ok=True)
    with paths.replacing(path) as temp:
        temp.write_bytes(buffer.getvalue())


def read(path: Path) -> Pregrasp:
    """Read a pre-grasp.

    Raises:
        CorruptAssetError: the file is missing, damaged, or holds impossible values.
    """
    arrays, label = safe_npz.read_npz(path), str(path)
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
        raise CorruptAssetError(f"{label}: '{_NOTE}' is missing or no JSON") from error
    if not isinstance(note, dict):
        raise CorruptAssetError(f"{label}: '{_NOTE}' is no JSON object")
    return Pregrasp(pose, reached, note, hashlib.sha256(path.read_bytes()).hexdigest())
