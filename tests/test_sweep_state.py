from __future__ import annotations

import dataclasses
import io
import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from pgdm.cli.console.sweep_table import failures, live_table, span, summary_line
from pgdm.cli.sweep import FRONT
from pgdm.errors import SweepError
from pgdm.memory import free_bytes
from pgdm.runs.log import RunLog
from pgdm.stop import StopRequest
from pgdm.sweep.driver import Driver
from pgdm.sweep.launcher import Assignment
from pgdm.sweep.ledger import Ending, Ledger
from pgdm.sweep.local import LocalLauncher, Room, room
from pgdm.sweep.processes import Process
from pgdm.sweep.status import (
    LOGS,
    PARENT,
    Row,
    log_path,
    parent,
    rows,
    run_ending,
    settle,
    summarize,
)
from sweep_plans import LOCAL, plan


def dead() -> Process:
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as process:
        return Process.of(process.pid)


def record(run_dir: Path, frames: int, kind: str = "train", **metrics: float) -> None:
    run_dir.mkdir(parents=True, exist_ok=True)
    log = RunLog(run_dir / "metrics.jsonl")
    log.append(metrics, frames=frames, iteration=1, time_s=frames / 4, kind=kind)


def result(run_dir: Path, status: str, frames: int, **more: object) -> None:
    run_dir.mkdir(parents=True, exist_ok=True)
    metrics = {"eval_sampled/success": 0.25}
    content = {"status": status, "frames": frames, "metrics": metrics, **more}
    (run_dir / "result.json").write_text(json.dumps(content))


def test_how_a_run_stands(tmp_path: Path) -> None:
    run = tmp_path / "run"
    assert run_ending(run, 32) == Ending("interrupted", None, 0, {}, None)
    record(run, 0, "eval", **{"eval_sampled/success": 0.1})
    record(run, 16, **{"train/success": 0.2})
    assert run_ending(run, 32) == Ending(
        "interrupted", None, 16, {"eval_sampled/success": 0.1}, None
    )
    success = {"eval_sampled/success": 0.25}
    result(run, "failed", 16, error="no room")
    assert run_ending(run, 32) == Ending("failed", None, 16, success, "no room")
    result(run, "finished", 32)
    assert run_ending(run, 32) == Ending("finished", None, 32, success, None)
    assert run_ending(run, 64).state == "interrupted"  # it was a shorter run


def test_a_run_that_its_limit_of_time_ended_is_finished(tmp_path: Path) -> None:
    result(tmp_path, "finished", 16, ended_by="time_limit", wall_time_s=61.0)
    assert run_ending(tmp_path, 32).state == "finished"  # under the limit that it had
    assert run_ending(tmp_path, 32, 1.0).state == "finished"
    for limit_min in (2.0, None):  # now it may continue
        assert run_ending(tmp_path, 32, limit_min).state == "interrupted"
    result(tmp_path, "finished", 16, ended_by="frames", wall_time_s=61.0)
    assert run_ending(tmp_path, 32, 1.0).state == "interrupted"  # it was a shorter run


