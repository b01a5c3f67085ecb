from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pgdm.errors import SweepError
from pgdm.sweep import ledger as ledgers
from pgdm.sweep.ledger import Attempt, Ending, Ledger
from pgdm.sweep.processes import Process
from sweep_plans import plan

ME = Process.of(os.getpid())


@pytest.fixture
def ledger(tmp_path: Path) -> Ledger:
    """Return the ledger of a sweep of three jobs."""
    made = Ledger(tmp_path)
    made.add(plan(tmp_path))
    return made


def keys(ledger: Ledger) -> list[str]:
    return [entry.key for entry in ledger.entries()]


def test_a_new_ledger_has_the_plan(ledger: Ledger, tmp_path: Path) -> None:
    entries = ledger.entries()
    assert [entry.name for entry in entries] == ["seed=0", "seed=1", "seed=2"]
    assert {(e.state, e.total_frames, e.last) for e in entries} == {("waiting", 32, None)}
    assert [e.run_dir for e in entries] == [tmp_path / "runs" / f"s{i}" for i in range(3)]


def test_an_attempt_from_beginning_to_end(ledger: Ledger) -> None:
    key = keys(ledger)[1]
    number = ledger.begin(key, ME)
    assert (number, ledger.states()[key]) == (1, "running")
    worker = Process("host", 7, "then")
    assert ledger.register(key, number, worker)
    ledger.end(key, number, Ending("failed", 1, 16, {"a": 0.5}, "no room"))
    ledger.end(key, number, Ending("finished", 0, 32, {}, None))  # what was noted stays
    assert not ledger.register(key, number, ME)
    assert ledger.begin(key, ME) == 2
    first, second = ledger.attempts()
    assert first == Attempt(
        key, 1, "failed", worker, first.start, first.end, 1, 16, {"a": 0.5}, "no room"
    )
    assert second.process == ME and second.state == "running"
    assert ledger.entries()[1].last == second


def test_more_jobs_are_added_and_the_others_stay(ledger: Ledger, tmp_path: Path) -> None:
    ledger.set_states({keys(ledger)[0]: "finished"})
    ledger.add(plan(tmp_path, 5))
    assert list(ledger.states().values()) == ["finished"] + ["waiting"] * 4


def test_a_sweep_may_be_moved(ledger: Ledger, tmp_path: Path) -> None:
    moved = tmp_path / "moved"
    moved.mkdir()
    ledger.path.rename(moved / ledger.path.name)
    assert Ledger(moved).entries()[0].run_dir == moved / "runs" / "s0"


def test_facts(ledger: Ledger) -> None:
    assert ledger.fact("slots") is None
    ledger.set_fact("slots", 2)
    ledger.set_fact("slots", [3, "a"])
    assert ledger.fact("slots") == [3, "a"]


WRITER = """
import os, sys
from pathlib import Path
from pgdm.sweep.ledger import Ending, Ledger
from pgdm.sweep.processes import Process
me = Process.of(os.getpid())
while True:
    ledger = Ledger(Path(sys.argv[1]))
    for _ in range(int(sys.argv[3])):
        number = ledger.begin(sys.argv[2], me)
        ledger.end(sys.argv[2], number, Ending("finished", 0, 1, {"a": 1.0}, None))
        print(number, flush=True)
    if sys.argv[3] != "1":
        break
"""


def writer(ledger: Ledger, count: int) -> subprocess.Popen[str]:
    arguments = [str(ledger.folder), keys(ledger)[0], str(count)]
    return subprocess.Popen(
        [sys.executable, "-c", WRITER, *arguments], stdout=subprocess.PIPE, text=True
    )


def test_many_writers_lose_nothing(ledger: Ledger) -> None:
    writers = [writer(ledger, 15) for _ in range(4)]
    outputs = [process.communicate(timeout=120)[0] for process in writers]
    assert [process.returncode for process in writers] == [0] * 4
    numbers = sorted(int(line) for output in outputs for line in output.split())
    assert numbers == list(range(1, 61))
    assert {attempt.state for attempt in ledger.attempts()} == {"finished"}


def test_killed_writers_leave_it_whole(ledger: Ledger) -> None:
    for pause_s in (0.0, 0.01, 0.05):
        process = writer(ledger, 1)
        assert process.stdout is not None
        process.stdout.readline()
        time.sleep(pause_s)
        process.send_signal(signal.SIGKILL)
        told = [int(line) for line in process.communicate()[0].split()]
        with sqlite3.connect(ledger.path) as db:
            assert db.execute("PRAGMA integrity_check").fetchone() == ("ok",)
        db.close()
        assert {a.number for a in ledger.attempts() if a.state == "finished"} >= set(told)


def test_a_locked_ledger_is_waited_for(ledger: Ledger, monkeypatch: pytest.MonkeyPatch) -> None:
    other = sqlite3.connect(ledger.path, isolation_level=None, check_same_thread=False)
    other.execute("BEGIN EXCLUSIVE")
    monkeypatch.setattr(ledgers, "LOCK_S", 0.1)
    with pytest.raises(SweepError, match="locked by another program"):
        ledger.set_fact("a", 1)
    monkeypatch.setattr(ledgers, "LOCK_S", 30.0)
    threading.Timer(1.0, other.execute, ["COMMIT"]).start()
    ledger.set_fact("a", 2)
    assert ledger.fact("a") == 2
    other.close()


def test_a_damaged_ledger(ledger: Ledger) -> None:
    ledger.path.write_bytes(b"no database, by far not one" * 100)
    with pytest.raises(SweepError, match=r"damaged.*remove it"):
        ledger.entries()


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    """Return a disk of 200 kB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=200k", "tmpfs", str(folder)]
    if os.getuid() or subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("needs the right to mount a small disk")
    yield folder
    subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_loses_nothing(disk: Path) -> None:
    ledger = Ledger(disk)
    ledger.add(plan(disk))
    key = keys(ledger)[0]
    number = ledger.begin(key, ME)
    ballast = disk / "ballast"
    with open(ballast, "wb", buffering=0) as file, pytest.raises(OSError, match="No space"):
        while True:
            file.write(b"0" * 4096)
    big = Ending("finished", 0, 32, {f"metric {i}": 0.1 for i in range(5000)}, None)
    with pytest.raises(SweepError, match="make room and run the same command again"):
        ledger.end(key, number, big)
    assert ledger.attempts()[0].state == "running"
    ballast.unlink()
    ledger.end(key, number, Ending("finished", 0, 32, {"metric": 0.1}, None))
    assert ledger.attempts()[0].state == "finished"
