"""The state of each job of a sweep.

It is read from the ledger and, for an attempt that the ledger has as running, from the run folder
or Slurm as well.
"""

from __future__ import annotations

import hashlib
import math
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pgdm.runs.folder import RunFolder
from pgdm.runs.log import Record
from pgdm.runs.result import reached
from pgdm.sweep.ledger import (
    FINISHED,
    INTERRUPTED,
    RUNNING,
    STATES,
    WAITING,
    Attempt,
    Ending,
    Entry,
    Ledger,
)
from pgdm.sweep.processes import Process
from pgdm.sweep.queue import UNKNOWN, Queue

SUCCESS = "eval_sampled/success"
NAME, PARENT, SLOTS = "name", "parent", "slots"
"""Facts in the ledger: the sweep's name, the process that drives it, and how many of its jobs run
at a time."""
PLAN, LOGS = "plan.json", "logs"
"""The plan, and the folder of the logs, in the folder of a sweep."""
_TAIL_BYTES = 1 << 14  # a dozen lines
_LONGEST = 150
_LEFT = (WAITING, RUNNING, INTERRUPTED)


@dataclass(frozen=True)
class Row:
    """The state of a job, as shown to the user."""

    key: str
    name: str
    state: str
    """Verified: ``running`` only if its process is alive, Slurm runs it or, for a process on
    another machine, its run folder shows it as running."""
    attempts: int
    frames: int
    """Frames of the run so far; while the job runs, up to its last record."""
    total_frames: int
    success: float | None
    """Sampled success, 0..1: of the last evaluation, or, while the job runs, of the episodes in its
    last iteration. None if unknown."""
    steps_per_s: float | None
    """Speed of the last iteration, frames/s; None unless the job runs."""
    frames_per_s: float | None
    """Speed over the whole run so far, evaluations included; None if unknown."""
    left_s: float | None
    """Remaining time at ``frames_per_s``; None if that is unknown or the job does not run."""
    run_dir: Path
    log: Path | None
    """Output of the last attempt; None before the first."""
    error: str | None
    slurm: str | None
    """ID and state in Slurm of an attempt that the ledger has as running, such as
    ``12_3 PENDING (Resources)``; else None."""


@dataclass(frozen=True)
class Summary:
    """A sweep as a whole."""

    counts: dict[str, int]
    """Jobs by state; states without any are left out."""
    frames: int
    total_frames: int
    left_s: float | None
    """Remaining time of the waiting, running and interrupted jobs, at the mean ``frames_per_s`` of
    all jobs for which it is known; None if it is known for no job."""


def run_ending(run_dir: Path, total_frames: int, time_limit_min: float | None = 0.0) -> Ending:
    """Return a run's status and progress, from its folder; a killed run counts as interrupted.

    Args:
        run_dir: folder of the run.
        total_frames: length that is wanted now, frames.
        time_limit_min: time limit that is wanted now; None: no limit; 0: the limit the run had.
    """
    found = reached(RunFolder(run_dir), total_frames, time_limit_min)
    return Ending(found.status, None, found.frames, found.metrics, found.error)


def is_alive(attempt: Attempt, run_dir: Path, queue: Queue) -> bool:
    """Return whether an attempt runs or is queued in Slurm, as far as this machine can tell."""
    if attempt.state != RUNNING:
        return False
    if attempt.slurm_id is not None:
        return queue.find(attempt.slurm_id).alive
    return attempt.process.alive or (
        not attempt.process.here and RunFolder(run_dir).status() == RUNNING
    )


def parent(ledger: Ledger) -> Process | None:
    """Return the process on this machine that drives the sweep now, or None."""
    known = ledger.fact(PARENT)
    process = Process(*known) if known else None
    return process if process is not None and process.alive else None


def settle(ledger: Ledger, queue: Queue | None = None) -> list[Entry]:
    """Close the attempts whose process is gone, and return their jobs as they were before.

    Args:
        ledger: ledger of the sweep.
        queue: the sweep's jobs in Slurm; None queries Slurm anew.
    """
    queue, closed = queue or Queue(), []
    for entry in ledger.entries():
        last = entry.last
        if last is None or last.state != RUNNING or is_alive(last, entry.run_dir, queue):
            continue
        ending = run_ending(entry.run_dir, entry.total_frames)
        ledger.end(entry.key, last.number, ending)
        if entry.state == RUNNING or ending.state == FINISHED:
            ledger.set_states({entry.key: ending.state})
        closed.append(entry)
    return closed


