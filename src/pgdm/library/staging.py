"""Atomic changes to the library.

A change writes a folder under a temporary name, then renames it to replace the old folder, while
holding a lock that other writers wait for. Readers ignore whatever an interrupted change leaves
behind; the next change removes it.
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
from pgdm.files import read_text
from pgdm.library.progress import Notify
from pgdm.paths import replacing

SELF_CONTAINED = ("checkout", "registry")
"""Library sources that include hands and the table scene, in default order of precedence."""

OWN = "own"
"""Library source of the user's objects, hands and tasks; stored in :func:`pgdm.paths.user`."""

ANIMATED = "animated"
"""Library source of the motions that come with pgdm, compiled from keyframes."""

SOURCES = (OWN, *SELF_CONTAINED, ANIMATED)
"""Library sources in default order of precedence."""

EXPERTS = "experts"
"""Folder of the expert hand trajectories. They belong to no library source, because they fit
the motions of both `checkout` and `registry`."""

_TIMEOUT_S = 3600.0  # enough for a fetch over a slow connection
_STAGING, _PREVIOUS = ".staging-", ".previous-"
_FIRST = "first-source"
_log = logging.getLogger(__name__)


@contextmanager
def locked(root: Path, timeout_s: float = _TIMEOUT_S) -> Iterator[None]:
    """Hold a library's lock. The lock is not reentrant.

    Args:
        root: the library.
        timeout_s: how long to wait for another process.

    Raises:
        LibraryError: the folder cannot be written, or another process held the lock for
            ``timeout_s``.
    """
    busy = f"{root}: another process has been changing the library for {timeout_s:.0f} s"
    waiting = f"another process is changing the library in {root}: waiting for it"
    try:
        lock = _acquired(root / ".lock", timeout_s, lambda: _log.warning(waiting), busy)
        try:
            yield
        finally:
            lock.release()
    except OSError as error:
        raise LibraryError(f"{root}: cannot be written ({error.strerror or error})") from error


@contextmanager
def making(path: Path, notify: Notify) -> Iterator[None]:
    """Hold the lock of one file while it is computed; other processes wait.

    Raises:
        LibraryError: the folder cannot be written, or another process held the lock for an hour.
    """
    busy = f"{path}: another process has been computing it for {_TIMEOUT_S:.0f} s"
    waiting = f"another process is computing {path}: waiting for it"
    try:
        file = path.with_name(f".{path.stem}.lock")
        lock = _acquired(file, _TIMEOUT_S, lambda: notify(waiting), busy)
    except OSError as error:
        raise LibraryError(f"{path}: cannot be written ({error.strerror or error})") from error
    try:
        yield
    finally:
        lock.release()


def _acquired(file: Path, timeout_s: float, on_wait: Callable[[], None], busy: str) -> FileLock:
    file.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(str(file))
    try:
        try:
            lock.acquire(timeout=0.2)
        except Timeout:
            begun = time.monotonic()
            on_wait()
            lock.acquire(timeout=timeout_s)
            _log.info("waited %.0f s for %s", time.monotonic() - begun, file)
    except Timeout as error:
        raise LibraryError(f"{busy}; wait for it or stop it") from error
    return lock


@contextmanager
def replacing_folder(root: Path, relative: str) -> Iterator[Path]:
    """Yield an empty folder that replaces a folder of the library if the block succeeds.

    The caller holds :func:`locked`.

    Args:
        root: the locked folder.
        relative: the folder to replace, at most two levels below ``root``, such as
            ``objects/cup``.
    """
    _clear(root)
    target = root / relative
    fresh = Path(tempfile.mkdtemp(prefix=f"{_STAGING}{target.name}-", dir=root))
    # mkdtemp makes the folder private, but other users may read a library.
    fresh.chmod(0o755)
    try:
        yield fresh
        target.parent.mkdir(exist_ok=True)
        previous = target.with_name(f"{_PREVIOUS}{target.name}")
        if target.exists():
            os.replace(target, previous)
        os.replace(fresh, target)
        shutil.rmtree(previous, ignore_errors=True)
    finally:
        shutil.rmtree(fresh, ignore_errors=True)


def folder_of(root: Path, source: str) -> Path | None:
    """Return the folder from which a library source is read, None if missing.

    If a change was interrupted between its two renames, the previous content is used.
    """
    for folder in (root / source, root / f"{_PREVIOUS}{source}"):
        if (folder / "manifest.json").is_file():
            return folder
    return None


def prefer(root: Path, source: str) -> None:
    """Give a library source precedence over all others except ``own``."""
    with locked(root), replacing(root / _FIRST) as temp:
        temp.write_text(f"{source}\n", encoding="utf-8")


def preferred(root: Path) -> str | None:
    """Return the source chosen with :func:`prefer`, or None."""
    try:
        return read_text(root / _FIRST).strip()
    except (OSError, ValueError):
        return None


def remove(root: Path, source: str) -> None:
    """Delete a library source.

    Raises:
        LibraryError: the folder cannot be written, or another process held the lock for an hour.
    """
    with locked(root):
        _clear(root)
        gone = root / f"{_STAGING}{source}-removed"  # readers see all of it or nothing
        os.replace(root / source, gone)
        shutil.rmtree(gone)


def _clear(root: Path) -> None:
    """Remove leftovers of interrupted changes; restore a folder moved aside but never replaced."""
    for leftover in root.glob(f"{_STAGING}*"):
        _log.info("removing %s, left by an interrupted change", leftover.name)
        shutil.rmtree(leftover, ignore_errors=True)
    for previous in (*root.glob(f"{_PREVIOUS}*"), *root.glob(f"*/{_PREVIOUS}*")):
        target = previous.with_name(previous.name.removeprefix(_PREVIOUS))
        if target.exists():
            shutil.rmtree(previous, ignore_errors=True)
        else:
            os.replace(previous, target)
