"""``pgdm runs``: what lies in a folder of runs, and MLflow rebuilt from it."""

from __future__ import annotations

import json
import math
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.table import Table
from typer.core import TyperGroup

from pgdm import paths
from pgdm.cli.sweep import settled
from pgdm.errors import RunError
from pgdm.tracking.run_folder import RunFolder, find_runs
from pgdm.tracking.run_log import metrics_of

_WIDE = 200  # columns where nobody's terminal sets them: in a file or a pipe nothing is cut
_UNKNOWN = "-"
_COLOURS = {"running": "cyan", "finished": "green", "interrupted": "yellow", "failed": "red"}

# Column -> (key in a row, format); text columns have no format.
_COLUMNS = {
    "task": ("task", None),
    "method": ("method", None),
    "algo": ("algo", None),
    "action": ("action", None),
    "start": ("start", None),
    "seed": ("seed", "d"),
    "frames": ("frames", ",d"),
    "success": ("success", ".1%"),
    "error": ("com_error_released", ".2e"),
    "lifted": ("lifted", ".0%"),
    "steps/s": ("steps_per_s", ",.0f"),
    "status": ("status", None),
    "when": ("when", None),
    "run": ("run", None),
}


class _ListByDefault(TyperGroup):
    """``runs DIR`` is ``runs list DIR``: a first word that is no command is a folder."""

    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:  # type: ignore[override]
        if not args or (args[0] not in self.commands and args[0] != "--help"):
            args = ["list", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(cls=_ListByDefault, help="Show local runs; `sync` rebuilds MLflow from them.")

Root = Annotated[Path | None, typer.Argument(metavar="DIR", help="Folder of runs [runs].")]
AsJson = Annotated[bool, typer.Option("--json", help="Print JSON for programs, not a table.")]
Uri = Annotated[str | None, typer.Option(help="MLflow store to fill, such as http://host:5000.")]


@app.command("list")
def list_runs(root: Root = None, as_json: AsJson = False) -> None:
    """Show a folder's runs, the latest last (`pgdm runs [DIR]` does this)."""
    root = _existing(root)
    rows = sorted((row(folder, root) for folder in find_runs(root)), key=lambda r: r["modified"])
    if as_json:
        print(json.dumps(rows, indent=1))
    elif rows:
        _console().print(_table(rows))
    else:
        print(f"no runs in {root}; `pgdm-run` starts one")


@app.command("sync")
def sync_runs(root: Root = None, uri: Uri = None) -> None:
    """Make MLflow show each run of a folder as the folder's own records do."""
    from pgdm.tracking.sync import Synced, sync

    root = _existing(root)
    for plan in sorted(root.glob("sweeps/*/plan.json")):
        settled(plan.parent)

    def notify(done: Synced) -> None:
        reason = f" ({done.reason})" if done.reason else ""
        print(f"{done.action:<11}{_relative(done.folder, root)}{reason}")

    counts = Counter(done.action for done in sync(root, uri, notify))
    print(", ".join(f"{count} {action}" for action, count in counts.items()) or "no runs")


def row(folder: RunFolder, root: Path) -> dict[str, Any]:
    """Return what a table shows of a run; None where it is not known.

    Args:
        folder: the run. One that cannot be read gets the status ``unreadable``.
        root: the folder of runs, to name the run in it.
    """
    base = {"run": _relative(folder, root), "modified": folder.modified()}
    try:
        tags = folder.tags()
        lines = folder.log.tail()
    except RunError as error:
        return {**base, "status": "unreadable", "reason": str(error)}
    last = lines[-1] if lines else {}
    evaluations = [line for line in lines if line["kind"] == "eval"]
    evaluation = metrics_of(evaluations[-1]) if evaluations else {}
    metrics = {**evaluation, **folder.result.get("metrics", {})}
    rates = [line["train/steps_per_s"] for line in lines if "train/steps_per_s" in line]
    named = ("success", "com_error_released", "lifted")
    return {
        **{key: tags.get(key) for key in ("task", "hand", "method", "algo", "action")},
        # What the run itself found where it was asked for, else what was asked for.
        "start": tags.get("pregrasp_used", tags.get("pregrasp_source")),
        "ablation": tags.get("ablation"),
        "seed": folder.setting("seed"),
        "frames": folder.result.get("frames", last.get("frames")),
        **{name: _finite(metrics.get(f"eval_sampled/{name}")) for name in named},
        "steps_per_s": _finite(folder.result.get("steps_per_s", rates[-1] if rates else None)),
        "status": folder.status(),
        **base,
    }


def _table(rows: list[dict[str, Any]]) -> Table:
    caption = "success (within 1 cm), error (released form, m), lifted: last evaluation, sampled"
    table = Table(caption=caption, box=None, header_style="bold", caption_justify="left")
    for name, (_, form) in _COLUMNS.items():
        table.add_column(name, justify="right" if form else "left", overflow="fold")
    for values in rows:
        shown = {**values, "when": _ago(time.time() - values["modified"])}
        if values.get("ablation") not in (None, "none"):
            shown["start"] = f"{values['start']} {values['ablation']}"
        cells = [_cell(shown.get(key), form) for key, form in _COLUMNS.values()]
        status = list(_COLUMNS).index("status")
        colour = _COLOURS.get(values["status"], "red")
        cells[status] = f"[{colour}]{values['status']}[/]"
        table.add_row(*cells)
    return table


def _cell(value: Any, form: str | None) -> str:
    if value is None:
        return _UNKNOWN
    if form is None or isinstance(value, str):
        return str(value).replace("[", r"\[")
    return format(int(value) if form.endswith("d") else value, form)


def _ago(seconds: float) -> str:
    for length, unit in ((86400, "d"), (3600, "h"), (60, "min")):
        if seconds >= length:
            return f"{seconds / length:.0f} {unit} ago"
    return "just now"


def _finite(value: Any) -> float | None:
    is_number = isinstance(value, int | float) and math.isfinite(value)
    return float(value) if is_number else None


def _relative(folder: RunFolder, root: Path) -> str:
    return str(folder.path.relative_to(root.absolute()))


def _existing(root: Path | None) -> Path:
    chosen = root or paths.runs()
    if not chosen.is_dir():
        hint = "`pgdm-run` makes one" if root is None else "name a folder that holds runs"
        raise RunError(f"there is no folder '{chosen}'; {hint}")
    return chosen


def _console() -> Console:
    return Console() if sys.stdout.isatty() else Console(width=_WIDE)
