from __future__ import annotations

import json
import logging
import math
import os
import shutil
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from command_line import TINY_SAC, command
from fake_runs import (
    LENGTH,
    STEP,
    config,
    empty_database,
    end,
    eval_metrics,
    make,
    train,
    train_metrics,
    truth,
)
from pgdm.errors import UnknownNameError
from pgdm.runs.config_file import as_text, dotted
from pgdm.runs.files import LINK, read_json
from pgdm.runs.folder import RunFolder
from pgdm.tracking import NullTracker, Tracker, TrackingCfg, metric_names, open_tracker
from pgdm.tracking.live import MlflowTracker
from pgdm.tracking.mlflow import Mirror, Store, find_run, store_uri
from pgdm.tracking.thin import MAX_POINTS, Thin, points

__all__ = ["empty_database"]  # a fixture

# MLflow warns of what it and its dependencies will change; that is theirs.
pytestmark = pytest.mark.filterwarnings("ignore")

CFG = TrackingCfg("mlflow", None, "pgdm")
FACTS = {"asset_source": "checkout", "git": None, "something": "else"}


@pytest.fixture(autouse=True)
def _database(request: pytest.FixtureRequest, tmp_path: Path, empty_database: Path) -> None:
    """Start from a database without runs, as making one takes seconds."""
    if "without_a_database" not in request.node.name:
        (tmp_path / "runs").mkdir()
        shutil.copy(empty_database, tmp_path / "runs" / "mlflow.db")


def track(tracker: Tracker, first: int = 1, last: int = LENGTH) -> None:
    for i in range(first, last + 1):
        tracker.log(train_metrics(i), i * STEP)
        if i % 5 == 0:
            tracker.log(eval_metrics(i), i * STEP)


def steps(store: Store, run_id: str, name: str) -> list[tuple[int, float]]:
    return [(m.step, m.value) for m in store.client.get_metric_history(run_id, name)]


def test_kinds_of_tracker(tmp_path: Path) -> None:
    folder = make(tmp_path / "a")
    tracker = open_tracker(TrackingCfg("none", None, "pgdm"), folder, FACTS)
    assert isinstance(tracker, NullTracker)
    track(tracker)
    tracker.finish("finished")
    assert [p.name for p in folder.path.iterdir()] == ["config.yaml"]
    with pytest.raises(UnknownNameError, match=r"'mlfow'.*mlflow"):
        open_tracker(TrackingCfg("mlfow", None, "pgdm"), folder, FACTS)


def test_one_method_makes_a_tracker(tmp_path: Path) -> None:
    seen = {}

    class Mine(Tracker):
        def log(self, metrics: dict[str, float], frames: int) -> None:
            seen[frames] = metrics

    mine = Mine()
    mine.log({"a": 1.0}, 5)
    mine.video(tmp_path, tmp_path, 5)
    mine.finish("finished")
    assert seen == {5: {"a": 1.0}}


def test_a_run_as_mlflow_shows_it(tmp_path: Path) -> None:
    folder = make(tmp_path / "runs" / "x" / "a")
    start = time.monotonic()
    tracker = open_tracker(CFG, folder, FACTS)
    track(tracker)
    assert time.monotonic() - start < 1.0  # nobody waits for MLflow
    tracker.log({"train/kl": float("nan")}, LENGTH * STEP)
    train(folder)
    end(folder)
    videos = folder.path / "videos"
    film = videos / "frames_000000040960.mp4"
    tracker.video(film, film.with_suffix(".png"), LENGTH * STEP)
    gone = videos / "frames_000000000000.mp4"
    tracker.video(gone, gone.with_suffix(".png"), 0)
    tracker.finish("finished")

    store = Store.open(store_uri(tmp_path / "runs"), "pgdm")
    link = read_json(folder.path / LINK)
    run = store.client.get_run(link["run_id"])
    assert run.info.status == "FINISHED"
    assert run.info.end_time >= run.info.start_time
    assert run.info.run_name == "hammer-use1 s0 pgdm ppo_fast residual"
    tags = {k: v for k, v in run.data.tags.items() if not k.startswith("mlflow.")}
    synced = RunFolder(folder.path).fingerprint()
    assert tags == {**RunFolder(folder.path).tags(), "attempts": "1", "synced": synced}
    assert run.data.tags["mlflow.source.git.commit"] == "0123abc"
    assert tags["git"] == "0123abc"  # from the result; unknown at the start
    assert "| `com_error` | m |" in run.data.tags["mlflow.note.content"]
    params = dotted({k: v for k, v in config().items() if k not in ("run_dir", "resume")})
    assert run.data.params == {name: as_text(value) for name, value in params.items()}
    assert steps(store, link["run_id"], "train/return") == [
        (i * STEP, 10.0 * i) for i in range(1, LENGTH + 1)
    ]
    assert steps(store, link["run_id"], "eval_sampled/success") == [
        (5 * STEP, 0.05),
        (10 * STEP, 0.1),
    ]
    assert "train/kl" not in run.data.metrics
    top = {item.path: item for item in store.client.list_artifacts(link["run_id"])}
    assert {"config.yaml", "result.json", "metrics.jsonl", "videos", "checkpoints"} <= set(top)
    assert top["result.json"].file_size == (folder.path / "result.json").stat().st_size
    kept = [item.path for item in store.client.list_artifacts(link["run_id"], "checkpoints")]
    assert kept == ["checkpoints/best.ckpt", "checkpoints/frames_000000040960.ckpt"]
    films = [item.path for item in store.client.list_artifacts(link["run_id"], "videos")]
    assert films == [f"videos/frames_000000040960.{kind}" for kind in ("mp4", "png")]
    images = [item.path for item in store.client.list_artifacts(link["run_id"], "images")]
    assert any(f"evaluation+step+{LENGTH * STEP}+" in name for name in images)
    experiment = store.client.get_experiment(run.info.experiment_id)
    assert "| `success` | 0..1 |" in experiment.tags["mlflow.note.content"]


