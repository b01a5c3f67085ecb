"""The record of a sweep: every attempt at every job, in an SQLite file in the sweep's folder.

Any number of processes read and write it, and any of them may be killed at any moment. The progress
of a job is in its run folder; a lost ledger is rebuilt from there.
"""

from __future__ import annotations

import json
import sqlite3
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pgdm.errors import SweepError
from pgdm.sweep.processes import Process

if TYPE_CHECKING:
    from pgdm.sweep.plan import Job, Plan

FILE = "ledger.sqlite"
WAITING, RUNNING, FINISHED = "waiting", "running", "finished"
FAILED, INTERRUPTED, CANCELLED = "failed", "interrupted", "cancelled"
STATES = (WAITING, RUNNING, FINISHED, FAILED, INTERRUPTED, CANCELLED)
"""States of a job; an attempt is running, finished, failed or interrupted."""
LOCK_S = 120.0
"""How long to retry when the ledger is locked, s."""

# The default rollback journal stays: a write-ahead log needs shared memory, and so a single host.
_SCHEMA = """
BEGIN IMMEDIATE;
CREATE TABLE IF NOT EXISTS jobs (
    key TEXT PRIMARY KEY, place INTEGER, name TEXT, run_dir TEXT, total_frames INTEGER, state TEXT);
CREATE TABLE IF NOT EXISTS attempts (
    key TEXT, number INTEGER, state TEXT, host TEXT, pid INTEGER, born TEXT, start REAL, end REAL,
    exit_code INTEGER, frames INTEGER, metrics TEXT, error TEXT, slurm_id TEXT,
    PRIMARY KEY (key, number));
CREATE TABLE IF NOT EXISTS facts (name TEXT PRIMARY KEY, value TEXT);
COMMIT;
"""
_RETRY_S = 0.05

T = TypeVar("T")


@dataclass(frozen=True)
class Attempt:
    """One process that works or worked on a job; in Slurm one Slurm job, even if it is requeued.

    While an attempt runs, it has no end, exit code, frames, metrics or error.
    """

    key: str
    number: int
    """Counted from 1."""
    state: str
    process: Process
    start: float
    """s since the epoch."""
    end: float | None = None
    """s since the epoch."""
    exit_code: int | None = None
    frames: int | None = None
    """Progress of the run at the attempt's end, frames."""
    metrics: Mapping[str, float] | None = None
    """Metrics of the run's last evaluation."""
    error: str | None = None
    slurm_id: str | None = None
    """ID of the Slurm job that makes the attempt; None outside Slurm."""


@dataclass(frozen=True)
class Entry:
    """A job, and the last attempt at it."""

    key: str
    name: str
    run_dir: Path
    total_frames: int
    state: str
    last: Attempt | None


@dataclass(frozen=True)
class Ending:
    """How an attempt ended."""

    state: str
    exit_code: int | None
    frames: int | None
    metrics: Mapping[str, float]
    error: str | None


