"""Additions to the reward and the discount in training, and their absence in evaluations."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from command_line import TINY, command
from pgdm.config.compose import compose
from pgdm.errors import ConfigError
from pgdm.experiment import env_builder
from pgdm.library import open_library
from pgdm.mdp.shaping import GRASP, SLOPE, ShapingCfg, shaped
from pgdm.runs.files import read_json

SETTINGS = ("task=hammer-use1", "shaping=soft_end", "shaping.soft_end_m=0.1")
KERNEL = ("shaping.kernel_weight=5", "shaping.kernel_scale=10")
NO_SHAPING = ShapingCfg("none", 0.0, 10.0, 0.0, 20.0, None, False)


@pytest.mark.usefixtures("library_home")
def test_training_has_slope_and_soft_end_and_evaluation_has_neither() -> None:
    builder = env_builder(compose([*SETTINGS, *KERNEL]), open_library())
    train, evaluation = builder.make(2, 1), builder.make(2, 1, stream="eval")
    own_sum = added_sum = torch.zeros(2).double()
    for _ in range(200):
        action = train.warm_start().repeat(2, 1)
        _, reward, terminated, _, info = train.step(action)
        _, own, _, _, plain = evaluation.step(action)
        error = plain["object_error_m"]
        torch.testing.assert_close(info["discount"], torch.exp(-((error / 0.1) ** 2)).float())
        torch.testing.assert_close(info["terms"][SLOPE], 5 * torch.exp(-10 * error))
        torch.testing.assert_close(reward, (own + info["terms"][SLOPE]).float())
        assert plain["discount"] is None and SLOPE not in plain["terms"]
        own_sum, added_sum = own_sum + own, added_sum + info["terms"][SLOPE]
        if terminated.any():
            break
    trained, measured = info["episodes"].metrics(), plain["episodes"].metrics()
    torch.testing.assert_close(
        trained["return"], measured["return"]
    )  # the return of the task alone
    torch.testing.assert_close(trained["shaping"], added_sum)
    assert "shaping" not in measured


@pytest.mark.usefixtures("library_home")
def test_without_shaping_training_uses_the_recipe_of_evaluation() -> None:
    builder = env_builder(compose(["task=hammer-use1"]), open_library())
    assert builder.make(1, 1).mdp.recipe is builder.mdp.recipe


@pytest.mark.usefixtures("library_home")
def test_a_hand_that_moves_with_the_object_earns_the_whole_grasp_term() -> None:
    builder = env_builder(compose(["task=hammer-use1", "shaping=grasp"]), open_library())
    train = builder.make(1, 1)
    # At the start nothing has moved: the term is its weight. Straight fingers leave the object.
    held = next(term for term in train.mdp.recipe.rewards if term.name == GRASP)
    assert held.value(train._context(train.sim.read())).item() == pytest.approx(1.0, abs=1e-12)
    open_hand = train.warm_start()[None].clone()
    open_hand[:, 6:] = -1.0
    values = [train.step(open_hand)[4]["raw_terms"][GRASP].item() for _ in range(5)]
    assert values == sorted(values, reverse=True) and values[-1] < 0.5


@pytest.mark.usefixtures("library_home")
def test_the_soft_end_counts_only_what_exceeds_the_plan() -> None:
    env = env_builder(compose(["task=hammer-use1"]), open_library()).make(2, 1)
    context = env._context(env.sim.read())
    error = context.object_error  # at reset, the same in both simulations
    context = replace(context, t=torch.tensor([1, 3]))
    plan_error = torch.tensor([0.25, 0.0, 2.0]) * error[0]
    cfg = replace(NO_SHAPING, soft_end_m=0.1)

    def discount(beyond_plan: bool, plan: torch.Tensor | None) -> torch.Tensor:
        changed = shaped(env.mdp.recipe, replace(cfg, beyond_plan=beyond_plan), plan).discount
        assert changed is not None
        return changed(context)

    whole = torch.exp(-((error / 0.1) ** 2))
    beyond = torch.exp(-((torch.tensor([0.75, 0.0]) * error / 0.1) ** 2))
    torch.testing.assert_close(discount(True, plan_error), beyond)
    torch.testing.assert_close(discount(True, None), whole)
    torch.testing.assert_close(discount(False, plan_error), whole)


@pytest.mark.usefixtures("library_home")
def test_training_spares_the_error_of_its_own_wrist_plan() -> None:
    cfg = compose(["+experiment=fast", "task=duck-lift", "shaping.soft_end_m=0.01"])
    idle = np.zeros((20, 6))  # a base that stays behind: the plan's error grows
    builder = env_builder(cfg, open_library(), commands=idle)
    env = builder.make(2, 1)
    context = env._context(env.sim.read())
    context = replace(context, t=torch.tensor([1, 20]))
    assert builder.wrist is not None and env.mdp.recipe.discount is not None
    beyond = (context.object_error.numpy() - builder.wrist.error_m[[0, 19]]).clip(min=0.0)
    assert beyond[1] == 0.0 < context.object_error[1]
    expected = torch.exp(-(torch.from_numpy(beyond) / 0.01).square())
    torch.testing.assert_close(env.mdp.recipe.discount(context), expected)


@pytest.mark.parametrize(
    "far", [("pregrasp=none",), ("ablation=distance_15cm",), ("ablation=open_hand",)]
)
def test_only_an_intact_pregrasp_is_to_be_kept(far: tuple[str, ...]) -> None:
    assert compose(["shaping=grasp"]).used_shaping.grasp_weight > 0
    away = compose(["shaping=grasp", *far]).used_shaping
    assert away.grasp_weight == 0 and away.soft_end_m == 0.15


def test_without_a_wrist_plan_the_whole_error_counts() -> None:
    assert compose(["+experiment=fast"]).used_shaping.beyond_plan
    assert not compose(["+experiment=fast", "action.wrist_path=clipped"]).used_shaping.beyond_plan
    assert not compose(["action=absolute", "shaping=soft_end"]).used_shaping.beyond_plan


def test_the_additions_are_described_in_words() -> None:
    assert NO_SHAPING.described() == ""
    described = replace(NO_SHAPING, kernel_weight=5.0, soft_end_m=0.15).described()
    assert described == (
        "5 exp(-e/0.1 m) is added to the reward (e: the object's error), and "
        "future rewards are scaled by exp(-(e/0.15 m)^2) (e: the object's error)"
    )
    beyond = replace(NO_SHAPING, soft_end_m=0.15, beyond_plan=True).described()
    assert beyond.endswith("(e: the object's error, less that of the wrist plan)")
    assert "3 exp(-d/0.05 m), averaged over" in replace(NO_SHAPING, grasp_weight=3.0).described()


def test_a_dry_run_lists_the_additions(library_home: Path) -> None:
    outcome = command("pgdm-run", "--offline", *SETTINGS, *KERNEL, "--dry-run")
    rows = [line.split() for line in outcome.out.splitlines()]
    assert ["reward,", "training", "only", "slope", "5"] in rows
    assert ["discount,", "training", "only"] in rows
    plain = command("pgdm-run", "--offline", "task=hammer-use1", "--dry-run")
    assert "training only" not in plain.out


@pytest.mark.usefixtures("library_home")
def test_a_result_records_the_additions_only_if_there_are_any(tmp_path: Path) -> None:
    for name, settings in (("bare", ()), ("shaped", KERNEL)):
        outcome = command("pgdm-run", "--offline", *TINY, *settings, f"run_dir={name}")
        assert outcome.code == 0, outcome.err
    assert "shaping" not in read_json(tmp_path / "bare" / "result.json")
    recorded = read_json(tmp_path / "shaped" / "result.json")["shaping"]
    assert recorded == "5 exp(-e/0.1 m) is added to the reward (e: the object's error)"


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"kernel_weight": -1.0}, "kernel_weight is -1.0; it must be at least 0"),
        ({"kernel_scale": 0.0}, "kernel_scale is 0.0; it must be above 0"),
        ({"grasp_weight": -1.0}, "grasp_weight is -1.0; it must be at least 0"),
        ({"grasp_scale": 0.0}, "grasp_scale is 0.0; it must be above 0"),
        ({"soft_end_m": -0.1}, "soft_end_m is -0.1; it must be above 0"),
    ],
)
def test_invalid_numbers_are_named(changed: dict[str, float], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        replace(NO_SHAPING, **changed).validate()
