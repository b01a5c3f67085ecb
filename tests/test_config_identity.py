from __future__ import annotations

import dataclasses
import subprocess
import sys

import pytest

from pgdm.config.compose import compose
from pgdm.config.identity import (
    ADDED_LATER,
    check_continues,
    default_run_dir,
    difference,
    identity,
    identity_hash,
    with_added_keys,
)
from pgdm.errors import RunError
from pgdm.runs.config_file import dotted

BESIDE = [
    "run_dir=elsewhere", "resume=must", "offline=true", "budget=smoke", "num_threads=1",
    "total_frames=123", "tracking=none", "checkpoint.interval_s=5", "eval.interval_frames=7",
    "eval.video=false", "eval.video_every_eval=true", "task.paper_success=0.5",
]  # fmt: skip
CHANGES = [
    "seed=1", "num_envs=64", "task=duck-lift", "hand=dhand", "pregrasp=mined", "obs=paper",
    "action=residual", "algo=ppo_fast", "algo.clip=0.1", "method.reward.lift_weight=0",
    "sim.solver_iterations=10", "sim.object_mass=published", "eval.episodes=5",
    "task.timestep_s=0.002", "pregrasp.fallback=null",
]  # fmt: skip


def test_a_dataclass_is_flattened_as_its_plain_form() -> None:
    cfg = compose(["task=dmanus-sim2real"])
    flat = dotted(dataclasses.asdict(cfg))
    assert list(dotted(cfg).items()) == list(flat.items())
    assert flat["task.placements"][0]["body"] == cfg.task.placements[0].body


@pytest.mark.parametrize("override", BESIDE)
def test_what_is_beside_the_result_changes_nothing(override: str) -> None:
    assert identity_hash(compose([override])) == identity_hash(compose())


@pytest.mark.parametrize("override", CHANGES)
def test_what_changes_the_result_changes_the_hash(override: str) -> None:
    changed = compose([override])
    assert identity_hash(changed) != identity_hash(compose())
    assert default_run_dir(changed) != default_run_dir(compose())


def test_the_hash_is_the_same_in_every_process() -> None:
    code = "from pgdm.config.compose import compose; print(compose(['seed=3']).run_dir)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == compose(["seed=3"]).run_dir


def test_the_folder_says_what_is_in_it() -> None:
    cfg = compose(
        ["task=cup-pour1", "seed=7", "action=residual", "algo=ppo_fast", "pregrasp=mined"]
    )
    start = "runs/cup-pour1/pgdm/mined-residual-ppo_fast-s7-"
    assert cfg.run_dir == f"{start}{identity_hash(cfg)}"


def test_a_folder_given_is_kept() -> None:
    assert compose(["run_dir=out/a"]).run_dir == "out/a"


def test_identity_is_of_plain_values() -> None:
    plain = identity(compose())
    assert plain["algo.hidden"] == [256, 128]
    assert plain["task.placements"][0]["body"] == "hammer/object"
    assert not any(key.startswith(("tracking", "checkpoint")) for key in plain)


def test_the_difference_has_both_values() -> None:
    changed = compose(["seed=3", "algo.clip=0.1"])
    assert difference(compose(), changed) == ["algo.clip: 0.2 -> 0.1", "seed: 0 -> 3"]


def test_a_key_that_came_later_changes_no_identity_at_the_value_of_before() -> None:
    assert not identity(compose()).keys() & ADDED_LATER.keys()
    changed = compose(["sim.object_mass=published"])
    assert difference(compose(), changed) == ["sim.object_mass: volume -> published"]
    assert difference(changed, compose()) == ["sim.object_mass: published -> volume"]
    assert with_added_keys({"sim": {"a": 1}})["sim"] == {
        "engine": "mujoco",
        "object_mass": "volume",
        "a": 1,
    }
    assert (
        with_added_keys({"sim": {"object_mass": "published"}})["sim"]["object_mass"] == "published"
    )
    assert with_added_keys({"sim": None})["sim"] is None  # damaged: reported when it is built
    assert with_added_keys({})["shaping"]["name"] == "none"  # a whole group that came later


def test_a_run_may_grow() -> None:
    check_continues(compose(["total_frames=10"]), compose(["total_frames=20", "budget=smoke"]))


def test_a_run_may_not_shrink_or_become_another() -> None:
    with pytest.raises(RunError, match=r"total_frames: 20 -> 10 \(it may only grow\)"):
        check_continues(compose(["total_frames=20"]), compose(["total_frames=10"]))
    with pytest.raises(RunError, match=r"'out/a' .*seed: 0 -> 3.*choose another run_dir"):
        check_continues(compose(["run_dir=out/a"]), compose(["run_dir=out/a", "seed=3"]))


def test_keys_of_a_planned_wrist_count_only_where_it_is_planned() -> None:
    def hashed(*overrides: str) -> str:
        return identity_hash(compose(["+experiment=fast", *overrides]))

    plain = "action.hold_steps=0", "action.carry_load=false", "shaping.beyond_plan=false"
    clipped = "action.wrist_path=clipped"
    assert hashed(clipped) == hashed(clipped, *plain)  # as it was before there were the keys
    assert len({hashed(), *(hashed(key) for key in plain)}) == 4
