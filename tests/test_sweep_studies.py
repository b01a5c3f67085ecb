from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from pgdm.errors import ConfigError, UnknownNameError
from pgdm.sweep.studies import default_name, open_study, studies

PAPERS = ["ablations_tcdm30", "baselines_tcdm30", "sim2real", "validate_tcdm50"]


def test_the_papers_studies_are_there() -> None:
    assert list(studies()) == PAPERS
    read = open_study(["+sweep=validate_tcdm50", "budget=smoke"])
    assert read == ("validate_tcdm50", ["budget=smoke"], ["task=tcdm50", "seed=0,1,2"])


def test_no_study() -> None:
    assert open_study(["seed=1"]) == (None, ["seed=1"], [])


@pytest.mark.parametrize(
    ("text", "overrides"),
    [
        ("task: tcdm30\n", ["task=tcdm30"]),
        ("seed: 0,1,2\n", ["seed=0,1,2"]),
        ("seed: [0, 1]\n", ["seed=0,1"]),
        ("seed: range(0,5)\n", ["seed=range(0,5)"]),
        ("algo.hidden: [[64, 64], [256, 128]]\n", ["algo.hidden=[64,64],[256,128]"]),
        ("total_frames: 1_000\nalgo.clip: 0.1\n", ["total_frames=1000", "algo.clip=0.1"]),
        ("run_dir: null\noffline: true\n", ["run_dir=null", "offline=true"]),
        ("+experiment: quickstart\n", ["+experiment=quickstart"]),
    ],
)
def test_a_file_says_what_one_would_type(tmp_path: Path, text: str, overrides: list[str]) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    assert open_study([f"+sweep={tmp_path / 'mine.yaml'}"]) == ("mine", [], overrides)


def test_a_file_in_your_own_folder(tmp_path: Path) -> None:
    (tmp_path / "sweeps").mkdir()
    (tmp_path / "sweeps" / "mine.yaml").write_text("seed: 0,1\n")
    assert "mine" in studies(tmp_path)
    assert open_study(["+sweep=mine"], tmp_path) == ("mine", [], ["seed=0,1"])


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["+sweep=validate"], "unknown sweep file 'validate'; did you mean validate_tcdm50"),
        (["+sweep=none.yaml"], "unknown sweep file 'none.yaml'"),
        (["sweep=sim2real"], r"with a plus: \+sweep=sim2real"),
        (["+sweep=sim2real", "+sweep=sim2real"], "is given 2 times; start one"),
    ],
)
def test_wrong_names(overrides: list[str], message: str) -> None:
    with pytest.raises((ConfigError, UnknownNameError), match=message):
        open_study(overrides)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("task: [a\n", "not valid YAML"),
        ("- task\n", "is not a sweep file; write lines such as task: tcdm30"),
        ("", "is not a sweep file"),
        ("algo: {clip: 0.1}\n", "write nested keys in one line"),
    ],
)
def test_wrong_files(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "mine.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message) as caught:
        open_study([f"+sweep={tmp_path / 'mine.yaml'}"])
    assert "\n" not in str(caught.value)


# Names of sweeps.


@pytest.mark.parametrize(
    ("overrides", "study", "name"),
    [
        ([], None, "grid"),
        (["task=tcdm30", "seed=0,1,2"], None, "grid"),
        ([], "validate_tcdm50", "validate_tcdm50"),
        (["budget=smoke"], "validate_tcdm50", "validate_tcdm50-smoke"),
        (["task=duck-lift", "seed=7", "budget=smoke"], "sim2real", "sim2real-smoke"),
        (["sweep.detach=true", "hydra.launcher.max_jobs=2", "hydra/launcher=local"], None, "grid"),
        (["tracking=none", "num_threads=1", "checkpoint.interval_s=5"], None, "grid"),
    ],
)
def test_a_name_follows_from_the_study(overrides: list[str], study: str, name: str) -> None:
    assert default_name(overrides, study) == name


def test_other_settings_are_another_sweep() -> None:
    typed = ["algo=ppo_fast", "action=residual"]
    name = default_name(typed, None)
    assert name.startswith("grid-residual-ppo_fast-")
    assert default_name([*reversed(typed), "seed=3", "task=dhand"], None) == name
    assert default_name(["algo=ppo_fast", "tracking=none", "action=residual"], None) == name
    others = (["algo=ppo"], ["algo=ppo_fast"], ["algo=ppo_fast", "obs=residual"], ["seed_=1"])
    assert len({default_name(other, None) for other in others} | {name}) == 5


@given(st.lists(st.text(max_size=20), max_size=4))
def test_any_name_is_one_for_a_folder(overrides: list[str]) -> None:
    name = default_name(overrides, "study")
    assert name.startswith("study")
    assert "/" not in name and len(name) < 100
