"""``pgdm author object``: make an object from a mesh, print its properties and draw it."""

from __future__ import annotations

from rich.table import Table

from pgdm.cli.console.screen import bars, console, notify
from pgdm.errors import ConfigError, RenderError, check_name
from pgdm.library.authored.mesh import UNITS_M
from pgdm.library.authored.object import AuthoredObject, ObjectRequest, author_object
from pgdm.sim.object_sheet import write_object_sheet


def metres(scale: float | None, unit: str | None) -> float:
    """Return the metres per unit of a mesh's file.

    Raises:
        ConfigError: both are given, or the unit is unknown.
    """
    if scale is not None and unit is not None:
        raise ConfigError("--scale and --unit exclude each other; give one of them")
    if unit is None:
        return 1.0 if scale is None else scale
    check_name("unit", unit, UNITS_M)
    return UNITS_M[unit]


def run(request: ObjectRequest) -> None:
    """Make an object, print repairs and properties, and draw it.

    Raises:
        PgdmError: the mesh cannot be used, a value is wrong, or the object cannot be stored.
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
    console().print(table, markup=False)
    print(f"object:  {made.folder / 'object.xml'}")
    _draw(made)
    print(f"next:    pgdm author task --object {made.name} --keyframes FILE --id {made.name}-lift")


def _draw(made: AuthoredObject) -> None:
    values = [text for _, text in made.rows()]
    lines = f"{made.name}: {values[0]}, {values[5]}", f"convex parts: {values[6]}"
    try:
        path = write_object_sheet(made.folder / "object.xml", lines, made.folder / "picture.png")
    except RenderError as error:
        notify(f"no picture: {error}")
        return
    print(f"picture: {path}")
