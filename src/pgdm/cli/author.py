"""``pgdm author``: objects and tasks of one's own."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(help="Make objects from meshes, and tasks from motions.", no_args_is_help=True)


@app.command("object")
def make_object(
    mesh: Annotated[Path, typer.Argument(metavar="MESH", help="STL, OBJ, PLY, GLB or OFF.")],
    name: Annotated[
        str, typer.Option(metavar="NAME", help="Name of the object: small letters, digits, '_'.")
    ],
    scale: Annotated[
        float | None, typer.Option(help="Metres in one unit of the file [1].", metavar="S")
    ] = None,
    unit: Annotated[
        str | None, typer.Option(help="Unit of the file: mm, cm or m.", metavar="UNIT")
    ] = None,
    mass: Annotated[
        float | None, typer.Option(help="Known mass, kg; else the density counts.", metavar="KG")
    ] = None,
    density: Annotated[
        float, typer.Option(help="kg/m3; the benchmark's objects are printed of PLA, 1250.")
    ] = 1250.0,
    parts: Annotated[
        int | None, typer.Option(help="Convex parts at most, 1 to 64.", metavar="N")
    ] = None,
    threshold: Annotated[
        float, typer.Option(help="Concavity that is left, 0.01 to 1; lower gives more parts.")
    ] = 0.05,
    licence: Annotated[
        str, typer.Option(help="Licence of the mesh, recorded with the object.")
    ] = "unstated",
    replace: Annotated[
        bool, typer.Option("--replace", help="Make an object of that name anew.")
    ] = False,
) -> None:
    """Make an object from a mesh: repaired, checked, taken apart, weighed, dropped, pictured."""
    from pgdm.cli.author_object import print_object
    from pgdm.library.author_object import ObjectRequest
    from pgdm.library.author_parts import PartsCfg

    factor = _factor(scale, unit)
    cfg = PartsCfg(threshold, parts)
    print_object(ObjectRequest(mesh, name, factor, mass, density, cfg, licence, replace))


def _factor(scale: float | None, unit: str | None) -> float:
    """Return the metres in one unit of the file."""
    from pgdm.errors import ConfigError, UnknownNameError
    from pgdm.library.author_mesh import UNITS_M

    if scale is not None and unit is not None:
        raise ConfigError("--scale and --unit say the same; give one of them")
    if unit is None:
        return 1.0 if scale is None else scale
    if unit not in UNITS_M:
        raise UnknownNameError("unit", unit, UNITS_M)
    return UNITS_M[unit]
