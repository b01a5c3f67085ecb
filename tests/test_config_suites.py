from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pgdm.config.compose import compose
from pgdm.config.groups import available
from pgdm.config.suites import expand_tasks, suite, suites, task_facts
from pgdm.errors import ConfigError, UnknownNameError

TASKS = available("task")
SIZES = {
    "tcdm50": 50, "tcdm30": 30, "adroit40": 40, "dhand": 5, "dmanus": 2, "adroit_experts": 36,
    "quick6": 6, "tune6": 6, "animated7": 7,
}  # fmt: skip


def test_the_suites_are_there_with_their_sizes() -> None:
    assert {name: len(suite(name)) for name in suites()} == SIZES


def test_the_suites_hold_what_they_say() -> None:
    cfgs = {task: compose([f"task={task}"]) for task in TASKS}
    rated = {task for task, cfg in cfgs.items() if cfg.task.paper_success is not None}
    assert (
        set(suite("tcdm50")) == rated == set(TASKS) - {"dmanus-sim2real"} - set(suite("animated7"))
    )
    assert set(suite("tcdm30")) == {task for task, cfg in cfgs.items() if cfg.task.tcdm30}
    for hand in ("dhand", "dmanus"):
        assert set(suite(hand)) == {t for t in rated if cfgs[t].hand.name == hand}
    adroit40 = {task for task, cfg in cfgs.items() if cfg.task.trajectory_source == "mocap"}
    assert set(suite("adroit40")) == adroit40
    assert {cfgs[task].hand.name for task in adroit40} == {"adroit"}


def test_experts_are_36_of_40_and_26_of_30() -> None:
    experts = set(suite("adroit_experts"))
    assert experts < set(suite("adroit40"))
    assert len(experts & set(suite("tcdm30"))) == 26


def test_facts_are_of_the_file_and_of_its_hand(tmp_path: Path) -> None:
    (tmp_path / "a.yaml").write_text(
        "defaults: [_tcdm, _self_, {override /hand@_global_.hand: dhand}]\nid: a\n"
    )
    assert task_facts(tmp_path / "a.yaml") == {"id": "a", "hand": "dhand"}


@pytest.mark.parametrize(
    ("words", "tasks"),
    [
        (["dhand-cup"], ["dhand-cup"]),
        (["dhand-cup", "dhand-cup"], ["dhand-cup"]),
        (["dmanus", "dhand-cup"], ["dmanus-coffeecan", "dmanus-crackerbox", "dhand-cup"]),
        (["dmanus-c*", "-animated7"], ["dmanus-coffeecan", "dmanus-crackerbox"]),
        (["dmanus-*", "-dmanus", "-animated7"], ["dmanus-sim2real"]),
        (["-dmanus", "dmanus"], ["dmanus-coffeecan", "dmanus-crackerbox"]),
        (["dmanus", "-dmanus-c*", "dmanus-coffeecan"], ["dmanus-coffeecan"]),
        (["mug-drink[0-9]"], ["mug-drink3"]),
        ([], []),
    ],
)
def test_words_become_tasks(words: list[str], tasks: list[str]) -> None:
    assert list(expand_tasks(words)) == tasks


WORDS = st.sampled_from([*TASKS[:6], *SIZES, "dhand-*", "*-lift"])


@given(st.lists(WORDS, max_size=6), st.lists(WORDS, max_size=3))
def test_a_union_less_what_is_taken_away(plus: list[str], minus: list[str]) -> None:
    found = expand_tasks([*plus, *(f"-{word}" for word in minus)])
    named = [set(expand_tasks([word])) for word in plus]
    gone = [set(expand_tasks([word])) for word in minus]
    assert set(found) == set().union(*named) - set().union(*gone)
    assert len(found) == len(set(found))
    assert expand_tasks(found) == found


@given(st.text(max_size=12))
def test_any_word_is_tasks_or_refused(word: str) -> None:
    try:
        assert set(expand_tasks([word])) <= set(TASKS)
    except UnknownNameError as error:
        assert "unknown task or suite" in str(error)


@pytest.mark.parametrize(
    ("word", "near"),
    [("tcdm31", "tcdm30"), ("duck-lft", "duck-lift"), ("dhnd-*", "dhand"), ("quick", "quick6")],
)
def test_an_unknown_word_is_answered_with_near_ones(word: str, near: str) -> None:
    with pytest.raises(UnknownNameError, match=f"unknown task or suite '.*did you mean .*{near}"):
        expand_tasks([word])


def test_an_unknown_suite_lists_the_suites() -> None:
    with pytest.raises(UnknownNameError, match="unknown suite 'quick7'; did you mean quick6"):
        suite("quick7")


def own_suite(folder: Path, text: str) -> None:
    (folder / "suite").mkdir(exist_ok=True)
    (folder / "suite" / "mine.yaml").write_text(text)


def test_a_suite_of_your_own(tmp_path: Path) -> None:
    own_suite(tmp_path, "# Mine.\ntasks: [dmanus, duck-lift]\n")
    assert suite("mine", tmp_path) == ("dmanus-coffeecan", "dmanus-crackerbox", "duck-lift")
    own_suite(tmp_path, "where: {pregrasp_source: teleop}\n")
    assert suite("mine", tmp_path) == ("door-open", "hammer-strike", "spheremedium-relocate")
    with pytest.raises(UnknownNameError):
        suite("mine")


def test_a_suite_of_a_task_of_your_own(tmp_path: Path) -> None:
    (tmp_path / "task").mkdir()
    (tmp_path / "task" / "new.yaml").write_text("id: new\ntcdm30: true\npaper_success: null\n")
    assert set(suite("tcdm30", tmp_path)) - set(suite("tcdm30")) == {"new"}
    assert suite("tcdm50", tmp_path) == suite("tcdm50")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("tasks: [mine]\n", "the suite 'mine' contains itself"),
        ("tasks: duck-lift\n", r"either tasks: \[...\] or where"),
        ("tasks: [duck-lift]\nwhere: {tcdm30: true}\n", "either tasks"),
        ("tasks: [duck-lft]\n", "unknown task or suite 'duck-lft'"),
        ("tasks: [duck\n", "mine.yaml: not valid YAML"),
        ("- duck-lift\n", "mine.yaml holds no keys"),
        ("", "either tasks"),
    ],
)
def test_a_wrong_suite(tmp_path: Path, text: str, message: str) -> None:
    own_suite(tmp_path, text)
    with pytest.raises(ConfigError, match=message) as caught:
        suite("mine", tmp_path)
    assert "\n" not in str(caught.value)
