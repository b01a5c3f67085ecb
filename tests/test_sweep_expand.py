from __future__ import annotations

import itertools
import math
from typing import Any

import hydra
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from hypothesis import given, settings
from hypothesis import strategies as st
from omegaconf import OmegaConf

from pgdm.config.compose import Composer
from pgdm.config.explain import COMPOSITION_ERRORS
from pgdm.config.groups import conf_dir
from pgdm.config.hydra_private import Loader
from pgdm.config.suites import expand_tasks
from pgdm.errors import ConfigError
from pgdm.library.progress import silent
from pgdm.runs.config_file import dotted
from pgdm.sweep.expand import Composed, composed_jobs, grid, with_tasks_as_choices

PARSER = OverridesParser.create()


def expanded(*overrides: str) -> list[tuple[str, ...]]:
    """Return the grid of what one would type."""
    return grid(PARSER.parse_overrides(list(overrides)), expand_tasks, 10_000)


@pytest.mark.parametrize(
    ("overrides", "jobs"),
    [
        ([], [()]),
        (["seed=1"], [("seed=1",)]),
        (["seed=0,1"], [("seed=0",), ("seed=1",)]),
        (["seed=range(0,3)"], [("seed=0",), ("seed=1",), ("seed=2",)]),
        (["a=1,2", "b=x,y"], [("a=1", "b=x"), ("a=1", "b=y"), ("a=2", "b=x"), ("a=2", "b=y")]),
        (["seed=0,1,2", "a=1", "seed=5"], [("seed=5", "a=1")]),
        (["algo.hidden=[64,64],[8]"], [("algo.hidden=[64,64]",), ("algo.hidden=[8]",)]),
        (["+experiment=quickstart"], [("+experiment=quickstart",)]),
        (["task=dmanus"], [("task=dmanus-coffeecan",), ("task=dmanus-crackerbox",)]),
        (["task=choice(dmanus)"], [("task=dmanus-coffeecan",), ("task=dmanus-crackerbox",)]),
        (["task=dhand-cup,dhand-cu*"], [("task=dhand-cup",)]),
        (["task='dhand-cu*'"], [("task=dhand-cup",)]),
        (["task=dmanus,-dmanus-coffeecan"], [("task=dmanus-crackerbox",)]),
    ],
)
def test_the_grid(overrides: list[str], jobs: list[tuple[str, ...]]) -> None:
    assert expanded(*overrides) == jobs


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("seed=interval(0,1)", "is an interval; list the values to try"),
        ("task=dhand,-dhand", "leaves nothing to run"),
        ("task=tcdm31", "unknown task or suite 'tcdm31'; did you mean tcdm30"),
    ],
)
def test_what_is_no_grid(override: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        expanded(override)


KEYS = st.sampled_from(["seed", "algo.clip", "num_envs", "obs"])
AXES = st.dictionaries(KEYS, st.lists(st.integers(0, 99), min_size=1, max_size=4, unique=True))


@given(AXES)
def test_the_grid_is_every_combination_once(axes: dict[str, list[int]]) -> None:
    jobs = expanded(*(f"{key}={','.join(map(str, values))}" for key, values in axes.items()))
    assert len(set(jobs)) == len(jobs) == math.prod(map(len, axes.values()))
    whole = itertools.product(*([f"{key}={v}" for v in values] for key, values in axes.items()))
    assert jobs == list(whole)


def test_a_single_word_for_the_task_becomes_a_choice() -> None:
    given_ = ["task=tcdm30", "task=dhand-*", "task=a,b", "task=choice(a)", "task=null", "seed=1"]
    assert with_tasks_as_choices(given_) == [
        "task=choice(tcdm30)", "task=choice(dhand-*)", *given_[2:]
    ]  # fmt: skip


# Compared with Hydra itself.

SWEEPS = [
    ["task=quick6,dhand", "seed=0,1", "algo=ppo,ppo_fast", "algo.clip=0.1", "run_dir=a/${seed}"],
    ["+experiment=fast", "task=duck-lift,dmanus-sim2real", "total_frames=1e5,2_000"],
    ["seed=0,1", "time_limit_min=null,2.5", "offline=true", "device=cpu", "budget=smoke,paper"],
    [
        "algo.hidden=[8],[16,16]",
        "+action.extra=3",
        "++algo.clip=0.3",
        "~checkpoint.keep_last",
        "seed=1,2",
    ],
    ["task.objects=[duck]", "seed=1,2"],  # others refer to it
    ["task.id=mine", "task.objects.0=duck", "seed=1,2"],
    ["num_envs=${seed}", "seed=3,4"],
    ["num_envs=4,8", "run_dir=out/${num_envs}-${oc.env:HOME}", "algo.clip=0.1"],
    ["algo={clip: 0.3}", "eval={episodes: 2}", "seed=0,1"],
    ["run_dir='a b','c,d'", "sweep.name=x", 'tracking.experiment="it\'s"'],
    ["shaping=glob(*)", "ablation=glob(*)", "pregrasp=mined,none", "~algo.clip"],
    ["method=pgdm,deepmimic,graff,full", "method.success_threshold_m=0.02", "seed=7"],
]


def jobs_of(overrides: list[str]) -> list[Composed]:
    return composed_jobs(Composer(), overrides, None, silent, 10_000)


@pytest.mark.parametrize("overrides", SWEEPS, ids=" ".join)
def test_every_job_is_what_hydra_composes(overrides: list[str]) -> None:
    jobs = jobs_of(overrides)
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        for own, settings in jobs:
            composed = hydra.compose("config", list(own))
            assert settings == OmegaConf.to_container(composed, resolve=True), own
            assert [type(v) for v in dotted(settings).values()] == [
                type(v) for v in dotted(OmegaConf.to_container(composed, resolve=True)).values()
            ]


def test_the_number_of_jobs() -> None:
    assert len(jobs_of(SWEEPS[0])) == (6 + 4) * 2 * 2  # dhand-cup is in both suites


def test_most_jobs_need_no_composition_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    composed: list[int] = []
    whole = Loader.chosen
    monkeypatch.setattr(Loader, "chosen", lambda *a: composed.append(1) or whole(*a))
    monkeypatch.delattr(Loader, "apply")
    assert len(jobs_of(["task=quick6", "seed=range(0,10)", "algo.learning_rate=1e-4,1e-5"])) == 120
    assert len(composed) == 6


VALUES = st.sampled_from(
    ["1", "-3", "0.5", "1e3", "true", "null", "text", "'a b'", "[1,2]", "{a: 1}", "${seed}",
     "'${seed}'", "???", "nan", "inf", "''", "a/b", "0x1", "1_000", "$x", "\\${seed}", "yes"]
)  # fmt: skip
SETTINGS = st.sampled_from(
    ["seed", "num_envs", "run_dir", "task.id", "task.objects", "task.tracked_body",
     "task.placements",
     "algo.hidden", "algo.clip", "eval", "+new", "++new.key", "++seed", "~seed", "~algo.clip",
     "tracking.uri", "method.reward.lift_weight", "method.reward", "task.objects.0"]
)  # fmt: skip


COMPOSER = Composer()


@settings(deadline=None, max_examples=50)
@given(st.lists(st.tuples(SETTINGS, VALUES), min_size=1, max_size=3, unique_by=lambda s: s[0]))
def test_any_settings_are_what_hydra_composes(pairs: list[tuple[str, str]]) -> None:
    overrides = [f"{key}={value}" for key, value in pairs]
    mine: dict[str, Any] | None
    try:
        mine = COMPOSER.plain(overrides)
    except ConfigError:
        mine = None
    try:
        with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
            found = hydra.compose("config", overrides)
            theirs = OmegaConf.to_container(found, resolve=True, throw_on_missing=True)
    except (*COMPOSITION_ERRORS, TypeError):  # Hydra's own at a list of numbers for a group
        theirs = None
    assert repr(mine) == repr(theirs)


def test_a_wrong_job_is_refused_with_its_name() -> None:
    with pytest.raises(ConfigError, match="unknown key 'seeed'; did you mean seed") as caught:
        jobs_of(["seeed=1"])
    assert "in the run" not in str(caught.value)
    message = r"unknown obs 'x'.* \(in the run obs=x; none was started\)"
    with pytest.raises(ConfigError, match=message):
        jobs_of(["task=duck-lift", "obs=paper,x"])
