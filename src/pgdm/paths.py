"""Folders of pgdm, names that become part of a path, and atomic replacement of files."""

from __future__ import annotations

import contextlib
import itertools
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

from pgdm.errors import ConfigError

TEMPORARY = ".tmp-"
"""Prefix of the names of unfinished files."""

_NAME = re.compile(r"\w[\w.+-]{0,99}")
"""Valid names of files and folders; excludes ``/`` and names that start with a dot."""


def home() -> Path:
    """Return ``PGDM_HOME``, by default ``pgdm`` in the user's cache directory."""
    return _chosen("PGDM_HOME", "XDG_CACHE_HOME", "~/.cache")


def library() -> Path:
    """Return the folder of the normalised asset library."""
    return home() / "library"


def downloads() -> Path:
    """Return the folder of downloaded packages."""
    return home() / "downloads"


def user() -> Path:
    """Return the folder of the user's own settings, objects, motions and pre-grasps.

    ``PGDM_USER_DIR``, by default ``pgdm`` in the user's configuration directory. Unlike a cache its
    contents cannot be restored.
    """
    return _chosen("PGDM_USER_DIR", "XDG_CONFIG_HOME", "~/.config")


def _chosen(variable: str, base_variable: str, base: str) -> Path:
    if chosen := os.environ.get(variable):
        return expanded(chosen, f"{variable}=")
    cure = f"set HOME or {variable}"
    return expanded(os.environ.get(base_variable) or base, cure=cure) / "pgdm"


def expanded(
    path: str | os.PathLike[str], shown: str = "", cure: str = "write the whole path"
) -> Path:
    """Return an absolute path, a leading ``~`` or ``~user`` replaced by the home folder.

    Args:
        path: as written.
        shown: text put before the path in messages.
        cure: what to do if the home folder is unknown.

    Raises:
        ConfigError: if the home folder is unknown: many containers have neither ``HOME`` nor an
            entry for the user.
    """
    try:
        return Path(path).expanduser().absolute()
    except RuntimeError as error:
        raise ConfigError(
            f"{shown}{path}: no home folder is known for '{Path(path).parts[0]}'; {cure}"
        ) from error


def user_conf() -> Path:
    """Return the folder of the user's own settings, laid out as ``conf/``."""
    return user() / "conf"


def runs() -> Path:
    """Return the default folder of runs: ``runs`` under the working directory."""
    return Path.cwd() / "runs"


def check_path_part(kind: str, name: object) -> None:
    """Check a name that may become part of a path.

    Args:
        kind: what it stands for, such as ``task.id``.
        name: the name.

    Raises:
        ConfigError: if it is not 1 to 100 letters, digits, ``_``, ``.``, ``+`` and ``-``, of which
            the first is a letter, a digit or ``_``.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        shown = repr(name) if len(repr(name)) <= 60 else f"{name!r:.57}..."
        raise ConfigError(
            f"{kind} {shown} is not valid: give letters, digits, '_', '-', '+' and '.', the first "
            "of them a letter, digit or '_', 100 at most"
        )


def as_name(text: str) -> str:
    """Return a valid name made from any text, such as the name of an experiment."""
    return re.sub(r"[^\w.+-]+", "-", text).lstrip(".+-")[:100] or "_"


def inside(folder: Path, *names: str, kind: str = "name", suffix: str = "") -> Path:
    """Check names, then join them to a folder. Any name that a user chose becomes a path here.

    Args:
        folder: the folder.
        names: nested folders, outermost first, then the file.
        kind: what the names stand for, for messages.
        suffix: appended to the last name, such as ``.npz``.

    Raises:
        ConfigError: if a name is not valid.
    """
    for name in names:
        check_path_part(kind, name)
    return folder.joinpath(*names[:-1], names[-1] + suffix)


def unused(folder: Path, stem: str, suffix: str = "") -> Path:
    """Return the first of ``STEM-1``, ``STEM-2``, ... in a folder that does not exist yet."""
    numbered = (folder / f"{stem}-{i}{suffix}" for i in itertools.count(1))
    return next(path for path in numbered if not path.exists())


def leaves(path: Path, folder: Path) -> bool:
    """Return whether a path is outside of a folder once links are followed."""
    return not path.resolve().is_relative_to(folder.resolve())


def free_bytes(folder: Path) -> int:
    """Return the free space on the disk of a folder, or of its nearest parent that exists."""
    place = folder.absolute()
    return shutil.disk_usage(next(p for p in (place, *place.parents) if p.is_dir())).free


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield a temporary file name; the file written there replaces ``path`` atomically.

    Readers see the old file or the new one, also after a power failure.

    Raises:
        OSError: if the file cannot be written; the old one is untouched.
    """
    # Keep the suffix: libraries infer the format from it.
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
    """If the block fails, remove the files it created in a folder, and the folder if then empty.

    Files that grew are cut to their old length.
    """
    before = {path: path.stat() for path in folder.glob("*")}
    try:
        yield
    except BaseException:
        for path in folder.glob("*"):
            if path not in before:
                path.unlink()
            elif path.stat().st_ino == before[path].st_ino:  # else it was replaced
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
