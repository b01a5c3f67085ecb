"""The list of tasks."""

from __future__ import annotations

from dataclasses import dataclass

from rich.console import Console
from rich.table import Table

from pgdm.config.describe import describe
from pgdm.config.groups import available, conf_dir
from pgdm.library import open_library


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
    description = describe(conf_dir() / "task" / f"{name}.yaml")
    value = {key.name: key.value for key in description.keys}
    hand = next(option for key, option in description.defaults.items() if "/hand" in key)
    success = value["paper_success"]
    return TaskRow(
        id=value["id"],
        hand=hand,
        objects=value["objects"].strip("[]"),
        pregrasp_source=value["pregrasp_source"],
        trajectory_source=value["trajectory_source"],
        tcdm30=value["tcdm30"] == "true",
        paper_success="" if success == "null" else f"{float(success):.1%}",
    )


def print_tasks(tcdm30: bool) -> None:
    """Print the tasks, and which source of the asset library serves each."""
    sources = open_library().tasks()
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
    Console(width=100).print(table)
    missing = sum(row.id not in sources for row in rows)
    if missing:
        print(f"{missing} of {len(rows)} tasks are not in the asset library: pgdm assets --help")
