"""Playbacks: commands of arm and hand over time, in files that are checked when read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from pgdm import files
from pgdm.deploy.limits import JOINTS
from pgdm.deploy.names import check_suffix
from pgdm.errors import ConfigError, PgdmError, amount
from pgdm.library.files import npz
from pgdm.paths import replacing

FORMAT = "pgdm-playback-1"
MOST_SAMPLES = 100_000
MOST_BYTES = 1 << 26
_FEWEST = 6  # samples that a quintic spline needs
_UNIT = 1e-3  # tolerance of the norm of unit quaternions
_MOST_RATE_HZ = 1000.0


class PlaybackError(PgdmError):
    """A file is missing, damaged or not a playback, or a playback does not fit its task."""


@dataclass(frozen=True)
class Playback:
    """A playback of K samples. World frame: origin on the table top, z up; quaternions wxyz."""

    time_s: np.ndarray = field(repr=False)  # (K,) increasing from 0
    arm_joints_rad: np.ndarray = field(repr=False)  # (K, 7) commanded
    hand_joints_rad: np.ndarray = field(repr=False)  # (K, h) commanded
    base_pos_m: np.ndarray = field(repr=False)  # (K, 3) hand's mount body, as to follow
    base_quat: np.ndarray = field(repr=False)  # (K, 4)
    object_pos_m: np.ndarray = field(repr=False)  # (K, 3) centre of mass, expected
    object_quat: np.ndarray = field(repr=False)  # (K, 4)
    arm_joints: tuple[str, ...]
    """Names of the arm's joints, (7,)."""
    hand_joints: tuple[str, ...]
    """Names of the hand's joints, (h,), without the six base joints."""
    facts: dict[str, Any]
    """Where the playback comes from (task, run, settings), and where arm, hand and table are: plain
    values."""

    @property
    def duration_s(self) -> float:
        """Length, s."""
        return float(self.time_s[-1])


_WIDTHS: dict[str, int | None] = {
    "arm_joints_rad": len(JOINTS),
    "hand_joints_rad": None,
    "base_pos_m": 3,
    "base_quat": 4,
    "object_pos_m": 3,
    "object_quat": 4,
}
_AXES = {3: "xyz", 4: "wxyz"}


def write(path: Path, playback: Playback) -> None:
    """Write a playback as ``.npz`` or ``.csv``, whole or not at all.

    Raises:
        ConfigError: if the name has another suffix, or the file cannot be written.
    """
    check_suffix(path)
    try:
        with replacing(path) as temp:
            if path.suffix == ".csv":
                temp.write_text(_as_csv(playback), encoding="utf-8")
            else:
                npz.write_npz(temp, _as_arrays(playback))
    except OSError as error:
        raise ConfigError(f"{path}: cannot be written ({error.strerror or error})") from error


def read(path: Path) -> Playback:
    """Read and check a playback; no code in the file is run.

    Raises:
        ConfigError: if the name is neither ``.npz`` nor ``.csv``.
        PlaybackError: if the file is missing, damaged or not a playback; the message says why.
    """
    check_suffix(path)
    try:
        if path.suffix == ".csv":
            arrays = _from_csv(files.read_text(path, MOST_BYTES))
        else:
            files.read_bytes(path, MOST_BYTES)
            arrays = npz.read_npz(path)
        return _checked(arrays)
    except PgdmError as error:
        text = str(error)
        raise PlaybackError(text if str(path) in text else f"{path}: {text}") from error
    except (OSError, ValueError, RecursionError) as error:
        raise PlaybackError(f"{path}: is not a playback ({files.reason(error)})") from error


def _as_arrays(playback: Playback) -> dict[str, np.ndarray]:
    arrays = {f.name: getattr(playback, f.name) for f in fields(playback) if f.name in _WIDTHS} | {
        "time_s": playback.time_s
    }
    return arrays | {
        "format": np.array(FORMAT),
        "arm_joints": np.array(playback.arm_joints),
        "hand_joints": np.array(playback.hand_joints),
        "facts": np.array(json.dumps(playback.facts)),
    }


def _columns(arm_joints: tuple[str, ...], hand_joints: tuple[str, ...]) -> dict[str, list[str]]:
    """Return the names of each array's columns in a CSV file."""
    names = {
        "time_s": ["time_s"],
        "arm_joints_rad": [f"{name}_rad" for name in arm_joints],
        "hand_joints_rad": [f"{name}_rad" for name in hand_joints],
    }
    for key, width in _WIDTHS.items():
        if key not in names and width is not None:
            stem, _, unit = key.rpartition("_")
            tail = "_m" if unit == "m" else ""
            stem = key.removesuffix("_m")
            names[key] = [f"{stem}_{axis}{tail}" for axis in _AXES[width]]
    return names


def _as_csv(playback: Playback) -> str:
    arrays = _as_arrays(playback)
    columns = _columns(playback.arm_joints, playback.hand_joints)
    table = np.column_stack([arrays[key] for key in columns])
    lines = [
        f"# {FORMAT}",
        f"# {json.dumps(playback.facts)}",
        ",".join(name for names in columns.values() for name in names),
        *(",".join(f"{value:.10g}" for value in row) for row in table),
    ]
    return "\n".join(lines) + "\n"


