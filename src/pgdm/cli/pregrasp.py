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
_Tasks = Annotated[
    list[str], typer.Argument(metavar="TASK...", help="Tasks, or suites such as tcdm50.")
]
_Seed = Annotated[int, typer.Option(min=0, help="Of the search's random numbers.")]
_Reach = Annotated[
    bool,
    typer.Option("--reach/--no-reach", help="Plan the way there, and start where the plan ends."),
]
_Image = Annotated[Path | None, typer.Option(metavar="FILE", help="Draw it into this PNG, too.")]
_Offline = Annotated[bool, typer.Option("--offline", help="Never use the network.")]


@app.command()
def reach(
    tasks: _Tasks,
    hand: _Hand = None,
    source: Annotated[
        str, typer.Option(help="Pre-grasp to reach: mined, mocap, teleop, labeled or learned.")
    ] = "mined",
    replace: Annotated[
        bool, typer.Option("--replace", help="Also where a plan is published, or there already.")
    ] = False,
    seed: _Seed = 0,
    offline: _Offline = False,
) -> None:
    """Plan the hand's way from its reset pose to a pre-grasp, and store the plan."""
    from pgdm.cli.pregrasp_reach import ReachRequest, plan_reaches

    request = ReachRequest(tasks, hand, source, replace, seed, offline)
    raise typer.Exit(plan_reaches(request))


@app.command()
def check(
    words: Annotated[
        list[str],
        typer.Argument(metavar="TASK|FILE...", help="Tasks, suites, or files of pre-grasps."),
    ],
    source: Annotated[
        list[str] | None,
        typer.Option(help="Only pre-grasps from here, again for more; by default all there are."),
    ] = None,
    hand: _Hand = None,
    reach: Annotated[
        bool, typer.Option("--reach", help="Where no plan is stored, try to make one.")
    ] = False,
    policies: Annotated[
        int, typer.Option(min=1, help="Random closing policies of the lift test.")
    ] = 32,
    seed: _Seed = 0,
    json_file: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Write the figures here too.")
    ] = None,
    offline: _Offline = False,
) -> None:
    """Measure pre-grasps: free of contact, near, facing the object, reachable, able to lift."""
    from pgdm.cli.pregrasp_check import CheckRequest, check_pregrasps

    check_pregrasps(
        CheckRequest(words, hand, source or (), reach, policies, seed, json_file, offline)
    )


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


@app.command()
def label(
    task: _Task,
    hand: _Hand = None,
    origin: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="POSE",
            help="Pose to start from: mined, planned, learned, mocap, teleop, labeled, mean, open, "
            "none, or a pre-grasp's FILE; by default your draft, else the best that there is.",
        ),
    ] = None,
    port: Annotated[
        int,
        typer.Option(min=0, max=65535, help="Port; another one is taken if it is in use."),
    ] = 8090,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page, or only serve it.")
    ] = True,
    offline: _Offline = False,
) -> None:
    """Pose the hand in the browser (on this machine only); Ctrl-C ends it."""
    from pgdm.cli.pregrasp_label import label as serve

    serve(task, hand, origin, port, browser, offline)


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
    from pgdm.pregrasp.predict.predicted import PredictCfg

    how = PredictCfg(samples, seed, reach)
    predict_pregrasp(Request(task, hand, how, weights, image, offline))
