"""After any process is killed, disk full or ledger locked, the same command completes each job."""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import subprocess
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import pytest

from pgdm.runs.files import read_json
from pgdm.runs.log import RunLog
from pgdm.sweep.ledger import FILE, Ledger
from pgdm.sweep.plan import write_plan
from pgdm.sweep.queue import Queue
from pgdm.sweep.status import is_alive, rows
from sweep_plans import plan, start

JOBS, FAULTS = 2, 10
SMALL = (
    "task=dmanus-sim2real",  # its resets draw random numbers too
    "total_frames=12800",
    "num_envs=4",
    "algo.steps_per_env=32",
    "algo.minibatch_size=64",
    "eval.interval_frames=2560",
    "checkpoint.interval_s=0.3",
)
FURTHEST: dict[str, int] = {}
TIMED = ("time_s", "train/steps_per_s")


@pytest.fixture
def disk(library_home: Path, tmp_path: Path) -> Iterator[Path]:
    """Return a disk of 64 MB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64m", "tmpfs", str(folder)]
    if os.getuid() or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a small disk")
    yield folder
    subprocess.run(["umount", "--lazy", str(folder)], check=True)


def metrics(folder: Path, seed: int) -> list[dict[str, str]]:
    lines = RunLog(folder / "runs" / f"s{seed}" / "metrics.jsonl").read()
    return [{k: repr(v) for k, v in line.items() if k not in TIMED} for line in lines]


def kill_workers(folder: Path) -> None:
    for entry in Ledger(folder).entries():
        if entry.last is not None and is_alive(entry.last, entry.run_dir, Queue()):
            entry.last.process.signal(signal.SIGKILL)


@contextmanager
def full(folder: Path) -> Iterator[None]:
    """Fill the disk of a folder."""
    ballast = folder / "ballast"
    with open(ballast, "wb", buffering=0) as file:
        try:
            while file.write(b"0" * 4096) == 4096:
                pass
        except OSError:
            pass
    yield
    ballast.unlink()


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Lock the ledger as another program would."""
    with closing(sqlite3.connect(folder / FILE, timeout=60, isolation_level=None)) as db:
        db.execute("BEGIN EXCLUSIVE")
        yield
        db.execute("ROLLBACK")


def wait_for_progress(folder: Path, sweep: subprocess.Popen[str]) -> None:
    """Wait until any job has come further than it ever was, or the sweep has ended."""
    limit = time.monotonic() + 180
    while sweep.poll() is None and time.monotonic() < limit:
        reached = {row.key: row.frames for row in rows(Ledger(folder)) if row.state == "running"}
        if any(frames > FURTHEST.get(key, 0) for key, frames in reached.items()):
            FURTHEST.update(reached)
            return
        time.sleep(0.1)


def strike(kind: str, folder: Path, sweep: subprocess.Popen[str], rng: random.Random) -> None:
    if kind in ("parent", "both"):
        sweep.kill()
    if kind in ("worker", "both"):
        kill_workers(folder)
    if kind in ("disk", "ledger"):
        with full(folder) if kind == "disk" else locked(folder):
            time.sleep(rng.uniform(0.5, 3.0))


@pytest.mark.slow
def test_ten_faults_change_nothing(disk: Path, tmp_path: Path) -> None:
    straight, struck = tmp_path / "straight", disk / "struck"
    for folder in (straight, struck):
        write_plan(plan(folder, JOBS, *SMALL))
    with open(tmp_path / "output.txt", "a+") as output:
        assert start(straight, output).wait(900) == 0
        rng = random.Random(20)
        kinds = ["worker", "parent", "both", "disk", "ledger"] * (FAULTS // 5)
        rng.shuffle(kinds)
        kinds.sort(key=lambda kind: kind != "worker")  # first: these always hit a running job
        sweep = start(struck, output)
        for kind in kinds:
            if sweep.poll() is not None:
                sweep = start(struck, output)
            if kind == "worker" or rng.random() < 0.8:  # else perhaps before anything has begun
                wait_for_progress(struck, sweep)
            if kind != "worker":
                time.sleep(rng.uniform(0.0, 3.0))
            strike(kind, struck, sweep, rng)
        code = sweep.wait(900)
        if code != 0:  # the last fault ended it, or used up a job's attempts
            code = start(struck, output).wait(900)
        assert code == 0, (tmp_path / "output.txt").read_text()

    found = rows(Ledger(struck))
    assert [row.state for row in found] == ["finished"] * JOBS
    attempts = Ledger(struck).attempts()
    assert len(attempts) > JOBS  # faults did hit
    assert all(attempt.state != "running" for attempt in attempts)
    finished = [attempt.key for attempt in attempts if attempt.state == "finished"]
    assert sorted(finished) == sorted(row.key for row in found)  # each once
    for seed in range(JOBS):
        assert metrics(struck, seed) == metrics(straight, seed)
        results = [read_json(f / "runs" / f"s{seed}" / "result.json") for f in (straight, struck)]
        assert results[0]["metrics"] == results[1]["metrics"]
