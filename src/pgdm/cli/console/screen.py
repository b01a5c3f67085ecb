"""Where output goes: tables to stdout; notes and progress to stderr."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import typer
from rich.console import Console, ConsoleOptions, RenderableType
from rich.progress import (
    BarColumn,
    DownloadColumn,
    MofNCompleteColumn,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeRemainingColumn,
    TransferSpeedColumn,
)
from rich.progress import Progress as Bars
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

from pgdm.cli.console.printable import printable
from pgdm.library.progress import ProgressLines, StepProgress


class _Clean(Console):
    """A rich console that escapes control characters in texts, and keeps those of rich itself."""

    def render(
        self, renderable: RenderableType, options: ConsoleOptions | None = None
    ) -> Iterator[Segment]:
        """See rich."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else segment._replace(text=printable(segment.text))


SCREEN = _Clean(stderr=True)
_WIDE = 10_000  # columns in a file or a pipe, where nothing is cut
_BYTE_STEPS = ("download", "copy")
_PATIENCE_S, _POLL_S = 5.0, 1.0


def tables() -> Console:
    """Return the console for tables: as wide as the terminal, or wide enough for any table."""
    return console() if sys.stdout.isatty() else _Clean(width=_WIDE)


def console() -> Console:
    """Return the console for other results, as wide as the terminal."""
    return _Clean()


def fits(console: Console, table: Table) -> bool:
    """Return whether a console is wide enough for a table with nothing cut or folded."""
    free = console.options.update(max_width=_WIDE)
    return console.measure(table, options=free).maximum <= console.width


def notify(text: str) -> None:
    """Print a note to stderr, for example on what takes time or deviates from the request."""
    SCREEN.print(text, markup=False, highlight=False, soft_wrap=True)


@contextmanager
def loading() -> Iterator[None]:
    """Announce slow imports in the with block: at once on a terminal, else every five seconds."""
    text = "loading torch and MuJoCo"
    with SCREEN.status(text) if SCREEN.is_terminal else _every(_PATIENCE_S, lambda: notify(text)):
        yield


@contextmanager
def _every(interval_s: float, call: Callable[[], object]) -> Iterator[None]:
    """Call a function every ``interval_s`` from another thread, during the with block."""
    ended = threading.Event()

    def repeat() -> None:
        while not ended.wait(interval_s):
            call()

    thread = threading.Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def confirmed(question: str) -> bool:
    """Return whether the user says yes; Ctrl-C and a missing input mean no."""
    try:
        return typer.confirm(question)
    except typer.Abort:  # Ctrl-C, or no input
        print()
        return False


@contextmanager
def bars(patience_s: float = 0.0) -> Iterator[StepProgress]:
    """Show progress: on a terminal, bars with the remaining time; else a line every few seconds.

    Args:
        patience_s: on a terminal, time before the bars appear, s.
    """
    if not SCREEN.is_terminal:
        lines = ProgressLines(notify)
        with _every(_POLL_S, lines.repeat):  # also during a step that reports nothing
            yield lines
        return
    columns = (TextColumn("{task.description}"), BarColumn(), _Amount(), TimeRemainingColumn())
    shown = Bars(*columns, console=SCREEN, transient=True)
    try:
        yield _Rows(shown, time.monotonic() + patience_s)
    finally:
        shown.stop()


@contextmanager
def each(names: Sequence[str]) -> Iterator[Iterator[tuple[str, StepProgress]]]:
    """Iterate over names, each with a callback for its progress, and show how many are done."""
    with bars() as progress:
        yield _announced(names, progress)


def _announced(names: Sequence[str], progress: StepProgress) -> Iterator[tuple[str, StepProgress]]:
    for i, name in enumerate(names):
        if SCREEN.is_terminal:
            progress(f"task {name}", i, len(names))
        elif len(names) > 1:
            notify(f"{name} ({i + 1} of {len(names)})")
        yield name, progress


class _Amount(ProgressColumn):
    """Bytes and their rate for steps that move bytes, counts for all others."""

    def __init__(self) -> None:
        super().__init__()
        self._bytes, self._speed = DownloadColumn(), TransferSpeedColumn()
        self._count = MofNCompleteColumn()

    def render(self, task: Task) -> Text:
        """See rich."""
        if task.description in _BYTE_STEPS:
            return Text(" ").join((self._bytes.render(task), self._speed.render(task)))
        return self._count.render(task)


class _Rows:
    """A StepProgress that shows a row for each kind of step; the kind is the step's first word."""

    def __init__(self, bars: Bars, start_s: float) -> None:
        self._bars, self._start_s = bars, start_s
        self._rows: dict[str, TaskID] = {}
        self._done: dict[str, int] = {}

    def __call__(self, step: str, done: int, total: int) -> None:
        if time.monotonic() >= self._start_s:
            self._bars.start()
        kind = step.partition(" ")[0]
        if kind not in self._rows:
            self._rows[kind] = self._bars.add_task(step, total=None)
        row = self._rows[kind]
        if done < self._done.get(kind, 0):  # the step starts again
            self._bars.reset(row)
        self._done[kind] = done
        # A row without a total pulses.
        self._bars.update(row, description=step, completed=done, total=total or None)