def rows(ledger: Ledger, queue: Queue | None = None) -> list[Row]:
    """Return all jobs of a sweep in the order of its plan; ``queue`` as for ``settle``."""
    queue = queue or Queue()
    return [_row(ledger.folder, entry, queue) for entry in ledger.entries()]


def summarize(found: Sequence[Row], slots: int) -> Summary:
    """Return a sweep as a whole.

    Args:
        found: its jobs.
        slots: how many of them run at a time.
    """
    counted = Counter(row.state for row in found)
    rates = [row.frames_per_s for row in found if row.frames_per_s]
    # A run ends with a whole iteration, and so may exceed the wanted length.
    remaining = [max(row.total_frames - row.frames, 0) for row in found if row.state in _LEFT]
    left_s = 0.0 if not remaining else None
    if remaining and rates:
        rate = sum(rates) / len(rates)
        # At least the time of the longest job, which cannot be divided between slots.
        left_s = max(sum(remaining) / min(max(slots, 1), len(remaining)), max(remaining)) / rate
    return Summary(
        {state: counted[state] for state in STATES if counted[state]},
        sum(min(row.frames, row.total_frames) for row in found),
        sum(row.total_frames for row in found),
        left_s,
    )


def log_path(folder: Path, name: str, attempt: int) -> Path:
    """Return the file with the output of an attempt at a job."""
    safe = "".join(c if c.isalnum() or c in "=.,+-" else "_" for c in name)
    if len(safe) > _LONGEST:  # names may differ only at the end
        safe = f"{safe[:_LONGEST]}-{hashlib.sha256(name.encode()).hexdigest()[:8]}"
    return folder / LOGS / f"{safe}.{attempt}.log"


def _row(folder: Path, entry: Entry, queue: Queue) -> Row:
    last, state, slurm = entry.last, entry.state, None
    ending = None if last is None else Ending(last.state, None, last.frames, last.metrics or {}, "")
    lines: list[Record] = []
    if last is not None and last.state == RUNNING:
        slurm, pending = _in_slurm(last, entry.run_dir, queue)
        if pending:
            ending = replace(run_ending(entry.run_dir, entry.total_frames), state=WAITING)
        elif is_alive(last, entry.run_dir, queue):
            lines = RunFolder(entry.run_dir).log.tail(_TAIL_BYTES)
            # Evaluations are rare, so show the success in training, which samples actions too.
            shown = {SUCCESS: _last(lines, "train/success")}
            ending = Ending(RUNNING, None, _last(lines, "frames"), shown, None)
        else:
            ending = run_ending(entry.run_dir, entry.total_frames)
        if state == RUNNING or ending.state in (RUNNING, FINISHED):
            state = ending.state
    frames = (ending.frames if ending else None) or 0
    pace = _pace(last, lines, frames)
    remaining = max(entry.total_frames - frames, 0)
    return Row(
        key=entry.key,
        name=entry.name,
        state=state,
        attempts=0 if last is None else last.number,
        frames=frames,
        total_frames=entry.total_frames,
        success=ending.metrics.get(SUCCESS) if ending else None,
        steps_per_s=_last(lines, "train/steps_per_s"),
        frames_per_s=pace,
        left_s=remaining / pace if pace and state == RUNNING else None,
        run_dir=entry.run_dir,
        log=None if last is None else log_path(folder, entry.name, last.number),
        error=None if last is None or state == FINISHED else last.error,
        slurm=slurm,
    )


def _in_slurm(attempt: Attempt, run_dir: Path, queue: Queue) -> tuple[str | None, bool]:
    """Return an attempt's ID and state in Slurm, or None, and whether it waits to start.

    If Slurm cannot be queried, the attempt counts as waiting unless the run folder shows the run
    as running.
    """
    if attempt.slurm_id is None:
        return None, False
    found = queue.find(attempt.slurm_id)
    reason = f" ({found.reason})" if found.pending else ""
    unseen = found.state == UNKNOWN and RunFolder(run_dir).status() != RUNNING
    return f"{attempt.slurm_id} {found.state}{reason}", found.pending or unseen


def _pace(last: Attempt | None, lines: Sequence[Record], frames: int) -> float | None:
    elapsed_s = _last(lines, "time_s")
    if elapsed_s is None and last is not None and last.state == FINISHED and last.number == 1:
        elapsed_s = (last.end or time.time()) - last.start
    return frames / elapsed_s if elapsed_s and frames else None


def _last(lines: Sequence[Record], name: str) -> Any:
    """Return the last finite value that was recorded for a metric, or None."""
    values = (line[name] for line in reversed(lines) if name in line)
    return next((v for v in values if isinstance(v, int | float) and math.isfinite(v)), None)
