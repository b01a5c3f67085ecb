"""Changing the library all at once or not at all.

A source is written into a folder of its own beside the library's and takes its place by renaming,
under a lock that other imports wait for. Whatever an interrupted import leaves behind is ignored by
readers and removed by the next import.
"""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from filelock import FileLock, Timeout

from pgdm.errors import LibraryError

WHOLE = ("checkout", "registry")
"""Sources that have hands and a table of their own, the one that wins first."""

OWN = "own"
"""Source of what the user made; it lies in the user's folder, not in the library's."""

ANIMATED = "animated"
"""Source of the motions that come with the program, compiled from its keyframes."""

SOURCES = (OWN, *WHOLE, ANIMATED)
"""Library sources, the one that wins first."""

EXPERTS = "experts"
"""Folder of the expert hand trajectories, which belong to no source: they fit either one's."""

_MAKING_TIMEOUT_S = 3600.0
_STAGING = ".staging-"
_PREVIOUS = ".previous-"
_log = logging.getLogger(__name__)


@contextmanager
def locked(root: Path, timeout_s: float = 3600.0) -> Iterator[None]:
    """Hold the library's lock, which is not to be asked for again while it is held.

    Args:
        root: the library.
        timeout_s: how long to wait for another process; a fetch over a slow line takes its time.

    Raises:
        LibraryError: the folder cannot be written, or another import holds the lock too long.
    """
    try:
        root.mkdir(parents=True, exist_ok=True)
        lock = FileLock(str(root / ".lock"))
        try:
            lock.acquire(timeout=0.2)
        except Timeout:
            _log.warning("another process is filling the library in %s: waiting for it", root)
            lock.acquire(timeout=timeout_s)
        try:
            yield
        finally:
            lock.release()
    except Timeout as error:
        raise LibraryError(
            f"{root}: another import has held the library's lock for {timeout_s:.0f} s; "
            "wait for it or end it"
        ) from error
    except OSError as error:
        raise LibraryError(f"{root}: cannot be written ({error.strerror or error})") from error


@contextmanager
def making(path: Path, notify: Callable[[str], None]) -> Iterator[None]:
    """Hold the lock of one file that is being made; others wait for it.

    Raises:
        LibraryError: the folder cannot be written, or another process holds it too long.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = FileLock(str(path.with_name(f".{path.stem}.lock")))
        try:
            lock.acquire(timeout=0.2)
        except Timeout:
            begun = time.monotonic()
            notify(f"another process is making {path}: waiting for it")
            lock.acquire(timeout=_MAKING_TIMEOUT_S)
            _log.info("waited %.0f s for %s", time.monotonic() - begun, path)
    except Timeout as error:
        raise LibraryError(
            f"{path}: another process has been making it for {_MAKING_TIMEOUT_S:.0f} s; wait for "
            "it or end it"
        ) from error
    except OSError as error:
        raise LibraryError(f"{path}: cannot be written ({error.strerror or error})") from error
    try:
        yield
    finally:
        lock.release()


@contextmanager
def replacing(root: Path, source: str) -> Iterator[Path]:
    """Yield an empty folder that becomes the source's if the block ends without an error.

    The caller holds :func:`locked`.
    """
    _clear(root)
    staging = Path(tempfile.mkdtemp(prefix=f"{_STAGING}{source}-", dir=root))
    # mkdtemp makes it private; a library may be shared like any other folder.
    staging.chmod(0o755)
    try:
        yield staging
        _swap(root, source, staging)
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def folder_of(root: Path, source: str) -> Path | None:
    """Return the folder a source is read from, None where there is none.

    If an import was killed between its two renames, the previous content still serves.
    """
    for folder in (root / source, root / f"{_PREVIOUS}{source}"):
        if (folder / "manifest.json").is_file():
            return folder
    return None


def _swap(root: Path, source: str, staging: Path) -> None:
    target, previous = root / source, root / f"{_PREVIOUS}{source}"
    if target.exists():
        os.replace(target, previous)
    os.replace(staging, target)
    shutil.rmtree(previous, ignore_errors=True)


def _clear(root: Path) -> None:
    for leftover in root.glob(f"{_STAGING}*"):
        _log.info("removing %s, left by an interrupted import", leftover.name)
        shutil.rmtree(leftover, ignore_errors=True)
    for source in (*WHOLE, ANIMATED, EXPERTS):
        previous = root / f"{_PREVIOUS}{source}"
        if previous.exists() and (root / source).exists():
            shutil.rmtree(previous, ignore_errors=True)
        elif previous.exists():
            os.replace(previous, root / source)
