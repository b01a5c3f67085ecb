"""``pgdm runs``: list and remove the runs in a folder, and rebuild MLflow from them."""

from __future__ import annotations

import fnmatch
import itertools
import json
import math
import shutil
import time
from collections import Counter
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.table import Table
from rich.text import Text
from typer.core import TyperGroup

from pgdm import paths
from pgdm.cli.console.screen import bars, confirmed, fits, tables
from pgdm.cli.options import Runs
from pgdm.errors import ConfigError, RunError, UnknownNameError, amount
from pgdm.runs.folder import RunFolder, claimed, find_runs, folder_of, located
from pgdm.runs.log import metrics_of

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


# Columns that a narrow terminal leaves out, in this order; the run's name, which is then printed
# below its row, contains most of these values.
_NEEDLESS = ("action", "algo", "start", "method", "steps/s", "lifted", "error", "when", "seed")


class _ListByDefault(TyperGroup):
    """``runs DIR`` is ``runs list DIR``: a first word that is not a command is a folder."""

    def parse_args(self, ctx: typer.Context, args: list[str]) -> list[str]:  # type: ignore[override]
        if not args or (args[0] not in self.commands and args[0] not in ("-h", "--help")):
            args = ["list", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(cls=_ListByDefault, help="List or remove runs, or rebuild MLflow from them.")

AsJson = Annotated[bool, typer.Option("--json", help="Print JSON instead of a table.")]
Uri = Annotated[
    str | None,
    typer.Option(
        help="MLflow store to fill, such as http://host:5000 [MLFLOW_TRACKING_URI, else mlflow.db "
        "in DIR]."
    ),
]


Where = Annotated[
    list[str] | None,
    typer.Option(
        metavar="COLUMN=VALUE",
        help="List only matching runs, as in task=cup* or status=failed; if repeated, runs must "
        "match all.",
    ),
]
Sort = Annotated[
    str,
    typer.Option(
        metavar="COLUMN", help="Sort by this column, largest last; -COLUMN: largest first."
    ),
]
Limit = Annotated[
    int | None,
    typer.Option(
        "--limit", "-n", min=1, help="List only the N largest, or the N latest if sorted by time."
    ),
]


@app.command("list")
def list_runs(
    root: Runs = None,
    where: Where = None,
    sort: Sort = "when",
    limit: Limit = None,
    as_json: AsJson = False,
) -> None:
    """List a folder's runs, the latest last; same as `pgdm runs [DIR]`."""
    root, matches, order = _existing(root), _matcher(where or ()), _order(sort)
    folders, rows = find_runs(root), []
    with bars(patience_s=2.0) as progress:
        for folder in folders:
            progress("reading runs", len(rows), len(folders))
            rows.append(row(folder, root))
    found, count = len(rows), limit or len(rows)
    rows = sorted(filter(matches, rows), key=order)[-count:]
    rows = rows[::-1] if sort.startswith("-") else rows
    if as_json:
        print(json.dumps(rows, indent=1))
    elif rows:
        _print(rows)
    elif found:
        print(f"of {amount(found, 'run')} in {root} none has {', '.join(where or ())}")
    else:
        print(f"no runs in {root}; `pgdm-run` starts one")


@app.command("remove")
def remove_runs(
    runs: Annotated[list[Path], typer.Argument(metavar="RUN...", help="Folders of runs.")],
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")] = False,
) -> None:
    """Remove runs with all their files; this cannot be undone."""
    folders = [RunFolder(folder_of(path)) for path in runs]
    for path, folder in zip(map(located, runs), folders, strict=True):
        if path.is_file() or folder.path.is_symlink():
            raise RunError(f"'{path}' is a link, or a file in a run; name the run's own folder")
        if folder.status() == "running":
            raise RunError(f"'{folder.path}' is running; stop it first")
    names = ", ".join(str(folder.path) for folder in folders)
    if not yes and not confirmed(f"remove {names}? This cannot be undone"):
        print("nothing was removed")
        return
    for folder in folders:
        with claimed(folder.path):
            shutil.rmtree(folder.path)
        print(f"removed {folder.path}")


@app.command("sync")
def sync_runs(root: Runs = None, uri: Uri = None) -> None:
    """Bring MLflow up to date with the run folders."""
    from pgdm.cli.sweep import settled
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
    """Return the values of a run that the table shows; None if unknown.

    Args:
        folder: the run; if it cannot be read, its status is ``unreadable``.
        root: the folder of runs; the run's name is its path relative to this folder.
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
        # The source that was used, or the requested one if the run did not record it.
        "start": tags.get("pregrasp_used", tags.get("pregrasp_source")),
        "ablation": tags.get("ablation"),
        "seed": folder.setting("seed"),
        "frames": folder.result.get("frames", last.get("frames")),
        **{name: _finite(metrics.get(f"eval_sampled/{name}")) for name in named},
        "steps_per_s": _finite(folder.result.get("steps_per_s", rates[-1] if rates else None)),
        "status": folder.status(),
        **base,
    }


def _key(column: str) -> str:
    """Return a column's key in a row, given the column's heading or the key itself.

    Raises:
        UnknownNameError: if there is no such column.
    """
    keys = {name: key for name, (key, _) in _COLUMNS.items()} | {"when": "modified"}
    keys |= {key: key for key in (*keys.values(), "hand", "ablation")}
    if column not in keys:
        raise UnknownNameError("column", column, keys)
    return keys[column]


def _matcher(where: Sequence[str]) -> Callable[[dict[str, Any]], bool]:
    """Return a function that says whether a row meets conditions such as ``task=cup*``."""
    wanted = []
    for text in where:
        column, equals, value = text.partition("=")
        if not equals:
            raise ConfigError(f"cannot read '{text}'; write COLUMN=VALUE, such as status=failed")
        wanted.append((_key(column), value))
    return lambda found: all(
        fnmatch.fnmatchcase(_cell(found.get(key), None), value) for key, value in wanted
    )


def _order(sort: str) -> Callable[[dict[str, Any]], Any]:
    """Return the sort key of rows; rows without the value come first."""
    key = _key(sort.removeprefix("-"))

    def order(found: dict[str, Any]) -> tuple[bool, bool, Any]:
        value = found.get(key)
        is_text = not isinstance(value, int | float)
        return value is not None, is_text, str(value) if is_text else value

    return order


def _print(rows: list[dict[str, Any]]) -> None:
    console = tables()
    columns = list(_COLUMNS)
    table = _table(rows, columns)
    if fits(console, table):
        console.print(table)
        return
    columns.remove("run")
    for name in ("", *_NEEDLESS):
        columns = [column for column in columns if column != name]
        table = _table(rows, columns)
        if fits(console, table):
            break
    with console.capture() as capture:
        console.print(table)
    head, *lines = capture.get().splitlines()
    console.print(Text.from_ansi(head))
    for line, values in itertools.zip_longest(lines, rows, fillvalue=None):
        console.print(Text.from_ansi(line or ""))
        if values:  # not through rich, which would cut the name; users copy it into commands
            print(f"  {values['run']}", flush=True)


def _table(rows: list[dict[str, Any]], columns: Sequence[str]) -> Table:
    caption = "success (within 1 cm), error (released form, m), lifted: last evaluation, sampled"
    table = Table(caption=caption, box=None, header_style="bold", caption_justify="left")
    chosen = {name: _COLUMNS[name] for name in columns}
    for name, (_, form) in chosen.items():
        table.add_column(name, justify="right" if form else "left", overflow="fold")
    for values in rows:
        shown = {**values, "when": _ago(time.time() - values["modified"])}
        if values.get("ablation") not in (None, "none"):
            shown["start"] = f"{values['start']} {values['ablation']}"
        cells = [_cell(shown.get(key), form) for key, form in chosen.values()]
        status = list(chosen).index("status")
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
