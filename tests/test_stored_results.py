"""The pages in benchmark/results agree with the stored runs."""

from __future__ import annotations

import dataclasses
import json
import sys
from pathlib import Path

import pytest
import yaml

from pgdm.config.compose import compose
from pgdm.config.identity import with_added_keys

BENCHMARK = Path(__file__).resolve().parents[1] / "benchmark"

sys.path.insert(0, str(BENCHMARK))
import fast_methods  # noqa: E402 (benchmark/ is no package: each file is a program)
import methods  # noqa: E402
import study  # noqa: E402
import tcdm50  # noqa: E402
import wrist  # noqa: E402


@pytest.mark.parametrize("setting", study.SETTINGS)
def test_stored_runs_of_the_study_are_what_their_folder_says(setting: str) -> None:
    tasks, overrides = study.SETTINGS[setting]
    for task in tasks:
        folder = study.place(setting, task)
        stored = with_added_keys(yaml.safe_load((folder / "config.yaml").read_text()))
        wanted = dataclasses.asdict(compose([f"task={task}", *study.COMMON, *overrides]))
        assert stored["run_dir"] == f"runs/{setting}/{task}"
        assert stored["task"]["id"] == task
        for key in ("method", "ablation", "pregrasp", "action", "algo", "seed", "total_frames"):
            assert stored[key] == wanted[key]
        assert json.loads((folder / "result.json").read_text())["status"] == "finished"


def test_tables_of_stored_results_are_current() -> None:
    assert study.table(study.measured()) in (study.RESULTS / "README.md").read_text()
    found = [
        json.loads((methods.RESULTS / f"{task}-{setting}.json").read_text())
        for task in methods.TASKS
        for setting in methods.settings(methods.FRAMES)
    ]
    assert methods.table(found) in (methods.RESULTS / "README.md").read_text()


def test_the_table_of_wrist_plans_is_current() -> None:
    page = (BENCHMARK.parent / "docs" / "wrist.md").read_text()
    assert wrist.table(json.loads(wrist.RESULTS.read_text())) in page


def test_the_table_of_all_tasks_is_current() -> None:
    page = (BENCHMARK.parent / "docs" / "tcdm50.md").read_text()
    assert tcdm50.task_table(tcdm50.by_task(tcdm50.stored())) in page


def test_the_page_on_learning_shows_the_stored_curves() -> None:
    shown = BENCHMARK.parent / "docs" / "images" / "learning.png"
    assert shown.read_bytes() == (BENCHMARK / "results" / "learning" / "curves.png").read_bytes()


def test_the_baselines_are_compared_at_pgdms_frames_and_in_points() -> None:
    rows = {"a": {"pgdm": (0.5, 1.0), "graff": (0.7, 1.0)}, "b": {"pgdm": (0.2, 0.9)}}
    rows["c"] = {"pgdm": (0.4, 1.0), "graff": (0.3, 0.8)}
    assert fast_methods.differences(rows, "graff") == pytest.approx([0.2, -0.1])
    # t at 97.5% and 1 degree of freedom is 12.706; the standard error is 0.15.
    assert "| +5.0 (-185.6 to +195.6) |" in fast_methods.table(rows)
    for task in fast_methods.TASKS:
        assert fast_methods.wanted(fast_methods.settings("graff", task))
    for other in ("method=pgdm", "method=graff seed=1", "method=graff total_frames=50000"):
        words = ["+experiment=fast", "task=cup-pour1", "total_frames=100000", *other.split()]
        assert not fast_methods.wanted(compose(words))
