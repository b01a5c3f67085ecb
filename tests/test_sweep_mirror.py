"""A sweep in MLflow: one run with its jobs below it, whose statuses are true after kills."""

from __future__ import annotations

import dataclasses
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

from command_line import command
from fake_runs import empty_database, end, make, train
from pgdm.config.saved import save_config
from pgdm.runs.files import LINK, read_json, write_json
from pgdm.runs.folder import PARENT, RunFolder
from pgdm.sweep.driver import status_of
from pgdm.sweep.ledger import Ending, Ledger
from pgdm.sweep.mirror import SweepMirror
from pgdm.sweep.plan import Plan, write_plan
from pgdm.sweep.processes import Process
from pgdm.tracking import TrackingCfg, open_tracker
from pgdm.tracking.mlflow import Store, store_uri
from pgdm.tracking.sync import sync
from sweep_plans import plan, start

__all__ = ["empty_database"]  # a fixture

# MLflow warns of what it and its dependencies will change; that is theirs.
pytestmark = pytest.mark.filterwarnings("ignore")

MIRRORED = ("tracking=mlflow", "tracking.experiment=other")


@pytest.fixture
def whole(tmp_path: Path, empty_database: Path) -> Plan:
    """Return a planned sweep of two jobs, with an empty database in its folder."""
    made = plan(tmp_path / "study", 2, *MIRRORED)
    write_plan(made)
    shutil.copy(empty_database, made.folder / "mlflow.db")
    return made


def runs(folder: Path) -> dict[str, tuple[str, str | None]]:
    """Return status and parent of each run by its folder."""
    store = Store.open(store_uri(folder), "other")
    found = store.client.search_runs([store.experiment_id])
    assert len({run.data.tags["run_dir"] for run in found}) == len(found)
    tags = {run.info.run_id: run.data.tags for run in found}
    return {
        Path(run.data.tags["run_dir"]).name: (
            run.info.status,
            tags[run.data.tags["mlflow.parentRunId"]]["mlflow.runName"]
            if "mlflow.parentRunId" in run.data.tags
            else None,
        )
        for run in found
    }


def unexpected(text: str) -> None:
    raise AssertionError(text)


def test_a_sweep_is_one_run_however_often_it_is_opened(whole: Plan, tmp_path: Path) -> None:
    for status, shown in (
        ("interrupted", "KILLED"),
        ("failed", "FAILED"),
        ("finished", "FINISHED"),
    ):
        mirror = SweepMirror.of(whole, unexpected)
        mirror.open(whole)
        assert runs(whole.folder) == {"study": ("RUNNING", None)}
        assert read_json(whole.folder / LINK)["status"] == "running"
        mirror.close(status)
        assert runs(whole.folder) == {"study": (shown, None)}
    (whole.folder / LINK).unlink()
    SweepMirror.of(whole, unexpected).open(whole)
    assert len(runs(whole.folder)) == 1


@pytest.mark.parametrize(
    ("states", "stopped", "status"),
    [
        (["finished", "finished"], False, "finished"),
        (["finished", "failed"], False, "failed"),  # also if only the first one was retried
        (["finished", "cancelled"], False, "failed"),
        (["finished", "waiting"], False, "interrupted"),
        (["finished", "running"], True, "interrupted"),
    ],
)
def test_status_of_a_sweep(states: list[str], stopped: bool, status: str) -> None:
    assert status_of(states, stopped) == status


def test_jobs_are_shown_below_it(whole: Plan, tmp_path: Path) -> None:
    mirror = SweepMirror.of(whole, unexpected)
    mirror.open(whole)
    folder = make(whole.folder / "runs" / "s0")
    mirror.adopt(whole.jobs[0])
    tracker = open_tracker(TrackingCfg("mlflow", None, "other"), folder, {})
    train(folder)
    end(folder)
    tracker.finish("finished")
    # In the sweep's store; without a sweep, the run would use one next to its own folder.
    assert runs(whole.folder) == {"study": ("RUNNING", None), "s0": ("FINISHED", "study")}
    assert not (whole.folder / "runs" / "mlflow.db").exists()


