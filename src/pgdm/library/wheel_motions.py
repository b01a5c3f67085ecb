"""Motions of the package ``robohive`` in the library's form."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pgdm.errors import CorruptAssetError
from pgdm.library import figures, motion_file, safe_npz
from pgdm.library.motion_file import Start, numbers

NO_PLAN = "has no planned start: the package stores no reach plan (use pregrasp=mined)"
"""Said of every task from the package."""

NOTES = {
    "wineglass-drink1": (
        "mined start: five finger joints (MFJ2, RFJ2, LFJ4, LFJ3, LFJ2) differ from TCDM's by up "
        "to 1.6 rad"
    ),
    "wineglass-toast1": (
        "mined start: the package has none; made from its expert trajectory at the motion's first "
        "frame, moved out of the glass, within 0.1 rad of TCDM's; motion equal to 3e-13 m"
    ),
}
"""What still differs from TCDM, by task, besides the missing plan."""

SKIPPED_FRAMES = {"mug-drink3": 6}
"""Frames at the beginning of a motion that TCDM's does not have."""

_EXPERT = {"wineglass-toast1": ("Adroit_wineglass_toast_1.npz", 15)}
"""Motions taken from an expert trajectory: file and first frame."""

EXPERT_FILES = tuple(file for file, _ in _EXPERT.values())
"""Files needed of the package's expert trajectories."""


def locate(assets: Path, task: str) -> Path | None:
    """Return the file of a task's motion, None if the package has none.

    The package drops the number at the end of a name where the name is unique without it.

    Args:
        assets: the package's ``envs/tcdm/assets`` folder, unpacked.
        task: a task id.
    """
    if task in _EXPERT:
        path = assets / "tmp_data" / _EXPERT[task][0]
        return path if path.is_file() else None
    name, _, motion = task.partition("-")
    for ending in (motion, motion.rstrip("0123456789")):
        path = assets / "data" / f"Adroit_{name}_{ending}.npz"
        if path.is_file():
            return path
    return None


def read(path: Path, task: str, label: str) -> tuple[np.ndarray, np.ndarray, Start]:
    """Read a motion and its start as stored.

    Args:
        path: from :func:`locate`.
        task: its task id.
        label: what to call the file in messages.

    Returns:
        Positions (T, 3) m, orientations (T, 4) wxyz, and the mined start.

    Raises:
        CorruptAssetError: something is missing, of a wrong shape, or not finite.
    """
    arrays = safe_npz.read_npz(path)
    if task in _EXPERT:
        first = _EXPERT[task][1]
        position = numbers(arrays, "object_translation", label, (None, 3))
        rotation = numbers(arrays, "object_orientation", label, (len(position), 4))
        states = numbers(arrays, "s", label, (len(position), 36))
        if len(states) <= first:
            raise CorruptAssetError(f"{label}: has {len(states)} frames, needs over {first}")
        return position[first:], rotation[first:], _still(states[first])
    steps = len(numbers(arrays, "time", label, (None,)))
    poses = numbers(arrays, "object", label, (None, 7))
    if steps > len(poses):
        raise CorruptAssetError(f"{label}: 'time' has {steps} rows, 'object' {len(poses)}")
    hand = numbers(arrays, "robot_int", label, (30,))
    thing = numbers(arrays, "object_int", label, (6,))
    poses = poses[SKIPPED_FRAMES.get(task, 0) : steps]
    return poses[:, :3], poses[:, 3:], _still(np.concatenate((hand, thing)))


def _still(qpos: np.ndarray) -> Start:
    return Start(qpos.copy(), np.zeros_like(qpos), None)


def notes(task: str) -> list[str]:
    """Return what differs from TCDM in a task of the package."""
    return [NO_PLAN, *([NOTES[task]] if task in NOTES else [])]


def packed(position: np.ndarray, rotation: np.ndarray, start: Start) -> dict[str, np.ndarray]:
    """Return the arrays of the normalised file."""
    return motion_file.pack(position, rotation, figures.SUBSTEPS, {"mined": start})
