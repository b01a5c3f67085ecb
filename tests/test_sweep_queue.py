"""Commands for Slurm, and the parsing of its answers, without a Slurm."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import pytest
from submitit.slurm.slurm import _make_sbatch_string

from command_line import TINY, command
from pgdm.sweep.ledger import Ledger
from pgdm.sweep.processes import Process
from pgdm.sweep.queue import Queue, Standing, parse
from pgdm.sweep.slurm import parameters
from pgdm.sweep.status import rows, settle
from sweep_plans import SLURM, plan

# As Slurm 22.05 prints it, but for the spaces between the columns.
ANSWER = """\
31_4      PENDING        0      JobArrayTaskLimit
31_3      PENDING        0      launch_failed_requeued_held
31_2      RUNNING        0      None
31_1      CANCELLED      15     None
31_0      FAILED         36608  NonZeroExitCode
30        PENDING        0      (ReqNodeNotAvail, UnavailableNodes:n2)
29        COMPLETED      0      None
28        OUT_OF_MEMORY  32000  OutOfMemory
27        COMPLETING     0      None
"""


def test_what_squeue_says() -> None:
    found = parse(ANSWER)
    assert found["31_0"] == Standing("FAILED", 36608, "NonZeroExitCode")
    assert found["30"].reason == "(ReqNodeNotAvail, UnavailableNodes:n2)"
    alive = [slurm_id for slurm_id, standing in found.items() if standing.alive]
    assert alive == ["31_4", "31_3", "31_2", "30", "27"]
    pending = [slurm_id for slurm_id, standing in found.items() if standing.pending]
    assert pending == ["31_4", "31_3", "30"]
    assert [slurm_id for slurm_id, standing in found.items() if standing.stuck] == ["31_3"]
    codes = {slurm_id: found[slurm_id].exit_code for slurm_id in ("31_0", "31_1", "29", "28")}
    assert codes == {"31_0": 143, "31_1": -15, "29": 0, "28": 125}
    assert parse("") == {}
    assert parse("\n31_5 PENDING 0\n") == {"31_5": Standing("PENDING", 0, "")}


def squeue(folder: Path, text: str) -> None:
    """Put a command in the place of Slurm's that prints a text, and counts how often."""
    program = folder / "squeue"
    program.write_text(f"#!/bin/sh\necho x >> {folder}/asked\ncat <<'.'\n{text}.\n")
    program.chmod(0o755)


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> list[float]:
    now = [100.0]
    monkeypatch.setattr("pgdm.sweep.queue.time.monotonic", lambda: now[0])
    monkeypatch.setenv("PATH", f"{tmp_path}:/usr/bin:/bin")
    return now


def test_slurm_is_asked_once_for_all(clock: list[float], tmp_path: Path) -> None:
    squeue(tmp_path, ANSWER)
    queue = Queue(10.0)
    assert [queue.find(i).state for i in ("31_2", "29", "99")] == ["RUNNING", "COMPLETED", "GONE"]
    asked = tmp_path / "asked"
    assert len(asked.read_text().split()) == 1
    clock[0] += 2
    assert queue.find("31_2").state == "RUNNING"
    assert len(asked.read_text().split()) == 1
    assert queue.find("99").state == "GONE"  # it might be new
    assert len(asked.read_text().split()) == 2
    clock[0] += 11
    queue.find("31_2")
    assert len(asked.read_text().split()) == 3
    queue.forget()
    queue.find("31_2")
    assert len(asked.read_text().split()) == 4


def test_a_slurm_that_does_not_answer_ends_nothing(clock: list[float], tmp_path: Path) -> None:
    (tmp_path / "squeue").write_text("#!/bin/sh\nexit 1\n")
    (tmp_path / "squeue").chmod(0o755)
    ledger = Ledger(tmp_path)
    ledger.add(plan(tmp_path, 1))
    (key,) = ledger.states()
    number = ledger.begin(key, Process("elsewhere", 1, ""))
    ledger.submitted({(key, number): "31_0"})
    queue = Queue(10.0)
    assert settle(ledger, queue) == []
    (row,) = rows(ledger, queue)
    assert (row.state, row.slurm) == ("waiting", "31_0 UNKNOWN")
    clock[0] += 50
    assert queue.silent_s == 50
    squeue(tmp_path, ANSWER)
    assert queue.find("31_0").state == "FAILED"
    assert queue.silent_s == 0


def test_status_of_what_slurm_has(clock: list[float], tmp_path: Path) -> None:
    squeue(tmp_path, ANSWER)
    ledger = Ledger(tmp_path)
    ledger.add(plan(tmp_path, 4))
    keys = list(ledger.states())
    numbers = [ledger.begin(key, Process("login", 1, "")) for key in keys]
    ids = ["31_2", "30", "31_1", "99"]
    places = zip(keys, numbers, strict=True)
    ledger.submitted(dict(zip(places, ids, strict=True)))
    ledger.register(keys[0], numbers[0], Process.of(os.getpid()), "31_2")
    ledger.submitted({(keys[0], numbers[0]): "31_2"})  # later than the job itself
    noted = {attempt.slurm_id: attempt.process for attempt in ledger.attempts()}
    assert noted["31_2"] == Process.of(os.getpid())
    assert noted["30"] == Process("", 0, "")
    assert [row.state for row in rows(ledger)] == ["running", "waiting"] + ["interrupted"] * 2
    shown = [row.slurm for row in rows(ledger)]
    assert shown[1] == "30 PENDING ((ReqNodeNotAvail, UnavailableNodes:n2))"
    assert [entry.key for entry in settle(ledger)] == keys[2:]
    assert list(ledger.states().values()) == ["running"] * 2 + ["interrupted"] * 2


def test_what_sbatch_is_given(tmp_path: Path) -> None:
    given = ["exclusive", "mail-type=FAIL"]
    cfg = dataclasses.replace(
        SLURM, partition="gpu", gpus_per_job=1, cores_per_job=4, setup=["module load x"]
    )
    cfg = dataclasses.replace(cfg, additional_parameters=given, signal_delay_s=90)
    made = parameters(cfg, "study", 3)
    lines = _make_sbatch_string("run", tmp_path, **made, map_count=12).splitlines()
    assert {
        "#SBATCH --array=0-11%3",
        "#SBATCH --cpus-per-task=4",
        "#SBATCH --exclusive",
        "#SBATCH --gpus-per-node=1",
        "#SBATCH --job-name=study",
        "#SBATCH --mail-type=FAIL",
        "#SBATCH --mem=1024MB",
        "#SBATCH --open-mode=append",
        "#SBATCH --partition=gpu",
        "#SBATCH --requeue",
        "#SBATCH --signal=USR2@90",
        "#SBATCH --time=60",
        "module load x",
    } <= set(lines)
    assert not [line for line in lines if "account" in line or "wckey" in line or "gres" in line]
    assert lines[-1].startswith("srun ") and "--cpus-per-task=4" in lines[-1]


def test_no_slurm_here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "")
    settings = ("-m", "seed=0,1", *TINY, "hydra/launcher=slurm", "sweep.dir=study")
    assert command("pgdm-run", *settings, "--dry-run").code == 0
    outcome = command("pgdm-run", *settings)
    assert outcome.code == 1
    (error,) = outcome.errors
    assert "sbatch, which is not on PATH; start the sweep on a login node" in error
    assert not (tmp_path / "study").exists()
