"""The library's source ``own``: objects and motions that the user made.

It lies in the user's folder, not in a cache: nothing can bring it back. A thing is written into a
folder beside it, then moved in, then entered in the manifest; readers know only what stands there.
"""

from __future__ import annotations

import dataclasses
import datetime
import json
import os
import re
import shutil
import tempfile
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from pgdm import paths
from pgdm.errors import ConfigError, LibraryError, UnknownNameError
from pgdm.library import figures, names, staging
from pgdm.library import manifest as manifests
from pgdm.library.catalog import open_library
from pgdm.library.manifest import FileEntry, Manifest, TaskEntry

ORIGIN = "made here by 'pgdm author'"
_STAGING = ".staging-own-"
_OBJECT_NAME, _TASK_NAME = re.compile(r"[a-z][a-z0-9_]*"), re.compile(r"[a-z][a-z0-9_-]*")
_LONGEST = 60


def folder() -> Path:
    """Return the folder of the source."""
    return paths.user() / "library"


def read() -> Manifest:
    """Return its manifest, an empty one if there is none yet.

    Raises:
        CorruptAssetError: the manifest is damaged.
    """
    if not (folder() / manifests.NAME).is_file():
        return Manifest(source=staging.OWN, origin=ORIGIN, imported_at=_now())
    return manifests.read(folder())


def check_object_name(name: str, replace: bool) -> None:
    """Check that an object may be called so.

    Raises:
        ConfigError: the name is no name, is the library's, or is taken and not to be replaced.
    """
    if not _OBJECT_NAME.fullmatch(name) or len(name) > _LONGEST:
        raise ConfigError(
            f"object name '{name}' is not valid: a small letter, then small letters, digits and "
            f"'_' ('-' parts the words of task ids), {_LONGEST} at most"
        )
    library, own = open_library(), read()
    taken = {o for s, m in library.sources().items() if s != staging.OWN for o in m.objects}
    taken |= {o for t in _benchmark_tasks() for o in names.objects_of(t)} | set(names.HANDS)
    if name in taken:
        raise ConfigError(f"object name '{name}' is the library's own; choose another one")
    if name in own.objects and not replace:
        raise ConfigError(f"you have an object '{name}' already; --replace makes it anew")
    if name in own.tasks:
        raise ConfigError(f"you have a task '{name}'; choose another name for the object")


def check_task_name(task: str, shipped: Collection[str], replace: bool) -> None:
    """Check that a task may be called so.

    Args:
        task: the wanted id.
        shipped: tasks and suites of the package.
        replace: whether one that the user made may be overwritten.

    Raises:
        ConfigError: the name is no name, is one of the package's, or is taken.
    """
    if not _TASK_NAME.fullmatch(task) or len(task) > _LONGEST:
        raise ConfigError(
            f"task id '{task}' is not valid: a small letter, then small letters, digits, '-' and "
            f"'_', {_LONGEST} at most"
        )
    if task in (*shipped, *_benchmark_tasks()):
        raise ConfigError(f"task id '{task}' is one of pgdm's own; choose another one")
    own = read()
    if task in own.tasks and not replace:
        raise ConfigError(f"you have a task '{task}' already; --replace makes it anew")
    if task in own.objects:
        raise ConfigError(f"you have an object '{task}'; choose another id, such as {task}-lift")


def add_object(name: str, make: Callable[[Path], list[str]], origin: str, licence: str) -> Path:
    """Add an object, or replace the one of that name.

    Args:
        name: its name.
        make: writes it into an empty folder that it is given, and returns what is to be known.
        origin: the mesh's file name.
        licence: its licence.

    Returns:
        The object's folder.

    Raises:
        LibraryError: the user's folder cannot be written.
    """
    with staging.locked(folder()):
        fresh = _fresh()
        try:
            notes = make(fresh)
            target = folder() / "objects" / name
            _move(fresh, target)
            own = read()
            files = _without(own.files, f"objects/{name}/")
            for path in sorted(p for p in target.rglob("*") if p.is_file()):
                relative = path.relative_to(folder()).as_posix()
                files[relative] = _entry(path, origin, licence)
            objects = sorted({*own.objects, name})
            changed = {"files": files, "objects": objects, "notes": {**own.notes, name: notes}}
            _write(dataclasses.replace(own, **changed))
            return target
        finally:
            shutil.rmtree(fresh, ignore_errors=True)


