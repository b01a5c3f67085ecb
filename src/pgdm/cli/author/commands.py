"""``pgdm author``: commands and their options; each runs in the module of the same name."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pgdm.cli.console.screen import loading
from pgdm.cli.options import Offline, check_hand, existing
from pgdm.config.groups import conf_dir
from pgdm.config.suites import suites
from pgdm.errors import ConfigError, check_name
from pgdm.library import open_library
from pgdm.library.authored import own

app = typer.Typer(
    help="Make your own objects from meshes, hands from models, and tasks from motions.",
    no_args_is_help=True,
)


@app.command("object")
def make_object(
    mesh: Annotated[
        Path, typer.Argument(metavar="MESH", help="STL, OBJ, PLY, GLB or OFF.", callback=existing)
    ],
    name: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Name of the object: a lower-case letter, then lower-case letters, digits, '_'.",
        ),
    ],
    scale: Annotated[
        float | None, typer.Option(help="Metres per unit of the file [1].", metavar="S")
    ] = None,
    unit: Annotated[
        str | None, typer.Option(help="Unit of the file: mm, cm or m.", metavar="UNIT")
    ] = None,
    mass: Annotated[
        float | None,
        typer.Option(help="Mass, kg [from volume and density].", metavar="KG"),
    ] = None,
    density: Annotated[
        float | None,
        typer.Option(
            help="Density, kg/m3 [1250: PLA, as in the benchmark's printed objects].",
            metavar="D",
        ),
    ] = None,
    parts: Annotated[
        int | None,
        typer.Option(
            help="Largest number of convex parts, 1 to 64 [as many as --threshold needs].",
            metavar="N",
        ),
    ] = None,
    threshold: Annotated[
        float,
        typer.Option(
            help="Concavity that may remain, as a fraction (0.01 to 1) of the object's size; lower "
            "gives more parts."
        ),
    ] = 0.05,
    licence: Annotated[
        str, typer.Option(help="Licence of the mesh, recorded with the object.")
    ] = "unstated",
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace an object of that name.")
    ] = False,
) -> None:
    """Make an object from a mesh.

    The mesh is repaired, checked and split into convex parts. The object's mass and inertia are
    computed; it is dropped on a table in simulation, and drawn to picture.png in its folder.
    """
    own.check_object_name(name, replace)
    with loading():
        from pgdm.cli.author.object import metres, run
        from pgdm.library.authored.object import DENSITY, ObjectRequest
        from pgdm.library.authored.parts import PartsCfg

    factor = metres(scale, unit)
    if mass is not None and density is not None:
        raise ConfigError("--mass and --density both give the mass; use one of them")
    cfg = PartsCfg(threshold, parts)
    material = DENSITY if density is None else density
    run(ObjectRequest(mesh, name, factor, mass, material, cfg, licence, replace))


@app.command("hand")
def make_hand(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="MJCF or URDF.", callback=existing)],
    name: Annotated[
        str,
        typer.Option(
            metavar="NAME",
            help="Name of the hand: a lower-case letter, then lower-case letters, digits, '_'.",
        ),
    ],
    fingers: Annotated[
        list[str] | None,
        typer.Option(
            help="A link or joint of each finger, if pgdm cannot find the fingers: "
            "thumb=LINK,index=LINK,...",
            metavar="LIST",
        ),
    ] = None,
    reset: Annotated[
        list[str] | None,
        typer.Option(
            help="Joint positions in the reset pose, rad or m: JOINT=POSITION,... [zero, or the "
            "limit nearest to zero].",
            metavar="LIST",
        ),
    ] = None,
    mount: Annotated[
        str,
        typer.Option(help="Wrist position in the reset pose, m, world frame.", metavar="X,Y,Z"),
    ] = "0,-0.27,0.2",
    turn: Annotated[
        str,
        typer.Option(
            help="Rotate the hand about the world's x, then y, then z axis, degrees; unrotated, "
            "fingers point along y and the palm down.",
            metavar="X,Y,Z",
        ),
    ] = "0,0,0",
    kp: Annotated[
        float | None,
        typer.Option(
            help="Gain of all finger and wrist servos, N m/rad [the file's, or 3].", metavar="KP"
        ),
    ] = None,
    drop_tendons: Annotated[
        bool,
        typer.Option(
            "--drop-tendons",
            help="Leave out actuators on tendons; each joint gets a servo instead.",
        ),
    ] = False,
    root: Annotated[
        Path | None,
        typer.Option(
            help="Folder that must contain all meshes [the file's folder].",
            metavar="DIR",
            callback=existing,
        ),
    ] = None,
    licence: Annotated[
        str, typer.Option(help="Licence of the model, recorded with the hand.")
    ] = "unstated",
    replace: Annotated[
        bool, typer.Option("--replace", help="Replace a hand of that name.")
    ] = False,
) -> None:
    """Make a hand from MJCF or URDF.

    The hand gets six base joints, tracked points, a reset pose, a mean hand, and a position servo
    for each joint that is not coupled to another; it is checked and drawn to picture.png in its
    folder.
    """
    shipped = [path.stem for path in (conf_dir() / "hand").glob("*.yaml")]
    own.check_hand_name(name, shipped, replace)
    with loading():
        from pgdm.author.hand import HandRequest
        from pgdm.cli.author.hand import angles, numbers, pairs, run

    run(
        HandRequest(
            file=file,
            name=name,
            root=root,
            fingers=pairs("--fingers", fingers) if fingers else {},
            reset=angles(reset) if reset else {},
            kp=kp,
            place=numbers("--mount", mount),
            turn_deg=numbers("--turn", turn),
            drop_tendons=drop_tendons,
            licence=licence,
            replace=replace,
        )
    )


@app.command("task")
def make_task(
    object_name: Annotated[
        str, typer.Option("--object", metavar="NAME", help="Object, yours or the library's.")
    ],
    task: Annotated[
        str, typer.Option("--id", metavar="ID", help="Id of the new task, such as gear-lift.")
    ],
    hand: Annotated[
        str, typer.Option(help="adroit, dhand, dmanus, or your own.", callback=check_hand)
    ] = "adroit",
    keyframes: Annotated[
        Path | None,
        typer.Option(help="YAML file of keyframes.", metavar="FILE", callback=existing),
    ] = None,
    poses: Annotated[
        Path | None,
        typer.Option(
            help="Recorded poses: .csv, .npz or .json.", metavar="FILE", callback=existing
        ),
    ] = None,
    origin: Annotated[
        str,
        typer.Option(
            help="Only --poses: point whose positions were recorded: com (centre of mass), or mesh "
            "(the mesh file's origin)."
        ),
    ] = "com",
    pregrasp: Annotated[
        str,
        typer.Option(
            help="mean, open or TASK: search for a pose near the object, with fingers close to the "
            "mean hand, the open hand or that task's pre-grasp; FILE.npz: use this pre-grasp; "
            "later: make the task without one.",
            metavar="WHICH",
        ),
    ] = "mean",
    smooth: Annotated[
        bool, typer.Option("--smooth", help="Filter the motion, and start and end it at rest.")
    ] = False,
    slower: Annotated[float, typer.Option(help="Slow the motion down by this factor.")] = 1.0,
    lift_above_table: Annotated[
        bool, typer.Option("--lift-above-table", help="Raise poses that cut into the table.")
    ] = False,
    settle: Annotated[
        bool,
        typer.Option(
            "--settle", help="Shift and turn the motion to start where the object comes to rest."
        ),
    ] = False,
    replace: Annotated[bool, typer.Option("--replace", help="Replace a task of that id.")] = False,
    offline: Offline = False,
) -> None:
    """Make a task from an object, a hand and a motion (--keyframes or --poses).

    Train it with pgdm-run task=ID.
    """
    own.check_task_name(task, suites(), replace)
    library = open_library()
    # If the library, which provides the hands and the table, is empty, ``run`` fills it first.
    if library.is_filled:
        check_name("object", object_name, library.objects())
    with loading():
        from pgdm.author import TaskRequest
        from pgdm.author.motion import MotionRequest
        from pgdm.cli.author.task import run

    motion = MotionRequest(keyframes, poses, origin, smooth, slower, lift_above_table, settle)
    run(TaskRequest(task, object_name, hand, motion, pregrasp, replace), offline)


@app.command("list")
def list_own() -> None:
    """List your own objects, hands and tasks."""
    from pgdm.cli.author.list import run

    run()


@app.command("remove")
def remove_own(
    name: Annotated[
        str, typer.Argument(metavar="NAME", help="One of your objects, hands or tasks.")
    ],
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")] = False,
) -> None:
    """Remove one of your objects, hands or tasks; this cannot be undone."""
    from pgdm.cli.author.remove import run

    run(name, yes)
