"""``pgdm report``: results as a page, beside the paper's."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
from rich.progress import Progress as Bar

if TYPE_CHECKING:
    from pgdm.report.source import Progress

_PATIENCE_S = 2.0


def make_report(places: list[str], out: Path | None, uri: str | None) -> None:
    """Write the report and say where it is."""
    from pgdm.report.page import write_report

    first = Path(places[0])
    folder = out or (first if first.is_dir() else Path("runs")) / "report"
    with _shown() as progress:
        page, results = write_report(places, folder, progress, uri)
    states = ", ".join(f"{count} {state}" for state, count in results.counts().items())
    print(f"{len(results.runs)} runs ({states}): {page}")


@contextlib.contextmanager
def _shown() -> Iterator[Progress]:
    """Show a bar on a terminal once it has taken a while."""
    console, began = Console(stderr=True), time.monotonic()
    columns = TextColumn("{task.description}"), BarColumn(20), MofNCompleteColumn()
    with contextlib.ExitStack() as stack:
        bar = Bar(*columns, console=console, transient=True)
        row = bar.add_task("", total=None)

        def progress(step: str, done: int, total: int) -> None:
            bar.update(row, description=step, completed=done, total=total)
            late = time.monotonic() - began > _PATIENCE_S
            if late and console.is_terminal and not bar.live.is_started:
                stack.enter_context(bar)

        yield progress
