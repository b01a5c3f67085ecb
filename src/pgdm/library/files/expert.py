"""Expert hand trajectories in the library's format: plain arrays, checked when read and written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pgdm.errors import CorruptAssetError, amount
from pgdm.library.files import npz
from pgdm.library.files.motion import numbers

HAND = "adroit"
"""The robot hand of the trajectories."""
FINGERS = ("ff", "mf", "lf", "rf", "th")
"""Order of the fingers in all arrays: index, middle, little, ring finger, thumb."""
FINGERTIPS = tuple(f"{finger}distal_point" for finger in FINGERS)
"""Adroit's fingertips, as geoms and bodies of its model."""

JOINTS = 30
"""Number of Adroit's joints: six of the base, then wrist and fingers."""

HUMAN_JOINTS = 16
"""Number of joints of the human hand (MANO): wrist, then three each of index, middle, little and
ring finger and thumb."""


@dataclass(frozen=True)
class Expert:
    """Motion of a person's hand along a task's motion; row t belongs to the motion's pose t.

    Lengths in m, angles in rad, world frame of the task's scene.
    """

    task: str
    """Task id."""
    qpos: np.ndarray = field(repr=False)
    """Adroit's joint positions (T, 30), not clipped: they may exceed the joints' limits."""
    human_joints: np.ndarray = field(repr=False)
    """Joint locations of the human hand (T, 16, 3), MANO order; the last joint of each finger
    is the one nearest to its tip."""
    fingertips: np.ndarray = field(repr=False)
    """Adroit's fingertips (T, 5, 3) when ``qpos`` is clipped to the joints' limits."""
    contacts: np.ndarray = field(repr=False)
    """Points of the object closest to the human fingers (T, 5, 3), in the frame of the object's
    body (whose origin is not the centre of mass)."""
    in_contact: np.ndarray = field(repr=False)
    """Whether each finger touches the object (T, 5), bool."""
    approximate: bool
    """True if rebuilt from another recording of the same motion, False if published."""
    sha256: str
    """Hash of its file in the library."""


def check(arrays: Mapping[str, Any], label: str) -> dict[str, np.ndarray]:
    """Check the arrays of an expert trajectory's file and return them, in float64 and bool.

    Args:
        arrays: arrays of the file.
        label: the file's name in messages.

    Raises:
        CorruptAssetError: an array is missing, has a wrong shape, type or value, or is not finite,
            or there are fewer than two rows.
    """
    qpos = numbers(arrays, "qpos", label, (None, JOINTS))
    steps, fingers = len(qpos), len(FINGERS)
    if steps < 2:
        raise CorruptAssetError(f"{label}: qpos has {amount(steps, 'row')}, needs 2 or more")
    return {
        "qpos": qpos,
        "human_joints": numbers(arrays, "human_joints", label, (steps, HUMAN_JOINTS, 3)),
        "fingertips": numbers(arrays, "fingertips", label, (steps, fingers, 3)),
        "contacts": numbers(arrays, "contacts", label, (steps, fingers, 3)),
        "in_contact": flags(arrays, "in_contact", label, (steps, fingers)),
        "approximate": flags(arrays, "approximate", label, ()),
    }


def flags(
    arrays: Mapping[str, Any], key: str, label: str, shape: tuple[int | None, ...]
) -> np.ndarray:
    """Return a bool array of a given shape, where None stands for any length.

    Raises:
        CorruptAssetError: the array is missing, has another shape, or values other than 0 and 1.
    """
    value = numbers(arrays, key, label, shape)
    if not np.isin(value, (0.0, 1.0)).all():
        raise CorruptAssetError(f"{label}: '{key}' holds values other than 0 and 1")
    return value.astype(bool)


def write(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Check and write an expert trajectory; equal arrays always give equal bytes.

    Raises:
        CorruptAssetError: as for :func:`check`.
    """
    npz.write_npz(path, check(arrays, path.name))


def read(path: Path, task: str) -> Expert:
    """Read an expert trajectory.

    Raises:
        CorruptAssetError: the file is missing, damaged, or holds invalid values.
    """
    stored, digest = npz.read_hashed(path)
    arrays = check(stored, str(path))
    approximate = bool(arrays.pop("approximate"))
    return Expert(task=task, approximate=approximate, sha256=digest, **arrays)
