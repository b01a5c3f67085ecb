"""When stored results of runs are kept, trained anew, or left out of means."""

from __future__ import annotations

import json
import shutil
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from pgdm.config.compose import compose
from pgdm.config.saved import load_config, save_config

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "benchmark"))
import experiments
import learning
import tcdm50
from short_runs import Job

JOB = Job("door-open", "fast-earlier", ("+experiment=fast",), 0)


def result(task: str, success: float, frames: int = 1_000_000, **more: Any) -> dict[str, Any]:
    curves = {"eval_sampled/success": [success], "eval_deterministic/success": [success]}
    return {
        "task": task,
        "setting": "fast",
        "seed": 0,
        "curve_frames": [frames],
        "curves": curves,
        "frames": frames,
        "wall_time_s": 60.0,
        "metrics": {name: values[0] for name, values in curves.items()}
        | {"eval_sampled/com_error_released": 1e-3},
        "paper_success": 0.9,
        "paper_com_error": 1e-3,
        **more,
    }


def test_a_result_of_fewer_frames_replaces_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learning, "RESULTS", tmp_path)
    for frames, kept in ((300_000, 300_000), (1_000_000, 1_000_000), (300_000, 1_000_000)):
        learning.store(JOB, result("door-open", 0.5, frames))
        assert learning.stored(JOB)["frames"] == kept


def test_what_is_stored_is_not_trained_again_and_no_run_is_asked_to_shrink(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(learning, "RESULTS", tmp_path)
    asked = learning.to_train(tmp_path, JOB, 300_000)
    assert asked is not None and asked.overrides[-1] == "total_frames=300000"
    save_config(compose(["+experiment=fast", "total_frames=1_000_000"]), tmp_path / JOB.name)
    asked = learning.to_train(tmp_path, JOB, 300_000)
    assert asked is not None and asked.overrides[-1] == "total_frames=1000000"
    learning.store(JOB, result("door-open", 0.5, 300_032))
    assert learning.to_train(tmp_path, JOB, 300_000) is None
    assert learning.to_train(tmp_path, JOB, 1_000_000) is not None


def test_recommended_runs_are_those_stored_by_tcdm50_unless_they_have_earlier_settings(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    job = Job("hammer-use1", "fast", ("+experiment=fast",), 0)
    run = tcdm50.place(job.task, 0)
    fast = tcdm50.fast(load_config(run))
    monkeypatch.setattr(tcdm50, "RESULTS", tmp_path)
    assert learning.stored(job) == {}
    shutil.copytree(run, tcdm50.place(job.task, 0))
    save_config(fast, tcdm50.place(job.task, 0))
    one = learning.stored(job)
    assert one["frames"] >= 300_000 and len(one["curve_minutes"]) == len(one["curve_frames"])
    assert one["metrics"]["eval_sampled/success"] > 0.5
    save_config(replace(fast, num_envs=32), tcdm50.place(job.task, 0))
    assert learning.stored(job) == {}


def test_old_scenes_are_marked_and_in_no_mean_and_missing_times_are_told() -> None:
    found = learning.with_old_scenes(
        [
            result("door-open", 0.1, scene_sha256="before"),
            result("cup-pour1", 0.5, scene_sha256="cup", curve_minutes=[1.0]),
            result("cup-pour1", 0.7),  # nobody knows
        ],
        {"door-open": "door", "cup-pour1": "cup"},
    )
    assert "60.0% at 1,000,000 frames, mean of 2 runs" in learning.means(found)
    assert learning.table(found).count("(old scene)") == 1
    assert "| door-open (old scene) |" in learning.table(found)
    assert "2 of the runs were stored without times" in learning.remarks(found)
    assert learning.remarks(found[1:2]) == ""


def test_ppo_is_compared_with_everything_else_as_in_fast() -> None:
    fast, ppo = (
        compose(["task=hammer-use1", *learning.SETTINGS[name], learning.WHOLE_ERROR])
        for name in ("fast", "ppo_fast-planned")
    )
    assert ppo.algo.name == "ppo_fast"
    assert (ppo.obs, ppo.action, ppo.shaping) == (fast.obs, fast.action, fast.shaping)


def test_minutes_to_half_success() -> None:
    one = result("cup-pour1", 0.0)
    one["curve_minutes"], one["curves"] = [0.1, 2.0, 4.0], {"eval_sampled/success": [0.0, 0.5, 0.4]}
    assert learning.to_half(one) == "2.0"
    one["curves"]["eval_sampled/success"][1] = 0.49
    assert learning.to_half(one) == "not in 4"
    assert "| fast |  | not in 4 |  |" in learning.minutes([one, result("door-open", 0.9)])


def test_an_experiment_is_trained_anew_when_its_settings_have_changed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(experiments, "RESULTS", tmp_path)
    assert not experiments.current(JOB)
    one = {"identity": experiments.identity_of(JOB), "frames": experiments.FRAMES}
    (tmp_path / f"{JOB.name}.json").write_text(json.dumps(one))
    assert experiments.current(JOB)
    changed = Job(JOB.task, JOB.setting, (*JOB.overrides, "algo.gamma=0.9"), JOB.seed)
    assert changed.name == JOB.name and not experiments.current(changed)

    run = tmp_path / "runs" / JOB.name
    save_config(compose(["task=door-open", *JOB.overrides]), run)
    experiments.make_way(run, JOB)
    assert run.exists()
    experiments.make_way(run, changed)
    assert not run.exists() and len(list(run.parent.iterdir())) == 1


def test_nothing_is_written_of_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(experiments, "RESULTS", tmp_path)
    monkeypatch.setattr(sys, "argv", ["experiments.py", "--collect", "--runs", str(tmp_path / "r")])
    monkeypatch.setattr(experiments, "EXPERIMENTS", experiments.EXPERIMENTS[:1])
    experiments.main()
    assert list(tmp_path.iterdir()) == []
