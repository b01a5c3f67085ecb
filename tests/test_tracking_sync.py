from __future__ import annotations

import contextlib
import json
import os
import shutil
import sqlite3
import subprocess
import sys
from pathlib import Path

import pytest
from filelock import FileLock

from fake_runs import LENGTH, STEP, empty_database, end, eval_metrics, make, train, truth
from pgdm.errors import TrackingError
from pgdm.runs.files import LINK, read_json
from pgdm.runs.folder import RunFolder
from pgdm.tracking import TrackingCfg, open_tracker
from pgdm.tracking.mlflow import Store, store_uri
from pgdm.tracking.sync import sync

__all__ = ["empty_database"]  # a fixture

# MLflow warns of what it and its dependencies will change; that is theirs.
pytestmark = pytest.mark.filterwarnings("ignore")


@pytest.fixture(autouse=True)
def root(tmp_path: Path, empty_database: Path) -> Path:
    runs = tmp_path / "runs"
    runs.mkdir()
    shutil.copy(empty_database, runs / "mlflow.db")
    return runs


def finished(path: Path, seed: int = 0) -> RunFolder:
    folder = make(path, seed)
    train(folder)
    end(folder)
    return RunFolder(path)


def actions(root: Path) -> dict[str, str]:
    done = sync(root)
    return {d.folder.path.relative_to(root).as_posix(): d.action for d in done}


def mirrored(root: Path, folder: RunFolder) -> dict[str, dict[int, float]]:
    """Return the last value of each metric at each step, as MLflow has it."""
    store = Store.open(store_uri(root), "pgdm")
    run = store.client.get_run(read_json(folder.path / LINK)["run_id"])
    shown: dict[str, dict[int, float]] = {}
    for name in run.data.metrics:
        history = store.client.get_metric_history(run.info.run_id, name)
        shown[name] = {m.step: m.value for m in sorted(history, key=lambda m: m.timestamp)}
    return shown


def test_empty_store_is_filled_and_then_left_alone(root: Path) -> None:
    folders = [finished(root / "x" / f"s{seed}", seed) for seed in range(2)]
    assert actions(root) == {"x/s0": "created", "x/s1": "created"}
    assert actions(root) == {"x/s0": "unchanged", "x/s1": "unchanged"}
    store = Store.open(store_uri(root), "pgdm")
    store.client.update_run(folders[0].link["run_id"], status="RUNNING")
    assert actions(root) == {"x/s0": "completed", "x/s1": "unchanged"}
    runs = store.client.search_runs([store.experiment_id])
    assert len(runs) == 2
    for folder in folders:
        assert mirrored(root, folder) == truth(folder)
        run = store.client.get_run(read_json(folder.path / LINK)["run_id"])
        assert run.info.status == "FINISHED"
        assert run.info.start_time < run.info.end_time
        assert run.data.tags["asset_source"] == "checkout"
        assert run.data.params["algo.hidden"] == "[256, 128]"
        names = {item.path for item in store.client.list_artifacts(run.info.run_id)}
        assert names >= {"config.yaml", "result.json", "videos", "checkpoints", "images"}
        images = store.client.list_artifacts(run.info.run_id, "images")
        assert any(f"+step+{LENGTH * STEP}+" in item.path for item in images)


def test_what_a_live_run_missed_is_completed(root: Path) -> None:
    folder = make(root / "a")
    tracker = open_tracker(TrackingCfg("mlflow", None, "pgdm"), folder, {})
    train(folder, 1, 5)
    for record in folder.log.read():
        tracker.log({k: float(v) for k, v in record.items() if "/" in k}, int(record["frames"]))
    tracker.finish("finished")
    run_id = read_json(folder.path / LINK)["run_id"]
    end(folder)
    assert actions(root) == {"a": "completed"}  # its end was not known when it finished
    assert actions(root) == {"a": "unchanged"}
    train(folder, 6, 10)  # and now MLflow was away
    end(folder, "failed")
    assert actions(root) == {"a": "completed"}
    assert read_json(folder.path / LINK)["run_id"] == run_id
    assert mirrored(root, folder) == truth(folder)
    store = Store.open(store_uri(root), "pgdm")
    assert store.client.get_run(run_id).info.status == "FAILED"
    history = store.client.get_metric_history(run_id, "train/return")
    assert len(history) == LENGTH  # what was there was not sent again
    assert actions(root) == {"a": "unchanged"}


