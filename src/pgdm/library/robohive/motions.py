"""Reading the motions of the package ``robohive``; TCDM is the paper authors' repository."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pgdm.errors import CorruptAssetError
from pgdm.library.files import npz
from pgdm.library.files.motion import Start, numbers

NO_PLAN = "has no planned start: the package stores no reach plan (use pregrasp=mined)"
"""Note on every task from the package."""

NOTES = {
    "wineglass-drink1": (
        "mined start: five finger joints (MFJ2, RFJ2, LFJ4, LFJ3, LFJ2) differ from TCDM's by up "
        "to 1.6 rad"
    ),
    "wineglass-toast1": (
        "mined start: the package has none; made from its expert trajectory at the motion's first "
        "frame, with the hand moved clear of the glass; joints within 0.1 rad of TCDM's; motion "
        "equal to TCDM's within 3e-13 m"
    ),
}
"""Remaining differences from TCDM's data by task, apart from the missing reach plan."""

SKIPPED_FRAMES = {"mug-drink3": 6}
"""By task, number of first frames of the package's motion that TCDM's motion lacks."""

_EXPERT = {"wineglass-toast1": ("Adroit_wineglass_toast_1.npz", 15)}
"""Tasks whose motion is taken from an expert trajectory: file and first frame."""

EXPERT_FILES = tuple(file for file, _ in _EXPERT.values())
"""Expert trajectories from which motions are taken."""


def locate(assets: Path, task: str) -> Path | None:
    """Return the file of a task's motion, None if missing.

    The package omits the number at the end of a motion's name if the name is unique without it.

    Args:
        assets: the package's ``envs/tcdm/assets`` folder, unpacked.
        task: task id.
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


def read(path: Path, task: str) -> tuple[np.ndarray, np.ndarray, Start]:
    """Read a motion and its start state, in the world frame.

    Frames of :data:`SKIPPED_FRAMES`, and poses beyond the rows of ``time``, are left out.

    Args:
        path: file from :func:`locate`.
        task: task id.

    Returns:
        Positions (T, 3) m, orientations (T, 4) wxyz, mined start.

    Raises:
        CorruptAssetError: an array is missing, too short, of a wrong shape, or not finite.
    """
    arrays, label = npz.read_npz(path), path.name
    if task in _EXPERT:
        first = _EXPERT[task][1]
        position = numbers(arrays, "object_translation", label, (None, 3))
        rotation = numbers(arrays, "object_orientation", label, (len(position), 4))
        states = numbers(arrays, "s", label, (len(position), 36))
        if len(states) <= first:
            raise CorruptAssetError(f"{label}: has {len(states)} frames, needs more than {first}")
        return position[first:], rotation[first:], _still(states[first])
    steps = len(numbers(arrays, "time", label, (None,)))
    poses = numbers(arrays, "object", label, (None, 7))
    if steps > len(poses):
        raise CorruptAssetError(f"{label}: 'time' has {steps} rows, 'object' {len(poses)}")
    hand = numbers(arrays, "robot_int", label, (30,))
    object_joints = numbers(arrays, "object_int", label, (6,))
    poses = poses[SKIPPED_FRAMES.get(task, 0) : steps]
    return poses[:, :3], poses[:, 3:], _still(np.concatenate((hand, object_joints)))


def _still(qpos: np.ndarray) -> Start:
    return Start(qpos.copy(), np.zeros_like(qpos), None)


def notes(task: str) -> list[str]:
    """Return how a task of the package differs from TCDM's."""
    return [NO_PLAN, *([NOTES[task]] if task in NOTES else [])]
