"""``pgdm author``: objects and tasks of one's own."""

from __future__ import annotations

import typer

app = typer.Typer(help="Make objects from meshes, and tasks from motions.", no_args_is_help=True)
