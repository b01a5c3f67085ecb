"""Expert hand trajectories of the package ``robohive``, aligned with the library's motions."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pgdm.errors import CorruptAssetError
from pgdm.library.files import motion as motion_file
from pgdm.library.files import npz
from pgdm.library.files.expert import HUMAN_JOINTS, JOINTS, flags
from pgdm.library.files.motion import Motion, numbers

FOLDER = "mj_envs/envs/tcdm/assets/tmp_data"
"""Folder of the recordings in the package."""

STORED_POSES = {"alarmclock-lift": 40, "duck-lift": 38, "waterbottle-lift": 42}
"""Number of stored poses, for motions of which TCDM (the paper authors' repository) uses only the
first part. Their recordings end at the last stored pose."""

SHIFTED = frozenset({"alarmclock-lift"})
"""Tasks whose recorded positions have a constant offset from the motion's, which `Recording.shift`
corrects; here (0.8, -10.1, -2.9) mm."""

_NEAR_M, _NEAR_COS = 0.003, float(np.cos(0.01))
"""How far a recording's object may be from the motion: largest mean distance, and largest rotation,
0.02 rad, given as the cosine of half that angle. The released recordings stay below 1.5 mm and
0.0034 rad."""


@dataclass(frozen=True)
class Recording:
    """Recorded motion of hand and object; row t belongs to the exemplar motion's pose t."""

    qpos: np.ndarray
    """Joint positions of Adroit (T, 30), m and rad."""
    human_joints: np.ndarray
    """Joint locations of the human hand (T, 16, 3) m, MANO order, world frame."""
    touching: np.ndarray
    """Recorded flag of contact between hand and object (T,), bool; all True if not recorded."""
    position: np.ndarray
    """Positions of the origin of the object's mesh (T, 3) m, world frame."""
    rotation: np.ndarray
    """Orientations of the object (T, 4), unit quaternions wxyz."""
    skipped: int
    """Number of frames of the recording before the motion's first pose."""
    shift: np.ndarray
    """Offset (3,) m, world frame, that moves recorded positions to the motion's when added."""
    approximate: bool
    """True if the hand's trajectory was rebuilt, False if published."""


def file_name(task: str) -> str:
    """Return the name of a task's file: ``Adroit_hammer_use_1.npz`` for ``hammer-use1``."""
    name, _, motion = task.partition("-")
    numbered = re.sub(r"([0-9]+)$", r"_\1", motion)
    return f"Adroit_{name}_{numbered}.npz"


def aligned(frames: int, task: str, motion: Motion, label: str) -> slice:
    """Return the frames of a recording that belong to the motion's poses.

    A recording ends at the motion's last stored pose, and begins some frames before the first.

    Args:
        frames: length of the recording.
        task: task id.
        motion: its motion.
        label: the recording's name in messages.

    Raises:
        CorruptAssetError: the recording is too short.
    """
    steps = len(motion.translation)
    stored = STORED_POSES.get(task, steps)
    if frames < stored:
        raise CorruptAssetError(
            f"{label} has {frames} frames, fewer than the {stored} poses of {task}"
        )
    return slice(frames - stored, frames - stored + steps)


def read(path: Path, task: str, motion: Motion) -> Recording:
    """Read a recording and cut it to the task's motion with :func:`aligned`.

    Args:
        path: the package's file, unpacked.
        task: task id.
        motion: its motion.

    Raises:
        CorruptAssetError: an array is missing, empty, too short, of a wrong shape, not finite or
            not of unit quaternions, or the object's poses are not the motion's.
    """
    label = path.name
    if path.is_file() and path.stat().st_size == 0:
        raise CorruptAssetError(f"{label} is empty in the package")
    arrays = npz.read_npz(path)
    states = numbers(arrays, "s", label, (None, JOINTS + 6))
    frames = len(states)
    human = numbers(arrays, "human_joint_coords", label, (frames, HUMAN_JOINTS, 3))
    touching = flags(arrays, "human_obj_contact", label, (frames,))
    position = numbers(arrays, "object_translation", label, (frames, 3))
    rotation = numbers(arrays, "object_orientation", label, (frames, 4))
    motion_file.check_unit(rotation, "object_orientation", label)
    rows = aligned(frames, task, motion, label)
    away = motion.translation - position[rows]
    shift = away.mean(axis=0) if task in SHIFTED else np.zeros(3)
    distance = float(np.linalg.norm(away - shift, axis=1).mean())
    # The dot product of two unit quaternions is the cosine of half the angle between them.
    cosine = float(np.abs((rotation[rows] * motion.orientation).sum(axis=1)).min())
    if distance > _NEAR_M or cosine < _NEAR_COS:
        raise CorruptAssetError(
            f"{label} does not match the motion of {task}: its object is {1e3 * distance:.1f} mm "
            "away on average and rotated by up to "
            f"{2 * np.degrees(np.arccos(min(cosine, 1.0))):.1f} degrees"
        )
    return Recording(
        qpos=states[rows, :JOINTS],
        human_joints=human[rows],
        touching=touching[rows],
        position=position[rows],
        rotation=rotation[rows],
        skipped=rows.start,
        shift=shift,
        approximate=False,
    )