def test_running_is_believed_only_of_the_living(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    ledger.add(plan(tmp_path, 4))
    keys = list(ledger.states())
    runs = [tmp_path / "runs" / f"s{i}" for i in range(4)]
    ledger.begin(keys[0], Process.of(os.getpid()))
    record(runs[0], 16, **{"train/success": 0.5, "train/steps_per_s": 100.0})
    ledger.begin(keys[1], dead())
    record(runs[1], 8)
    ledger.begin(keys[2], dead())
    result(runs[2], "finished", 32)
    shown = [(row.state, row.frames, row.success, row.attempts) for row in rows(ledger)]
    assert shown == [
        ("running", 16, 0.5, 1),
        ("interrupted", 8, None, 1),
        ("finished", 32, 0.25, 1),
        ("waiting", 0, None, 0),
    ]
    first = rows(ledger)[0]
    assert (first.steps_per_s, first.frames_per_s, first.left_s) == (100.0, 4.0, 4.0)
    assert [entry.key for entry in settle(ledger)] == keys[1:3]
    assert list(ledger.states().values()) == ["running", "interrupted", "finished", "waiting"]
    assert settle(ledger) == []


def test_a_cancelled_job_stays_so_when_its_process_is_gone(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    ledger.add(plan(tmp_path, 1))
    (key,) = ledger.states()
    ledger.begin(key, dead())
    ledger.set_states({key: "cancelled"})
    settle(ledger)
    assert ledger.states()[key] == "cancelled"
    assert rows(ledger)[0].state == "cancelled"


def test_who_drives(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    assert parent(ledger) is None
    for process, alive in ((Process.of(os.getpid()), True), (dead(), False)):
        ledger.set_fact(PARENT, [process.host, process.pid, process.born])
        assert parent(ledger) == (process if alive else None)


def row(state: str, frames: int, pace: float | None = None, **changes: object) -> Row:
    whole = {"key": "k", "name": "seed=0", "state": state, "attempts": 1, "frames": frames}
    whole |= {"total_frames": 100, "success": None, "steps_per_s": None, "frames_per_s": pace}
    whole |= {"left_s": None, "run_dir": Path(), "log": None, "error": None, "slurm": None}
    return Row(**(whole | changes))  # type: ignore[arg-type]


def test_a_sweep_as_a_whole() -> None:
    found = [
        row("finished", 100, 2.0),
        row("running", 50, 4.0),
        row("waiting", 0),
        row("failed", 7),
    ]
    summary = summarize(found, 2)
    assert summary.counts == {"waiting": 1, "running": 1, "finished": 1, "failed": 1}
    assert (summary.frames, summary.total_frames) == (157, 400)
    # 150 frames are left, at 3 frames/s each: 25 s by two, but the one of 100 takes 33 s alone.
    assert summary.left_s == pytest.approx(100 / 3)
    assert summarize(found, 1).left_s == pytest.approx(50)
    assert summarize([row("finished", 100)], 1).left_s == 0
    over = row("running", 150, 4.0)  # of 100: the last iteration is a whole one
    assert summarize([over], 1).left_s == 0
    assert summarize([row("waiting", 0)], 1).left_s is None
    assert summary_line("x", summarize(found, 1)) == (
        "x: 1 waiting, 1 running, 1 finished, 1 failed; 157 of 400 frames, about 50 s left"
    )


def test_the_live_table_shows_what_runs() -> None:
    running = row("running", 50, 4.0, name="seed=1", steps_per_s=5.0, success=0.25, left_s=12.5)
    found = [row("finished", 100), running, row("waiting", 0, name="seed=2")]
    console = Console(width=100, file=io.StringIO())
    console.print(live_table("x", found, summarize(found, 2)))
    lines = console.file.getvalue().splitlines()  # type: ignore[attr-defined]
    assert lines[0].split() == ["running", "frames", "steps/s", "success", "left"]
    assert [word for word in lines[1].split() if word.isascii()] == [
        *("seed=1", "50/100", "5", "25.0%", "12", "s")
    ]
    assert len(lines) == 4
    assert lines[3].strip().startswith("x: 1 waiting, 1 running, 1 finished; 150 of 300 frames")


def test_times_as_people_say_them() -> None:
    assert [span(s) for s in (0.2, 59.6, 3600, 7500, 90061, 86400)] == [
        "0 s",
        "1 min",
        "1 h",
        "2 h 5 min",
        "1 d 1 h",
        "1 d",
    ]


def test_failures_show_the_end_of_the_log(tmp_path: Path) -> None:
    log = tmp_path / "a.log"
    log.write_text("".join(f"line {i}\n" for i in range(100)))
    text = failures([row("finished", 1), row("failed", 1, log=log, error="no room", attempts=3)])
    table, _, end = text.partition("failed: seed=0 (attempt 3), log: ")
    words = "1 failed job attempts frames error seed=0 3 1 no room"
    assert table.split() == words.split()
    assert end.splitlines()[0] == str(log)
    assert "line 99" in text and "line 50\n" not in text
    assert failures([row("finished", 1)]) == ""


def test_logs_have_names_that_any_disk_takes(tmp_path: Path) -> None:
    assert log_path(tmp_path, "task=cup-pour1 seed=1", 2).name == "task=cup-pour1_seed=1.2.log"
    assert log_path(tmp_path, "a/../b" * 100, 1).parent == tmp_path / "logs"
    assert len(log_path(tmp_path, "a/../b" * 100, 1).name) < 200
    assert log_path(tmp_path, "a" * 200 + "1", 1) != log_path(tmp_path, "a" * 200 + "2", 1)


@pytest.mark.parametrize(
    ("max_jobs", "cores_per_job", "threads", "cores", "memory_gb", "expected"),
    [
        (0, 0, 0, 2, 64, Room(2, 1)),  # by cores
        (0, 0, 0, 16, 5, Room(5, 3)),  # by memory, the cores divided
        (0, 0, 0, 16, 64, Room(6, 2)),  # no more than jobs
        (0, 4, 0, 16, 64, Room(4, 4)),
        (0, 0, 8, 16, 64, Room(2, 8)),  # the jobs set their threads themselves
        (3, 0, 0, 16, 64, Room(3, 5)),
        (3, 2, 0, 1, 64, Room(3, 2)),  # explicit numbers win
        (0, 0, 0, 1, 0.5, Room(1, 1)),
    ],
)
def test_how_jobs_share_a_machine(
    max_jobs: int,
    cores_per_job: int,
    threads: int,
    cores: int,
    memory_gb: float,
    expected: Room,
    tmp_path: Path,
) -> None:
    launcher = type(LOCAL)("local", max_jobs, cores_per_job, 1.0)
    assert room(plan(tmp_path, 6, f"num_threads={threads}"), launcher, cores, memory_gb) == expected
    assert 1e7 < free_bytes() < 1e13


def test_a_worker_that_exits_with_0_before_its_run_is_finished_has_failed(tmp_path: Path) -> None:
    whole, heard = plan(tmp_path, 1), []
    (tmp_path / LOGS).mkdir()
    launcher = LocalLauncher(whole, LOCAL, ("true",))
    front = dataclasses.replace(FRONT, notify=heard.append)
    assert Driver(whole, 1, launcher, front).run(StopRequest()) == 1
    (attempt,) = Ledger(tmp_path).attempts()
    error = "exited with code 0, but its run is unfinished: 0 of 32 frames"
    assert (attempt.state, attempt.exit_code, attempt.error) == ("failed", 0, error)
    assert heard[0] == f"seed=0: attempt 1 failed: {error}"


def test_if_one_worker_cannot_be_started_none_stays(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, begun = plan(tmp_path, 2), []

    class Begun(subprocess.Popen[bytes]):
        def __init__(self, *args: object, **kwargs: object) -> None:
            super().__init__(*args, **kwargs)  # type: ignore[call-overload]
            begun.append(self)

    launcher = LocalLauncher(whole, LOCAL, (sys.executable, "-c", "import time; time.sleep(60)"))
    log_path(tmp_path, "seed=1", 1).mkdir(parents=True)  # where its log would be
    with monkeypatch.context() as patch:
        patch.setattr(subprocess, "Popen", Begun)
        with pytest.raises(
            SweepError, match=r"cannot start the worker of seed=1, .*1\.1\.log: Is a"
        ):
            launcher.start([Assignment(job, 1) for job in whole.jobs])
    assert [process.poll() for process in begun] == [-signal.SIGKILL]
    launcher.end(0.0)  # knows of none
