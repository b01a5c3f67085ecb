"""``pgdm compare``: runs side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from rich.table import Table
from rich.text import Text

from pgdm.cli.console.screen import tables
from pgdm.errors import ConfigError
from pgdm.report.compare import Comparison
from pgdm.runs.folder import RunFolder, folder_of


def compare_runs(runs: Sequence[Path], image: Path) -> None:
    """Print differences and results of runs, and draw their curves.

    Raises:
        ConfigError: if fewer than two different runs are named.
        RunError: if a path is not a run, or a run cannot be read.
    """
    folders = list(dict.fromkeys(folder_of(path).resolve() for path in runs))
    if len(folders) < 2:
        raise ConfigError(f"{len(folders)} run is named; name at least two different runs")
    found = Comparison([RunFolder(folder) for folder in folders])
    changes = found.differences()
    _print("setting", found.names, {k: list(map(_shown, v)) for k, v in changes.items()})
    if not changes:
        print("their settings are the same, apart from any that do not affect the result")
    _print("result", found.names, found.results())
    found.draw(image)
    print(f"curves: {image}")


def _print(what: str, names: Sequence[str], rows: Mapping[str, Sequence[str]]) -> None:
    if not rows:
        return
    table = Table(box=None, header_style="bold")
    for name in (what, *names):
        table.add_column(Text(name), overflow="fold")
    for name, values in rows.items():
        table.add_row(*map(Text, (name, *values)))  # Text: brackets in values are not markup
    tables().print(table)
    print()


def _shown(value: object) -> str:
    return "-" if value is None else str(value)
