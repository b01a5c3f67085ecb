"""``pgdm pregrasp``: make pre-grasps from every source, and judge them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    help="Make pre-grasps: plan, retarget, cut, label, predict; and check them.",
    no_args_is_help=True,
)

_Task = Annotated[
    str, typer.Argument(metavar="TASK", help="Such as hammer-use1; pgdm assets list has all.")
]
_Hand = Annotated[
    str | None, typer.Option(help="Another hand than the task's: adroit, dhand or dmanus.")
]
_Reach = Annotated[
    bool,
    typer.Option("--reach/--no-reach", help="Plan the way there, and start where the plan ends."),
]
_Image = Annotated[Path | None, typer.Option(metavar="FILE", help="Draw it into this PNG, too.")]
_Offline = Annotated[bool, typer.Option("--offline", help="Never use the network.")]


@app.command()
def mocap(
    task: _Task,
    hand: _Hand = None,
    file: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Human hand joints (.npz, .json, .csv); by default the library's, or the task's "
            "own hand at its pre-grasp.",
        ),
    ] = None,
    frame: Annotated[
        int | None,
        typer.Option(min=0, help="Which frame; by default the last one before contact."),
    ] = None,
    reach: _Reach = True,
    image: _Image = None,
    offline: _Offline = False,
) -> None:
    """Bring any hand to where a human hand was, by inverse kinematics (pregrasp=mocap)."""
    from pgdm.cli.pregrasp_mocap import mocap as make

    make(task, hand, file, frame, reach, image, offline)


@app.command()
def teleop(
    task: _Task,
    file: Annotated[
        Path,
        typer.Argument(metavar="FILE", help="A DAPG .pickle, a Minari .hdf5 or dataset folder."),
    ],
    demo: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Which demonstration, from 0; by default the one whose object stood nearest to "
            "the task's.",
        ),
    ] = None,
    reach: _Reach = True,
    image: _Image = None,
    offline: _Offline = False,
) -> None:
    """Cut a pre-grasp from a demonstration, just before it takes hold (pregrasp=teleop)."""
    from pgdm.cli.pregrasp_teleop import cut

    cut(task, file, demo, reach, image, offline)


@app.command()
def show(task: _Task, hand: _Hand = None, offline: _Offline = False) -> None:
    """List the pre-grasps that a task has: the library's and your own."""
    from pgdm.cli.pregrasp_mocap import show as show_all

    show_all(task, hand, offline)