@pytest.mark.parametrize(
    ("status", "shown", "named"),
    [
        ("interrupted", "KILLED", True),
        ("interrupted", "KILLED", False),  # killed before its folder recorded its MLflow run
        ("finished", "FINISHED", True),
    ],
)
def test_a_killed_job_gets_its_true_status(
    whole: Plan, tmp_path: Path, status: str, shown: str, named: bool
) -> None:
    mirror = SweepMirror.of(whole, unexpected)
    mirror.open(whole)
    folder = make(whole.folder / "runs" / "s0", tracking={"experiment": "other"})
    (folder.path / ".lock").touch()
    mirror.adopt(whole.jobs[0])
    tracker = open_tracker(TrackingCfg("mlflow", None, "other"), folder, {})
    limit = time.monotonic() + 60
    while "s0" not in runs(whole.folder) or "run_id" not in folder.link:
        assert time.monotonic() < limit
        time.sleep(0.1)
    tracker._pool.shutdown()  # type: ignore[attr-defined] # as if it was killed here
    train(folder)
    if status == "finished":
        end(folder)
    if not named:
        link = read_json(folder.path / LINK)
        write_json(folder.path / LINK, {PARENT: link[PARENT]})
    mirror.correct(folder.path)
    assert runs(whole.folder)["s0"] == (shown, "study")
    assert [done.action for done in sync(whole.folder)] == [
        "unchanged" if status == "finished" else "completed"
    ]
    assert runs(whole.folder)["s0"] == (shown, "study")


def test_a_job_that_was_killed_before_mlflow_heard_of_it_is_shown(whole: Plan) -> None:
    mirror = SweepMirror.of(whole, unexpected)
    mirror.open(whole)
    folder = make(whole.folder / "runs" / "s0", tracking={"experiment": "other"})
    train(folder)
    end(folder)
    mirror.correct(folder.path)  # not adopted: a job without MLflow
    assert runs(whole.folder) == {"study": ("RUNNING", None)}
    mirror.adopt(whole.jobs[0])
    mirror.correct(folder.path)
    assert runs(whole.folder) == {"study": ("RUNNING", None), "s0": ("FINISHED", "study")}


def test_status_tells_mlflow_that_a_sweep_was_killed(whole: Plan, tmp_path: Path) -> None:
    SweepMirror.of(whole, unexpected).open(whole)
    ledger = Ledger(whole.folder)
    ledger.add(whole)
    (tmp_path / "runs").mkdir()
    (tmp_path / "runs" / "sweeps").symlink_to(tmp_path)
    ways = {"KILLED": ("sweep", "status", str(whole.folder)), "FINISHED": ("runs", "sync")}
    for expected, way in ways.items():
        assert command("pgdm", *way).code == 0
        assert runs(whole.folder) == {"study": (expected, None)}
        SweepMirror.of(whole, unexpected).open(whole)
        for key in ledger.states():
            number = ledger.begin(key, Process.of(os.getpid()))
            ledger.end(key, number, Ending("finished", 0, 32, {}, None))
            ledger.set_states({key: "finished"})


def test_a_job_that_outlives_its_sweep_and_is_killed_then(whole: Plan) -> None:
    mirror = SweepMirror.of(whole, unexpected)
    mirror.open(whole)
    ledger = Ledger(whole.folder)
    ledger.add(whole)
    folder = make(Path(whole.jobs[0].cfg.run_dir), tracking={"experiment": "other"})
    (folder.path / ".lock").touch()
    mirror.adopt(whole.jobs[0])
    tracker = open_tracker(TrackingCfg("mlflow", None, "other"), folder, {})
    tracker._pool.shutdown()  # type: ignore[attr-defined] # what it began is done
    name, status = folder.path.name, ("sweep", "status", str(whole.folder))
    worker = subprocess.Popen(["sleep", "60"])
    try:
        ledger.begin(whole.jobs[0].key, Process.of(worker.pid))
        assert command("pgdm", *status).code == 0
        assert runs(whole.folder) == {"study": ("KILLED", None), name: ("RUNNING", "study")}
    finally:
        worker.kill()
        worker.wait()
    assert command("pgdm", *status).code == 0
    assert runs(whole.folder) == {"study": ("KILLED", None), name: ("KILLED", "study")}