class Ledger:
    """The ledger of the sweep in a folder; the file is created if it is missing.

    Each change is one transaction. While the file is locked, reads and changes are retried for up
    to ``LOCK_S``.

    Args:
        folder: folder of the sweep.

    Raises:
        SweepError: from every method, if the file cannot be read or written, or stays locked.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder.absolute()
        self.path = self.folder / FILE
        self._do(lambda db: db.executescript(_SCHEMA) if _is_empty(db) else None)

    def add(self, plan: Plan) -> None:
        """Add a plan's jobs; those already in the ledger keep their state and attempts."""
        rows = [
            (job.key, place, job.name, run_dir_in(self.folder, job), job.cfg.total_frames)
            for place, job in enumerate(plan.jobs)
        ]
        self._write(
            "INSERT INTO jobs VALUES (?, ?, ?, ?, ?, 'waiting') ON CONFLICT (key) DO UPDATE SET "
            "name = excluded.name, run_dir = excluded.run_dir, "
            "total_frames = excluded.total_frames",
            rows,
        )

    def entries(self) -> list[Entry]:
        """Return all jobs in the order of the plan."""
        newest = self._read(
            "SELECT * FROM attempts "
            "WHERE (key, number) IN (SELECT key, max(number) FROM attempts GROUP BY key)"
        )
        last = {attempt.key: attempt for attempt in map(_attempt, newest)}
        rows = self._read("SELECT key, name, run_dir, total_frames, state FROM jobs ORDER BY place")
        return [
            Entry(key, name, self.folder / run_dir, total, state, last.get(key))
            for key, name, run_dir, total, state in rows
        ]

    def states(self) -> dict[str, str]:
        """Return the state of each job by its key."""
        return dict(self._read("SELECT key, state FROM jobs"))

    def attempts(self) -> list[Attempt]:
        """Return all attempts, ordered by job key and number."""
        return [_attempt(row) for row in self._read("SELECT * FROM attempts ORDER BY key, number")]

    def begin(self, key: str, process: Process) -> int:
        """Record the start of an attempt, and return its number."""

        def work(db: sqlite3.Connection) -> int:
            db.execute("BEGIN IMMEDIATE")
            ((number,),) = db.execute(
                "INSERT INTO attempts (key, number, state, host, pid, born, start) "
                "SELECT ?1, coalesce(max(number), 0) + 1, 'running', ?2, ?3, ?4, ?5 "
                "FROM attempts WHERE key = ?1 RETURNING number",
                (key, process.host, process.pid, process.born, time.time()),
            ).fetchall()
            # A job cancelled meanwhile stays cancelled: the driver then stops its worker.
            db.execute(
                "UPDATE jobs SET state = 'running' WHERE key = ? AND state != 'cancelled'", (key,)
            )
            db.execute("COMMIT")
            return number

        return self._do(work)

    def submitted(self, slurm_ids: Mapping[tuple[str, int], str]) -> None:
        """Record the Slurm job IDs of attempts, each attempt given by job key and number."""
        # Until now the driver is recorded as the attempts' process. An attempt that already runs
        # has registered its own process and Slurm job ID: its row is not changed.
        self._write(
            "UPDATE attempts SET slurm_id = ?, host = '', pid = 0, born = '' "
            "WHERE key = ? AND number = ? AND slurm_id IS NULL",
            [(slurm_id, *place) for place, slurm_id in slurm_ids.items()],
        )

    def register(
        self, key: str, number: int, process: Process, slurm_id: str | None = None
    ) -> bool:
        """Record which process makes an attempt; return False if the attempt is already closed."""
        changed = self._write(
            "UPDATE attempts SET host = ?, pid = ?, born = ?, slurm_id = ? "
            "WHERE key = ? AND number = ? AND state = 'running'",
            [(process.host, process.pid, process.born, slurm_id, key, number)],
        )
        return changed == 1

    def end(self, key: str, number: int, ending: Ending) -> None:
        """Record how an attempt ended, unless that is recorded already."""
        found = ending.exit_code, ending.frames, json.dumps(ending.metrics), ending.error
        self._write(
            "UPDATE attempts SET state = ?, end = ?, exit_code = ?, frames = ?, metrics = ?, "
            "error = ? WHERE key = ? AND number = ? AND state = 'running'",
            [(ending.state, time.time(), *found, key, number)],
        )

    def recall(self, key: str, start: float, end: float, ending: Ending) -> None:
        """Record attempt 1 of a job from its run folder, unless the job has an attempt 1."""
        row = (key, ending.state, start, end, ending.frames, json.dumps(ending.metrics))
        self._write(
            "INSERT OR IGNORE INTO attempts (key, number, state, host, pid, born, start, end, "
            "frames, metrics) VALUES (?, 1, ?, '', 0, '', ?, ?, ?, ?)",
            [row],
        )

    def set_states(self, states: Mapping[str, str]) -> None:
        """Change the state of jobs."""
        rows = [(state, key) for key, state in states.items()]
        self._write("UPDATE jobs SET state = ? WHERE key = ?", rows)

    def fact(self, name: str) -> Any:
        """Return a fact about the sweep as a whole, or None."""
        rows = self._read("SELECT value FROM facts WHERE name = ?", (name,))
        return json.loads(rows[0][0]) if rows else None

    def set_fact(self, name: str, value: Any) -> None:
        """Record a fact about the sweep as a whole."""
        self._write("INSERT OR REPLACE INTO facts VALUES (?, ?)", [(name, json.dumps(value))])

    def _read(self, query: str, values: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        return self._do(lambda db: db.execute(query, values).fetchall())

    def _write(self, query: str, rows: Iterable[tuple[Any, ...]]) -> int:
        """Run a query for each row in one transaction; return the number of rows changed."""
        wanted = list(rows)

        def work(db: sqlite3.Connection) -> int:
            db.execute("BEGIN IMMEDIATE")
            changed = db.executemany(query, wanted).rowcount
            db.execute("COMMIT")
            return changed

        return self._do(work)

    def _do(self, work: Callable[[sqlite3.Connection], T]) -> T:
        """Call ``work`` with a new connection and close it; retry while the file is locked."""
        limit = time.monotonic() + LOCK_S
        while True:
            try:
                with closing(_connect(self.path)) as db:
                    return work(db)
            except sqlite3.Error as error:
                if "locked" not in str(error):
                    raise SweepError(_explained(self.path, error)) from error
                if time.monotonic() > limit:
                    raise SweepError(
                        f"{self.path} has been locked by another program for {LOCK_S:.0f} s; close "
                        "that program, then run the same command again (nothing is lost)"
                    ) from error
            time.sleep(_RETRY_S)


def run_dir_in(folder: Path, job: Job) -> str:
    """Return a job's run folder as stored: relative if below ``folder``, which may then move."""
    path = Path(job.cfg.run_dir)
    return str(path.relative_to(folder) if path.is_relative_to(folder) else path)


def _connect(path: Path) -> sqlite3.Connection:
    # A short timeout, since Python handles no Ctrl-C while SQLite waits.
    return sqlite3.connect(path, timeout=0.5, isolation_level=None)


def _is_empty(db: sqlite3.Connection) -> bool:
    return db.execute("SELECT count(*) FROM sqlite_master").fetchone() == (0,)


def _explained(path: Path, error: sqlite3.Error) -> str:
    text = str(error)
    if "full" in text or "disk I/O" in text:
        return (
            f"cannot write {path}: {text}; make room and run the same command again (the progress "
            "of the jobs is in their run folders)"
        )
    if isinstance(error, sqlite3.OperationalError):
        return f"cannot use {path}: {text}; check that its folder exists and is writable"
    return f"{path} is damaged ({text}); remove it, and it is rebuilt from the run folders"


def _attempt(row: tuple[Any, ...]) -> Attempt:
    key, number, state, host, pid, born, start, end, code, frames, metrics, error, slurm_id = row
    known = json.loads(metrics) if metrics else None
    process = Process(host, pid, born)
    return Attempt(key, number, state, process, start, end, code, frames, known, error, slurm_id)
