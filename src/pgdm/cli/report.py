"""``pgdm report``: results on a page, compared with the paper's."""

from __future__ import annotations

from pathlib import Path

from pgdm.cli.console.screen import bars, notify
from pgdm.errors import amount
from pgdm.report.source import check_place
from pgdm.tracking.address import chosen


def make_report(places: list[str], out: Path | None, uri: str | None) -> None:
    """Write the report and print where it is."""
    first = Path(places[0])
    folder = out or (first if first.is_dir() else Path("runs")) / "report"
    named = not all(Path(place).is_dir() for place in places)
    store = chosen(uri, "--uri", notify) if named else None
    for place in places:
        check_place(place, store)
    from pgdm.report.page import write_report  # loads matplotlib

    with bars(patience_s=2.0) as progress:
        page, results = write_report(places, folder, progress, store)
    states = ", ".join(f"{count} {state}" for state, count in results.counts().items())
    print(f"{amount(len(results.runs), 'run')} ({states}): {page}")
