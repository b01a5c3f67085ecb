"""The index of the library's expert trajectories: origin and quality of each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pgdm.library import manifest as manifests
from pgdm.library.manifest import FileEntry

FORMAT = 1
"""Version of the folder's layout and of the procedure that fills it."""

_CURE = "fill them again with 'pgdm assets fetch'"


@dataclass(frozen=True)
class ExpertEntry:
    """One task's expert trajectory: provenance and quality."""

    file: FileEntry
    """Hash and size of its file; origin inside the package, licence."""
    package: str
    """Package it came from, with version and hash."""
    approximate: bool
    """Whether it was rebuilt from another recording of the same motion, not published."""
    steps: int
    """Rows T, one for each pose of the motion."""
    skipped: int
    """Frames k of the recording before the motion's first pose."""
    shift_m: list[float]
    """Offset (3,) m, world frame, added to the recorded positions so that the object is where the
    motion has it."""
    object_mean_m: float
    """Distance of the recording's object from the motion's after that, mean over the poses."""
    object_max_m: float
    """Largest such distance over the poses."""
    beyond_limits_m: float
    """How far the base's slides exceed their limits at most."""
    beyond_limits_rad: float
    """How far the hinges exceed their limits at most."""
    touching_frames: int
    """Poses at which the hand touches the object according to the recording."""
    contact_frames: list[int]
    """Touching poses with the finger in contact, by finger (fore, middle, little, ring, thumb)."""
    within_5mm: list[float]
    """Share of the touching poses with the finger within 5 mm of the object, by finger."""


@dataclass(frozen=True)
class ExpertIndex:
    """Content of the folder's ``manifest.json``."""

    made_at: str
    """UTC time, ISO 8601."""
    experts: dict[str, ExpertEntry]
    """Expert trajectories by task id."""
    left_out: dict[str, str]
    """Tasks without one that the package should have, with the reason."""
    format: int = FORMAT
    """Layout version."""


def write(folder: Path, index: ExpertIndex) -> None:
    """Write the index into the folder of the expert trajectories."""
    manifests.write_json(folder / manifests.NAME, index)


def read(folder: Path) -> ExpertIndex:
    """Read the index.

    Raises:
        CorruptAssetError: it is missing, damaged or of another format.
    """
    return manifests.read_json(folder / manifests.NAME, _from_json, FORMAT, _CURE)


def _from_json(data: dict[str, Any]) -> ExpertIndex:
    experts = {
        task: ExpertEntry(**{**entry, "file": FileEntry(**entry["file"])})
        for task, entry in data["experts"].items()
    }
    return ExpertIndex(**{**data, "experts": experts})
