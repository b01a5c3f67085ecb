"""``pgdm sweep``: follow and control sweeps, running or ended, from any shell."""

from __future__ import annotations

import dataclasses
import json
import signal
import sys
import time
from collections.abc import Sequence
from io import TextIOWrapper
from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from pgdm import files
from pgdm.cli import worker
from pgdm.cli.console.errors import INTERRUPTED as INTERRUPTED_CODE
from pgdm.cli.console.screen import notify, tables
from pgdm.cli.console.sweep_table import SweepView, percent, span, summary_line
from pgdm.errors import SweepError, UnknownNameError, amount
from pgdm.sweep.front import Front
from pgdm.sweep.ledger import (
    CANCELLED,
    FAILED,
    FINISHED,
    INTERRUPTED,
    RUNNING,
    WAITING,
    Entry,
    Ledger,
)
from pgdm.sweep.queue import Queue
from pgdm.sweep.queue import cancel as cancel_in_slurm
from pgdm.sweep.repair import repaired
from pgdm.sweep.status import NAME, SLOTS, Row, log_path, parent, rows, summarize

_COLOURS = {
    RUNNING: "cyan",
    FINISHED: "green",
    FAILED: "red",
    INTERRUPTED: "yellow",
    CANCELLED: "magenta",
}
_POLL_S = 0.5
_STOP_S = 120.0
_ASK_S = 2.0

FRONT = Front(
    notify,
    SweepView,
    worker=worker.COMMAND,
    resume=(sys.executable, "-m", "pgdm", "sweep", "resume"),
)
"""How a sweep prints messages, shows its state, starts workers and continues in the background."""

app = typer.Typer(help="Follow, stop and resume sweeps.", no_args_is_help=True)

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="Folder of the sweep.")]
Jobs = Annotated[
    list[str] | None,
    typer.Argument(metavar="[JOB]...", help="Jobs, by part of their name or start of their key."),
]
Detach = Annotated[bool, typer.Option("--detach", help="Run in the background.")]


@app.command()
def status(
    folder: Folder,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON for programs.")] = False,
) -> None:
    """Show each job and the whole sweep.

    A row per job: state, frames, success, attempts, time left.
    """
    queue = Queue()
    ledger = settled(folder, queue)
    found = rows(ledger, queue)
    summary = summarize(found, ledger.fact(SLOTS) or 1)
    if as_json:
        whole = {"name": ledger.fact(NAME), "driven": parent(ledger) is not None}
        jobs = [dataclasses.asdict(row) for row in found]
        print(json.dumps({**whole, **dataclasses.asdict(summary), "jobs": jobs}, default=str))
        return
    tables().print(_table(found))
    print(summary_line(ledger.fact(NAME) or folder.name, summary))
    left = [row for row in found if row.state in (WAITING, INTERRUPTED) and row.slurm is None]
    if parent(ledger) is None and left:
        print(f"no process drives the sweep; pgdm sweep resume {folder} resumes it")


@app.command()
def watch(folder: Folder) -> None:
    """Follow a sweep until it ends; Ctrl-C stops only the display."""
    queue = Queue()
    ledger = settled(folder, queue)
    try:
        with SweepView(ledger.fact(NAME) or folder.name, ledger, queue) as view:
            while parent(ledger) is not None or _continues(rows(ledger, queue)):
                view.update()
                time.sleep(_POLL_S)
    except KeyboardInterrupt:
        print(f"the sweep continues; pgdm sweep cancel {folder} stops it", file=sys.stderr)
        raise typer.Exit(INTERRUPTED_CODE) from None
    settled(folder, queue)
    print(view.line())
    if text := view.failures():
        print(text)
    raise typer.Exit(int(any(state != FINISHED for state in ledger.states().values())))


@app.command()
def logs(
    folder: Folder,
    job: Annotated[
        str, typer.Argument(metavar="JOB", help="Part of the job's name, or start of its key.")
    ],
    follow: Annotated[
        bool, typer.Option("-f", "--follow", help="Keep printing until the job ends.")
    ] = False,
) -> None:
    """Print the output of a job's last attempt."""
    queue = Queue()
    ledger = settled(folder, queue)
    entry = _one(ledger.entries(), job)
    path = log_path(ledger.folder, entry.name, 0 if entry.last is None else entry.last.number)
    if not path.exists():
        raise SweepError(f"{entry.name} has not been started yet")
    with TextIOWrapper(files.open_file(path), errors="replace") as log:
        while True:
            # The state is queried before reading, so that the job's last output is not missed.
            continues = follow and any(
                r.key == entry.key and r.state == RUNNING for r in rows(ledger, queue)
            )
            while text := log.read(1 << 16):
                print(text, end="", flush=True)
            if not continues:
                return
            time.sleep(_POLL_S)


