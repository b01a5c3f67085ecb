"""Where things are kept, and how a file there is replaced."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from pathlib import Path

TEMPORARY = ".tmp-"
"""How the names of unfinished files begin."""


def home() -> Path:
    """Return ``PGDM_HOME``, by default ``pgdm`` in the user's cache directory."""
    chosen = os.environ.get("PGDM_HOME")
    if chosen:
        return Path(chosen).expanduser().absolute()
    cache = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return Path(cache).expanduser().absolute() / "pgdm"


def library() -> Path:
    """Return the folder of the normalised asset library."""
    return home() / "library"


def downloads() -> Path:
    """Return the folder where downloaded packages are kept."""
    return home() / "downloads"


def user() -> Path:
    """Return the folder of what people make themselves: settings, objects, motions, pre-grasps.

    ``PGDM_USER_DIR``, by default ``pgdm`` in the user's configuration directory. Unlike a cache it
    holds what nothing can bring back.
    """
    chosen = os.environ.get("PGDM_USER_DIR")
    if chosen:
        return Path(chosen).expanduser().absolute()
    config = os.environ.get("XDG_CONFIG_HOME") or "~/.config"
    return Path(config).expanduser().absolute() / "pgdm"


def user_conf() -> Path:
    """Return the folder of the user's own settings, laid out as ``conf/``."""
    return user() / "conf"


def runs() -> Path:
    """Return the default folder of runs: ``runs`` under the working directory."""
    return Path.cwd() / "runs"


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a name to write to; what was written takes the place of ``path``, whole or not at all.

    Whoever looks sees the old file or the new one, also after a loss of power.

    Raises:
        OSError: if the file cannot be written; the old one is untouched.
    """
    # Its ending stays: libraries tell a format by it.
    temp = path.with_name(f"{TEMPORARY}{os.getpid()}-{path.name}")
    try:
        yield temp
        _sync(temp)
        os.replace(temp, path)
        _sync(path.parent)  # the folder's own entry must reach the disk too
    finally:
        with contextlib.suppress(OSError):
            temp.unlink()


@contextlib.contextmanager
def restoring(folder: Path) -> Iterator[None]:
    """Take back what was made in a folder, the folder too, if what follows fails.

    Files that were there before and have grown get their old length back.
    """
    before = {path: path.stat() for path in folder.glob("*")}
    try:
        yield
    except BaseException:
        for path in folder.glob("*"):
            if path not in before:
                path.unlink()
            elif path.stat().st_ino == before[path].st_ino:  # else another has taken its place
                os.truncate(path, before[path].st_size)
        with contextlib.suppress(OSError):
            folder.rmdir()
        raise


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
