"""``pgdm pregrasp``: commands and their options; each runs in the module of the same name."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from pgdm.cli.console.screen import loading
from pgdm.cli.options import (
    Hand,
    Image,
    Offline,
    Port,
    Source,
    Task,
    Tasks,
    check_hand,
    complete_tasks,
    existing,
    known_sources,
    tasks_or_files,
)

app = typer.Typer(help="Make pre-grasps, and check them.", no_args_is_help=True)

_Reach = Annotated[
    bool,
    typer.Option(
        "--reach/--no-reach",
        help="Plan the reach; if it succeeds, episodes start where it ends, else at the pre-grasp.",
    ),
]


@app.command()
def reach(
    tasks: Tasks,
    hand: Hand = None,
    source: Source = "mined",
    replace: Annotated[
        bool,
        typer.Option(
            "--replace",
            help="Plan again even if a plan is published or stored; a stored plan from the same "
            "search and seed is kept.",
        ),
    ] = False,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the search.")] = 0,
    offline: Offline = False,
) -> None:
    """Plan the reach from reset pose to pre-grasp; store it if it succeeds."""
    with loading():
        from pgdm.cli.pregrasp.reach import Request, run

    raise typer.Exit(run(Request(tasks, hand, source, replace, seed, offline)))


@app.command()
def check(
    words: Annotated[
        list[str],
        typer.Argument(
            metavar="TASK|FILE...",
            help="Tasks, suites, patterns such as 'dhand-*', or pre-grasp files (.npz).",
            callback=tasks_or_files,
            autocompletion=complete_tasks,
        ),
    ],
    source: Annotated[
        list[str] | None,
        typer.Option(
            help="Check only pre-grasps from this source; can be repeated [all].",
            callback=known_sources,
        ),
    ] = None,
    hand: Hand = None,
    reach: Annotated[
        bool, typer.Option("--reach", help="Plan a reach to pre-grasps without a stored plan.")
    ] = False,
    policies: Annotated[
        int, typer.Option(min=1, help="Number of random closing policies in the lift test.")
    ] = 32,
    seed: Annotated[int, typer.Option(min=0, help="Seed of lift test and reach plan.")] = 0,
    json_file: Annotated[
        Path | None,
        typer.Option("--json", metavar="FILE", help="Also write the measurements to this file."),
    ] = None,
    offline: Offline = False,
) -> None:
    """Measure how good pre-grasps are.

    Measures penetration, fingertip distance, palm angle, lift rate, and errors of the reach.
    """
    with loading():
        from pgdm.cli.pregrasp.check import Request, run

    run(Request(words, hand, source or (), reach, policies, seed, json_file, offline))


@app.command()
def mocap(
    task: Task,
    hand: Hand = None,
    file: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Human hand joints (.npz, .json, .csv); by default the library's expert, else "
            "points of the task's own hand at its stored pre-grasp.",
            callback=existing,
        ),
    ] = None,
    frame: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Frame of the recording; by default the last before contact in a FILE, the first "
            "in the library's expert.",
        ),
    ] = None,
    reach: _Reach = True,
    image: Image = None,
    offline: Offline = False,
) -> None:
    """Retarget a human hand to a robot hand (pregrasp=mocap)."""
    with loading():
        from pgdm.cli.pregrasp.mocap import run

    run(task, hand, file, frame, reach, image, offline)


@app.command()
def teleop(
    task: Task,
    file: Annotated[
        Path,
        typer.Argument(
            metavar="FILE",
            help="A DAPG .pickle, a Minari .hdf5 or dataset folder.",
            callback=existing,
        ),
    ],
    demo: Annotated[
        int | None,
        typer.Option(
            min=0,
            help="Index of the demonstration, from 0; by default the usable demonstration whose "
            "object is nearest to the task's.",
        ),
    ] = None,
    reach: _Reach = True,
    image: Image = None,
    offline: Offline = False,
) -> None:
    """Cut a pre-grasp from a demonstration (pregrasp=teleop).

    The pre-grasp is the pose just before the hand takes hold, that is, before its first contact
    that lasts 0.2 s or more.
    """
    with loading():
        from pgdm.cli.pregrasp.teleop import run

    run(task, file, demo, reach, image, offline)


@app.command()
def show(task: Task, hand: Hand = None, offline: Offline = False) -> None:
    """List the pre-grasps of a task, the library's and your own."""
    with loading():
        from pgdm.cli.pregrasp.show import run

    run(task, hand, offline)


@app.command()
def label(
    task: Task,
    hand: Hand = None,
    origin: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="POSE",
            help="Pose to start from: mined, planned, learned, mocap, teleop, labeled, mean, open, "
            "none (reset pose), or a pre-grasp's FILE; by default your draft, else the first that "
            "exists of labeled, planned, mined, mocap and none.",
        ),
    ] = None,
    port: Port = 8090,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page, or only serve it.")
    ] = True,
    offline: Offline = False,
) -> None:
    """Pose the hand in the browser (pregrasp=labeled).

    The page is served to this machine only; Ctrl-C quits.
    """
    with loading():
        from pgdm.cli.pregrasp.label import run

    run(task, hand, origin, port, browser, offline)


@app.command()
def train(
    hand: Annotated[
        str,
        typer.Option(
            help="Hand whose pre-grasps to learn: adroit, dhand, dmanus, or your own.",
            callback=check_hand,
        ),
    ] = "adroit",
    leave_out: Annotated[
        list[str] | None,
        typer.Option(metavar="OBJECT", help="Exclude this object; can be repeated."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write the weights to this file; by default to the file that pregrasp=learned "
            "reads.",
        ),
    ] = None,
) -> None:
    """Train a predictor on the library's mined pre-grasps of a hand and on your own.

    Your own are those made by label, mocap and teleop.
    """
    with loading():
        from pgdm.cli.pregrasp.train import run

    run(hand, leave_out or [], out)


@app.command()
def predict(
    task: Task,
    hand: Hand = None,
    samples: Annotated[int, typer.Option(min=1, help="Number of candidates to lift-test.")] = 8,
    seed: Annotated[
        int, typer.Option(min=0, help="Seed of samples, lift test and reach plan.")
    ] = 0,
    weights: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Weights from 'pgdm pregrasp train --out FILE' [those trained without --out].",
            callback=existing,
        ),
    ] = None,
    reach: _Reach = True,
    image: Image = None,
    offline: Offline = False,
) -> None:
    """Predict a pre-grasp from the object's shape (pregrasp=learned).

    Candidates are sampled, moved out of contact and ranked by lift tests.
    """
    with loading():
        from pgdm.cli.pregrasp.predict import run
        from pgdm.pregrasp.predict.predicted import PredictCfg

    run(task, hand, PredictCfg(samples, seed, reach), weights, image, offline)
