from __future__ import annotations

import pytest

from command_line import command
from pgdm.config.compose import compose
from pgdm.config.groups import groups
from pgdm.config.synonyms import _KEYS, meant
from pgdm.runs.config_file import dotted


@pytest.mark.parametrize(
    ("key", "ours"),
    [
        ("algo.lr", "algo.learning_rate"),
        ("lr", "algo.learning_rate"),
        ("learning_rate", "algo.learning_rate"),
        ("algo.n_steps", "algo.steps_per_env"),
        ("algo.clip_range", "algo.clip"),
        ("algo.ent_coef", "algo.entropy_coef"),
        ("total_timesteps", "total_frames"),
        ("n_envs", "num_envs"),
        ("env_id", "task"),
        ("eval.n_eval_episodes", "eval.episodes"),
        ("algo.gama", "algo.gamma"),
    ],
)
def test_keys_of_other_libraries_are_understood(key: str, ours: str) -> None:
    outcome = command("pgdm-run", f"{key}=1")
    assert outcome.code == 2
    assert outcome.err.startswith(f"error: unknown key '{key}'; did you mean {ours}")


def test_a_key_of_another_learner_is_found_there() -> None:
    assert "did you mean algo.target_rate?" in command("pgdm-run", "algo=sac", "algo.tau=1").err


def test_the_same_holds_for_a_key_that_is_added() -> None:
    assert "did you mean learning_rate?" in command("pgdm-run", "+algo.lr=1").err


def test_the_section_that_was_typed_comes_first() -> None:
    names = ["algo.hidden", "other.hidden"]
    assert meant("other.layers", names) == ["other.hidden"]
    assert meant("layers", names) == names
    assert meant("nonsense", names) == []


def test_every_synonym_leads_to_a_key_and_is_none() -> None:
    options = ([], ["algo=sac"], ["algo=ppo_fast"])
    keys = {key for chosen in options for key in dotted(compose(chosen))}
    last = {key.rpartition(".")[2] for key in keys} | set(groups()) | {"seed"}
    assert {ours for found in _KEYS.values() for ours in found} <= last
    assert not set(_KEYS) & {key for key in keys if "." not in key}
