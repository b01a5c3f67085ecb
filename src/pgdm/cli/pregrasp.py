"""``pgdm pregrasp``: make pre-grasps from every source, and judge them."""

from __future__ import annotations

import typer

app = typer.Typer(
    help="Make pre-grasps: plan, retarget, cut, label, predict; and check them.",
    no_args_is_help=True,
)
