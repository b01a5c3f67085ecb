"""The library source ``own``: the user's objects, hands and motions.

The source is in the user's folder (:func:`pgdm.paths.user`), not in a cache, because it cannot be
fetched again. Files are replaced atomically, then entered in the manifest; readers see only files
that the manifest lists.
"""

from __future__ import annotations

import dataclasses
import re
import shutil
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

from pgdm import paths
from pgdm.errors import ConfigError, LibraryError, UnknownNameError, check_name
from pgdm.files import read_json, reason
from pgdm.library import manifest as manifests
from pgdm.library import staging
from pgdm.library.catalog import open_library
from pgdm.library.files import motion as motion_file
from pgdm.library.manifest import FileEntry, Manifest, TaskEntry
from pgdm.library.tasks import BENCHMARK_TASKS, HANDS, objects_of

ORIGIN = "made here by 'pgdm author'"
_OBJECT_NAME, _TASK_NAME = re.compile(r"[a-z][a-z0-9_]*"), re.compile(r"[a-z][a-z0-9_-]*")
_LONGEST = 60


def folder() -> Path:
    """Return the folder of the source."""
    return paths.user() / "library"


def read() -> Manifest:
    """Return the manifest of the source, an empty one if the file does not exist yet.

    Raises:
        CorruptAssetError: the manifest is damaged.
    """
    if not (folder() / manifests.NAME).is_file():
        return Manifest(source=staging.OWN, origin=ORIGIN, imported_at=manifests.now())
    return manifests.read(folder(), manifests.OWN_CURE)


def check_object_name(name: str, replace: bool) -> None:
    """Check that a new object may have this name.

    Args:
        name: the name.
        replace: whether an object of the user's may be replaced.

    Raises:
        ConfigError: the name is invalid, or used by the benchmark, another library source, a task
            or hand of the user's, or, without ``replace``, an object of the user's.
    """
    if not _OBJECT_NAME.fullmatch(name) or len(name) > _LONGEST:
        raise ConfigError(
            f"object name '{name}' is not valid: a lower-case letter, then lower-case letters, "
            f"digits and '_' ('-' separates the words of task ids), at most {_LONGEST} characters"
        )
    library, own = open_library(), read()
    taken = {o for s, m in library.sources().items() if s != staging.OWN for o in m.objects}
    taken |= {o for task in BENCHMARK_TASKS for o in objects_of(task)} | set(HANDS)
    if name in taken:
        raise ConfigError(f"object name '{name}' is taken by the library; choose another one")
    if name in own.objects and not replace:
        raise ConfigError(f"you already have an object '{name}'; --replace replaces it")
    if name in (*own.tasks, *own.hands):
        kind = "task" if name in own.tasks else "hand"
        raise ConfigError(f"you have a {kind} '{name}'; choose another name for the object")


def check_hand_name(name: str, shipped: Collection[str], replace: bool) -> None:
    """Check that a new hand may have this name.

    Args:
        name: the name.
        shipped: hands whose settings come with pgdm.
        replace: whether a hand of the user's may be replaced.

    Raises:
        ConfigError: the name is invalid, or used by pgdm, another library source, an object or task
            of the user's, or, without ``replace``, a hand of the user's.
    """
    if not _OBJECT_NAME.fullmatch(name) or len(name) > _LONGEST:
        raise ConfigError(
            f"hand name '{name}' is not valid: a lower-case letter, then lower-case letters, "
            f"digits and '_', at most {_LONGEST} characters"
        )
    library, own = open_library(), read()
    taken = {h for s, m in library.sources().items() if s != staging.OWN for h in m.hands}
    things = {o for m in library.sources().values() for o in m.objects}
    if name in taken | things | {*HANDS, *shipped}:
        raise ConfigError(f"hand name '{name}' is taken by a hand or an object; choose another one")
    if name in own.hands and not replace:
        raise ConfigError(f"you already have a hand '{name}'; --replace replaces it")
    if name in own.tasks:
        raise ConfigError(f"you have a task '{name}'; choose another name for the hand")


def check_task_name(task: str, shipped: Collection[str], replace: bool) -> None:
    """Check that a new task may have this id.

    Args:
        task: the id.
        shipped: tasks and suites that come with pgdm.
        replace: whether a task of the user's may be replaced.

    Raises:
        ConfigError: the id is invalid, or used by pgdm, an object or hand of the user's, or,
            without ``replace``, a task of the user's.
    """
    if not _TASK_NAME.fullmatch(task) or len(task) > _LONGEST:
        raise ConfigError(
            f"task id '{task}' is not valid: a lower-case letter, then lower-case letters, digits, "
            f"'-' and '_', at most {_LONGEST} characters"
        )
    if task in (*shipped, *BENCHMARK_TASKS):
        raise ConfigError(f"task id '{task}' is taken by pgdm; choose another one")
    own = read()
    if task in own.tasks and not replace:
        raise ConfigError(f"you already have a task '{task}'; --replace replaces it")
    for kind, names in (("an object", own.objects), ("a hand", own.hands)):
        if task in names:
            raise ConfigError(f"you have {kind} '{task}'; choose another id, such as {task}-lift")


