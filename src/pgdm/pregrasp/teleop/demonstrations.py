"""Reads tele-operated demonstrations from DAPG pickles and Minari datasets without running code.

Only the observations are read, which is all that a pre-grasp needs. docs/pregrasps/teleop.md
describes the file formats.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from pgdm.errors import ConfigError, CorruptAssetError, UnknownNameError
from pgdm.library.files import pickles as safe_pickle
from pgdm.library.files.motion import numbers
from pgdm.library.files.pickles import reason

PICKLES = (".pickle", ".pkl")
HDF5 = (".hdf5", ".h5")
MINARI_FILE = Path("data", "main_data.hdf5")
"""Path of the episodes' file in the folder of a Minari dataset."""
MAX_STEPS = 1_000_000


@dataclass(frozen=True)
class Demonstration:
    """The observations of one demonstration."""

    number: int
    """Number in the file, from 0."""
    observations: np.ndarray = field(repr=False)
    """(T, D), one row per control step."""


def read(path: Path) -> list[Demonstration]:
    """Read all demonstrations of a file.

    Args:
        path: a DAPG ``.pickle`` (or ``.pkl``), a Minari ``.hdf5`` (or ``.h5``), or the folder of a
            Minari dataset.

    Raises:
        UnknownNameError: the extension is unknown.
        UnsafePickleError: the pickle contains more than arrays, containers, strings and numbers.
        CorruptAssetError: the file is missing, damaged, or holds no demonstrations.
    """
    if path.is_dir():
        inside = [path / MINARI_FILE, path / MINARI_FILE.name]
        path = next((p for p in inside if p.is_file()), inside[0])
    readers: dict[str, Callable[[Path], list[Demonstration]]] = {
        **dict.fromkeys(PICKLES, _read_pickle),
        **dict.fromkeys(HDF5, _read_hdf5),
    }
    if path.suffix.lower() not in readers:
        raise UnknownNameError(f"extension of {path.name}", path.suffix, readers)
    found = readers[path.suffix.lower()](path)
    if not found:
        raise CorruptAssetError(f"{path}: contains no demonstrations")
    return found


def chosen(demonstrations: list[Demonstration], number: int, label: str) -> Demonstration:
    """Return the demonstration with a given number.

    Raises:
        ConfigError: there is no such demonstration.
    """
    by_number = {one.number: one for one in demonstrations}
    if number not in by_number:
        raise ConfigError(
            f"demonstration {number} is not in {label}: it has {min(by_number)} to {max(by_number)}"
        )
    return by_number[number]


def _read_pickle(path: Path) -> list[Demonstration]:
    content = safe_pickle.read_pickle(path)
    if not isinstance(content, list | tuple):
        raise CorruptAssetError(f"{path}: is not a list of demonstrations")
    return [_checked(demo, i, f"{path}, demonstration {i}") for i, demo in enumerate(content)]


def _read_hdf5(path: Path) -> list[Demonstration]:
    if not path.is_file():
        raise CorruptAssetError(f"{path}: no such file")
    found = []
    try:
        with h5py.File(path, "r") as file:
            for name, group in file.items():
                number = _number(str(name))
                if number is None:
                    continue
                label = f"{path}, {name}"
                data = group.get("observations") if isinstance(group, h5py.Group) else None
                if not isinstance(data, h5py.Dataset) or (data.size or 0) > 100 * MAX_STEPS:
                    raise CorruptAssetError(
                        f"{label}: array 'observations' is missing or too large"
                    )
                found.append(_checked({"observations": data[()]}, number, label))
    except (OSError, RuntimeError, KeyError) as error:
        raise CorruptAssetError(f"{path}: not readable as HDF5 ({reason(error)})") from error
    return sorted(found, key=lambda one: one.number)


def _number(name: str) -> int | None:
    """Return N for the name ``episode_N`` of an HDF5 group, None for any other name."""
    kind, _, number = name.partition("_")
    return int(number) if kind == "episode" and number.isdecimal() else None


def _checked(demo: Any, number: int, label: str) -> Demonstration:
    if not isinstance(demo, Mapping):
        raise CorruptAssetError(f"{label}: not a dict of arrays")
    observations = numbers(demo, "observations", label, (None, None))
    if not 1 <= len(observations) <= MAX_STEPS:
        raise CorruptAssetError(f"{label}: {len(observations)} steps; 1 to {MAX_STEPS} are read")
    return Demonstration(number, observations)