def test_mlflow_out_of_reach_stops_nothing(whole: Plan) -> None:
    heard: list[str] = []
    uri = "sqlite:////proc/nowhere/mlflow.db"
    cfg = dataclasses.replace(whole.jobs[0].cfg, tracking=TrackingCfg("mlflow", uri, "other"))
    jobs = (dataclasses.replace(whole.jobs[0], cfg=cfg),)
    mirror = SweepMirror.of(dataclasses.replace(whole, jobs=jobs), heard.append)
    save_config(cfg, cfg.run_dir)
    mirror.open(dataclasses.replace(whole, jobs=jobs))
    mirror.correct(Path(cfg.run_dir))
    mirror.close("finished")
    assert len(heard) == 1 and uri in heard[0] and "the sweep continues" in heard[0]


def test_mlflow_that_was_away_at_the_start_has_all_in_the_end(
    whole: Plan, tmp_path: Path, empty_database: Path
) -> None:
    place = tmp_path / "away"
    place.touch()
    tracking = TrackingCfg("mlflow", store_uri(place), "other")
    jobs = [
        dataclasses.replace(j, cfg=dataclasses.replace(j.cfg, tracking=tracking))
        for j in whole.jobs
    ]
    heard: list[str] = []
    away = dataclasses.replace(whole, jobs=tuple(jobs))
    mirror = SweepMirror.of(away, heard.append)
    mirror.open(away)
    mirror.adopt(jobs[0])
    folder = make(whole.folder / "runs" / "s0", tracking=dataclasses.asdict(tracking))
    train(folder)
    end(folder)
    assert len(heard) == 1 and "the sweep continues" in heard[0]
    place.unlink()
    place.mkdir()
    shutil.copy(empty_database, place / "mlflow.db")
    sync(whole.folder, store_uri(place))
    assert runs(place) == {"s0": ("FINISHED", None)}
    mirror.close("finished")
    assert [done.action for done in sync(whole.folder, store_uri(place))] == ["completed"]
    assert runs(place) == {"study": ("FINISHED", None), "s0": ("FINISHED", "study")}
    assert [done.action for done in sync(whole.folder, store_uri(place))] == ["unchanged"]
    assert len(heard) == 1


@pytest.mark.slow
def test_kills_leave_no_run_twice_and_none_running(library_home: Path, tmp_path: Path) -> None:
    long = ("total_frames=1600", "eval.interval_frames=0", "checkpoint.interval_s=0.5")
    whole = plan(tmp_path / "study", 2, *MIRRORED, *long)
    write_plan(whole)
    for pause_s in (5.0, 12.0, 15.0):
        sweep = start(whole.folder)
        time.sleep(pause_s)
        sweep.send_signal(signal.SIGSTOP)  # or it would start others in their place
        for attempt in Ledger(whole.folder).attempts():
            attempt.process.signal(signal.SIGKILL)  # at first this may be the driver itself
        sweep.kill()
        sweep.communicate()
        # A worker that was just started may be in no ledger; it exits without help.
        limit = time.monotonic() + 60
        while True:
            assert command("pgdm", "sweep", "status", str(whole.folder)).code == 0
            if "RUNNING" not in {status for status, _ in runs(whole.folder).values()}:
                break
            assert time.monotonic() < limit, runs(whole.folder)
            time.sleep(1)
    sweep = start(whole.folder)
    _, err = sweep.communicate(timeout=300)
    assert sweep.returncode == 0, err
    assert runs(whole.folder) == {
        "study": ("FINISHED", None),
        "s0": ("FINISHED", "study"),
        "s1": ("FINISHED", "study"),
    }
    counts = [done.action for done in sync(whole.folder)]
    assert counts == ["unchanged"] * 2
    assert RunFolder(whole.folder / "runs" / "s0").status() == "finished"
