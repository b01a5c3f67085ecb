from __future__ import annotations

import os
import shutil
import socket
import time
from pathlib import Path

import pytest
from filelock import FileLock

from fake_runs import LENGTH, STEP, end, make, train
from pgdm import paths
from pgdm.errors import RunError
from pgdm.runs.config_file import as_text, dotted
from pgdm.runs.files import write_json
from pgdm.runs.folder import SILENT_S, RunFolder, find_runs, runs_root


def test_tags_say_what_the_run_is(tmp_path: Path) -> None:
    folder = make(tmp_path / "a", seed=3)
    end(folder)
    assert folder.tags() == {
        "task": "hammer-use1",
        "hand": "adroit",
        "method": "pgdm",
        "ablation": "none",
        "pregrasp_source": "planned",
        "obs": "released",
        "action": "residual",
        "algo": "ppo_fast",
        "seed": "3",
        "budget": "smoke",
        "asset_source": "checkout",
        "git": "0123abc",
        "run_dir": str(tmp_path / "a"),
        "host": socket.gethostname(),
    }
    assert folder.name() == "hammer-use1 s3 pgdm ppo_fast residual"


def test_facts_of_a_run_without_a_result_come_from_its_link(tmp_path: Path) -> None:
    folder = make(tmp_path / "a")
    write_json(folder.path / "mlflow.json", {"asset_source": "registry", "run_id": "x"})
    assert folder.tags()["asset_source"] == "registry"
    assert "git" not in folder.tags()


def test_status(tmp_path: Path) -> None:
    folder = make(tmp_path / "a")
    assert folder.status() == "running"  # no lock to ask, and it wrote something just now
    long_ago = time.time() - SILENT_S - 1
    os.utime(folder.path / "config.yaml", (long_ago, long_ago))
    assert folder.status() == "interrupted"
    for status in ("finished", "interrupted", "failed"):
        end(folder, status)
        assert RunFolder(folder.path).status() == status
    end(folder, "exploded")
    assert RunFolder(folder.path).status() == "failed"


def test_the_lock_tells_running_from_killed(tmp_path: Path) -> None:
    folder = make(tmp_path / "a")
    with FileLock(folder.path / ".lock"):
        assert folder.status() == "running"
        end(folder, "interrupted")  # the result of the attempt before
        assert RunFolder(folder.path).status() == "running"
    (folder.path / "result.json").unlink()
    assert RunFolder(folder.path).status() == "interrupted"  # at once, however fresh its files


def test_when_it_started(tmp_path: Path) -> None:
    folder = make(tmp_path / "a")
    train(folder)
    at = time.time()
    assert folder.started() == pytest.approx(at - 2.0 * LENGTH, abs=2)
    assert folder.modified() == pytest.approx(at, abs=2)
    assert folder.total_frames() == LENGTH * STEP


def test_artifacts_are_the_newest_checkpoint_and_the_best(tmp_path: Path) -> None:
    folder = make(tmp_path / "a")
    end(folder)
    names = [f"{place}/{path.name}" for path, place in folder.artifacts()]
    assert names == [
        "/config.yaml",
        "/result.json",
        "videos/frames_000000040960.mp4",
        "videos/frames_000000040960.png",
        "checkpoints/best.ckpt",
        "checkpoints/frames_000000040960.ckpt",
    ]


def test_find_runs_at_any_depth_but_not_copies_of_their_files(tmp_path: Path) -> None:
    for place in ("b/x", "a", "a/copy", "mlflow-artifacts/pgdm/1/artifacts", ".trash/c"):
        make(tmp_path / place)
    assert [f.path.relative_to(tmp_path).as_posix() for f in find_runs(tmp_path)] == ["a", "b/x"]
    assert find_runs(tmp_path / "nowhere") == []


def test_store_lies_in_the_folder_of_runs(tmp_path: Path) -> None:
    assert runs_root(Path("runs/hammer-use1/pgdm/s0")) == paths.runs()
    assert runs_root(Path("out/a")) == tmp_path / "out"


def test_settings_are_flattened_and_written_as_text() -> None:
    nested = {"a": {"b": 1, "c": {"d": [1, {"e": 2}]}}, "f": None, "g": True, "h": "x"}
    flat = dotted(nested)
    assert flat == {"a.b": 1, "a.c.d": [1, {"e": 2}], "f": None, "g": True, "h": "x"}
    assert [as_text(value) for value in flat.values()] == [
        *("1", '[1, {"e": 2}]', "null", "true", "x")
    ]


@pytest.mark.parametrize("text", ["- a", "a: [", "\x00", ""])
def test_unreadable_configuration_is_one_line(text: str, tmp_path: Path) -> None:
    folder = make(tmp_path / "a")
    (folder.path / "config.yaml").write_text(text)
    with pytest.raises(RunError, match=r"config\.yaml") as error:
        folder.tags()
    assert "\n" not in str(error.value)


def test_damaged_result_counts_as_none(tmp_path: Path) -> None:
    folder = make(tmp_path / "a")
    (folder.path / "result.json").write_text('{"status": "fin')
    assert folder.result == {}
    shutil.rmtree(folder.path)
    with pytest.raises(RunError, match="No such file"):
        folder.tags()