def test_what_contradicts_the_records_is_made_anew(root: Path) -> None:
    folder = finished(root / "a")
    sync(root)
    wrong = read_json(folder.path / LINK)["run_id"]
    folder.log.truncate(5 * STEP)
    (folder.path / "result.json").unlink()
    assert actions(root) == {"a": "running"}  # it wrote something just now: maybe it goes on
    with FileLock(folder.path / ".lock"):
        assert actions(root) == {"a": "running"}
    assert actions(root) == {"a": "rebuilt"}
    assert read_json(folder.path / LINK)["run_id"] != wrong
    assert mirrored(root, folder) == truth(folder)
    store = Store.open(store_uri(root), "pgdm")
    (run,) = store.client.search_runs([store.experiment_id])
    assert run.info.status == "KILLED"


def test_run_that_goes_on_appears_in_a_new_store(root: Path) -> None:
    folder = make(root / "a")
    train(folder, 1, 3)
    with FileLock(folder.path / ".lock"):
        assert actions(root) == {"a": "created"}
    store = Store.open(store_uri(root), "pgdm")
    (run,) = store.client.search_runs([store.experiment_id])
    assert run.info.status == "RUNNING"


def test_unreadable_run_does_not_stop_the_others(root: Path) -> None:
    finished(root / "b")
    (make(root / "a").path / "config.yaml").write_text("[")
    done = {d.folder.path.name: d for d in sync(root)}
    assert (done["a"].action, done["b"].action) == ("unreadable", "created")
    assert "config.yaml" in done["a"].reason


def test_runs_of_other_experiments_and_of_none(root: Path) -> None:
    make(root / "a", tracking={"kind": "none", "uri": None, "experiment": "mine"})
    make(root / "b", tracking={})
    sync(root)
    for name in ("mine", "pgdm"):
        store = Store.open(store_uri(root), name)
        assert len(store.client.search_runs([store.experiment_id])) == 1


def test_long_runs_are_thinned_the_same_way_each_time(root: Path) -> None:
    folder = make(root / "a", total_frames=50_000_000)
    for i in range(1, 41):
        folder.log.append({"train/kl": i}, frames=i * STEP, iteration=i, time_s=i, kind="train")
    folder.log.append(eval_metrics(40), frames=40 * STEP, iteration=40, time_s=40, kind="eval")
    end(folder)
    sync(root)
    shown = mirrored(root, folder)
    assert 3 <= len(shown["train/kl"]) <= 6
    assert shown["eval_sampled/success"] == {40 * STEP: 0.4}
    (folder.path / "result.json").write_text(json.dumps({"status": "failed"}))
    assert actions(root) == {"a": "completed"}
    assert mirrored(root, folder) == shown


def test_store_that_cannot_be_used_is_one_line(root: Path) -> None:
    finished(root / "a")
    with pytest.raises(TrackingError) as error:
        sync(root, uri="http://127.0.0.1:9")
    assert "\n" not in str(error.value)
    (root / "notes.txt").write_text("milk, bread, and more than a hundred characters " * 9)
    with pytest.raises(TrackingError, match=r"notes\.txt: file is not a database"):
        sync(root, uri=f"sqlite:///{root}/notes.txt")
    with pytest.raises(TrackingError, match="No such file or directory: '/proc"):
        sync(root, uri="sqlite:////proc/version")


def test_deleted_database_comes_back(root: Path) -> None:
    folder = finished(root / "a")
    sync(root)
    for path in (root / "mlflow.db", root / "mlflow-artifacts"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    # A process of its own: MLflow keeps databases open that are gone.
    program = "from pathlib import Path; from pgdm.tracking.sync import sync; "
    program += "print([done.action for done in sync(Path('runs'))])"
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ)
    assert done.stdout == "['created']\n"
    assert done.stderr == ""
    with contextlib.closing(sqlite3.connect(root / "mlflow.db")) as database:
        (count,) = database.execute("select count(*) from metrics").fetchone()
    assert count == sum(len(steps) for steps in truth(folder).values())
