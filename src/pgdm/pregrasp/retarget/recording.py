"""Reads recordings of human hand joints: frames of keypoints, optionally with object poses.

docs/pregrasps/mocap.md describes the formats. Reading a file never runs code from it.
"""

from __future__ import annotations

import csv
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pgdm.errors import ConfigError, CorruptAssetError, UnknownNameError, amount
from pgdm.files import parse_json
from pgdm.library.files import npz as safe_npz
from pgdm.library.files.motion import check_unit, numbers
from pgdm.library.files.pickles import read_bytes, reason
from pgdm.pregrasp.retarget.keypoints import ORDERS, Keypoints

FORMATS = (".npz", ".json", ".csv")
"""File extensions that can be read."""

QUATERNIONS = ("wxyz", "xyzw")
"""Orders of a quaternion's numbers."""

KEYS = (
    *("joints", "order", "object_position", "object_orientation"),
    "object_orientation_order",
)
"""Keys that a ``.npz`` or ``.json`` file may have."""

COLUMNS = ("frame", "joint", "x", "y", "z")
"""Columns of a ``.csv`` file, named in its first line."""

MAX_FRAMES = 100_000
"""Longer recordings are refused; those of one grasp are far shorter."""


@dataclass(frozen=True)
class Recording:
    """Recorded motion of a person's right hand, world frame, m."""

    frames: tuple[Keypoints, ...] = field(repr=False)
    """Keypoints of the hand in each of N frames."""
    position: np.ndarray | None = field(default=None, repr=False)
    """Position of the object body's origin (N, 3) m; None if unknown."""
    orientation: np.ndarray | None = field(default=None, repr=False)
    """Orientation of the object's body (N, 4), unit quaternions wxyz; None if unknown."""
    origin: str = ""
    """Where the recording comes from, for messages."""
    chosen: int | None = None
    """Index of the frame that is the pre-grasp; None if unknown."""
    ordered: bool = True
    """Whether the file states the order of the quaternions' numbers; else wxyz is assumed."""


def read(path: Path) -> Recording:
    """Read a file of human hand joints.

    Args:
        path: ``.npz``, ``.json`` or ``.csv``.

    Raises:
        ConfigError: the extension or a key is unknown, or the joints are not a right hand in
            metres.
        CorruptAssetError: the file is missing or damaged, or an array is missing or has wrong
            contents.
    """
    readers = {".npz": safe_npz.read_npz, ".json": _read_json, ".csv": _read_csv}
    ending = path.suffix.lower()
    if ending not in readers:
        raise UnknownNameError(f"extension of {path.name}", ending, FORMATS)
    arrays = readers[ending](path)
    if unknown := sorted(set(arrays) - set(KEYS)):
        raise UnknownNameError(f"key in {path}", unknown[0], KEYS)
    return parse(arrays, str(path))


def parse(arrays: Mapping[str, Any], label: str) -> Recording:
    """Check the contents of a file and return them as a recording.

    Args:
        arrays: ``joints`` (16|21, 3) or (N, 16|21, 3) m; optionally ``order``, ``object_position``
            (3,) or (N, 3) m, and ``object_orientation`` (4,) or (N, 4), wxyz unless
            ``object_orientation_order`` says otherwise.
        label: name of the file, for messages.

    Raises:
        ConfigError: the joints are not a right hand in metres, one of their coordinates is not
            finite, or an order is unknown.
        CorruptAssetError: an array is missing, is not numeric or has a wrong shape; only one of the
            object's position and orientation is given; one of these is not finite; or the
            quaternions do not have unit length.
    """
    if "joints" not in arrays:
        raise CorruptAssetError(f"{label}: lacks 'joints'; it has {', '.join(sorted(arrays))}")
    joints = _numbers(arrays, "joints", label)
    joints = joints[None] if joints.ndim == 2 else joints
    if joints.ndim != 3 or not 1 <= len(joints) <= MAX_FRAMES:
        raise CorruptAssetError(
            f"{label}: 'joints' has shape {joints.shape}; expected (frames, 16 or 21, 3), "
            "with 1 to 100,000 frames"
        )
    order = arrays.get("order")
    if isinstance(order, np.ndarray) and order.ndim == 0:
        order = order.item()
    if order is not None and not isinstance(order, str):
        raise CorruptAssetError(f"{label}: 'order' is not a string; valid: {', '.join(ORDERS)}")
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
    if orientation is None:
        return Recording(frames, origin=label)
    check_unit(orientation, "object_orientation", label)
    key = "object_orientation_order"
    given = None if arrays.get(key) is None else str(arrays[key])
    if given not in (None, *QUATERNIONS):
        raise UnknownNameError(f"{key} in {label}", str(given), QUATERNIONS)
    if given == "xyzw":
        orientation = np.roll(orientation, 1, axis=1)
    if given is None:
        label += f", object_orientation read as w x y z (no {key})"
    return Recording(frames, position, orientation, label, ordered=given is not None)


