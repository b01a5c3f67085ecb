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
    files = [
        (source, name, entry)
        for source, manifest in library.sources().items()
        for name, entry in manifest.files.items()
    ]
    for i, (source, name, entry) in enumerate(files):
        progress("hash", i, len(files))
        path = library.folder(source) / name
        if not path.is_file():
            found.append(f"{source}/{name}: missing")
        elif path.stat().st_size != entry.bytes:
            found.append(f"{source}/{name}: {path.stat().st_size} bytes instead of {entry.bytes}")
        elif sha256_of(path) != entry.sha256:
            found.append(f"{source}/{name}: content changed, its SHA-256 is not the recorded one")
    progress("hash", len(files), len(files))
    return found
