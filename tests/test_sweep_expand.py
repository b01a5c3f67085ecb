from __future__ import annotations

import itertools
import math

import hydra
import pytest
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException
from hydra.types import RunMode
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from pgdm.config.groups import conf_dir
from pgdm.config.suites import expand_tasks
from pgdm.errors import ConfigError
from pgdm.sweep.expand import composed_jobs, grid, with_tasks_as_choices

PARSER = OverridesParser.create()


def expanded(*overrides: str) -> list[tuple[str, ...]]:
    """Return the grid of what one would type."""
    return grid(PARSER.parse_overrides(list(overrides)), expand_tasks)


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
        ("seed=interval(0,1)", "has no end of values; list those to try"),
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


# With Hydra itself.

SWEEP = ["task=quick6,dhand", "seed=0,1", "algo=ppo,ppo_fast", "algo.clip=0.1", "run_dir=a/${seed}"]


def test_every_job_is_what_hydra_composes() -> None:
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        whole = loader.load_configuration("config", ["hydra.job.name=x"], RunMode.MULTIRUN)
        jobs = composed_jobs(loader, whole, SWEEP)
        assert len(jobs) == (6 + 4) * 2 * 2  # dhand-cup is in both suites
        for overrides, settings in jobs:
            assert settings == hydra.compose("config", list(overrides))
            assert OmegaConf.to_container(settings, resolve=True)
        # None shares what another could change.
        jobs[0][1].task.id = jobs[0][1].algo.name = "changed"
        assert "changed" not in {job.algo.name for _, job in jobs[1:]}


def test_a_wrong_job_is_refused_as_hydra_does() -> None:
    with hydra.initialize_config_dir(str(conf_dir()), version_base="1.3"):
        loader = GlobalHydra.instance().config_loader()
        whole = loader.load_configuration("config", [], RunMode.MULTIRUN)
        wrong_ones = {"seeed=1": "Could not override 'seeed'", "obs=x": "Could not find 'obs/x'"}
        for wrong, message in wrong_ones.items():
            with pytest.raises(HydraException, match=message):
                composed_jobs(loader, whole, [wrong])
