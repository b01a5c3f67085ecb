"""The catalogue of tasks agrees with the settings, the suites and the keyframe files."""

from __future__ import annotations

import pytest

from pgdm.config.groups import available, conf_dir
from pgdm.config.suites import suite, task_facts
from pgdm.library import animated
from pgdm.library.tasks import (
    BENCHMARK_TASKS,
    CHECKOUT_TASKS,
    GRAB_COPIES,
    MOCAP_TASKS,
    REBUILT_EXPERTS,
    hand_of,
    objects_of,
    task_id,
)

FACTS = {task: task_facts(conf_dir() / "task" / f"{task}.yaml") for task in available("task")}


def by_source(*sources: str) -> set[str]:
    """Return the tasks whose settings name one of these trajectory sources."""
    return {task for task, facts in FACTS.items() if facts["trajectory_source"] in sources}


def test_every_task_with_settings_is_in_the_catalogue() -> None:
    assert (len(MOCAP_TASKS), len(set(BENCHMARK_TASKS))) == (40, 51)
    assert set(MOCAP_TASKS) == by_source("mocap")
    assert set(animated.TASKS) == by_source("keyframes")
    assert {*BENCHMARK_TASKS, *animated.TASKS} == set(FACTS)
    assert set(CHECKOUT_TASKS) > GRAB_COPIES


def test_the_suites_name_the_same_tasks() -> None:
    assert set(suite("adroit40")) == set(MOCAP_TASKS)
    assert set(suite("adroit_experts")) == set(MOCAP_TASKS) - set(REBUILT_EXPERTS)
    assert set(suite("tcdm50")) == set(BENCHMARK_TASKS) - {"dmanus-sim2real"}


@pytest.mark.parametrize("task", BENCHMARK_TASKS)
def test_an_id_gives_the_hand_and_objects_of_the_settings(task: str) -> None:
    assert (hand_of(task), list(objects_of(task))) == (FACTS[task]["hand"], FACTS[task]["objects"])
    assert task_id(task.replace("-", "_")) == task


@pytest.mark.parametrize("task", animated.TASKS)
def test_keyframes_and_settings_name_the_same_hand_and_object(task: str) -> None:
    found = animated.read(task)
    assert (found.hand, [found.object]) == (FACTS[task]["hand"], FACTS[task]["objects"])
