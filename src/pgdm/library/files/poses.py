"""Reading a user's recorded motion of an object from a CSV, NPZ or JSON file."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from pgdm import files
from pgdm.errors import ConfigError, CorruptAssetError, amount
from pgdm.library.files import columns, npz
from pgdm.library.files.columns import Table
from pgdm.library.files.keyframes import LONGEST_S, continuous
from pgdm.library.tasks import STEP_S

SUFFIXES = (".csv", ".npz", ".json")
"""Supported formats."""

# Deviation of a quaternion's norm from 1: up to the first limit it is ignored, up to the second the
# quaternion is normalised, beyond that it is an error.
_UNIT_TOLERANCE, _UNIT_LIMIT = 1e-6, 0.05
_ROWS = (2, 1_000_000)
_PARTS = ("poses", "object", "time", "columns")


@dataclass(frozen=True)
class PoseFile:
    """A recorded motion, resampled to the control step."""

    pos: np.ndarray = field(repr=False)
    """(T, 3) m, world frame."""
    quat: np.ndarray = field(repr=False)
    """(T, 4) unit quaternions wxyz; consecutive ones have non-negative dot products."""
    repairs: list[str]
    """What was assumed or changed, one sentence each."""
    named: bool = True
    """Whether the file states the order of a quaternion's components."""


def read(path: Path) -> PoseFile:
    """Read poses: rows with named columns, or with x y z qw qx qy qz after an optional time.

    A header line names the columns of a ``.csv``. A ``.json`` is a list of rows, each a list or a
    JSON object with named values; or it has ``poses`` and optionally ``time`` and ``columns``. An
    ``.npz`` has rows in ``poses`` or ``object`` and optionally ``time`` (T,) and ``columns``. Or,
    like the library's motions, the ``.npz`` has ``object_translation`` and ``object_orientation``
    (wxyz); its ``time`` is then ignored. Rows without times are 0.04 s apart.

    Raises:
        ConfigError: the format is not supported, or there is no such file.
        CorruptAssetError: the file is unreadable, columns are missing or unclear, or as for
            :func:`resampled`.
    """
    readers = {".csv": _csv, ".json": _json, ".npz": _npz}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ConfigError(
            f"{path}: format '{path.suffix}' is not supported; valid: {', '.join(SUFFIXES)}"
        )
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such file")
    table = reader(path)
    found = resampled(table.rows, table.times, str(path))
    return replace(found, repairs=[*table.notes, *found.repairs], named=table.named)


def resampled(rows: np.ndarray, times: np.ndarray | None, label: str) -> PoseFile:
    """Check rows and resample them to one row per control step.

    Args:
        rows: (N, 7) position m and quaternion wxyz.
        times: (N,) s, or None for rows that are 0.04 s apart.
        label: the file's name in messages.

    Raises:
        CorruptAssetError: there are fewer than two or over a million rows, a value is NaN or
            infinite, a quaternion's norm deviates from 1 by more than 0.05, times do not increase,
            or the motion lasts less than 0.04 s or more than an hour; if one row is to blame, the
            message names it.
    """
    repairs: list[str] = []
    if rows.ndim != 2 or rows.shape[1] != 7 or not _ROWS[0] <= len(rows) <= _ROWS[1]:
        raise CorruptAssetError(
            f"{label}: poses have shape {rows.shape}, expected (N, 7): position and wxyz, N from 2 "
            "to 1,000,000"
        )
    if bad := _first(~np.isfinite(rows).all(axis=1)):
        raise CorruptAssetError(f"{label}: row {bad - 1} has a NaN or infinite value")
    norms = np.linalg.norm(rows[:, 3:], axis=1)
    off: np.ndarray = np.abs(norms - 1.0)
    if bad := _first(off > _UNIT_LIMIT):
        raise CorruptAssetError(
            f"{label}: row {bad - 1} has a quaternion of norm {norms[bad - 1]:.4g}, not 1 "
            "(order: w x y z)"
        )
    if off.max() > _UNIT_TOLERANCE:
        repairs.append(f"normalised quaternions, whose norms were off by up to {off.max():.2g}")
    pos, quat = rows[:, :3], continuous(rows[:, 3:] / norms[:, None])
    if times is None:
        return PoseFile(pos, quat, repairs)
    _check_times(times, len(rows), label)
    elapsed: np.ndarray = np.asarray(times - times[0])
    if np.allclose(np.diff(elapsed), STEP_S, atol=1e-6):
        return PoseFile(pos, quat, repairs)
    # The last of these products may exceed the last time by a rounding error.
    wanted = np.minimum(STEP_S * np.arange(int(elapsed[-1] / STEP_S + 1e-9) + 1), elapsed[-1])
    repairs.append(
        f"resampled {len(rows)} rows over {elapsed[-1]:.2f} s to {len(wanted)} rows "
        f"{STEP_S:g} s apart"
    )
    orientations = Slerp(elapsed, Rotation.from_quat(quat, scalar_first=True))(wanted)
    quat = continuous(orientations.as_quat(scalar_first=True))
    return PoseFile(np.asarray(CubicSpline(elapsed, pos)(wanted)), quat, repairs)


