"""The index of one library source: its content, its origin, and the hash of every file."""

from __future__ import annotations

import datetime
import hashlib
import json
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pgdm import files, paths
from pgdm.errors import CorruptAssetError

if TYPE_CHECKING:
    from _typeshed import DataclassInstance

FORMAT = 1
"""Version of the library's layout; a library of another version must be filled again."""

NAME = "manifest.json"
"""The manifest's file name in a source's folder."""

CURE = "fill the library again with 'pgdm assets fetch' or 'pgdm assets import PATH'"
OWN_CURE = (
    "restore it from a copy, or move its folder away and make the objects, hands and tasks again "
    "with 'pgdm author'"
)
_Content = TypeVar("_Content")


@dataclass(frozen=True)
class FileEntry:
    """One file of the library."""

    sha256: str
    """Hash of the file in the library."""
    bytes: int
    """Size of the file in the library."""
    origin: str
    """Path of the file that it was derived from, relative to the root of the imported data or
    package; for the user's own assets, its name only."""
    licence: str
    """Stated licence: an SPDX id, with a remark if needed, or ``unstated``."""

    @classmethod
    def of(cls, path: Path, origin: str, licence: str) -> FileEntry:
        """Hash and measure a file."""
        return cls(sha256_of(path), path.stat().st_size, origin, licence)


@dataclass(frozen=True)
class TaskEntry:
    """One task of the library."""

    hand: str
    """Library name of the hand."""
    objects: list[str]
    """Library names of the objects, the tracked one first."""
    steps: int
    """Length T of the motion, control steps."""
    starts: list[str]
    """Names of the stored start states."""


@dataclass(frozen=True)
class Manifest:
    """Content of a library source's ``manifest.json``."""

    source: str
    """Name of the library source, such as ``checkout``."""
    origin: str
    """What it was made from, such as a package with version and hash, or a checkout's name."""
    imported_at: str
    """UTC time, ISO 8601."""
    defects: list[str] = field(default_factory=list)
    """Errors in the imported files, and how each was interpreted."""
    files: dict[str, FileEntry] = field(default_factory=dict)
    """Files by path relative to the source's folder."""
    tasks: dict[str, TaskEntry] = field(default_factory=dict)
    """Tasks that this source has, by task id."""
    hands: list[str] = field(default_factory=list)
    """Hands that this source provides."""
    objects: list[str] = field(default_factory=list)
    """Objects that this source provides."""
    left_out: dict[str, str] = field(default_factory=dict)
    """Tasks and models that were left out, with the reason."""
    notes: dict[str, list[str]] = field(default_factory=dict)
    """Remarks by task, object or hand, such as differences from the benchmark's released data."""
    format: int = FORMAT
    """Layout version."""


def write(folder: Path, manifest: Manifest) -> None:
    """Write the manifest into a source's folder."""
    write_json(folder / NAME, manifest)


def read(folder: Path, cure: str = CURE) -> Manifest:
    """Read a source's manifest.

    Raises:
        CorruptAssetError: the manifest is missing, damaged or of another format.
    """
    return read_json(folder / NAME, _from_json, FORMAT, cure)


def _from_json(data: dict[str, Any]) -> Manifest:
    files = {name: FileEntry(**entry) for name, entry in data["files"].items()}
    tasks = {name: TaskEntry(**entry) for name, entry in data["tasks"].items()}
    return Manifest(**{**data, "files": files, "tasks": tasks})


def write_json(path: Path, content: DataclassInstance) -> None:
    """Write an index, a dataclass with a field ``format``, atomically."""
    text = json.dumps(asdict(content), indent=1, sort_keys=True)
    with paths.replacing(path) as temp:
        temp.write_text(text + "\n", encoding="utf-8")


def read_json(
    path: Path, build: Callable[[dict[str, Any]], _Content], version: int, cure: str
) -> _Content:
    """Read an index written by :func:`write_json` and pass it to ``build``.

    Raises:
        CorruptAssetError: the index is missing, damaged or of another format; the message ends
            with ``cure``, the advice.
    """
    try:
        data = files.read_json(path)
        if data["format"] != version:
            raise CorruptAssetError(f"{path}: format {data['format']!r}, not {version}; {cure}")
        return build(data)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise CorruptAssetError(
            f"{path}: unreadable manifest ({files.reason(error)}); {cure}"
        ) from error


def now() -> str:
    """Return the UTC time, ISO 8601, to the second."""
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")


def sha256_of(path: Path) -> str:
    """Return the SHA-256 of a file, hexadecimal."""
    with files.open_file(path) as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