def add_model(
    kind: str, name: str, make: Callable[[Path], list[str]], origin: str, licence: str
) -> Path:
    """Add an object or a hand, or replace an existing one of that name.

    Args:
        kind: ``objects`` or ``hands``.
        name: the model's name.
        make: writes the model into the empty folder it is given; returns notes for the manifest.
        origin: name of the file from which the model was made.
        licence: the model's licence.

    Returns:
        The model's folder.

    Raises:
        LibraryError: the user's folder cannot be written.
    """
    with staging.locked(folder()):
        with staging.replacing_folder(folder(), f"{kind}/{name}") as fresh:
            notes = make(fresh)
        own, target = read(), folder() / kind / name
        files = _without(own.files, f"{kind}/{name}/")
        for path in sorted(p for p in target.rglob("*") if p.is_file()):
            relative = path.relative_to(folder()).as_posix()
            files[relative] = FileEntry.of(path, origin, licence)
        names = {kind: sorted({*getattr(own, kind), name})}
        _write(own, files=files, **names, notes={**own.notes, name: notes})
        return target


def add_motion(
    task: str, entry: TaskEntry, arrays: Mapping[str, Any], notes: list[str], origin: str
) -> Path:
    """Add a task with its motion, or replace an existing task of that id.

    Args:
        task: task id.
        entry: the task's hand, objects, length and start states.
        arrays: from :func:`pgdm.library.files.motion.pack`.
        notes: notes for the manifest.
        origin: name of the file from which the motion was derived.

    Returns:
        The motion's file.

    Raises:
        CorruptAssetError: the arrays are not a motion.
        LibraryError: the user's folder cannot be written.
    """
    with staging.locked(folder()):
        target = folder() / "motions" / f"{task}.npz"
        target.parent.mkdir(exist_ok=True)
        with paths.replacing(target) as temp:
            motion_file.write(temp, arrays)
        own, file = read(), FileEntry.of(target, origin, "unstated")
        files, tasks = {**own.files, f"motions/{task}.npz": file}, {**own.tasks, task: entry}
        _write(own, files=files, tasks=tasks, notes={**own.notes, task: notes})
        return target


def users_of(name: str) -> list[str]:
    """Return the user's tasks that use the object or hand of this name."""
    return [task for task, one in read().tasks.items() if name in (*one.objects, one.hand)]


def check_unused(name: str) -> None:
    """Check that no task of the user's uses the object or hand of this name.

    Raises:
        LibraryError: tasks use it; the message names them.
        UnknownNameError: the user has nothing of that name.
    """
    kind = kind_of(read(), name)
    if tasks := users_of(name):
        raise LibraryError(
            f"tasks that use {kind} '{name}': {', '.join(tasks)}; remove "
            f"{'it' if len(tasks) == 1 else 'them'} first"
        )


def remove(name: str) -> None:
    """Remove the user's object, hand or task of this name. A task's motion is removed with it.

    Raises:
        UnknownNameError: the user has nothing of that name; the message lists what exists.
        LibraryError: tasks still use the object or hand.
    """
    with staging.locked(folder()):
        own = read()
        kind = kind_of(own, name)
        if kind != "task":
            check_unused(name)
        relative = f"motions/{name}.npz" if kind == "task" else f"{kind}s/{name}/"
        _write(
            own,
            files=_without(own.files, relative),
            tasks={task: entry for task, entry in own.tasks.items() if task != name},
            objects=[o for o in own.objects if o != name],
            hands=[h for h in own.hands if h != name],
            notes={n: lines for n, lines in own.notes.items() if n != name},
        )
        if kind == "task":
            (folder() / relative).unlink(missing_ok=True)
        else:
            shutil.rmtree(folder() / relative, ignore_errors=True)


def kind_of(own: Manifest, name: str) -> str:
    """Return what the user has under a name: ``object``, ``hand`` or ``task``.

    Raises:
        UnknownNameError: the user has nothing of that name; the message lists what exists.
    """
    names = {"task": list(own.tasks), "object": own.objects, "hand": own.hands}
    kind = next((kind for kind, known in names.items() if name in known), None)
    if kind is None:
        known = [one for every in names.values() for one in every]
        raise UnknownNameError("object, hand or task of your own", name, known)
    return kind


def facts(name: str, kind: str = "object") -> dict[str, Any]:
    """Return what was recorded when the user's object or hand was created.

    Raises:
        UnknownNameError: the user has no such object or hand.
        LibraryError: the record is missing or damaged.
    """
    check_name(f"{kind} of your own", name, getattr(read(), f"{kind}s"))
    path = folder() / f"{kind}s" / name / f"{kind}.json"
    try:
        found = read_json(path)
    except (OSError, ValueError) as error:
        raise LibraryError(
            f"{path}: unreadable ({reason(error)}); create the {kind} again"
        ) from error
    return dict(found)


def _without(files: Mapping[str, FileEntry], prefix: str) -> dict[str, FileEntry]:
    return {name: entry for name, entry in files.items() if not name.startswith(prefix)}


def _write(own: Manifest, **changes: Any) -> None:
    changed = dataclasses.replace(own, imported_at=manifests.now(), **changes)
    manifests.write(folder(), changed)
