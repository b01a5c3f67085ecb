"""``pgdm pregrasp``: make pre-grasps from every source, and judge them."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

app = typer.Typer(
    help="Make pre-grasps: plan, retarget, cut, label, predict; and check them.",
    no_args_is_help=True,
)

_Tasks = Annotated[
    list[str], typer.Argument(metavar="TASK...", help="Tasks, or suites such as tcdm50.")
]
_Hand = Annotated[str | None, typer.Option(help="Another hand than the task's own.")]
_Offline = Annotated[bool, typer.Option("--offline", help="Never use the network.")]
_Seed = Annotated[int, typer.Option(min=0, help="Of the search's random numbers.")]


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
