from __future__ import annotations

import json
import shutil
import warnings
from pathlib import Path

import numpy as np
import pytest

from fake_runs import empty_database
from pgdm.config.compose import compose_plain
from pgdm.errors import RunError, TrackingError
from pgdm.report.results import Results
from pgdm.report.runs import RETURN, SHAPING, SUCCESS, Run
from pgdm.report.source import Found, find
from pgdm.tracking.group import Group
from pgdm.tracking.mlflow import store_uri
from pgdm.tracking.sync import sync
from report_runs import FRAMES, make

__all__ = ["empty_database"]  # a fixture


def read(*places: Path | str, uri: str | None = None) -> Found:
    return find([str(place) for place in places], uri, Path("report"), lambda *_: None)


def only(found: Found) -> Run:
    (run,) = found.runs
    return run


def test_a_run(tmp_path: Path) -> None:
    folder = make(tmp_path / "runs" / "a", 0.8, "task=cup-pour1", "seed=2")
    run = only(read(tmp_path / "runs"))
    assert (run.task, run.seed, run.state, run.frames) == ("cup-pour1", 2, "finished", FRAMES)
    assert (run.budget, run.start) == ("smoke", "planned")
    assert run.metric(SUCCESS) == 0.8
    assert run.facts["paper_success"] == 0.831
    assert run.evaluations["frames"].tolist() == [0, 10240, 20480, 30720, 40960]
    assert run.evaluations[SUCCESS].tolist() == pytest.approx([0, 0.2, 0.4, 0.6, 0.8])
    assert set(run.training[RETURN]) <= {0, 10, 20, 30, 40}
    assert run.video == folder.path / "videos" / f"frames_{FRAMES:012d}.mp4"


def test_folders_at_any_depth_and_each_once(tmp_path: Path) -> None:
    make(tmp_path / "runs" / "a", 0.8, "task=cup-pour1")
    make(tmp_path / "runs" / "b" / "c", 0.8, "task=door-open")
    found = read(tmp_path / "runs", tmp_path / "runs" / "b", tmp_path / "runs" / "a")
    assert [run.task for run in found.runs] == ["cup-pour1", "door-open"]


def test_states(tmp_path: Path) -> None:
    for seed, state in enumerate(("finished", "running", "interrupted", "failed")):
        make(tmp_path / state, 0.8, "task=cup-pour1", f"seed={seed}", state=state)
    results = Results(read(tmp_path).runs)
    assert results.counts() == {"finished": 1, "running": 1, "interrupted": 1, "failed": 1}
    (setting,) = results.settings
    assert [len(v) for v in results.scores(setting).values()] == [1]


def test_a_sweeps_jobs_that_have_not_started_are_missing(tmp_path: Path) -> None:
    sweep = tmp_path / "sweep"
    make(sweep / "a", 0.8, "task=cup-pour1")
    make(tmp_path / "elsewhere", 0.6, "task=cup-pour1", "seed=1")
    config = compose_plain(["task=cup-pour1", f"total_frames={FRAMES}", "budget=smoke"])
    places = ("a", str(tmp_path / "elsewhere"), "b")
    jobs = [{"config": config | {"seed": i, "run_dir": p}} for i, p in enumerate(places)]
    plan = {"format": 1, "command": "pgdm-run -m task=cup-pour1 seed=0,1,2", "jobs": jobs}
    (sweep / "plan.json").write_text(json.dumps(plan))
    found = read(sweep)
    assert {run.seed: run.state for run in found.runs} == {
        0: "finished",
        1: "finished",
        2: "missing",
    }
    assert found.commands == ["pgdm-run -m task=cup-pour1 seed=0,1,2"]


def test_runs_that_cannot_be_read_are_listed(tmp_path: Path) -> None:
    make(tmp_path / "a", 0.8, "task=cup-pour1")
    make(tmp_path / "b", 0.8, "task=door-open")
    (tmp_path / "b" / "config.yaml").write_text("][")
    found = read(tmp_path)
    assert [run.task for run in found.runs] == ["cup-pour1"]
    assert "cannot read" in found.unreadable[str(tmp_path / "b")]


def test_of_equal_runs_the_finished_one_counts(tmp_path: Path) -> None:
    make(tmp_path / "a", 0.8, "task=cup-pour1")
    make(tmp_path / "b", 0.1, "task=cup-pour1", state="failed")
    results = Results(read(tmp_path).runs)
    assert [run.path.name for run in results.runs] == ["a"]
    assert [run.path.name for run in results.doubles] == ["b"]


def test_no_runs_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RunError, match=r"no runs in .*; name a folder that holds some"):
        read(tmp_path)
    with pytest.raises(RunError, match=r"there is no folder 'x', and no MLflow store .*--uri"):
        read("x")


def test_mlflow(tmp_path: Path, empty_database: Path) -> None:
    root = tmp_path / "runs"
    root.mkdir()
    shutil.copy(empty_database, root / "mlflow.db")
    ended = {"ended_by": "time_limit"}
    first = make(root / "a", 0.8, "task=cup-pour1", "algo=ppo_fast", result=ended)
    log = first.path / "metrics.jsonl"
    log.write_text(log.read_text().replace('"train/kl": 0.1', f'"{SHAPING}": 3.0'))
    make(root / "b", 0.6, "task=cup-pour1", "algo=ppo_fast", "seed=1", state="failed")
    (root / "sweep").mkdir()
    direct = read(root)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert [done.action for done in sync(root)] == ["created", "created"]
        Group(root / "sweep", store_uri(root), "pgdm").open("sweep", {})  # is not a run
        linked = read("pgdm")
        assert {run.path for run in linked.runs} == {run.path for run in direct.runs}
        (root / "a").rename(tmp_path / "gone-a")
        (root / "b").rename(tmp_path / "gone-b")
        with pytest.raises(TrackingError, match=r"'nowhere' is neither .* which has .*pgdm"):
            read("nowhere")
        copied = read("pgdm", uri=store_uri(root))
    assert len(copied.runs) == 2
    for run in copied.runs:
        same = next(r for r in direct.runs if r.seed == run.seed)
        assert (run.setting, run.state, run.frames, run.task, run.start) == (
            *(same.setting, same.state, same.frames, same.task),
            same.start,
        )
        assert run.metric(SUCCESS) == same.metric(SUCCESS)
        assert run.evaluations[SUCCESS].tolist() == same.evaluations[SUCCESS].tolist()
        assert run.facts == same.facts
        assert np.array_equal(run.training[SHAPING], same.training[SHAPING], equal_nan=True)
        assert np.isfinite(run.training[SHAPING]).all() == (run.seed == 0)
        assert run.video is not None and run.video.with_suffix(".png").exists()