def _pose(
    arrays: Mapping[str, Any], key: str, size: int, frames: int, label: str
) -> np.ndarray | None:
    if key not in arrays:
        return None
    value = _numbers(arrays, key, label)
    value = value[None] if value.ndim == 1 else value
    return numbers({key: value}, key, label, (frames, size))


def _numbers(arrays: Mapping[str, Any], key: str, label: str) -> np.ndarray:
    try:
        return np.asarray(arrays[key], np.float64)
    except (TypeError, ValueError) as error:
        raise CorruptAssetError(f"{label}: '{key}' is not an array of numbers") from error


def _read_json(path: Path) -> dict[str, Any]:
    try:
        content = parse_json(read_bytes(path))
    except ValueError as error:
        raise CorruptAssetError(f"{path}: not JSON ({reason(error)})") from error
    if not isinstance(content, dict):
        raise CorruptAssetError(f"{path}: not a JSON object with 'joints'")
    return content


def _read_csv(path: Path) -> dict[str, Any]:
    try:
        text = read_bytes(path).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise CorruptAssetError(f"{path}: not text ({reason(error)})") from error
    try:
        rows = [row for row in csv.reader(text.splitlines()) if row]
    except csv.Error as error:
        raise CorruptAssetError(f"{path}: not a CSV table ({reason(error)})") from error
    header = tuple(name.strip().lower() for name in rows[0]) if rows else ()
    if header != COLUMNS:
        raise CorruptAssetError(
            f"{path}: begins with '{','.join(header)[:60]}'; expected the line {','.join(COLUMNS)}"
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
                f"{path}: row {number} is '{line}'; expected a frame, a joint and three numbers"
            ) from error
        if (frame, joint) in points:
            raise CorruptAssetError(f"{path}: row {number} repeats joint {joint} of frame {frame}")
        points[frame, joint] = xyz
    return {"joints": _table(points, path)}


def _table(points: dict[tuple[int, int], list[float]], path: Path) -> np.ndarray:
    frames, joints = (1 + max((key[i] for key in points), default=-1) for i in (0, 1))
    if joints not in (16, 21):
        raise ConfigError(f"{path}: joints go up to {joints - 1}; a hand has 0 to 15, or 0 to 20")
    if len(points) < joints or not 0 < frames <= MAX_FRAMES:
        raise CorruptAssetError(
            f"{path}: {amount(len(points), 'row')} for {amount(frames, 'frame')}; expected "
            "a row for each joint in each of 1 to 100,000 frames, numbered from 0"
        )
    for frame in range(frames):
        for joint in range(joints):
            if (frame, joint) not in points:
                raise CorruptAssetError(f"{path}: lacks joint {joint} of frame {frame}")
    if len(points) > frames * joints:
        raise CorruptAssetError(f"{path}: has a frame or joint below 0")
    return np.array([[points[f, j] for j in range(joints)] for f in range(frames)])
