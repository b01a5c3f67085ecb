"""Reading a recorded motion of an object from a file of poses."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, Slerp

from pgdm.errors import ConfigError, CorruptAssetError
from pgdm.library import safe_npz
from pgdm.library.animate import LONGEST_S, STEP_S, continuous

SUFFIXES = (".csv", ".npz", ".json")
"""Formats that are read."""

_UNIT_TOLERANCE, _UNIT_LIMIT = 1e-6, 0.05  # norms: silently unit, and repaired with a word
_ROWS = (2, 1_000_000)


@dataclass(frozen=True)
class PoseFile:
    """A motion as it was recorded, resampled to the control step."""

    pos: np.ndarray = field(repr=False)
    """(T, 3) m, world frame."""
    quat: np.ndarray = field(repr=False)
    """(T, 4) unit, wxyz, neighbours never pointing apart."""
    repairs: list[str]
    """What was changed, a sentence each."""


def read(path: Path) -> PoseFile:
    """Read poses: rows of x y z qw qx qy qz, with an optional time in front.

    A ``.csv`` may have a line of names. A ``.json`` is a list of rows, or has ``poses`` and an
    optional ``time``. An ``.npz`` has ``poses`` or ``object`` (T, 7) and an optional ``time``
    (T,), or, as the library's own motions, ``object_translation`` and ``object_orientation``.
    Rows without times are 0.04 s apart.

    Raises:
        ConfigError: the format is not read, or there is no such file.
        CorruptAssetError: it holds no poses, NaN, no quaternions, or times that do not grow.
    """
    readers = {".csv": _csv, ".json": _json, ".npz": _npz}
    reader = readers.get(path.suffix.lower())
    if reader is None:
        raise ConfigError(
            f"{path}: format '{path.suffix}' is not read; valid: {', '.join(SUFFIXES)}"
        )
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such file")
    rows, times = reader(path)
    return resampled(rows, times, str(path))


def resampled(rows: np.ndarray, times: np.ndarray | None, label: str) -> PoseFile:
    """Check rows and bring them to one a control step.

    Args:
        rows: (N, 7) position m and quaternion wxyz.
        times: (N,) s, or None for rows that are 0.04 s apart.
        label: the file's name, for messages.

    Raises:
        CorruptAssetError: a row cannot be a pose; names it.
    """
    repairs: list[str] = []
    if rows.ndim != 2 or rows.shape[1] != 7 or not _ROWS[0] <= len(rows) <= _ROWS[1]:
        raise CorruptAssetError(
            f"{label}: poses have shape {rows.shape}, expected (N, 7): position and wxyz, N from 2"
        )
    if bad := _first(~np.isfinite(rows).all(axis=1)):
        raise CorruptAssetError(f"{label}: row {bad - 1} has a NaN or infinite value")
    norms = np.linalg.norm(rows[:, 3:], axis=1)
    off: np.ndarray = np.abs(norms - 1.0)
    if bad := _first(off > _UNIT_LIMIT):
        raise CorruptAssetError(
            f"{label}: row {bad - 1} has a quaternion of norm {norms[bad - 1]:.4g}, not a unit one "
            "(order: w x y z)"
        )
    if off.max() > _UNIT_TOLERANCE:
        repairs.append(f"normalised quaternions, whose norms were up to {off.max():.2g} off 1")
    pos, quat = rows[:, :3], continuous(rows[:, 3:] / norms[:, None])
    if times is None:
        return PoseFile(pos, quat, repairs)
    _check_times(times, len(rows), label)
    elapsed: np.ndarray = np.asarray(times - times[0])
    if np.allclose(np.diff(elapsed), STEP_S, atol=1e-6):
        return PoseFile(pos, quat, repairs)
    wanted = STEP_S * np.arange(int(elapsed[-1] / STEP_S + 1e-9) + 1)
    repairs.append(
        f"resampled {len(rows)} rows over {elapsed[-1]:.2f} s to {len(wanted)}, {STEP_S:g} s apart"
    )
    turns = Slerp(elapsed, Rotation.from_quat(quat, scalar_first=True))(wanted)
    quat = continuous(turns.as_quat(scalar_first=True))
    return PoseFile(np.asarray(CubicSpline(elapsed, pos)(wanted)), quat, repairs)


def _check_times(times: np.ndarray, count: int, label: str) -> None:
    if times.shape != (count,) or not np.isfinite(times).all():
        raise CorruptAssetError(f"{label}: has {times.size} finite times for {count} rows")
    if bad := _first(np.diff(times) <= 0):
        raise CorruptAssetError(
            f"{label}: row {bad} has time {times[bad]:g} s, not after {times[bad - 1]:g} s"
        )
    if not STEP_S <= times[-1] - times[0] <= LONGEST_S:
        raise CorruptAssetError(
            f"{label}: lasts {times[-1] - times[0]:g} s; valid: {STEP_S:g} to {LONGEST_S:g} s"
        )


def _first(wrong: Any) -> int:
    """Return the number of the first True, from 1; 0 if there is none."""
    return int(wrong.argmax()) + 1 if wrong.any() else 0


def _csv(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            lines = [line for line in csv.reader(stream) if any(cell.strip() for cell in line)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CorruptAssetError(f"{path}: cannot be read ({error})") from error
    if lines and not _is_number(lines[0][0]):
        lines = lines[1:]
    widths = {len(line) for line in lines}
    if widths not in ({7}, {8}):
        raise CorruptAssetError(
            f"{path}: rows have {' and '.join(map(str, sorted(widths))) or 'no'} columns, expected "
            "7 (x y z qw qx qy qz) or 8 (time before them)"
        )
    for i, line in enumerate(lines):
        if wrong := [cell for cell in line if not _is_number(cell)]:
            raise CorruptAssetError(f"{path}: row {i} has '{wrong[0]}', not a number")
    return _split(np.array([[float(cell) for cell in line] for line in lines]))


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return False
    return True


def _split(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray | None]:
    """Part the time column from the poses, if there is one."""
    if rows.ndim == 2 and rows.shape[1] == 8:
        return rows[:, 1:], rows[:, 0]
    return rows, None


def _json(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if isinstance(content, dict):
            rows, times = content["poses"], content.get("time")
        else:
            rows, times = content, None
        table = np.array(rows, np.float64)
        stated = None if times is None else np.array(times, np.float64)
    except KeyError as error:
        raise CorruptAssetError(f"{path}: lacks {error}") from error
    except (OSError, ValueError, TypeError, RecursionError) as error:
        raise CorruptAssetError(f"{path}: cannot be read as poses ({error})") from error
    return (table, stated) if stated is not None else _split(table)


def _npz(path: Path) -> tuple[np.ndarray, np.ndarray | None]:
    arrays = safe_npz.read_npz(path)
    times = _array(arrays, "time", path).reshape(-1) if "time" in arrays else None
    if "object_translation" in arrays:  # the library's own motions: one row a control step
        pos = _array(arrays, "object_translation", path)
        quat = _array(arrays, "object_orientation", path)
        if pos.ndim != 2 or pos.shape[1:] != (3,) or quat.shape != (len(pos), 4):
            raise CorruptAssetError(
                f"{path}: object_translation {pos.shape} and object_orientation {quat.shape}, "
                "expected (T, 3) and (T, 4)"
            )
        return np.concatenate((pos, quat), axis=1), None
    for name in ("poses", "object"):
        if name in arrays:
            rows, own = _split(_array(arrays, name, path))
            return rows, times if own is None else own
    raise CorruptAssetError(
        f"{path}: has neither 'poses', 'object' nor 'object_translation'; it has "
        f"{', '.join(sorted(arrays)) or 'nothing'}"
    )


def _array(arrays: Mapping[str, Any], name: str, path: Path) -> np.ndarray:
    value = np.asarray(arrays.get(name, ()))
    if value.dtype.kind not in "iuf":
        raise CorruptAssetError(f"{path}: '{name}' is not numeric (dtype {value.dtype})")
    return value.astype(np.float64)
