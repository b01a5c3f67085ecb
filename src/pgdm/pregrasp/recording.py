"""Files of human hand joints: one or several frames of keypoints, with the object's pose if known.

docs/pregrasps/mocap.md describes the formats. Reading never runs code from a file.
"""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pgdm.errors import ConfigError, CorruptAssetError, UnknownNameError
from pgdm.library import safe_npz
from pgdm.library.motion_file import check_unit, numbers
from pgdm.library.safe_pickle import read_bytes, reason
from pgdm.pregrasp.keypoints import ORDERS, Keypoints

FORMATS = (".npz", ".json", ".csv")
"""Endings of files that can be read."""

KEYS = ("joints", "order", "object_position", "object_orientation")
"""What a file may hold."""

COLUMNS = ("frame", "joint", "x", "y", "z")
"""First line of a ``.csv``."""

MAX_FRAMES = 100_000
"""More frames than any recording of one grasp has."""


@dataclass(frozen=True)
class Recording:
    """How a person's right hand moved, world frame, m."""

    frames: tuple[Keypoints, ...] = field(repr=False)
    """Of N frames."""
    position: np.ndarray | None = field(default=None, repr=False)
    """Where the origin of the object's body was (N, 3) m; None where it is not known."""
    orientation: np.ndarray | None = field(default=None, repr=False)
    """How the object's body was turned (N, 4), unit quaternions wxyz; None with the position."""
    origin: str = ""
    """Where it came from, for people."""
    chosen: int | None = None
    """The frame that is the pre-grasp, where that is known."""


def read(path: Path) -> Recording:
    """Read a file of human hand joints.

    Args:
        path: ``.npz``, ``.json`` or ``.csv``.

    Raises:
        ConfigError: the ending is unknown, or the joints are no right hand in metres.
        CorruptAssetError: the file is missing, damaged, or lacks an array.
    """
    readers = {".npz": safe_npz.read_npz, ".json": _read_json, ".csv": _read_csv}
    ending = path.suffix.lower()
    if ending not in readers:
        raise UnknownNameError(f"ending of {path.name}", ending, FORMATS)
    arrays = readers[ending](path)
    if unknown := sorted(set(arrays) - set(KEYS)):
        raise UnknownNameError(f"key in {path}", unknown[0], KEYS)
    return parse(arrays, str(path))


def parse(arrays: Mapping[str, Any], label: str) -> Recording:
    """Check what a file holds.

    Args:
        arrays: some of :data:`KEYS`: ``joints`` (16|21, 3) or (N, 16|21, 3), ``order``,
            ``object_position`` (3,) or (N, 3) and ``object_orientation`` (4,) or (N, 4).
        label: the file's name, for messages.

    Raises:
        ConfigError: the joints are no right hand in metres.
        CorruptAssetError: an array is missing, has a wrong shape or a NaN.
    """
    if "joints" not in arrays:
        raise CorruptAssetError(f"{label}: lacks 'joints'; it has {', '.join(sorted(arrays))}")
    try:
        joints = np.asarray(arrays["joints"], np.float64)
    except (TypeError, ValueError) as error:
        raise CorruptAssetError(f"{label}: 'joints' is no array of numbers") from error
    joints = joints[None] if joints.ndim == 2 else joints
    if joints.ndim != 3 or not 1 <= len(joints) <= MAX_FRAMES:
        raise CorruptAssetError(
            f"{label}: 'joints' has shape {joints.shape}; it takes (frames, 16 or 21, 3)"
        )
    order = arrays.get("order")
    if isinstance(order, np.ndarray) and order.ndim == 0:
        order = order.item()
    if order is not None and not isinstance(order, str):
        raise CorruptAssetError(f"{label}: 'order' is no word; valid: {', '.join(ORDERS)}")
    one = len(joints) == 1
    frames = tuple(
        Keypoints.of(points, order, label if one else f"{label}, frame {i}")
        for i, points in enumerate(joints)
    )
    position = _pose(arrays, "object_position", 3, len(frames), label)
    orientation = _pose(arrays, "object_orientation", 4, len(frames), label)
    if (position is None) != (orientation is None):
        raise CorruptAssetError(
            f"{label}: needs both 'object_position' and 'object_orientation', or neither"
        )
    if orientation is not None:
        check_unit(orientation, "object_orientation", label)
    return Recording(frames, position, orientation, label)


def _pose(
    arrays: Mapping[str, Any], key: str, size: int, frames: int, label: str
) -> np.ndarray | None:
    if key not in arrays:
        return None
    try:
        value = np.asarray(arrays[key], np.float64)
    except (TypeError, ValueError) as error:
        raise CorruptAssetError(f"{label}: '{key}' is no array of numbers") from error
    value = value[None] if value.ndim == 1 else value
    return numbers({key: value}, key, label, (frames, size))


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = json.loads(read_bytes(path))
    except (ValueError, RecursionError) as error:
        raise CorruptAssetError(f"{path}: no JSON ({reason(error)})") from error
    if not isinstance(content, dict):
        raise CorruptAssetError(f"{path}: no JSON object with 'joints'")
    return content


def _read_csv(path: Path) -> dict[str, Any]:
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CorruptAssetError(f"{path}: no text ({reason(error)})") from error
    try:
        rows = [row for row in csv.reader(text.splitlines()) if row]
    except csv.Error as error:
        raise CorruptAssetError(f"{path}: no table ({reason(error)})") from error
    header = tuple(name.strip().lower() for name in rows[0]) if rows else ()
    if header != COLUMNS:
        raise CorruptAssetError(
            f"{path}: begins with '{','.join(header)[:60]}', it takes the line {','.join(COLUMNS)}"
        )
    points: dict[tuple[int, int], list[float]] = {}
    for number, row in enumerate(rows[1:], 2):
        try:
            frame, joint, *xyz = int(row[0]), int(row[1]), *(float(v) for v in row[2:])
            if len(xyz) != 3:
                raise ValueError
        except (ValueError, IndexError) as error:
            line = ",".join(row)[:60]
            raise CorruptAssetError(
                f"{path}: row {number} is '{line}', it takes a frame, a joint and three numbers"
            ) from error
        if (frame, joint) in points:
            raise CorruptAssetError(f"{path}: row {number} is joint {joint} of frame {frame} again")
        points[frame, joint] = xyz
    return {"joints": _table(points, path)}


def _table(points: dict[tuple[int, int], list[float]], path: Path) -> np.ndarray:
    frames, joints = (1 + max((key[i] for key in points), default=-1) for i in (0, 1))
    if joints not in (16, 21):
        raise ConfigError(f"{path}: joints go up to {joints - 1}; a hand has 0 to 15, or 0 to 20")
    if len(points) < joints or not 0 < frames <= MAX_FRAMES:
        raise CorruptAssetError(f"{path}: {len(points)} rows for {frames} frames")
    for frame in range(frames):
        for joint in range(joints):
            if (frame, joint) not in points:
                raise CorruptAssetError(f"{path}: lacks joint {joint} of frame {frame}")
    if len(points) > frames * joints:
        raise CorruptAssetError(f"{path}: has a frame or joint below 0")
    return np.array([[points[f, j] for j in range(joints)] for f in range(frames)])
