"""``pgdm pregrasp``: make pre-grasps from every source, and judge them."""

from __future__ import annotations

from typing import Annotated

import typer

app = typer.Typer(
    help="Make pre-grasps: plan, retarget, cut, label, predict; and check them.",
    no_args_is_help=True,
)


@app.command()
def label(
    task: Annotated[
        str, typer.Argument(metavar="TASK", help="Such as hammer-use1; pgdm tasks lists them.")
    ],
    hand: Annotated[
        str | None, typer.Option(help="Another hand than the task's: adroit, dhand or dmanus.")
    ] = None,
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
    offline: Annotated[bool, typer.Option("--offline", help="Never use the network.")] = False,
) -> None:
    """Pose the hand in the browser (on this machine only); Ctrl-C ends it."""
    from pgdm.cli.pregrasp_label import label as serve

    serve(task, hand, origin, port, browser, offline)
