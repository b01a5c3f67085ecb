"""The index of one library source: what is in it, where from, and every file's hash."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass, field
from pathlib import Path

from pgdm.errors import CorruptAssetError

FORMAT = 1
"""Version of the library's layout; a library of another one must be made anew."""

NAME = "manifest.json"
"""The manifest's file name in a source's folder."""


@dataclass(frozen=True)
class FileEntry:
    """One file of the library."""

    sha256: str
    """Hash of the file as it lies in the library."""
    bytes: int
    """Its size."""
    origin: str
    """Path it was made from, relative to the source's root."""
    licence: str
    """SPDX name of the licence its source gives."""


@dataclass(frozen=True)
class TaskEntry:
    """One task of the library."""

    hand: str
    """Library name of the hand."""
    objects: list[str]
    """Library names of the objects, the followed one first."""
    steps: int
    """Length T of the motion, control steps."""
    starts: list[str]
    """Names of the stored start states."""


@dataclass(frozen=True)
class Manifest:
    """Content of ``manifest.json``."""

    source: str
    """``checkout`` or ``registry``."""
    origin: str
    """Where it came from: a package with version and hash, or a folder's name."""
    imported_at: str
    """UTC time, ISO 8601."""
    defects: list[str] = field(default_factory=list)
    """What was wrong in the source's files and how it was read."""
    files: dict[str, FileEntry] = field(default_factory=dict)
    """Files by path relative to the source's folder."""
    tasks: dict[str, TaskEntry] = field(default_factory=dict)
    """Tasks that are complete here."""
    hands: list[str] = field(default_factory=list)
    """Hands that are complete here."""
    objects: list[str] = field(default_factory=list)
    """Objects that are complete here."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Tasks, hands or objects the source should have but lacks, with the reason."""
    notes: dict[str, list[str]] = field(default_factory=dict)
    """By task, what is known to differ from the benchmark's released data."""
    format: int = FORMAT
    """Layout version."""


def write(folder: Path, manifest: Manifest) -> None:
    """Write the manifest into a source's folder."""
    text = json.dumps(asdict(manifest), indent=1, sort_keys=True)
    (folder / NAME).write_text(text + "\n", encoding="utf-8")


def read(folder: Path) -> Manifest:
    """Read a source's manifest.

    Raises:
        CorruptAssetError: it is missing, damaged or of another format.
    """
    path = folder / NAME
    cure = "make the library anew with 'pgdm assets fetch' or 'pgdm assets import PATH'"
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        if data["format"] != FORMAT:
            raise CorruptAssetError(f"{path}: library format {data['format']!r}; {cure}")
        return Manifest(
            **{
                **data,
                "files": {name: FileEntry(**entry) for name, entry in data["files"].items()},
                "tasks": {name: TaskEntry(**entry) for name, entry in data["tasks"].items()},
            }
        )
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CorruptAssetError(f"{path}: unreadable manifest ({error}); {cure}") from error


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    digest = hashlib.sha256()
    with path.open("rb") as stream:
        while block := stream.read(1 << 20):
            digest.update(block)
    return digest.hexdigest()
