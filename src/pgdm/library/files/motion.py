"""Exemplar motions in the library's format: plain arrays, checked when read and written."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pgdm.errors import CorruptAssetError, amount
from pgdm.library.files import npz

STARTS = ("planned", "mined", "learned")
"""Names of the start states that may be stored with a motion."""

_UNIT_TOLERANCE = 1e-3
"""Largest deviation of a stored quaternion's norm from 1; the released files are within 1e-6."""


@dataclass(frozen=True)
class Start:
    """A start state of the whole scene: hand joints first, then the objects'."""

    qpos: np.ndarray = field(repr=False)
    """Joint positions (nq,), m and rad."""
    qvel: np.ndarray = field(repr=False)
    """Joint velocities (nv,), m/s and rad/s."""
    actions: np.ndarray | None = field(repr=False)
    """Actions (K, nu) in [-1, 1] of the reach plan that leads to this state, None if not stored."""


@dataclass(frozen=True)
class Motion:
    """An exemplar motion of an object, with the start states stored next to it."""

    id: str
    """Task id the motion belongs to."""
    source: str
    """Library source from which it was read, such as ``checkout``."""
    translation: np.ndarray = field(repr=False)
    """Target of the centre of mass (T, 3) m, world frame. In the benchmark's recorded motions
    it holds positions of the mesh's origin, which the released code nevertheless uses as the target
    of the centre of mass; see `ReferenceCfg.frame`."""
    orientation: np.ndarray = field(repr=False)
    """Target of the object body's orientation (T, 4), unit quaternion wxyz."""
    substeps: int
    """Physics steps per control step."""
    starts: Mapping[str, Start] = field(repr=False)
    """Stored start states by name, see :data:`STARTS`."""
    sha256: str
    """Hash of the motion's file in the library."""


def check(
    arrays: Mapping[str, Any], label: str
) -> tuple[np.ndarray, np.ndarray, int, dict[str, Start]]:
    """Check the arrays of a motion's file.

    Args:
        arrays: arrays of the file.
        label: the file's name in messages.

    Returns:
        Translation (T, 3) m, orientation (T, 4) wxyz, physics steps per control step, start states
        by name.

    Raises:
        CorruptAssetError: an array is missing, has a wrong shape, or is not finite; there are fewer
            than two poses; a quaternion is not unit; or ``substeps`` is not a whole number from 1
            to 1000.
    """
    translation = numbers(arrays, "object_translation", label, (None, 3))
    steps = len(translation)
    if steps < 2:
        raise CorruptAssetError(
            f"{label}: object_translation has {amount(steps, 'row')}, needs 2 or more"
        )
    orientation = numbers(arrays, "object_orientation", label, (steps, 4))
    check_unit(orientation, "object_orientation", label)
    substeps = float(numbers(arrays, "substeps", label, ()))
    if not 1 <= substeps <= 1000 or substeps != int(substeps):
        raise CorruptAssetError(
            f"{label}: substeps is {substeps}, not a whole number from 1 to 1000"
        )
    starts = {}
    for name in STARTS:
        if f"start_{name}_qpos" in arrays:
            starts[name] = start(arrays, f"start_{name}", label)
    return translation, orientation, int(substeps), starts


def check_unit(quaternions: np.ndarray, key: str, label: str) -> None:
    """Check that quaternions (T, 4) have norm 1, to within 0.001.

    Raises:
        CorruptAssetError: one does not; the message names the worst row.
    """
    norms = np.linalg.norm(quaternions, axis=1)
    worst = int(np.abs(norms - 1.0).argmax())
    if abs(norms[worst] - 1.0) > _UNIT_TOLERANCE:
        raise CorruptAssetError(
            f"{label}: {key} row {worst} has norm {norms[worst]:.4g}, not a unit quaternion"
        )


def start(arrays: Mapping[str, Any], prefix: str, label: str) -> Start:
    """Return the start state from the arrays whose names begin with a prefix.

    Raises:
        CorruptAssetError: an array is missing, has a wrong shape, or is not finite.
    """
    qpos = numbers(arrays, f"{prefix}_qpos", label, (None,))
    # All joints have one degree of freedom, so there are as many velocities as positions.
    qvel = numbers(arrays, f"{prefix}_qvel", label, (len(qpos),))
    actions = None
    if f"{prefix}_actions" in arrays:
        actions = numbers(arrays, f"{prefix}_actions", label, (None, None))
    return Start(qpos, qvel, actions)


def pack_start(start: Start, prefix: str) -> dict[str, np.ndarray]:
    """Return the arrays of a start state, with names that begin with a prefix."""
    arrays = {
        f"{prefix}_qpos": np.asarray(start.qpos, np.float64),
        f"{prefix}_qvel": np.asarray(start.qvel, np.float64),
    }
    if start.actions is not None:
        arrays[f"{prefix}_actions"] = np.asarray(start.actions, np.float64)
    return arrays


def numbers(
    arrays: Mapping[str, Any], key: str, label: str, shape: tuple[int | None, ...]
) -> np.ndarray:
    """Return a finite float64 array of a given shape, where None stands for any length.

    Raises:
        CorruptAssetError: the array is missing, not numeric, of another shape, or not finite.
    """
    if key not in arrays:
        raise CorruptAssetError(f"{label}: lacks '{key}'; it has {', '.join(sorted(arrays))}")
    value = np.asarray(arrays[key])
    if value.dtype.kind not in "biuf":
        raise CorruptAssetError(f"{label}: '{key}' is not numeric (dtype {value.dtype})")
    fits = value.ndim == len(shape) and all(
        want is None or want == have for want, have in zip(shape, value.shape, strict=True)
    )
    if not fits:
        wanted = str(tuple("any" if n is None else n for n in shape)).replace("'", "")
        raise CorruptAssetError(f"{label}: '{key}' has shape {value.shape}, expected {wanted}")
    value = value.astype(np.float64)
    if not np.isfinite(value).all():
        where = tuple(int(i) for i in np.argwhere(~np.isfinite(value))[0])
        raise CorruptAssetError(f"{label}: '{key}' has a NaN or infinite value at {where}")
    return value


def pack(
    translation: np.ndarray, orientation: np.ndarray, substeps: int, starts: Mapping[str, Start]
) -> dict[str, np.ndarray]:
    """Return the arrays of a motion's file."""
    arrays = {
        "object_translation": np.asarray(translation, np.float64),
        "object_orientation": np.asarray(orientation, np.float64),
        "substeps": np.asarray(substeps, np.int64),
    }
    for name, start in starts.items():
        arrays |= pack_start(start, f"start_{name}")
    return arrays


def write(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Check and write a motion; equal arrays always give equal bytes.

    Raises:
        CorruptAssetError: as for :func:`check`.
    """
    check(arrays, path.name)
    npz.write_npz(path, arrays)


def read(path: Path, motion_id: str, source: str) -> Motion:
    """Read a motion.

    Raises:
        CorruptAssetError: the file is missing, damaged, or holds invalid values.
    """
    arrays, digest = npz.read_hashed(path)
    translation, orientation, substeps, starts = check(arrays, str(path))
    return Motion(motion_id, source, translation, orientation, substeps, starts, digest)
