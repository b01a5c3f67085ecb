"""The index of the library's expert hand trajectories: origin and quality of each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pgdm.library import manifest as manifests
from pgdm.library.manifest import FileEntry

FORMAT = 1
"""Version of the library's folder ``experts``: of its layout and of the code that fills it."""

_CURE = "fetch the expert trajectories again with 'pgdm assets fetch --experts'"


@dataclass(frozen=True)
class ExpertEntry:
    """One task's expert trajectory: provenance and quality."""

    file: FileEntry
    """Hash, size and licence of its file, and the path inside the package."""
    package: str
    """Package from which it was made, with version and hash."""
    approximate: bool
    """True if rebuilt from another recording of the same motion, False if published."""
    steps: int
    """Number of rows T, one for each pose of the motion."""
    skipped: int
    """Number of frames of the recording before the motion's first pose."""
    shift_m: list[float]
    """Offset (3,) m, world frame, added to the recorded positions so that the object is where the
    motion has it."""
    object_mean_m: float
    """Distance between the motion and the recorded object after ``shift_m``, mean over poses."""
    object_max_m: float
    """Largest distance between the motion and the recorded object after ``shift_m``."""
    beyond_limits_m: float
    """Largest excess of the base's slides over their limits."""
    beyond_limits_rad: float
    """Largest excess of the hinges over their limits."""
    touching_frames: int
    """Number of poses at which the hand touches the object according to the recording; all
    poses if the recording has no contact flag."""
    contact_frames: list[int]
    """Of the ``touching_frames`` poses, the number with each finger in contact (index, middle,
    little, ring, thumb)."""
    within_5mm: list[float]
    """Of the ``touching_frames`` poses, the share with each finger less than 5 mm from the
    object."""


@dataclass(frozen=True)
class ExpertIndex:
    """Content of ``manifest.json`` in the folder of the expert trajectories."""

    made_at: str
    """UTC time, ISO 8601."""
    experts: dict[str, ExpertEntry]
    """Expert trajectories by task id."""
    left_out: dict[str, str]
    """Motion-capture tasks for which no trajectory is stored, with the reason."""
    format: int = FORMAT
    """Layout version."""


def write(folder: Path, index: ExpertIndex) -> None:
    """Write the index into the folder of the expert trajectories."""
    manifests.write_json(folder / manifests.NAME, index)


def read(folder: Path) -> ExpertIndex:
    """Read the index.

    Raises:
        CorruptAssetError: the index is missing, damaged or of another format.
    """
    return manifests.read_json(folder / manifests.NAME, _from_json, FORMAT, _CURE)


def _from_json(data: dict[str, Any]) -> ExpertIndex:
    experts = {
        task: ExpertEntry(**{**entry, "file": FileEntry(**entry["file"])})
        for task, entry in data["experts"].items()
    }
    return ExpertIndex(**{**data, "experts": experts})
