"""Checking that the library's files have not changed since the library was filled."""

from __future__ import annotations

from pgdm.library.catalog import Library, present
from pgdm.library.manifest import sha256_of
from pgdm.library.progress import StepProgress, counted, silent


def damaged(library: Library, progress: StepProgress = silent) -> list[str]:
    """Hash every file of the library; list damaged manifests, and missing or changed files.

    Args:
        library: the library.
        progress: receives the number of files checked.

    Returns:
        A line per damaged file; empty if all files are intact.

    Raises:
        CorruptAssetError: the index of the expert trajectories is damaged.
    """
    left_out = set(present(library.root)) - set(library.sources())
    found = [f"{source}/manifest.json: damaged" for source in sorted(left_out)]
    files = list(library.files())
    for name, path, entry in counted("hash", files, progress):
        if not path.is_file():
            found.append(f"{name}: missing")
        elif path.stat().st_size != entry.bytes:
            found.append(f"{name}: {path.stat().st_size} bytes instead of {entry.bytes}")
        elif sha256_of(path) != entry.sha256:
            found.append(f"{name}: content changed, its SHA-256 differs from the recorded one")
    return found
