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
        float | None,
        typer.Option(help="kg/m3 [1250: the benchmark's objects are printed of PLA].", metavar="D"),
    ] = None,
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
    from pgdm.errors import ConfigError
    from pgdm.library.author_object import DENSITY, ObjectRequest
    from pgdm.library.author_parts import PartsCfg

    factor = _factor(scale, unit)
    if mass is not None and density is not None:
        raise ConfigError("--mass and --density both say how heavy it is; give one of them")
    cfg = PartsCfg(threshold, parts)
    made_of = DENSITY if density is None else density
    print_object(ObjectRequest(mesh, name, factor, mass, made_of, cfg, licence, replace))


@app.command("task")
def make_task(
    object_name: Annotated[
        str, typer.Option("--object", metavar="NAME", help="Object, yours or the library's.")
    ],
    task: Annotated[
        str, typer.Option("--id", metavar="ID", help="Id of the new task, such as gear-lift.")
    ],
    hand: Annotated[str, typer.Option(help="adroit, dhand or dmanus.")] = "adroit",
    keyframes: Annotated[
        Path | None, typer.Option(help="YAML file of keyframes.", metavar="FILE")
    ] = None,
    poses: Annotated[
        Path | None, typer.Option(help="Recorded poses: .csv, .npz or .json.", metavar="FILE")
    ] = None,
    origin: Annotated[
        str, typer.Option(help="What recorded positions are of: com, or mesh (its file's origin).")
    ] = "com",
    pregrasp: Annotated[
        str,
        typer.Option(
            help="mean or open: search the hand near the object with such fingers; later: none "
            "yet; a pre-grasp's .npz; or a task whose fingers are taken.",
            metavar="WHICH",
        ),
    ] = "mean",
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Filter a motion, and have it start and end at rest.")
    ] = False,
    slower: Annotated[float, typer.Option(help="Play it slower by this factor.")] = 1.0,
    lift_above_table: Annotated[
        bool, typer.Option("--lift-above-table", help="Raise what lies in the table.")
    ] = False,
    settle: Annotated[
        bool, typer.Option("--settle", help="Carry the motion to where the object rests.")
    ] = False,
    replace: Annotated[
        bool, typer.Option("--replace", help="Make a task of that id anew.")
    ] = False,
    offline: Annotated[bool, typer.Option("--offline", help="Never use the network.")] = False,
) -> None:
    """Make a task from an object, a hand and a motion; pgdm-run task=ID then trains it."""
    from pgdm.author import TaskRequest
    from pgdm.author.motion import MotionRequest
    from pgdm.cli.author_task import print_task

    motion = MotionRequest(keyframes, poses, origin, smooth, slower, lift_above_table, settle)
    print_task(TaskRequest(task, object_name, hand, motion, pregrasp, replace), offline)


@app.command("list")
def list_own() -> None:
    """List the objects and tasks that you made."""
    from pgdm.cli.author_list import print_own

    print_own()


@app.command("remove")
def remove_own(
    name: Annotated[str, typer.Argument(metavar="NAME", help="An object or a task of yours.")],
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask.")] = False,
) -> None:
    """Remove an object or a task that you made; nothing brings it back."""
    from pgdm.cli.author_list import remove

    remove(name, yes)


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