def add_motion(
    task: str, entry: TaskEntry, make: Callable[[Path], None], notes: list[str], origin: str
) -> Path:
    """Add a task's motion, or replace the one of that id.

    Args:
        task: its id.
        entry: what it is made of.
        make: writes the motion to a file that it is given.
        notes: what is to be known about it.
        origin: name of the file it was made from.

    Returns:
        The motion's file.

    Raises:
        LibraryError: the user's folder cannot be written.
    """
    with staging.locked(folder()):
        target = folder() / "motions" / f"{task}.npz"
        target.parent.mkdir(exist_ok=True)
        with paths.replacing(target) as temp:
            make(temp)
        own = read()
        files = {**own.files, f"motions/{task}.npz": _entry(target, origin, "unstated")}
        tasks = {**own.tasks, task: entry}
        changed = {"files": files, "tasks": tasks, "notes": {**own.notes, task: notes}}
        _write(dataclasses.replace(own, **changed))
        return target


def users_of(object_name: str) -> list[str]:
    """Return the user's tasks in which an object plays."""
    return [task for task, entry in read().tasks.items() if object_name in entry.objects]


def check_unused(object_name: str) -> None:
    """Check that no task of the user's needs an object.

    Raises:
        LibraryError: one does; names it.
    """
    if tasks := users_of(object_name):
        raise LibraryError(
            f"object '{object_name}' plays in {', '.join(tasks)}; remove "
            f"{'it' if len(tasks) == 1 else 'them'} first"
        )


def remove(name: str) -> None:
    """Remove an object or a task's motion of the user's.

    Raises:
        UnknownNameError: there is none of that name; names those that are there.
        LibraryError: it is an object in which tasks still play.
    """
    with staging.locked(folder()):
        own = read()
        if name not in own.objects and name not in own.tasks:
            raise UnknownNameError("object or task of your own", name, [*own.objects, *own.tasks])
        if name in own.objects:
            check_unused(name)
        relative = f"motions/{name}.npz" if name in own.tasks else f"objects/{name}/"
        _write(
            dataclasses.replace(
                own,
                files=_without(own.files, relative),
                tasks={task: entry for task, entry in own.tasks.items() if task != name},
                objects=[o for o in own.objects if o != name],
                notes={n: lines for n, lines in own.notes.items() if n != name},
            )
        )
        if name in own.tasks:
            (folder() / relative).unlink(missing_ok=True)
        else:
            shutil.rmtree(folder() / relative, ignore_errors=True)


def facts(object_name: str) -> dict[str, Any]:
    """Return what was recorded when an object of the user's was made.

    Raises:
        UnknownNameError: the user has no such object.
        LibraryError: its record is damaged.
    """
    if object_name not in read().objects:
        raise UnknownNameError("object of your own", object_name, read().objects)
    path = folder() / "objects" / object_name / "object.json"
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise LibraryError(f"{path}: unreadable ({error}); make the object anew") from error
    return dict(found)


def _benchmark_tasks() -> tuple[str, ...]:
    return (*figures.GRAB_TASKS, *figures.OTHER_TASKS)


def _fresh() -> Path:
    for leftover in folder().glob(f"{_STAGING}*"):  # of a process that was killed
        shutil.rmtree(leftover, ignore_errors=True)
    return Path(tempfile.mkdtemp(prefix=_STAGING, dir=folder()))


def _move(fresh: Path, target: Path) -> None:
    target.parent.mkdir(exist_ok=True)
    fresh.chmod(0o755)
    old = target.with_name(f"{_STAGING}old-{target.name}")
    shutil.rmtree(old, ignore_errors=True)
    if target.exists():
        os.replace(target, old)
    os.replace(fresh, target)
    shutil.rmtree(old, ignore_errors=True)


def _without(files: Mapping[str, FileEntry], prefix: str) -> dict[str, FileEntry]:
    return {name: entry for name, entry in files.items() if not name.startswith(prefix)}


def _entry(path: Path, origin: str, licence: str) -> FileEntry:
    return FileEntry(manifests.sha256_of(path), path.stat().st_size, origin, licence)


def _write(own: Manifest) -> None:
    manifests.write(folder(), dataclasses.replace(own, imported_at=_now()))


def _now() -> str:
    return datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
