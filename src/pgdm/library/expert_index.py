"""The index of the library's expert trajectories: where each came from, and how good it is."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

from pgdm.errors import CorruptAssetError
from pgdm.library import manifest as manifests
from pgdm.library.manifest import FileEntry

FORMAT = 1
"""Version of the folder's layout and of the recipe that makes it."""

CURE = "make them anew with 'pgdm assets fetch'"
"""What to do when the index cannot be read."""


@dataclass(frozen=True)
class ExpertEntry:
    """One task's expert trajectory: provenance and quality figures."""

    file: FileEntry
    """Hash and size of its file; origin inside the package, licence."""
    package: str
    """Package it came from, with version and hash."""
    approximate: bool
    """Whether it was rebuilt from another recording of the same motion, not published."""
    steps: int
    """Rows T, one for each pose of the motion."""
    skipped: int
    """Frames k of the recording that lie before the motion's first pose."""
    shift_m: list[float]
    """What was added to the recorded positions (3,) m, world frame, to bring its object to the
    motion's."""
    object_mean_m: float
    """Distance of the recording's object from the motion's after that, mean over the poses."""
    object_max_m: float
    """The same, largest."""
    beyond_limits_m: float
    """How far the base's sliding joints leave their limits at most."""
    beyond_limits_rad: float
    """How far the turning joints leave their limits at most."""
    touching_frames: int
    """Poses at which the recording says that the hand touches the object."""
    contact_frames: list[int]
    """Of these, by finger (fore, middle, little, ring, thumb): poses with the finger in contact."""
    within_5mm: list[float]
    """By finger: share of the touching poses with the finger within 5 mm of the object."""


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
    text = json.dumps(asdict(index), indent=1, sort_keys=True)
    (folder / manifests.NAME).write_text(text + "\n", encoding="utf-8")


def read(folder: Path) -> ExpertIndex:
    """Read the index.

    Raises:
        CorruptAssetError: it is missing, damaged or of another format.
    """
    path = folder / manifests.NAME
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["format"] != FORMAT:
            raise CorruptAssetError(f"{path}: format {data['format']!r}; {CURE}")
        experts = {
            task: ExpertEntry(**{**entry, "file": FileEntry(**entry["file"])})
            for task, entry in data["experts"].items()
        }
        return ExpertIndex(**{**data, "experts": experts})
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CorruptAssetError(f"{path}: unreadable manifest ({error}); {CURE}") from error