def _from_csv(text: str) -> dict[str, Any]:
    lines = text.splitlines()
    if len(lines) < 3 or lines[0] != f"# {FORMAT}" or not lines[1].startswith("# "):
        raise ValueError(f"its first line must be '# {FORMAT}', the second '# ' and a JSON object")
    names = lines[2].split(",")
    if len(lines) - 3 > MOST_SAMPLES:
        raise ValueError(f"{len(lines) - 3} samples, more than the {MOST_SAMPLES} allowed")
    given = [name.removesuffix("_rad") for name in names if name.endswith("_rad")]
    arm, hand = tuple(given[: len(JOINTS)]), tuple(given[len(JOINTS) :])
    columns = _columns(arm, hand)
    if names != [name for group in columns.values() for name in group]:
        raise ValueError(f"its columns are not those of a playback: {lines[2]:.60}...")
    rows = [line.split(",") for line in lines[3:]]
    for number, row in enumerate(rows, 4):
        if len(row) != len(names):
            raise ValueError(f"line {number} has {amount(len(row), 'column')}, not {len(names)}")
    table = np.array(rows, dtype=float).reshape(len(rows), len(names))
    arrays: dict[str, Any] = {"format": FORMAT, "facts": lines[1][2:]}
    first = 0
    for key, group in columns.items():
        part = table[:, first : first + len(group)]
        arrays[key] = part[:, 0] if key == "time_s" else part
        first += len(group)
    return arrays | {"arm_joints": np.array(arm), "hand_joints": np.array(hand)}


def _checked(arrays: Mapping[str, Any]) -> Playback:
    """Return the playback that arrays contain, once they are checked.

    Raises:
        ValueError: if they are not a valid playback.
    """
    wanted = ("format", "time_s", *_WIDTHS, "arm_joints", "hand_joints", "facts")
    if missing := [name for name in wanted if name not in arrays]:
        raise ValueError(f"it lacks {', '.join(missing)}")
    if (found := str(arrays["format"])[:40]) != FORMAT:
        raise ValueError(f"its format is '{found}', not '{FORMAT}'")
    arm, hand = (_names(arrays[key], key) for key in ("arm_joints", "hand_joints"))
    if arm != JOINTS:
        raise ValueError(f"its arm_joints are {', '.join(arm)[:80]}; they must be {JOINTS}")
    time_s = _numbers(arrays["time_s"], "time_s", (None,))
    count = len(time_s)
    if not _FEWEST <= count <= MOST_SAMPLES:
        raise ValueError(f"{amount(count, 'sample')}; it needs {_FEWEST} to {MOST_SAMPLES}")
    if time_s[0] != 0.0:
        raise ValueError(f"time_s begins at {time_s[0]:g}, not at 0")
    steps = np.diff(time_s)
    if steps.min() <= 0:
        row = int(np.argmax(steps <= 0))
        raise ValueError(f"time_s does not increase from sample {row} to {row + 1}")
    if steps.min() < 0.999 / _MOST_RATE_HZ or steps.max() > 1.0:
        raise ValueError(
            f"time_s has steps from {steps.min():.3g} to {steps.max():.3g} s; "
            f"they must be {1 / _MOST_RATE_HZ:g} to 1 s"
        )
    values = {
        key: _numbers(arrays[key], key, (count, width or len(hand)))
        for key, width in _WIDTHS.items()
    }
    for key in ("base_quat", "object_quat"):
        if np.abs(np.linalg.norm(values[key], axis=1) - 1.0).max() > _UNIT:
            raise ValueError(f"{key} has rows that are not unit quaternions")
    facts = files.parse_json(str(arrays["facts"]).encode())
    if not isinstance(facts, dict):
        raise ValueError("its facts are not a JSON object")
    return Playback(time_s, **values, arm_joints=arm, hand_joints=hand, facts=facts)


def _names(value: Any, key: str) -> tuple[str, ...]:
    if not isinstance(value, np.ndarray) or value.dtype.kind != "U" or value.ndim != 1:
        raise ValueError(f"{key} is not a list of names")
    names = tuple(str(name) for name in value)
    if len(set(names)) != len(names) or not all(name.isprintable() and name for name in names):
        raise ValueError(f"{key} has a name that is empty, unprintable or given twice")
    return names


def _numbers(value: Any, key: str, shape: tuple[int | None, ...]) -> np.ndarray:
    if not isinstance(value, np.ndarray) or value.dtype.kind not in "fiu":
        raise ValueError(f"{key} is not an array of numbers")
    fits = value.ndim == len(shape) and all(
        n in (None, m) for n, m in zip(shape, value.shape, strict=True)
    )
    if not fits:
        expected = ", ".join("K" if n is None else str(n) for n in shape)
        raise ValueError(f"{key} has shape {value.shape}, not ({expected})")
    if not np.isfinite(value).all():
        where = np.argwhere(~np.isfinite(value))[0]
        raise ValueError(f"{key} is {value[tuple(where)]} in sample {where[0]}")
    return value.astype(float)
