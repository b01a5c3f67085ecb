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
def train(
    hand: Annotated[
        str, typer.Option(help="Whose pre-grasps to learn: adroit, dhand or dmanus.")
    ] = "adroit",
    leave_out: Annotated[
        list[str] | None,
        typer.Option(metavar="OBJECT", help="Never look at this object; may be given again."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Write the weights here, not to the user's folder."),
    ] = None,
) -> None:
    """Learn to predict pre-grasps from objects' shapes, of all that the library has."""
    from pgdm.cli.pregrasp_train import train_predictor

    train_predictor(hand, leave_out or [], out)


@app.command()
def predict(
    task: _Task,
    hand: _Hand = None,
    samples: Annotated[int, typer.Option(min=1, help="Candidates to lift-test.")] = 8,
    seed: Annotated[int, typer.Option(min=0, help="Of samples, lift test and reach plan.")] = 0,
    weights: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Weights of 'pgdm pregrasp train --out FILE'."),
    ] = None,
    reach: _Reach = True,
    image: _Image = None,
    offline: _Offline = False,
) -> None:
    """Predict a pre-grasp from the object's shape: sample, free, rank (pregrasp=learned)."""
    from pgdm.cli.pregrasp_predict import Request, predict_pregrasp

    predict_pregrasp(Request(task, hand, samples, seed, weights, reach, image, offline))
