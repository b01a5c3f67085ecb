from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import yaml
from filelock import FileLock
from typer.testing import CliRunner

from fake_runs import LENGTH, STEP, empty_database, end, make, train
from pgdm.cli.runs import app, row
from pgdm.errors import RunError
from pgdm.tracking import RunFolder

__all__ = ["empty_database"]  # a fixture

RUN = "hammer-use1/pgdm/s0"


def pgdm_runs(*args: str) -> str:
    done = CliRunner().invoke(app, args, catch_exceptions=False)
    assert done.exit_code == 0, done.output
    return done.output


def finished(path: Path, seed: int = 0) -> None:
    folder = make(path, seed)
    train(folder)
    end(folder)


def test_table_of_a_finished_run(tmp_path: Path) -> None:
    finished(tmp_path / "runs" / RUN)
    head, line, *_ = pgdm_runs().splitlines()
    assert head.split() == [
        *("task", "method", "algo", "action", "start", "seed", "frames", "success", "error"),
        *("lifted", "steps/s", "status", "when", "run"),
    ]
    assert line.split() == [
        *("hammer-use1", "pgdm", "ppo_fast", "residual", "planned", "0", "40,960", "10.0%"),
        *("3.00e-04", "50%", "1,988", "finished", "just", "now", RUN),
    ]


def test_ablated_starts_are_told_apart(tmp_path: Path) -> None:
    folder = make(tmp_path / "runs" / "a")
    config = {**folder.config, "ablation": {"name": "open_hand"}}
    (folder.path / "config.yaml").write_text(yaml.safe_dump(config))
    assert "planned open_hand" in " ".join(pgdm_runs().splitlines()[1].split())


def test_folder_can_be_named_with_and_without_the_command(tmp_path: Path) -> None:
    finished(tmp_path / "out" / "a")
    assert pgdm_runs("out") == pgdm_runs("list", "out")
    assert "out" not in pgdm_runs("out").splitlines()[1]
    assert json.loads(pgdm_runs("out", "--json"))[0]["run"] == "a"
    assert json.loads(pgdm_runs(str(tmp_path / "out" / "a"), "--json"))[0]["run"] == "."


def test_program_readable_rows(tmp_path: Path) -> None:
    finished(tmp_path / "runs" / RUN, seed=7)
    (only,) = json.loads(pgdm_runs("--json"))
    assert only.pop("modified") > 0
    assert only == {
        "task": "hammer-use1",
        "hand": "adroit",
        "method": "pgdm",
        "algo": "ppo_fast",
        "action": "residual",
        "start": "planned",
        "ablation": "none",
        "seed": 7,
        "frames": LENGTH * STEP,
        "success": 0.1,
        "com_error_released": 3e-4,
        "lifted": 0.5,
        "steps_per_s": 1987.6,
        "status": "finished",
        "run": RUN,
    }


def test_running_run_shows_how_far_it_is(tmp_path: Path) -> None:
    folder = make(tmp_path / "runs" / "a")
    train(folder, 1, 7)
    with FileLock(folder.path / ".lock"):
        shown = row(RunFolder(folder.path), tmp_path / "runs")
    assert shown["status"] == "running"
    assert shown["frames"] == 7 * STEP
    assert shown["success"] == 0.05  # of the evaluation at iteration 5
    assert shown["steps_per_s"] == 2007.0
    assert row(RunFolder(folder.path), tmp_path / "runs")["status"] == "interrupted"


def test_run_that_has_just_started_and_one_that_is_damaged(tmp_path: Path) -> None:
    make(tmp_path / "runs" / "a")
    (make(tmp_path / "runs" / "b[1]").path / "config.yaml").write_text("[")
    lines = pgdm_runs().splitlines()[1:3]
    assert lines[0].split()[6:10] == ["-", "-", "-", "-"]
    assert "unreadable" in lines[1] and "b[1]" in lines[1]


def test_latest_run_is_last(tmp_path: Path) -> None:
    for name in ("c", "a", "b"):
        make(tmp_path / "runs" / name)
    assert [r["run"] for r in json.loads(pgdm_runs("--json"))] == ["c", "a", "b"]


def test_no_runs(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"no folder .*runs'; `pgdm-run` makes one"):
        pgdm_runs()
    with pytest.raises(RunError, match="no folder 'nope'; name a folder"):
        pgdm_runs("nope")
    (tmp_path / "runs").mkdir()
    assert "no runs in" in pgdm_runs()
    assert pgdm_runs("--json") == "[]\n"


@pytest.mark.filterwarnings("ignore")
def test_sync_says_what_it_did(tmp_path: Path, empty_database: Path) -> None:
    finished(tmp_path / "runs" / RUN)
    (make(tmp_path / "runs" / "x").path / "config.yaml").write_text("[")
    shutil.copy(empty_database, tmp_path / "runs" / "mlflow.db")
    lines = pgdm_runs("sync").splitlines()
    assert lines[0].split() == ["created", RUN]
    assert lines[1].startswith("unreadable x (cannot read ")
    assert lines[2] == "1 created, 1 unreadable"
    assert pgdm_runs("sync").splitlines()[0].split() == ["unchanged", RUN]
