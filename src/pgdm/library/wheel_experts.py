"""Expert hand trajectories of the package ``robohive``, aligned with the library's motions."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pgdm.errors import CorruptAssetError
from pgdm.library import motion_file, safe_npz
from pgdm.library.expert_file import HUMAN_JOINTS, JOINTS, flags
from pgdm.library.motion_file import Motion, numbers

FOLDER = "mj_envs/envs/tcdm/assets/tmp_data"
"""Where the package has them."""

STORED_POSES = {"alarmclock-lift": 40, "duck-lift": 38, "waterbottle-lift": 42}
"""Poses that TCDM stores of a motion where it uses fewer: a recording ends with the last of
them."""

SHIFTED = frozenset({"alarmclock-lift"})
"""Tasks whose recording is displaced by a constant, (0.8, -10.1, -2.9) mm, which is taken out."""

_NEAR_M, _NEAR_COS = 0.003, float(np.cos(0.01))
"""How far a recording's object may lie from the motion's, mean, and be turned (0.02 rad, as the
cosine of half of it); the released ones: 1.5 mm and 0.0034 rad."""


@dataclass(frozen=True)
class Recording:
    """A hand and an object that moved together; row t belongs to the motion's pose t."""

    qpos: np.ndarray
    """Adroit's joints (T, 30), m and rad."""
    human_joints: np.ndarray
    """Joints of the human hand (T, 16, 3) m, MANO order, world frame."""
    touching: np.ndarray
    """Whether the hand touches the object (T,), bool."""
    position: np.ndarray
    """Origin of the object's mesh (T, 3) m, world frame."""
    rotation: np.ndarray
    """The object's orientation (T, 4), unit quaternions wxyz."""
    skipped: int
    """Frames before the motion's first pose."""
    shift: np.ndarray
    """What has to be added to all positions (3,) m to bring the object to the motion's."""
    approximate: bool
    """Whether the hand was rebuilt, not published."""


def file_name(task: str) -> str:
    """Return the name of a task's file: of ``hammer-use1`` ``Adroit_hammer_use_1.npz``."""
    thing, _, motion = task.partition("-")
    numbered = re.sub(r"([0-9]+)$", r"_\1", motion)
    return f"Adroit_{thing}_{numbered}.npz"


def aligned(frames: int, task: str, motion: Motion, label: str) -> slice:
    """Return which frames of a recording belong to the motion's poses.

    Recording and motion end together: its first frames are the ones that the motion lacks.

    Args:
        frames: length of the recording.
        task: a task id.
        motion: its motion.
        label: the recording's name, for messages.

    Raises:
        CorruptAssetError: the recording is too short.
    """
    steps = len(motion.translation)
    stored = STORED_POSES.get(task, steps)
    if frames < stored:
        raise CorruptAssetError(
            f"{label}: has {frames} frames, fewer than the {stored} poses of {task}"
        )
    return slice(frames - stored, frames - stored + steps)


def read(path: Path, task: str, motion: Motion) -> Recording:
    """Read a recording and cut it to the task's motion, as :func:`aligned` says.

    Args:
        path: the package's file, unpacked.
        task: a task id.
        motion: its motion.

    Raises:
        CorruptAssetError: something is missing, of a wrong shape, not finite, no unit quaternion,
            empty, too short, or its object moves otherwise than the motion's.
    """
    label = path.name
    if path.is_file() and path.stat().st_size == 0:
        raise CorruptAssetError(f"{label}: is empty in the package")
    arrays = safe_npz.read_npz(path)
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
    # The product of two unit quaternions is the cosine of half the angle between them.
    cosine = float(np.abs((rotation[rows] * motion.orientation).sum(axis=1)).min())
    if distance > _NEAR_M or cosine < _NEAR_COS:
        raise CorruptAssetError(
            f"{label}: its object lies {1e3 * distance:.1f} mm from the motion of {task} on "
            f"average and is turned by up to {2 * np.degrees(np.arccos(min(cosine, 1.0))):.1f} "
            "degrees: not a recording of it"
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
