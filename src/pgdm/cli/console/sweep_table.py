"""Progress of a sweep: a live table on a terminal, plain lines elsewhere."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from contextlib import suppress

from rich.console import Console, Group
from rich.live import Live
from rich.markup import escape
from rich.progress_bar import ProgressBar
from rich.table import Table
from rich.text import Text

from pgdm import files
from pgdm.sweep.ledger import FAILED, FINISHED, RUNNING, WAITING, Ledger
from pgdm.sweep.queue import Queue
from pgdm.sweep.status import SLOTS, Row, Summary, rows, summarize

PLAIN_INTERVAL_S = 30.0
"""Time between two plain lines."""
_REFRESH_S = 2.0
_TAIL_LINES = 15
_UNKNOWN = "-"
_WIDE = 120


class SweepView:
    """Context manager that shows the running jobs and the progress of a sweep.

    Args:
        name: name of the sweep.
        ledger: ledger of the sweep.
        queue: the sweep's jobs in Slurm.
    """

    def __init__(self, name: str, ledger: Ledger, queue: Queue) -> None:
        self._name, self._ledger, self._queue = name, ledger, queue
        self._console = Console(stderr=True)
        self._live = Live(console=self._console, auto_refresh=False, transient=True)
        self._shown_s = self._printed_s = -math.inf
        self._states: dict[str, str] = {}

    def __enter__(self) -> SweepView:
        if self._console.is_terminal:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def update(self) -> None:
        """Show the current state, unless it was last shown less than two seconds ago."""
        now = time.monotonic()
        if now - self._shown_s < _REFRESH_S:
            return
        self._shown_s = now
        found = rows(self._ledger, self._queue)
        summary = summarize(found, self._ledger.fact(SLOTS) or 1)
        if self._console.is_terminal:
            self._live.update(live_table(self._name, found, summary), refresh=True)
            return
        for row in found:
            if self._states.get(row.key, WAITING) != row.state:
                self._print(_change(row))
        self._states = {row.key: row.state for row in found}
        if now - self._printed_s >= PLAIN_INTERVAL_S:
            self._printed_s = now
            self._print(summary_line(self._name, summary))

    def line(self) -> str:
        """Return the current state in one line."""
        found = rows(self._ledger, self._queue)
        return summary_line(self._name, summarize(found, self._ledger.fact(SLOTS) or 1))

    def failures(self) -> str:
        """Return the failed jobs; see the function ``failures``."""
        return failures(rows(self._ledger, self._queue))

    def _print(self, text: str) -> None:
        self._console.print(text, markup=False, highlight=False, soft_wrap=True)


def summary_line(name: str, summary: Summary) -> str:
    """Return a sweep in one line."""
    states = ", ".join(f"{count} {state}" for state, count in summary.counts.items())
    frames = f"{summary.frames:,} of {summary.total_frames:,} frames"
    left = "" if not summary.left_s else f", about {span(summary.left_s)} left"
    return f"{name}: {states}; {frames}{left}"


def span(seconds: float) -> str:
    """Return a time with two units at most, such as ``3 d 4 h``, ``2 h 5 min``, ``40 s``."""
    parts = []
    for length, unit in ((86400, "d"), (3600, "h"), (60, "min"), (1, "s")):
        count, seconds = divmod(round(seconds), length)
        if count and len(parts) < 2:
            parts.append(f"{count} {unit}")
    return " ".join(parts) or "0 s"


def failures(found: Sequence[Row]) -> str:
    """Return a table of the failed jobs and the end of each one's log; empty if none failed."""
    failed = [row for row in found if row.state == FAILED]
    if not failed:
        return ""
    table = Table(box=None, title=f"{len(failed)} failed", title_justify="left")
    for head in ("job", "attempts", "frames", "error"):
        table.add_column(head, overflow="fold")
    for row in failed:
        error = escape(row.error or "")
        table.add_row(escape(row.name), str(row.attempts), f"{row.frames:,}", error)
    parts = ["", _as_text(table)]
    for row in failed:
        parts.append(f"failed: {row.name} (attempt {row.attempts}), log: {row.log}")
        if row.log is not None and row.log.exists():
            with suppress(OSError):  # the log cannot be read
                text = files.read_bytes(row.log).decode(errors="replace")
                parts += [f"  | {line}" for line in text.splitlines()[-_TAIL_LINES:]]
    return "\n".join(parts)


def _as_text(table: Table) -> str:
    console = Console(width=_WIDE)
    with console.capture() as capture:
        console.print(table)
    return "\n".join(line.rstrip() for line in capture.get().splitlines())


def percent(value: float | None) -> str:
    """Return a share as text."""
    return _UNKNOWN if value is None else f"{value:.1%}"


def _change(row: Row) -> str:
    text = f"{row.state}: {row.name}"
    if row.state == FINISHED:
        return f"{text}, {row.frames:,} frames, success {percent(row.success)}"
    return f"{text}, attempt {row.attempts}" if row.state == RUNNING else text


def live_table(name: str, found: Sequence[Row], summary: Summary) -> Group:
    """Return the running jobs as a table, and the whole sweep below it."""
    table = Table(box=None, header_style="bold")
    for head in ("running", ""):
        table.add_column(head, no_wrap=True)
    for head in ("frames", "steps/s", "success", "left"):
        table.add_column(head, justify="right", no_wrap=True)
    for row in found:
        if row.state == RUNNING:
            table.add_row(
                escape(row.name),
                ProgressBar(row.total_frames, row.frames, width=12),
                f"{row.frames:,}/{row.total_frames:,}",
                _UNKNOWN if row.steps_per_s is None else f"{row.steps_per_s:,.0f}",
                percent(row.success),
                _UNKNOWN if row.left_s is None else span(row.left_s),
            )
    whole = Table.grid()  # a grid ends the line; a bar alone would not
    whole.add_row(ProgressBar(summary.total_frames, summary.frames, width=40))
    return Group(table, whole, Text(summary_line(name, summary)))
