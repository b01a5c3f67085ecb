"""Tables of poses: the meaning of each column, and the order of a quaternion's components."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from pgdm.errors import ConfigError, CorruptAssetError, amount

POSE = ("x", "y", "z", "qw", "qx", "qy", "qz")
"""Columns of a pose, in the order of a table without names."""

_PLACE = r"(?:(?:\w+[./])*(?:p|pos|position|t|trans|translation)[._ ]?)?([xyz])(?:_m| ?\[m\])?"
_TURN = r"(?:\w+[./])*(?:q|quat|quaternion|r|rot|rotation|orientation)[._ ]?([wxyz])"
_TIME = r"t|t_s|time|time_s|timestamp|sec|secs|seconds|time ?\[s\]"
# Thresholds of check_order: tilt of the vertical, and angle of the rotation from the rest pose.
_LEVEL_RAD, _UPRIGHT_RAD, _TILTED_RAD = np.deg2rad([3.0, 10.0, 20.0])
_NEAR_RAD, _FAR_RAD = np.deg2rad([60.0, 120.0])


@dataclass(frozen=True)
class Table:
    """Poses as stored in a file."""

    rows: np.ndarray = field(repr=False)
    """(N, 7) in the order of `POSE`, unchecked."""
    times: np.ndarray | None = field(repr=False)
    """(N,) s, None if the file has no times."""
    named: bool
    """Whether the file names its columns."""
    notes: list[str]
    """What was assumed or left out, one sentence each."""


def known(names: Sequence[str]) -> bool:
    """Return whether any of the names is a known name of a pose or time column."""
    return any(_meaning(name) for name in names)


def by_name(rows: np.ndarray, names: Sequence[str], label: str) -> Table:
    """Return the poses of a table with named columns, in any order.

    Args:
        rows: (N, C).
        names: names of the C columns, such as ``qx``, ``quat_x`` or ``pose.orientation.x``.
        label: the file's name in messages.

    Raises:
        CorruptAssetError: rows do not have C columns, a column of the pose is missing, or two have
            the same meaning.
    """
    if rows.ndim != 2 or rows.shape[1] != len(names):
        raise CorruptAssetError(
            f"{label}: rows have shape {rows.shape} for {amount(len(names), 'column')}: "
            f"{', '.join(names)}"
        )
    meanings = [_meaning(name) for name in names]
    for wanted in POSE:
        if meanings.count(wanted) != 1:
            raise CorruptAssetError(
                f"{label}: has {meanings.count(wanted)} columns '{wanted}' among "
                f"{', '.join(names)}; a pose takes {', '.join(POSE)} (lengths in m), "
                "and optionally time (s)"
            )
    clocks = [name for name, meaning in zip(names, meanings, strict=True) if meaning == "time"]
    if len(clocks) > 1:
        raise CorruptAssetError(
            f"{label}: the columns {', '.join(clocks)} are all times; keep one, in s"
        )
    times = rows[:, meanings.index("time")] if "time" in meanings else None
    others = [name for name, meaning in zip(names, meanings, strict=True) if not meaning]
    notes = [f"left out the columns {', '.join(others)}"] if others else []
    return Table(rows[:, [meanings.index(name) for name in POSE]], times, True, notes)


def by_place(rows: np.ndarray, times: np.ndarray | None = None) -> Table:
    """Return the poses of a table without column names, whose columns are `POSE`.

    If there are eight columns and no ``times``, the first column is the time.
    """
    if rows.ndim == 2 and rows.shape[1] == 8 and times is None:
        rows, times = rows[:, 1:], rows[:, 0]
    note = f"the columns have no names and were read as {' '.join(POSE)}"
    return Table(rows, times, False, [note])


def check_order(quat: np.ndarray, rest: Rotation, label: str, cure: str) -> None:
    """Refuse an orientation that makes sense only if its components are in the order x y z w.

    Args:
        quat: (4,), read as wxyz.
        rest: orientation in which the object rests on the table.
        label: name of the orientation in the message.
        cure: advice in the message on how to state the order.

    Raises:
        ConfigError: read as wxyz, the orientation is tilted or rotated far from the resting one;
            read as xyzw, it is close by the same measure. The message states that measure for both.
    """
    taken, other = (Rotation.from_quat(quat, scalar_first=f) * rest.inv() for f in (True, False))
    tilts = [float(np.arccos(np.clip(r.as_matrix()[2, 2], -1, 1))) for r in (taken, other)]
    tilted = tilts[0] > _TILTED_RAD and tilts[1] < _UPRIGHT_RAD
    flipped = taken.magnitude() > _FAR_RAD and other.magnitude() < _NEAR_RAD
    if tilted or (flipped and tilts[0] > tilts[1] - _LEVEL_RAD):
        angles = tilts if tilted else [float(r.magnitude()) for r in (taken, other)]
        wrong, right = (f"{angle:.0f}" for angle in np.rad2deg(angles))
        raise ConfigError(
            f"{label}: read as w x y z its orientation is {'tilted' if tilted else 'turned'} by "
            f"{wrong} degrees from the object's resting orientation, as x y z w only by {right}; "
            f"{cure}"
        )


def _meaning(name: str) -> str:
    text = name.strip().lower()
    if re.fullmatch(_TIME, text):
        return "time"
    if found := re.fullmatch(_TURN, text):
        return f"q{found[1]}"
    place = re.fullmatch(_PLACE, text)
    return place[1] if place else ""