def test_resumed_run_goes_on_in_its_own(tmp_path: Path) -> None:
    folder = make(tmp_path / "runs" / "a")
    tracker = open_tracker(CFG, folder, FACTS)
    train(folder, 1, 7)
    track(tracker, 1, 7)
    tracker.finish("interrupted")
    store = Store.open(store_uri(tmp_path / "runs"), "pgdm")
    first = read_json(folder.path / LINK)
    assert store.client.get_run(first["run_id"]).info.status == "KILLED"

    folder = make(tmp_path / "runs" / "a", total_frames=99 * STEP)
    folder.log.truncate(5 * STEP)
    tracker = open_tracker(CFG, folder, FACTS)
    track(tracker, 6, 10)
    train(folder, 6, 10)
    deadline = time.monotonic() + 20
    while store.client.get_run(first["run_id"]).info.status != "RUNNING":
        assert time.monotonic() < deadline
        time.sleep(0.05)
    tracker.finish("failed")
    second = read_json(folder.path / LINK)
    assert (second["run_id"], second["attempts"]) == (first["run_id"], 2)
    run = store.client.get_run(first["run_id"])
    assert run.info.status == "FAILED"
    assert run.data.tags["attempts"] == "2"
    assert run.data.params["total_frames"] == str(10 * STEP)  # a parameter keeps its value
    assert run.data.tags["now.total_frames"] == str(99 * STEP)
    assert {step for step, _ in steps(store, first["run_id"], "train/return")} == {
        i * STEP for i in range(1, 11)
    }


@pytest.mark.slow
@pytest.mark.usefixtures("library_home")
def test_an_off_policy_run_goes_on_in_its_own_and_its_replay_stays_here(tmp_path: Path) -> None:
    settings = ("--offline", *TINY_SAC, "task=duck-lift", "shaping=grasp", "tracking.kind=mlflow")
    for frames in (32, 64):  # the second completes an episode, of 20 steps
        lengths = ("keep_replay=true", f"total_frames={frames}", "run_dir=runs/a")
        outcome = command("pgdm-run", *settings, *lengths)
        assert (outcome.code, outcome.errors) == (0, [])
    folder = RunFolder(tmp_path / "runs" / "a")
    assert (folder.path / "replay" / "action.bin").is_file()
    store, link = Store.open(store_uri(tmp_path / "runs"), "pgdm"), read_json(folder.path / LINK)
    run = store.client.get_run(link["run_id"])
    assert (link["attempts"], run.info.status) == (2, "FINISHED")
    assert run.info.run_name == "duck-lift s0 pgdm sac absolute"
    recorded = {
        name: known
        for name, values in truth(folder).items()
        if (known := {step: value for step, value in values.items() if math.isfinite(value)})
    }
    assert {"train/loss_critic", "train/temperature", "train/shaping"} <= set(recorded)
    assert set(run.data.metrics) == set(recorded)
    for name, values in recorded.items():
        assert dict(steps(store, link["run_id"], name)) == values
    top = {item.path for item in store.client.list_artifacts(link["run_id"])}
    assert "checkpoints" in top and "replay" not in top


