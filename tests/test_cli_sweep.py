"""``pgdm sweep ...`` on running and ended sweeps, and on folders without one."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path

import pytest

from command_line import Outcome, command
from pgdm.sweep.ledger import Ending, Ledger
from pgdm.sweep.plan import write_plan
from pgdm.sweep.processes import Process
from pgdm.sweep.status import log_path
from sweep_plans import plan

ME = Process.of(os.getpid())


@pytest.fixture
def ended(tmp_path: Path) -> Path:
    """Return a sweep that has ended: one job finished, one failed, one never started."""
    folder = tmp_path / "study"
    write_plan(plan(folder))
    ledger = Ledger(folder)
    ledger.add(plan(folder))
    first, second, _ = ledger.states()
    success = {"eval_sampled/success": 0.5}
    ledger.end(first, ledger.begin(first, ME), Ending("finished", 0, 32, success, None))
    ledger.end(second, ledger.begin(second, ME), Ending("failed", 1, 16, {}, "no room"))
    ledger.set_states({first: "finished", second: "failed"})
    log = log_path(folder, "seed=1", 1)
    log.parent.mkdir()
    log.write_text("error: no room\n")
    return folder


def sweep(name: str, *arguments: str | Path) -> Outcome:
    return command("pgdm", "sweep", name, *map(str, arguments))


@pytest.mark.parametrize("name", ["status", "watch", "cancel", "retry", "resume"])
def test_a_folder_without_a_sweep(name: str, tmp_path: Path) -> None:
    for folder in (tmp_path, tmp_path / "nowhere"):
        outcome = sweep(name, folder)
        assert outcome.code == 1
        assert "holds no sweep" in outcome.errors[0]
    assert list(tmp_path.iterdir()) == []


def test_status(ended: Path) -> None:
    outcome = sweep("status", ended)
    assert (outcome.code, outcome.err) == (0, "")
    lines = [line.split() for line in outcome.out.splitlines()]
    assert ["seed=0", "finished", "32/32", "50.0%", "1", "-"] in lines
    assert ["seed=1", "failed", "16/32", "-", "1", "-", "no", "room"] in lines
    assert ["seed=2", "waiting", "0/32", "-", "0", "-"] in lines
    assert "study: 1 waiting, 1 finished, 1 failed; 48 of 96 frames" in outcome.out
    assert f"pgdm sweep resume {ended}" in outcome.out


def test_status_for_programs(ended: Path) -> None:
    status = json.loads(sweep("status", ended, "--json").out)
    assert (status["frames"], status["driven"]) == (48, False)
    assert status["counts"] == {"waiting": 1, "finished": 1, "failed": 1}
    assert [job["state"] for job in status["jobs"]] == ["finished", "failed", "waiting"]
    assert status["jobs"][1]["error"] == "no room"


def test_status_needs_neither_torch_nor_mlflow(ended: Path) -> None:
    code = (
        "import sys; from pgdm.cli.main import main;"
        f"main(['sweep', 'status', {str(ended)!r}]);"
        "print({'torch', 'mlflow', 'hydra'} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.endswith("set()\n")


def test_watching_what_has_ended(ended: Path) -> None:
    outcome = sweep("watch", ended)
    assert outcome.code == 1
    assert "failed: seed=1 (attempt 1), log: " in outcome.out
    assert "  | error: no room" in outcome.out


def test_logs(ended: Path) -> None:
    assert sweep("logs", ended, "seed=1").out == "error: no room\n"
    assert sweep("logs", ended, "seed=1", "-f").out == "error: no room\n"
    assert "seed=2 has not been started yet" in sweep("logs", ended, "seed=2").errors[0]
    assert "'seed' matches 3 jobs" in sweep("logs", ended, "seed").errors[0]
    assert "did you mean seed=1" in sweep("logs", ended, "sed=1").errors[0]


def test_cancel_what_does_not_run(ended: Path) -> None:
    assert "cancelled 1 job;" in sweep("cancel", ended).out
    assert list(Ledger(ended).states().values()) == ["finished", "failed", "cancelled"]
    assert "cancelled 1 job;" in sweep("cancel", ended, "seed=1").out
    assert list(Ledger(ended).states().values()) == ["finished", "cancelled", "cancelled"]


def test_nothing_to_retry(ended: Path) -> None:
    assert "finished or running" in sweep("retry", ended, "seed=0").out
    Ledger(ended).set_states(dict.fromkeys(Ledger(ended).states(), "finished"))
    assert "no failed jobs" in sweep("retry", ended).out


PROGRAM = """
import sys
from pathlib import Path
from dataclasses import replace
import sweep_plans
from pgdm.cli.sweep import FRONT
from pgdm.sweep.launch import run_sweep
plan = sweep_plans.plan(Path("study").absolute(), 3, *sys.argv[1:])
sys.exit(run_sweep(plan, replace(sweep_plans.SWEEP, detach=True), sweep_plans.LOCAL, FRONT))
"""


def test_a_sweep_in_the_background(library_home: Path, tmp_path: Path) -> None:
    folder, here = tmp_path / "study", str(Path(__file__).parent)
    env = os.environ | {"PYTHONPATH": os.pathsep.join([here, *sys.path])}
    long = ["total_frames=100000", "eval.interval_frames=0"]
    started = subprocess.run(
        [sys.executable, "-c", PROGRAM, *long],
        env=env,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )
    assert started.returncode == 0, started.stderr
    assert f"pgdm sweep watch {folder}" in started.stderr
    watching = subprocess.Popen(
        [sys.executable, "-c", "from pgdm.cli.main import main; main()", "sweep", "watch", folder],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    limit = time.monotonic() + 120
    while [j["frames"] > 0 for j in status_of(folder)["jobs"]] != [True, True, False]:
        assert time.monotonic() < limit
        time.sleep(0.2)
    assert "running" in sweep("status", folder).out
    assert status_of(folder)["driven"]
    again = sweep("resume", folder)
    assert "already" in again.errors[0] and "pgdm sweep cancel" in again.errors[0]

    assert "cancelled 1 job;" in sweep("cancel", folder, "seed=0").out
    assert [job["state"] for job in status_of(folder)["jobs"]][:2] == ["cancelled", "running"]
    assert "retried by the running sweep" in sweep("retry", folder, "seed=0").out
    assert "cancelled 3 jobs;" in sweep("cancel", folder).out
    out, err = watching.communicate(timeout=60)
    assert "3 cancelled" in out, err
    assert [job["state"] for job in status_of(folder)["jobs"]] == ["cancelled"] * 3
    result = json.loads((folder / "runs" / "s1" / "result.json").read_text())
    assert result["status"] == "interrupted"
    assert "cancelled" in (folder / "logs" / "sweep.log").read_text()


def status_of(folder: Path) -> dict:
    return json.loads(sweep("status", folder, "--json").out)


def test_a_worker_whose_attempt_was_given_up(ended: Path) -> None:
    key = next(iter(Ledger(ended).states()))
    worker = [sys.executable, "-m", "pgdm.cli.worker", str(ended), key, "1", "1"]
    done = subprocess.run(worker, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "given up before it began" in done.stderr
    assert not (ended / "runs").exists()
