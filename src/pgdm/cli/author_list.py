"""``pgdm author list`` and ``remove``."""

from __future__ import annotations

import typer
from rich.console import Console
from rich.table import Table

from pgdm.author.task import remove_task
from pgdm.errors import UnknownNameError
from pgdm.library import own


def print_own() -> None:
    """Print the user's objects and tasks."""
    content = own.read()
    if not content.objects and not content.tasks:
        print("you have made no objects or tasks yet: pgdm author object --help")
        return
    objects = Table(box=None, header_style="bold")
    for name in ("object", "mass", "parts", "mesh", "tasks"):
        objects.add_column(name)
    for name in content.objects:
        facts = own.facts(name)
        parts = sum(f.startswith(f"objects/{name}/meshes/contact") for f in content.files)
        mass = f"{1e3 * facts['mass_kg']:.1f} g"
        objects.add_row(name, mass, str(parts), facts["mesh"], ", ".join(own.users_of(name)))
    tasks = Table(box=None, header_style="bold")
    for name in ("task", "hand", "object", "poses"):
        tasks.add_column(name)
    for task, entry in content.tasks.items():
        tasks.add_row(task, entry.hand, ", ".join(entry.objects), str(entry.steps))
    for table in (objects, tasks):
        if table.row_count:
            Console(width=120).print(table)
    print(f"in {own.folder()}")


def remove(name: str, sure: bool) -> None:
    """Remove an object or a task of the user's, after a question.

    Raises:
        UnknownNameError: there is none of that name.
        LibraryError: it is an object in which tasks still play.
    """
    content = own.read()
    if name not in content.objects and name not in content.tasks:
        raise UnknownNameError(
            "object or task of your own", name, [*content.objects, *content.tasks]
        )
    kind = "task" if name in content.tasks else "object"
    if kind == "object":
        own.check_unused(name)
    if not sure and not _confirmed(f"remove the {kind} '{name}'? Nothing brings it back"):
        print("nothing was removed")
        return
    if kind == "object":
        own.remove(name)
    elif (aside := remove_task(name)) is not None:
        print(f"its pre-grasps are kept in {aside}")
    print(f"removed the {kind} '{name}'")


def _confirmed(question: str) -> bool:
    try:
        return typer.confirm(question)
    except typer.Abort:  # nobody there to answer
        print()
        return False
