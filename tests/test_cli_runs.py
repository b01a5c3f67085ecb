from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
import yaml
from filelock import FileLock
from typer.testing import CliRunner

from command_line import in_terminal
from fake_runs import LENGTH, STEP, empty_database, end, make, train
from pgdm.cli.runs import app, row
from pgdm.errors import ConfigError, RunError, UnknownNameError
from pgdm.runs.folder import RunFolder

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


def test_ablated_starts_are_marked(tmp_path: Path) -> None:
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


LONG = "dhand-stanfordbunny-inspect/curriculum/planned-residual-ppo_fast-s1-1a2b3c41"


@pytest.mark.parametrize("columns", [60, 80, 120])
def test_a_narrow_terminal_shows_every_run_legibly_and_its_name_whole(
    tmp_path: Path, columns: int
) -> None:
    for seed, name in enumerate((f"{RUN}-1a2b3c40", LONG)):
        finished(tmp_path / "runs" / name, seed)
    head, first, *rest = (line.rstrip() for line in in_terminal(columns, "runs"))
    assert {"task", "frames", "success", "status"} <= set(head.split())
    assert len(head) <= columns and len(first) <= columns
    assert first.split()[0] == "hammer-use1" and "10.0%" in first and "finished" in first
    assert rest[0] == f"  {RUN}-1a2b3c40"
    assert rest[2] == f"  {LONG}"


def test_nothing_is_cut_in_a_pipe(tmp_path: Path) -> None:
    name = "/".join(["a" * 100] * 5)
    finished(tmp_path / "runs" / name)
    assert pgdm_runs().splitlines()[1].split()[-1] == name


def test_runs_are_filtered_sorted_and_limited(tmp_path: Path) -> None:
    for seed in (2, 0, 1):
        finished(tmp_path / "runs" / f"s{seed}", seed)
    make(tmp_path / "runs" / "cup", 5, task={"id": "cup-pour1"})
    (make(tmp_path / "runs" / "broken").path / "config.yaml").write_text("[")

    def names(*options: str) -> list[str]:
        return [found["run"] for found in json.loads(pgdm_runs("--json", *options))]

    assert names("--where", "task=hammer*", "--sort", "seed") == ["s0", "s1", "s2"]
    assert names("--where", "task=hammer*", "--sort", "-seed", "-n", "2") == ["s2", "s1"]
    assert names("--where", "task=hammer*", "--sort", "seed", "-n", "2") == ["s1", "s2"]
    assert names("--where", "status=finished", "--where", "seed=1") == ["s1"]
    assert names("--where", "status=unreadable") == ["broken"]
    assert names("--sort", "error")[-1] in {"s0", "s1", "s2"}  # those without a value come first
    assert "of 5 runs in" in pgdm_runs("--where", "seed=7")
    with pytest.raises(UnknownNameError, match="unknown column 'sucess'; did you mean success"):
        pgdm_runs("--sort", "sucess")
    with pytest.raises(ConfigError, match="cannot read 'seed'; write COLUMN=VALUE"):
        pgdm_runs("--where", "seed")


def test_runs_are_removed_after_a_question(tmp_path: Path) -> None:
    finished(tmp_path / "runs" / "a")
    finished(tmp_path / "runs" / "b")
    assert "nothing was removed" in pgdm_runs("remove", "a")  # nobody answers
    assert (tmp_path / "runs" / "a").is_dir()
    assert f"removed {tmp_path / 'runs' / 'a'}" in pgdm_runs("remove", "a", "--yes")
    assert [path.name for path in (tmp_path / "runs").iterdir()] == ["b"]


def test_what_is_no_run_or_in_use_is_not_removed(tmp_path: Path) -> None:
    finished(tmp_path / "runs" / "a")
    (tmp_path / "link").symlink_to(tmp_path / "runs" / "a")
    (tmp_path / "other").mkdir()
    checkpoint = next((tmp_path / "runs" / "a" / "checkpoints").glob("*.ckpt"))
    with pytest.raises(RunError, match="is a link"):
        pgdm_runs("remove", "link", "--yes")
    with pytest.raises(RunError, match="holds no run"):
        pgdm_runs("remove", "other", "--yes")
    with pytest.raises(RunError, match="name the run's own folder"):
        pgdm_runs("remove", str(checkpoint), "--yes")
    with (
        FileLock(tmp_path / "runs" / "a" / ".lock"),
        pytest.raises(RunError, match="is running; stop it first"),
    ):
        pgdm_runs("remove", "a", "--yes")
    assert checkpoint.is_file()


@pytest.mark.filterwarnings("ignore")
def test_sync_prints_what_it_did(tmp_path: Path, empty_database: Path) -> None:
    finished(tmp_path / "runs" / RUN)
    (make(tmp_path / "runs" / "x").path / "config.yaml").write_text("[")
    shutil.copy(empty_database, tmp_path / "runs" / "mlflow.db")
    lines = pgdm_runs("sync").splitlines()
    assert lines[0].split() == ["created", RUN]
    assert lines[1].startswith("unreadable x (cannot read ")
    assert lines[2] == "1 created, 1 unreadable"
    assert pgdm_runs("sync").splitlines()[0].split() == ["unchanged", RUN]
