"""Checking that the library's files are what they were when it was filled."""

from __future__ import annotations

from pgdm.library.catalog import Library
from pgdm.library.manifest import sha256_of
from pgdm.library.report import Progress, silent


def damaged(library: Library, progress: Progress = silent) -> list[str]:
    """Hash every file of the library and name those that are missing or changed.

    Args:
        library: the library.
        progress: told about files.

    Returns:
        One line a file, empty if all are sound.
    """
    found: list[str] = []
    files = list(library.files())
    for i, (name, path, entry) in enumerate(files):
        progress("hash", i, len(files))
        if not path.is_file():
            found.append(f"{name}: missing")
        elif path.stat().st_size != entry.bytes:
            found.append(f"{name}: {path.stat().st_size} bytes instead of {entry.bytes}")
        elif sha256_of(path) != entry.sha256:
            found.append(f"{name}: content changed, its SHA-256 is not the recorded one")
    progress("hash", len(files), len(files))
    return found
