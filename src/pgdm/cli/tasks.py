"""The list of tasks."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from pgdm.config.describe import describe
from pgdm.config.groups import available, folders
from pgdm.library import animated, open_library, staging


@dataclass(frozen=True)
class TaskRow:
    """What the list shows of a task."""

    id: str
    hand: str
    objects: str
    pregrasp_source: str
    trajectory_source: str
    tcdm30: bool
    paper_success: str


def read_rows() -> list[TaskRow]:
    """Return all tasks, read from their files: composing each would take seconds."""
    return [_row(name) for name in available("task")]


def _row(name: str) -> TaskRow:
    files = [folder / "task" / f"{name}.yaml" for folder in folders(None)]
    description = describe(next(file for file in files if file.is_file()))
    value = {key.name: key.value for key in description.keys}
    hands = [option for key, option in description.defaults.items() if "/hand" in key]
    success = value.get("paper_success", "null")
    # A user's own file may build on another one and leave out what that says.
    return TaskRow(
        id=value.get("id", name),
        hand=hands[0] if hands else "",
        objects=value.get("objects", "").strip("[]"),
        pregrasp_source=value.get("pregrasp_source", ""),
        trajectory_source=value.get("trajectory_source", ""),
        tcdm30=value.get("tcdm30") == "true",
        paper_success="" if success == "null" else f"{float(success):.1%}",
    )


def print_tasks(tcdm30: bool) -> None:
    """Print the tasks, and which source of the asset library serves each."""
    sources = dict.fromkeys(animated.TASKS, staging.ANIMATED) | open_library().tasks()
    table = Table(box=None, pad_edge=False)
    for head in ("task", "hand", "objects", "pre-grasp", "motion", "tcdm30"):
        table.add_column(head)
    table.add_column("paper", justify="right")
    table.add_column("library")
    rows = [row for row in read_rows() if row.tcdm30 or not tcdm30]
    for row in rows:
        table.add_row(
            *(row.id, row.hand, row.objects, row.pregrasp_source, row.trajectory_source),
            "yes" if row.tcdm30 else "",
            row.paper_success,
            sources.get(row.id, "-"),
        )
    Console(width=110).print(table)
    missing = sum(row.id not in sources for row in rows)
    if missing:
        print(f"{missing} of {len(rows)} tasks are not in the asset library: pgdm assets --help")
