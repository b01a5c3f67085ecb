"""What the commands about pre-grasps share: a task's scene, and how far many tasks are."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from pgdm.cli.train import notify
from pgdm.config.schema import ExperimentCfg
from pgdm.config.store import compose
from pgdm.library import Library, Motion, ensure
from pgdm.sim.scene import Scene, build_scene

WIDE = 160
"""Columns of a table where nobody's terminal sets them."""

Tell = Callable[[float, str], None]
"""Told which share of a task is done (0..1), and in what state it is."""


def open_scene(task: str, hand: str | None, offline: bool) -> tuple[Scene, Motion]:
    """Return a task's scene, with its own hand or another, and its motion.

    Raises:
        PgdmError: if a name is unknown, or the task's assets are missing.
    """
    cfg = composed(task, hand)
    library: Library = ensure(cfg.task.motion, offline, notify)
    scene = build_scene(library, cfg.task, cfg.hand, cfg.sim)
    return scene, library.motion(cfg.task.motion)


def composed(task: str, hand: str | None, *overrides: str) -> ExperimentCfg:
    """Return the settings of a task, with its own hand or another."""
    return compose([f"task={task}", *([f"hand={hand}"] if hand else []), *overrides])


def console() -> Console:
    """Return where tables go: in a file or a pipe nothing is cut."""
    return Console() if sys.stdout.isatty() else Console(width=WIDE)


@contextmanager
def each(tasks: Sequence[str]) -> Iterator[Iterator[tuple[str, Tell]]]:
    """Give the tasks one after the other, with a bar and an estimate on a terminal.

    Elsewhere the name of each is told in a plain line when it begins.
    """
    screen = Console(stderr=True)
    if not screen.is_terminal:
        yield ((task, _spoken(task, i, len(tasks))) for i, task in enumerate(tasks))
        return
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn()
    with Progress(
        *columns, TimeRemainingColumn(), TextColumn("{task.fields[at]}"),
        console=screen, transient=True,
    ) as bars:  # fmt: skip
        bar = bars.add_task("", total=len(tasks), at="")

        def walk() -> Iterator[tuple[str, Tell]]:
            for i, task in enumerate(tasks):
                bars.update(bar, description=task, completed=i, at="")
                yield task, lambda share, at, i=i: bars.update(bar, completed=i + share, at=at)

        yield walk()


def _spoken(task: str, done: int, total: int) -> Tell:
    if total > 1:
        notify(f"{task} ({done + 1} of {total})")
    return lambda share, at: None
