"""``pgdm author object``: what it prints and draws."""

from __future__ import annotations

from rich.console import Console
from rich.table import Table

from pgdm.cli.assets import bars
from pgdm.cli.train import notify
from pgdm.errors import RenderError
from pgdm.library.author_object import AuthoredObject, ObjectRequest, author_object
from pgdm.sim.object_sheet import write_object_sheet


def print_object(request: ObjectRequest) -> None:
    """Make an object, say what was found and done, and draw it.

    Raises:
        PgdmError: the mesh cannot be used, a value is wrong, or the object cannot be kept.
    """
    with bars() as progress:
        made = author_object(request, progress)
    for repair in made.mesh.repairs:
        print(f"note: {repair}")
    table = Table(box=None, show_header=False)
    table.add_column(style="bold")
    table.add_column(overflow="fold")
    for name, text in made.rows():
        table.add_row(name, text)
    Console().print(table, markup=False)
    print(f"object:  {made.folder / 'object.xml'}")
    _draw(made)
    print(f"next:    pgdm author task --object {made.name} --keyframes FILE --id {made.name}-lift")


def _draw(made: AuthoredObject) -> None:
    titles = (f"{made.name}: {made.rows()[0][1]}, {made.rows()[5][1]}", made.rows()[6][1])
    lines = titles[0], f"convex parts: {titles[1]}"
    try:
        path = write_object_sheet(made.folder / "object.xml", lines, made.folder / "picture.png")
    except RenderError as error:
        notify(f"no picture: {error}")
        return
    print(f"picture: {path}")