@app.command()
def cancel(folder: Folder, jobs: Jobs = None) -> None:
    """Stop the named jobs, or all that have not finished or failed; running jobs save first."""
    queue = Queue(_ASK_S)
    ledger = settled(folder, queue)
    ended = (FINISHED, FAILED) if not jobs else (FINISHED,)
    chosen = [entry for entry in _chosen(ledger, jobs) if entry.state not in ended]
    keys = {entry.key for entry in chosen}
    ledger.set_states(dict.fromkeys(keys, CANCELLED))
    if parent(ledger) is None:
        at_work = [e.last for e in chosen if e.last is not None and e.last.state == RUNNING]
        cancel_in_slurm(attempt.slurm_id for attempt in at_work if attempt.slurm_id is not None)
        for attempt in at_work:
            attempt.process.signal(signal.SIGTERM)
    limit = time.monotonic() + _STOP_S
    while any(row.state == RUNNING and row.key in keys for row in rows(ledger, queue)):
        if time.monotonic() > limit:
            raise SweepError(f"not all jobs have stopped yet; see pgdm sweep status {folder}")
        time.sleep(_POLL_S)
    print(f"cancelled {amount(len(chosen), 'job')}; to resume: pgdm sweep resume {folder}")


@app.command()
def retry(folder: Folder, jobs: Jobs = None) -> None:
    """Retry failed jobs.

    Named jobs are retried unless they are running or finished. If a process already drives the
    sweep, that process starts the jobs; otherwise this command does, and waits for them.
    """
    ledger = settled(folder)
    wanted = _chosen(ledger, jobs)
    chosen = [e for e in wanted if e.state == FAILED or (jobs and e.state != FINISHED)]
    chosen = [e for e in chosen if e.state != RUNNING]
    if not chosen:
        print(
            "no failed jobs" if not jobs else "nothing to retry: these jobs are finished or running"
        )
        return
    if parent(ledger) is not None:
        ledger.set_states({entry.key: WAITING for entry in chosen})
        print(f"{amount(len(chosen), 'job')} will be retried by the running sweep")
        return
    raise typer.Exit(_resume(folder, keys={entry.key for entry in chosen}))


@app.command()
def resume(folder: Folder, detach: Detach = False) -> None:
    """Resume all jobs that are not finished, including failed and cancelled ones.

    They run with the settings that the sweep was started with.
    """
    settled(folder)
    raise typer.Exit(_resume(folder, detach=detach))


def _resume(folder: Path, detach: bool = False, keys: set[str] | None = None) -> int:
    from pgdm.sweep.launch import launched, run_sweep
    from pgdm.sweep.plan import read_plan

    plan = read_plan(folder)
    if keys is not None:
        jobs = tuple(job for job in plan.jobs if job.key in keys)
        plan = dataclasses.replace(plan, jobs=jobs)
    sweep, launcher = launched(plan)
    return run_sweep(plan, dataclasses.replace(sweep, detach=detach), launcher, FRONT)


def settled(folder: Path, queue: Queue | None = None) -> Ledger:
    """Return a sweep's ledger, repaired; see ``pgdm.sweep.repair``."""
    return repaired(folder, queue, lambda text: print(text, file=sys.stderr))


def _continues(found: Sequence[Row]) -> bool:
    """Return whether jobs run or wait in Slurm, where they need no process to drive the sweep."""
    return any(row.slurm is not None and row.state in (WAITING, RUNNING) for row in found)


def _chosen(ledger: Ledger, jobs: Sequence[str] | None) -> list[Entry]:
    """Return the named jobs; all if none is named.

    Raises:
        UnknownNameError: if a text matches no job.
        SweepError: if a text matches several jobs.
    """
    entries = ledger.entries()
    return entries if not jobs else [_one(entries, text) for text in jobs]


def _one(entries: Sequence[Entry], text: str) -> Entry:
    exact = [entry for entry in entries if text in (entry.name, entry.key)]
    found = exact or [e for e in entries if text in e.name or e.key.startswith(text)]
    if not found:
        raise UnknownNameError("job", text, [entry.name for entry in entries])
    if len(found) > 1:
        some = ", ".join(entry.name for entry in found[:3])
        raise SweepError(
            f"'{text}' matches {len(found)} jobs: {some}; give more of the name or key"
        )
    return found[0]


def _table(found: Sequence[Row]) -> Table:
    table = Table(box=None, header_style="bold")
    table.add_column("job", overflow="fold")
    table.add_column("state")
    for head in ("frames", "success", "attempts", "left"):
        table.add_column(head, justify="right")
    table.add_column("error, or state in Slurm", overflow="fold")
    for row in found:
        table.add_row(
            escape(row.name),
            f"[{_COLOURS.get(row.state, 'default')}]{row.state}[/]",
            f"{row.frames:,}/{row.total_frames:,}",
            percent(row.success),
            str(row.attempts),
            "-" if row.left_s is None else span(row.left_s),
            escape(row.error or row.slurm or ""),
        )
    return table
