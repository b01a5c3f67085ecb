"""``pgdm author list``: the user's objects, hands and tasks."""

from __future__ import annotations

from rich.table import Table

from pgdm.cli.console.screen import tables
from pgdm.library.authored import own


def run() -> None:
    """Print the user's objects, hands and tasks."""
    content = own.read()
    if not (content.objects or content.hands or content.tasks):
        print("you have made no objects, hands or tasks yet: pgdm author --help")
        return
    objects = Table("object", "mass", "parts", "mesh", "tasks", box=None, header_style="bold")
    for name in content.objects:
        facts = own.facts(name)
        parts = sum(f.startswith(f"objects/{name}/meshes/contact") for f in content.files)
        mass = f"{1e3 * facts['mass_kg']:.1f} g"
        objects.add_row(name, mass, str(parts), facts["mesh"], ", ".join(own.users_of(name)))
    hands = Table("hand", "side", "fingers", "file", "tasks", box=None, header_style="bold")
    for name in content.hands:
        facts = own.facts(name, "hand")
        fingers = ", ".join(facts["fingers"])
        hands.add_row(name, facts["side"], fingers, facts["file"], ", ".join(own.users_of(name)))
    tasks = Table("task", "hand", "object", "poses", box=None, header_style="bold")
    for task, entry in content.tasks.items():
        tasks.add_row(task, entry.hand, ", ".join(entry.objects), str(entry.steps))
    for table in (objects, hands, tasks):
        if table.row_count:
            tables().print(table)
    print(f"stored in {own.folder()}")
