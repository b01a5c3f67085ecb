from __future__ import annotations

from typing import Any

import pytest

from pgdm.config.compose import compose_plain
from pgdm.report.settings import Setting, labels, setting_of, shared


def setting(*overrides: str, **changes: Any) -> Setting:
    return setting_of(compose_plain(overrides) | changes)


def test_the_papers_own_setting_differs_in_nothing() -> None:
    plain = setting("task=cup-pour1")
    assert plain.changes == ()
    assert plain.deviations() == []
    assert (plain.method, plain.option("algo"), plain.total_frames) == ("pgdm", "ppo", 50_000_000)
    assert plain.with_pregrasp


@pytest.mark.parametrize("task", ["dhand-cup", "dmanus-crackerbox", "door-open"])
def test_task_seed_and_own_hand_are_not_part_of_it(task: str) -> None:
    assert setting(f"task={task}", "seed=3") == setting("task=cup-pour1")


def test_keys_that_change_no_result_are_not_part_of_it() -> None:
    harmless = ("num_threads=3", "tracking=none", "eval.video=false", "run_dir=x")
    assert setting("task=cup-pour1", *harmless) == setting("task=cup-pour1")


@pytest.mark.parametrize(
    ("overrides", "changes"),
    [
        (("algo=ppo_fast", "action=residual"), ("action=residual", "algo=ppo_fast")),
        (("algo=ppo_fast", "algo.gamma=0.9"), ("algo=ppo_fast", "algo.gamma=0.9")),
        (("num_envs=64",), ("num_envs=64",)),
        (("hand=dhand",), ("hand=dhand",)),
        (("algo.hidden=[8,8]",), ("algo.hidden=[8, 8]",)),
        (("pregrasp.fallback=null",), ("pregrasp.fallback=null",)),
    ],
)
def test_changes_are_the_overrides(overrides: tuple[str, ...], changes: tuple[str, ...]) -> None:
    assert setting("task=cup-pour1", *overrides).changes == changes


def test_an_option_of_the_users_own() -> None:
    config = compose_plain(["task=cup-pour1"])
    other = setting_of(config | {"method": {**config["method"], "name": "near", "gain": 2.0}})
    assert other.changes == ("method=near", "method.gain=2.0")
    assert other.deviations("method") == ["method.gain=2.0"]


def test_fewer_frames_are_a_deviation_and_more_are_none() -> None:
    assert setting("total_frames=1000").deviations() == ["1,000 of 50,000,000 frames"]
    assert setting("total_frames=60_000_000").deviations() == []


def test_labels_leave_out_shared_changes() -> None:
    one = setting("algo=ppo_fast", "action=residual")
    two = setting("algo=ppo_fast", "pregrasp=none")
    assert labels([one]) == {one: "pgdm, action=residual, algo=ppo_fast"}
    assert shared([one]) == ()
    assert shared([one, two]) == ("algo=ppo_fast",)
    graff = [setting("method=graff", f"seed={s}", f"num_envs={n}") for s, n in ((0, 8), (1, 9))]
    assert shared(graff) == ()  # labels name the method always
    found = labels([one, two])
    assert found[one] == "pgdm, action=residual"
    assert found[two].startswith("pgdm, pregrasp=none")
    short = setting("algo=ppo_fast", "action=residual", "total_frames=4096")
    assert list(labels([one, short]).values()) == ["pgdm, 50,000,000 frames", "pgdm, 4,096 frames"]


def test_runs_out_of_time_are_not_averaged_with_complete_ones() -> None:
    config = compose_plain(["task=cup-pour1", "time_limit_min=10"])
    assert setting_of(config) == setting("task=cup-pour1")  # it had all its frames
    assert setting_of(config, out_of_time=True).changes == ("time_limit_min=10",)