def test_resumed_run_without_its_store_brings_its_records_along(tmp_path: Path) -> None:
    folder = make(tmp_path / "runs" / "a")
    train(folder, 1, 5)
    (folder.path / LINK).write_text('{"run_id": "of-a-store-that-was-deleted", "attempts": 4}')
    tracker = open_tracker(CFG, folder, FACTS)
    track(tracker, 6, 10)
    tracker.finish("finished")
    store = Store.open(store_uri(tmp_path / "runs"), "pgdm")
    link = read_json(folder.path / LINK)
    assert link["attempts"] == 5
    assert [s for s, _ in steps(store, link["run_id"], "train/return")] == [
        i * STEP for i in range(1, 11)
    ]


def test_resumed_run_brings_along_what_was_not_sent_before(tmp_path: Path) -> None:
    folder = make(tmp_path / "runs" / "a")
    store = Store.open(store_uri(tmp_path / "runs"), "pgdm")
    mirror = Mirror(store, folder, None)
    train(folder, 1, 5)
    mirror.log(points(folder, folder.log.read()[:3]))  # then MLflow went away, or it was killed
    tracker = open_tracker(CFG, folder, FACTS)
    track(tracker, 6, 10)
    train(folder, 6, 10)
    tracker.finish("finished")
    sent = [step for step, _ in steps(store, mirror.run_id, "train/return")]
    assert sorted(sent) == [i * STEP for i in range(1, 11)]


def test_copied_folder_is_a_run_of_its_own_and_a_moved_one_is_not(tmp_path: Path) -> None:
    folder = make(tmp_path / "runs" / "a")
    store = Store.open(store_uri(tmp_path / "runs"), "pgdm")
    mirror = Mirror(store, folder, None)
    mirror.link({})
    mirror.describe({})
    found = find_run(store, folder)
    assert found is not None and found.info.run_id == mirror.run_id
    copy = make(tmp_path / "runs" / "copy")
    (copy.path / LINK).write_text((folder.path / LINK).read_text())
    assert find_run(store, copy) is None
    moved = RunFolder(folder.path.rename(tmp_path / "runs" / "moved"))
    found = find_run(store, moved)
    assert found is not None and found.info.run_id == mirror.run_id


def test_machines_have_folders_of_the_same_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = make(tmp_path / "runs" / "a")
    store = Store.open(store_uri(tmp_path / "runs"), "pgdm")
    Mirror(store, folder, None)
    assert find_run(store, folder) is not None
    monkeypatch.setattr("socket.gethostname", lambda: "another")
    assert find_run(store, folder) is None