def _check_times(times: np.ndarray, count: int, label: str) -> None:
    if times.shape != (count,) or not np.isfinite(times).all():
        raise CorruptAssetError(
            f"{label}: has {amount(times.size, 'time')}, needs {count} finite ones"
        )
    if bad := _first(np.diff(times) <= 0):
        raise CorruptAssetError(
            f"{label}: row {bad} has time {times[bad]:g} s, not after {times[bad - 1]:g} s"
        )
    if not STEP_S <= times[-1] - times[0] <= LONGEST_S:
        raise CorruptAssetError(
            f"{label}: lasts {times[-1] - times[0]:g} s; valid: {STEP_S:g} to {LONGEST_S:g} s"
        )


def _first(wrong: Any) -> int:
    """Return the position of the first True, counted from 1; 0 if all are False."""
    return int(wrong.argmax()) + 1 if wrong.any() else 0


def _csv(path: Path) -> Table:
    try:
        text = files.read_text(path, files.MOST_JSON_BYTES).removeprefix("\ufeff")
        rows = csv.reader(text.splitlines())
        lines = [line for line in rows if any(cell.strip() for cell in line)]
    except (OSError, ValueError, csv.Error) as error:
        raise CorruptAssetError(f"{path}: cannot be read ({files.reason(error)})") from error
    names: list[str] = []
    while lines and not names and not _is_number(lines[0][0]):
        names = _header(lines.pop(0))
    widths = {len(line) for line in lines}
    if widths not in ([{len(names)}] if names else [{7}, {8}]):
        expected = len(names) or "7 (x y z qw qx qy qz) or 8 (time before them)"
        raise CorruptAssetError(
            f"{path}: columns of the rows: {' and '.join(map(str, sorted(widths))) or 0}, expected "
            f"{expected}"
        )
    for i, line in enumerate(lines):
        if wrong := [cell for cell in line if not _is_number(cell)]:
            raise CorruptAssetError(f"{path}: row {i} has '{wrong[0]}', not a number")
    rows = np.array([[float(cell) for cell in line] for line in lines])
    return columns.by_name(rows, names, str(path)) if names else columns.by_place(rows)


def _header(line: list[str]) -> list[str]:
    """Return the column names in a line; none if it is a comment without known names."""
    if not line[0].lstrip().startswith("#"):
        return [cell.strip() for cell in line]
    names = [name for name in re.split(r"[#,\s]+", ",".join(line)) if name]
    return names if columns.known(names) else []


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _json(path: Path) -> Table:
    try:
        content = files.read_json(path)
        parts = content if isinstance(content, dict) else {"poses": content}
        rows, names, times = parts["poses"], parts.get("columns"), parts.get("time")
        if rows and isinstance(rows, list) and isinstance(rows[0], dict) and names is None:
            names = list(rows[0])
            rows = [[row[name] for name in names] for row in rows]
        table = np.array(rows, np.float64)
        stated = None if times is None else np.array(times, np.float64)
    except KeyError as error:
        raise CorruptAssetError(f"{path}: lacks {error}") from error
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise CorruptAssetError(
            f"{path}: cannot be read as poses ({files.reason(error)})"
        ) from error
    return _with_names(table, stated, names, parts, path)


def _npz(path: Path) -> Table:
    arrays = npz.read_npz(path)
    times = _array(arrays, "time", path).reshape(-1) if "time" in arrays else None
    if "object_translation" in arrays:  # as in the library: one row per control step
        pos = _array(arrays, "object_translation", path)
        quat = _array(arrays, "object_orientation", path)
        if pos.ndim != 2 or pos.shape[1:] != (3,) or quat.shape != (len(pos), 4):
            raise CorruptAssetError(
                f"{path}: object_translation {pos.shape} and object_orientation {quat.shape}, "
                "expected (T, 3) and (T, 4)"
            )
        return Table(np.concatenate((pos, quat), axis=1), None, True, [])
    for name in ("poses", "object"):
        if name in arrays:
            rows, names = _array(arrays, name, path), arrays.get("columns")
            return _with_names(rows, times, names, {**arrays, "poses": rows}, path)
    raise CorruptAssetError(
        f"{path}: has neither 'poses', 'object' nor 'object_translation'; it has "
        f"{', '.join(sorted(arrays)) or 'nothing'}"
    )


def _with_names(
    rows: np.ndarray, times: np.ndarray | None, names: Any, parts: Mapping[str, Any], path: Path
) -> Table:
    """Return a table, given the file's column names or None; note the file's other keys."""
    if names is None:
        table = columns.by_place(rows, times)
    elif isinstance(names, list) and not all(isinstance(name, str) for name in names):
        raise CorruptAssetError(f"{path}: columns are {names!r:.60}, not a list of names")
    else:
        table = columns.by_name(rows, [str(name) for name in np.ravel(names)], str(path))
        if times is not None and table.times is not None:
            raise CorruptAssetError(f"{path}: has times in 'time' and in a column; keep one")
    others = sorted(str(key) for key in parts if key not in _PARTS)
    notes = [*table.notes, *([f"left out {', '.join(others)}"] if others else [])]
    return replace(table, times=table.times if times is None else times, notes=notes)


def _array(arrays: Mapping[str, Any], name: str, path: Path) -> np.ndarray:
    value = np.asarray(arrays.get(name, ()))
    if value.dtype.kind not in "iuf":
        raise CorruptAssetError(f"{path}: '{name}' is not numeric (dtype {value.dtype})")
    return value.astype(np.float64)
