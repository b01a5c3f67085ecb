"""Put the finished runs of a folder into the zoo: ``python tools/fill_zoo.py FOLDER``.

FOLDER is a sweep or any folder of runs; it is only read. Runs that have not finished are left out,
and so are runs whose entry exists; a second call adds runs that have finished since. An entry has
the name of its task. Of several runs of a task, the run with the lowest seed is taken; with
--all-seeds the others are added as ``<task>-s<seed>``. Evaluating a policy takes about a minute;
Ctrl-C stops without adding the policy that is being evaluated.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from pgdm.cli.console.screen import bars, notify
from pgdm.errors import PgdmError
from pgdm.runs.folder import RunFolder, find_runs
from pgdm.stop import StopRequest
from pgdm.zoo import Zoo
from pgdm.zoo.place import INDEX
from pgdm.zoo.policy import add_run

MOST_MB = 15
ZOO = Path(__file__).resolve().parents[1] / "zoo"


def named(folder: Path, all_seeds: bool) -> dict[str, RunFolder]:
    """Return the finished runs of a folder by the names of their entries."""
    runs = [run for run in find_runs(folder) if run.status() == "finished"]
    runs.sort(key=lambda run: run.setting("seed"))
    found: dict[str, RunFolder] = {}
    for run in runs:
        name = run.setting("task.id")
        if name in found and all_seeds:
            name += f"-s{run.setting('seed')}"
        found.setdefault(name, run)
    return found


def fill(folder: Path, zoo: Path, replace: bool, all_seeds: bool) -> int:
    """Put the runs into the zoo and return the exit code."""
    known = Zoo(str(zoo)).entries if (zoo / INDEX).is_file() else {}
    runs, failed = named(folder, all_seeds), 0
    wanted = {name: run for name, run in runs.items() if replace or name not in known}
    notify(f"{len(runs)} finished runs in {folder}, {len(wanted)} to add")
    for name, run in wanted.items():
        try:
            with StopRequest() as stop, bars() as progress:
                entry = add_run(run, name, zoo, notify, progress, stop)
        except PgdmError as error:
            notify(f"{name} is left out: {error}")
            failed += 1
            continue
        if entry is None:
            return stop.exit_code
        print(f"{name}: success {entry.success:.1%}, {entry.precision}, {entry.bytes / 1e3:.0f} kB")
    if (zoo / INDEX).is_file():
        entries = Zoo(str(zoo)).entries.values()
        size = sum(entry.bytes for entry in entries) / 1e6
        print(f"{zoo}: {len(entries)} policies, {size:.1f} MB")
        if size > MOST_MB:
            print(f"more than the {MOST_MB} MB that the repository takes")
            return 1
    return 1 if failed else 0


def main() -> int:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("folder", type=Path, help="folder of a sweep or of runs")
    parser.add_argument("--zoo", type=Path, default=ZOO, help="folder of the zoo [zoo]")
    parser.add_argument("--replace", action="store_true", help="replace existing entries")
    parser.add_argument(
        "--all-seeds", action="store_true", help="add the runs of all seeds of a task"
    )
    options = parser.parse_args()
    try:
        return fill(options.folder, options.zoo, options.replace, options.all_seeds)
    except PgdmError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


if __name__ == "__main__":
    sys.exit(main())