@pytest.mark.parametrize("uri", ["http://127.0.0.1:9", "sqlite:////proc/nowhere/mlflow.db"])
def test_store_out_of_reach_warns_once_and_harms_nobody(
    uri: str, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = make(tmp_path / "runs" / "a")
    with caplog.at_level(logging.WARNING, "pgdm"):
        tracker = open_tracker(TrackingCfg("mlflow", uri, "pgdm"), folder, FACTS)
        track(tracker)
        tracker.finish("finished")
    messages = [r.getMessage() for r in caplog.records if r.name.startswith("pgdm")]
    assert len(messages) == 2
    assert uri in messages[0] and "training continues" in messages[0]
    assert "pgdm runs sync" in messages[1]
    assert "\n" not in "".join(messages)


def test_a_store_that_hangs_does_not_hold_up_the_end(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder, released = make(tmp_path / "runs" / "a"), threading.Event()
    with caplog.at_level(logging.WARNING, "pgdm"):
        tracker = MlflowTracker(CFG, folder, FACTS)
        tracker._pool.submit(released.wait)  # as a call that gets no answer
        tracker.finish("finished", patience_s=0.1)
    released.set()
    (message,) = [r.getMessage() for r in caplog.records if r.name.startswith("pgdm")]
    assert "pgdm runs sync" in message


def test_store_that_was_locked_gets_all_of_it_later(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = make(tmp_path / "runs" / "a")
    Store.open(store_uri(tmp_path / "runs"), "pgdm")
    real = Mirror.log
    failures = iter([True, True, False])

    def flaky(self: Mirror, points: list) -> None:
        if points and next(failures, False):
            raise OSError("database is locked")
        real(self, points)

    monkeypatch.setattr(Mirror, "log", flaky)
    monkeypatch.setattr("pgdm.tracking.live.RETRY_S", 0.0)
    tracker = open_tracker(CFG, folder, FACTS)
    track(tracker)
    tracker.finish("finished")
    store = Store.open(store_uri(tmp_path / "runs"), "pgdm")
    run_id = read_json(folder.path / LINK)["run_id"]
    assert [s for s, _ in steps(store, run_id, "train/return")] == [
        i * STEP for i in range(1, LENGTH + 1)
    ]


def test_points_are_thinned_but_evaluations_are_not() -> None:
    thin = Thin(50_000_000)
    passed = [f for f in range(4096, 50_000_001, 4096) if thin.passes(f, {"train/kl": 1.0})]
    assert MAX_POINTS - 5 <= len(passed) <= MAX_POINTS + 1
    assert thin.passes(50_000_000, {"eval_sampled/success": 1.0})
    short = Thin(10 * STEP)
    assert all(short.passes(f, {"a": 1.0}) for f in range(STEP, 10 * STEP + 1, STEP))


def test_long_configuration_is_sent_in_parts(tmp_path: Path) -> None:
    folder = make(tmp_path / "runs" / "a", many={f"k{i}": i for i in range(250)})
    store = Store.open(store_uri(tmp_path / "runs"), "pgdm")
    mirror = Mirror(store, folder, None)
    mirror.describe({})
    assert store.client.get_run(mirror.run_id).data.params["many.k249"] == "249"


PROGRAM = """
import sys
from pathlib import Path
from fake_runs import make, train, end
from test_tracking_mlflow import CFG, FACTS, track
from pgdm.tracking import open_tracker
folder = make(Path("runs") / sys.argv[1], seed=int(sys.argv[1]))
tracker = open_tracker(CFG, folder, FACTS)
train(folder)
track(tracker)
end(folder)
tracker.finish("finished")
"""


def test_four_processes_start_at_once_without_a_database(tmp_path: Path) -> None:
    env = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", PROGRAM]
    jobs = [
        subprocess.Popen([*command, str(i)], env=env, stderr=subprocess.PIPE, text=True)
        for i in range(4)
    ]
    errors = [job.communicate(timeout=240)[1] for job in jobs]
    assert errors == [""] * 4
    assert [job.returncode for job in jobs] == [0] * 4
    store = Store.open(store_uri(tmp_path / "runs"), "pgdm")
    runs = store.client.search_runs([store.experiment_id])
    assert sorted(run.data.params["seed"] for run in runs) == ["0", "1", "2", "3"]
    assert {run.info.status for run in runs} == {"FINISHED"}
    for run in runs:
        assert len(steps(store, run.info.run_id, "train/return")) == LENGTH
    assert not (tmp_path / "mlruns").exists()


@pytest.mark.slow
def test_a_kill_leaves_no_half_made_store_without_a_database(tmp_path: Path) -> None:
    root = tmp_path / "runs"
    program = "import sys; from pgdm.tracking.mlflow import Store; Store.open(sys.argv[1], 'pgdm')"
    for tables in (1, 10, 25):
        maker = subprocess.Popen([sys.executable, "-c", program, store_uri(root)])
        while made(root, maker.pid) < tables:
            assert maker.poll() is None, "it should have been killed before its end"
        maker.kill()
        maker.wait()
        assert not (root / "mlflow.db").exists()
    store = Store.open(store_uri(root), "pgdm")
    assert store.client.search_runs([store.experiment_id]) == []
    assert sorted(p.name for p in root.iterdir()) == ["mlflow.db", "mlflow.db.lock"]


def made(root: Path, pid: int) -> int:
    """Return how many tables a process has made so far."""
    for file in root.glob(f"*{pid}-mlflow.db"):
        database = sqlite3.connect(file)
        try:
            return len(database.execute("select 1 from sqlite_master").fetchall())
        except sqlite3.OperationalError:  # in the middle of a change
            return 0
        finally:
            database.close()
    return 0


def test_database_speaks_to_nobody_and_leaves_nothing_beside(tmp_path: Path) -> None:
    Store.open(store_uri(tmp_path / "runs"), "pgdm")
    assert os.environ["MLFLOW_DISABLE_TELEMETRY"] == "true"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["runs"]
    with sqlite3.connect(tmp_path / "runs" / "mlflow.db") as database:
        names = [name for (name,) in database.execute("select name from experiments")]
    database.close()
    assert "pgdm" in names


def test_link_is_json_that_people_can_read(tmp_path: Path) -> None:
    folder = make(tmp_path / "runs" / "a")
    store = Store.open(store_uri(tmp_path / "runs"), "pgdm")
    Mirror(store, folder, None).link({"attempts": 1, "asset_source": "checkout"})
    link = json.loads((folder.path / LINK).read_text())
    assert set(link) == {"attempts", "asset_source", "run_id", "uri"}
    assert link["uri"] == f"sqlite:///{tmp_path}/runs/mlflow.db"


def test_the_docs_explain_every_metric() -> None:
    page = Path(__file__).parents[1] / "docs" / "tracking.md"
    assert metric_names.markdown() in page.read_text(encoding="utf-8")
