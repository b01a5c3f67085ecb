"""``pgdm tasks``: the list of tasks."""

from __future__ import annotations

from pathlib import Path

from rich.table import Table

from pgdm.cli.console.screen import tables
from pgdm.config.describe import describe
from pgdm.config.groups import available, folders, unreadable
from pgdm.errors import amount
from pgdm.files import reason
from pgdm.library import animated, open_library, staging

_HEADS = ("task", "hand", "objects", "pre-grasp", "motion", "tcdm30", "paper", "library")


def print_tasks(tcdm30: bool) -> None:
    """Print the tasks, and the library source that serves each."""
    sources = dict.fromkeys(animated.TASKS, staging.ANIMATED) | open_library().tasks()
    table = Table(box=None, pad_edge=False)
    for head in _HEADS:
        table.add_column(head, justify="right" if head == "paper" else "left")
    cells, wrong = [], unreadable("task")
    for name in available("task"):
        file = next(f for one in folders(None) if (f := one / "task" / f"{name}.yaml").is_file())
        try:
            cells.append(_cells(name, file))
        except (OSError, ValueError) as error:
            wrong[file] = reason(error)
    rows = [row for row in cells if row[_HEADS.index("tcdm30")] or not tcdm30]
    for row in rows:
        table.add_row(*row, sources.get(row[0], "-"))
    tables().print(table)
    for file, why in wrong.items():
        print(f"unreadable: {file}: {why}; correct or remove it")
    missing = sum(row[0] not in sources for row in rows)
    if missing:
        count = f"{missing} of {amount(len(rows), 'task')}"
        print(f"not in the asset library (pgdm assets --help): {count}")


def _cells(name: str, file: Path) -> list[str]:
    """Return a task's row without the column ``library``.

    The row is read from the task's file, since composing the settings takes far longer.
    """
    description = describe(file)
    value = {key.name: key.value for key in description.keys}
    hands = [option for key, option in description.defaults.items() if "/hand" in key]
    success = value.get("paper_success", "null")
    # A user's file may extend another file and omit its keys.
    return [
        value.get("id", name),
        hands[0] if hands else "",
        value.get("objects", "").strip("[]"),
        value.get("pregrasp_source", ""),
        value.get("trajectory_source", ""),
        "yes" if value.get("tcdm30") == "true" else "",
        "" if success == "null" else f"{float(success):.1%}",
    ]
