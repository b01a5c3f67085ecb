"""Sweeps of real runs in real processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from command_line import command
from pgdm.errors import SweepError
from pgdm.runs.files import read_json
from pgdm.runs.folder import claimed
from pgdm.runs.log import RunLog
from pgdm.sweep.launch import held
from pgdm.sweep.ledger import Ledger
from pgdm.sweep.plan import Plan, read_plan, write_plan
from pgdm.sweep.status import log_path, parent, rows
from sweep_plans import broken, plan, start

LONG = ("total_frames=1600", "eval.interval_frames=0", "checkpoint.interval_s=0.5")


@pytest.fixture
def folder(library_home: Path, tmp_path: Path) -> Path:
    return tmp_path / "sweep"


def planned(whole: Plan) -> Ledger:
    write_plan(whole)
    return Ledger(whole.folder)


def until(condition: Callable[[], object], process: subprocess.Popen[str]) -> None:
    limit = time.monotonic() + 120
    while not condition():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < limit
        time.sleep(0.05)


def frames(folder: Path, seed: int) -> int:
    lines = RunLog(folder / "runs" / f"s{seed}" / "metrics.jsonl").tail()
    return int(lines[-1]["frames"]) if lines else 0


def states(ledger: Ledger) -> list[str]:
    return [row.state for row in rows(ledger)]


def test_one_fails_the_others_finish_and_the_same_again_does_only_the_rest(folder: Path) -> None:
    whole = broken(plan(folder, 3), 1)
    ledger = planned(whole)
    process = start(folder)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 1, err
    assert out == ""
    assert states(ledger) == ["finished", "failed", "finished"]
    assert [row.attempts for row in rows(ledger)] == [1, 2, 1]
    failed = rows(ledger)[1]
    assert failed.error is not None and "no-such-motion" in failed.error
    assert log_path(folder, "seed=1", 1).exists() and failed.log == log_path(folder, "seed=1", 2)
    assert "failed: seed=1 (attempt 2)" in err and "  | error: " in err
    assert "Traceback" not in err
    attempts = {a.key: a for a in ledger.attempts() if a.state == "finished"}
    done = attempts[whole.jobs[0].key]
    assert (done.exit_code, done.frames, done.error) == (0, 32, None)
    assert done.metrics == read_json(folder / "runs" / "s0" / "result.json")["metrics"]

    written = (folder / "runs" / "s0" / "metrics.jsonl").stat().st_mtime_ns
    again = start(folder)
    again.communicate(timeout=300)
    assert again.returncode == 1
    assert [row.attempts for row in rows(ledger)] == [1, 4, 1]
    assert (folder / "runs" / "s0" / "metrics.jsonl").stat().st_mtime_ns == written

    # A ledger that was lost comes back from the run folders.
    before = [(row.state, row.frames, row.success) for row in rows(ledger)]
    ledger.path.unlink()
    status = json.loads(command("pgdm", "sweep", "status", str(folder), "--json").out)
    after = [(job["state"], job["frames"], job["success"]) for job in status["jobs"]]
    assert after == [before[0], ("waiting", 0, None), before[2]]


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_a_signal_saves_and_the_same_command_goes_on(folder: Path, number: signal.Signals) -> None:
    ledger = planned(plan(folder, 2, *LONG))
    process = start(folder)
    until(lambda: frames(folder, 0) > 64 and frames(folder, 1) > 64, process)
    refused = pytest.raises(SweepError, match=f"is already run by process {process.pid}")
    with refused, held(read_plan(folder)):
        pass
    process.send_signal(number)
    _, err = process.communicate(timeout=120)
    assert process.returncode == 128 + number, err
    assert states(ledger) == ["interrupted"] * 2
    assert parent(ledger) is None
    stopped = [frames(folder, seed) for seed in range(2)]
    assert [a.exit_code for a in ledger.attempts()] == [143, 143]
    for seed in range(2):
        result = read_json(folder / "runs" / f"s{seed}" / "result.json")
        assert (result["status"], result["frames"]) == ("interrupted", stopped[seed])
    outcome = command("pgdm", "sweep", "resume", str(folder))
    assert outcome.code == 0, outcome.err
    assert states(ledger) == ["finished"] * 2
    for seed in range(2):
        log = log_path(folder, f"seed={seed}", 2).read_text()
        assert f"at {stopped[seed]:,} frames" in log
    (folder / "launch.json").unlink()
    assert (
        "with its original command: pgdm-run -m"
        in command("pgdm", "sweep", "resume", str(folder)).err
    )


@pytest.mark.slow
def test_the_driver_is_killed_and_its_workers_save(folder: Path) -> None:
    ledger = planned(plan(folder, 2, *LONG))
    process = start(folder)
    until(lambda: frames(folder, 0) > 64 and frames(folder, 1) > 64, process)
    workers = [a.process for a in ledger.attempts()]
    process.kill()
    process.communicate()
    again = start(folder)  # immediately: the workers still run
    _, err = again.communicate(timeout=300)
    assert again.returncode == 0, err
    assert not any(worker.alive for worker in workers)
    attempts = sorted((a.key, a.number, a.state) for a in ledger.attempts())
    assert [state for _, _, state in attempts] == ["interrupted", "finished"] * 2
    for seed in range(2):
        lines = RunLog(folder / "runs" / f"s{seed}" / "metrics.jsonl").read()
        trained = [line["frames"] for line in lines if line["kind"] == "train"]
        assert trained == list(range(16, 1601, 16))


@pytest.mark.slow
def test_a_killed_worker_harms_nobody_and_is_tried_again(folder: Path) -> None:
    ledger = planned(plan(folder, 2, *LONG))
    process = start(folder)
    until(lambda: frames(folder, 0) > 64 and frames(folder, 1) > 64, process)
    victim = next(entry for entry in ledger.entries() if entry.name == "seed=0").last
    assert victim is not None and victim.process.signal(signal.SIGKILL)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    found = {row.name: row for row in rows(ledger)}
    assert (found["seed=0"].attempts, found["seed=1"].attempts) == (2, 1)
    assert "seed=0: attempt 1 failed: killed by SIGKILL" in err
    assert states(ledger) == ["finished"] * 2


def test_a_second_signal_ends_at_once(folder: Path) -> None:
    ledger = planned(plan(folder, 1, *LONG))
    process = start(folder)
    until(lambda: frames(folder, 0) > 32, process)
    worker = ledger.attempts()[0].process
    os.kill(worker.pid, signal.SIGSTOP)  # it cannot even save
    process.send_signal(signal.SIGINT)
    time.sleep(0.5)
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=30)
    assert process.returncode == 130
    assert not worker.alive
    assert states(ledger) == ["interrupted"]


def test_somebody_else_works_in_a_run_folder(folder: Path) -> None:
    ledger = planned(plan(folder, 1))
    with claimed(folder / "runs" / "s0"):
        process = start(folder)
        assert process.stderr is not None
        line = next(text for text in process.stderr if "another process is using" in text)
        assert line.startswith("seed=0: ")
        assert ledger.attempts() == []
    process.communicate(timeout=120)
    assert process.returncode == 0


def test_a_job_that_its_limit_of_time_ends_is_finished_at_its_first_attempt(folder: Path) -> None:
    whole = plan(folder, 1, "total_frames=1_000_000", "time_limit_min=0.02")
    ledger = planned(whole)
    process = start(folder)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    [row] = rows(ledger)
    assert (row.state, row.attempts) == ("finished", 1)
    assert row.frames < 1_000_000
