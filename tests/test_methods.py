"""Each method in its real environment: the terms it adds, the data it needs, what it records."""

from __future__ import annotations

import math
import os
import re
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from command_line import TINY, command, process
from pgdm.config.compose import compose
from pgdm.config.groups import available
from pgdm.config.identity import default_run_dir, identity, identity_hash
from pgdm.config.saved import load_config, save_config
from pgdm.envs.batch_env import BatchEnv
from pgdm.envs.build import EnvBuilder
from pgdm.errors import ConfigError, UnknownNameError
from pgdm.experiment import env_builder
from pgdm.library import Expert, Library, open_library
from pgdm.library.experts.kinematics import ExpertHand
from pgdm.mdp.context import SPACES
from pgdm.mdp.measures import HAND_MEASURES
from pgdm.mdp.recipe import Measure
from pgdm.methods import METHODS, pgdm, recipe
from pgdm.runs.log import RunLog

REPOSITORY = Path(__file__).resolve().parents[1]
PGDM = {"tracking", "lift"}
ADDED = {
    "pgdm": set(),
    "deepmimic": {"imitation"},
    "graff": {"contact"},
    "curriculum": set(),
    "full": {"imitation", "contact"},
}


class MadeUp(Library):
    """A library whose only expert, for cup-pour1, holds the hand still in its start state."""

    def expert(self, task: str) -> Expert:
        """Return the expert."""
        if task != "cup-pour1":
            raise UnknownNameError("expert hand trajectory", task, ["cup-pour1"])
        motion = self.motion(task)
        steps = len(motion.translation)
        return Expert(
            task=task,
            qpos=np.tile(motion.starts["mined"].qpos[:30], (steps, 1)),
            human_joints=np.zeros((steps, 16, 3)),
            fingertips=np.full((steps, 5, 3), 0.5),
            contacts=np.zeros((steps, 5, 3)),
            in_contact=np.arange(steps)[:, None] >= [3, 3, 99, 99, 99],
            approximate=True,
            sha256="made up",
        )


def build(*overrides: str) -> EnvBuilder:
    cfg = compose(["task=cup-pour1", *overrides])
    library = open_library()
    folders = {source: library.folder(source) for source in library.sources()}
    return env_builder(cfg, MadeUp(library.root, library.sources(), folders))


def steps(env: BatchEnv, count: int) -> dict:
    info: dict = {}
    for _ in range(count):
        *_, info = env.step(env.warm_start().repeat(env.num_envs, 1))
    return info


def test_every_method_has_a_settings_file() -> None:
    assert set(available("method")) == set(METHODS)


@pytest.mark.parametrize("method", METHODS)
def test_settings_have_their_own_class_and_load_as_saved(method: str, tmp_path: Path) -> None:
    cfg = compose([f"method={method}", f"run_dir={tmp_path / 'run'}"])
    assert type(cfg.method) is METHODS[method].config
    assert {term.name for term in recipe(cfg.method).rewards} == PGDM | ADDED[method]
    save_config(cfg, tmp_path / "run")
    assert load_config(tmp_path / "run") == cfg


def test_settings_of_a_method_distinguish_runs() -> None:
    plain = compose(["method=deepmimic"])
    joints = compose(["method=deepmimic", "method.imitation.space=joints"])
    assert identity_hash(plain) != identity_hash(joints)
    assert identity(joints)["method.imitation.space"] == "joints"
    assert "/deepmimic/" in default_run_dir(joints)
    assert not any("imitation" in key for key in identity(compose()))


@pytest.mark.parametrize("left_out", ["imitation", "contact", "curriculum"])
def test_full_leaves_out_sections_that_are_null(left_out: str) -> None:
    made = recipe(compose(["method=full", f"method.{left_out}=null"]).method)
    names = {term.name for term in made.rewards}
    assert names == PGDM | ({"imitation", "contact"} - {left_out})
    assert bool(made.schedules) is (left_out != "curriculum")
    assert ("hand_lost" in {end.name for end in made.ends}) is (left_out != "imitation")


def test_without_expert_terms_no_expert_is_needed() -> None:
    cfg = compose(["method=full", "method.imitation=null", "method.contact=null"])
    assert recipe(cfg.method).needs_expert is False
    assert recipe(cfg.method).measures == ()


def test_the_table_lists_all_active_terms() -> None:
    assert recipe(compose(["method=full"]).method).table() == [
        ("reward", "tracking", "10, scheduled from 0"),
        ("reward", "lift", "2.5"),
        ("reward", "imitation", "1"),
        ("reward", "contact", "1"),
        ("termination", "object_lost", ""),
        ("termination", "motion_ended", ""),
        ("termination", "hand_lost", ""),
        ("measure", "hand_error_m", ""),
        ("measure", "hand_error_rad", ""),
        ("measure", "contact_distance_m", ""),
    ]


def test_a_schedule_that_outlasts_a_run_is_reported(library_home: Path) -> None:
    curriculum = recipe(compose(["method=curriculum"]).method)
    assert curriculum.unfinished(1_000_000) == [("tracking", 2.5, 10.0)]
    assert curriculum.unfinished(4_000_000) == []
    line = ["task=cup-pour1", "method=curriculum", "total_frames=1000000", "--dry-run"]
    assert "weight of 'tracking' reaches only 2.5 of 10" in command("pgdm-run", *line).out


def test_a_dry_run_shows_the_terms_of_a_run(tmp_path: Path) -> None:
    outcome = command("pgdm-run", "task=cup-pour1", "method=curriculum", "--dry-run")
    assert outcome.code == 0
    assert re.search(r"reward +tracking +10, scheduled from 0", outcome.out)
    assert "train/weight/NAME" in outcome.out
    assert "nothing was started" in outcome.out
    assert list(tmp_path.iterdir()) == []


@pytest.mark.usefixtures("library_home")
def test_a_dry_run_names_the_missing_start() -> None:
    outcome = command("pgdm-run", "task=cup-pour1", "pregrasp=teleop", "--dry-run")
    assert outcome.code == 2 and "has no stored start 'teleop'" in outcome.errors[0]
    assert (
        command("pgdm-run", "task=cup-pour1", "pregrasp=mocap", "--dry-run").code == 0
    )  # is computed
    assert (
        command("pgdm-run", "task=cup-pour1", "method=graff", "--dry-run").code == 0
    )  # is fetched


@pytest.mark.parametrize("pregrasp", ["planned", "mined", "none"])
@pytest.mark.parametrize("method", METHODS)
def test_every_method_runs_from_every_start(method: str, pregrasp: str, library_home: Path) -> None:
    builder = build(f"method={method}", f"pregrasp={pregrasp}")
    env = builder.make(2, 1)
    info = steps(env, 3)
    assert set(info["raw_terms"]) == set(info["terms"]) == PGDM | ADDED[method]
    expert = method in ("deepmimic", "graff", "full")
    assert set(info["measures"]) == (
        {"hand_error_m", "hand_error_rad", "contact_distance_m"} if expert else set()
    )
    assert ("expert_sha256" in builder.facts()) is expert
    assert any("approximate" in note for note in builder.notes) is expert


def test_the_expert_is_clipped_and_its_contacts_are_relative_to_the_centre_of_mass(
    library_home: Path,
) -> None:
    builder = build("method=graff")
    expert, index, model = builder.mdp.expert, builder.scene.index, builder.scene.model
    assert expert is not None
    ranges = torch.from_numpy(model.jnt_range[:30].copy())
    assert (expert.joints >= ranges[:, 0]).all() and (expert.joints <= ranges[:, 1]).all()
    env = builder.make(1, 1)
    steps(env, 3)
    context = env._context(env.sim.read())
    # The made-up contact points are the origin of the object's body.
    origin = torch.from_numpy(env.sim.data(0).xpos[index.object_body].copy())
    torch.testing.assert_close(context.contact_points[0], origin.expand(5, 3))


def test_own_measures_are_kept_next_to_those_of_the_expert() -> None:
    own = Measure("height_m", lambda step: step.start_height)
    base = replace(pgdm.recipe(compose(["task=hammer-use1"]).method), measures=(own,))
    made = base.comparing(HAND_MEASURES).comparing(HAND_MEASURES)
    assert made.measures == (own, *HAND_MEASURES)
    assert made.needs_expert and not base.needs_expert


def test_measures_of_an_episode_are_means_over_the_applicable_steps(library_home: Path) -> None:
    env = build("method=graff").make(1, 1)
    seen: dict[str, list[Tensor]] = {}
    ended = None
    while ended is None:
        info = steps(env, 1)
        ended = info["episodes"]
        for name, value in info["measures"].items():
            seen.setdefault(name, []).append(value)
    episode = ended.metrics()
    for name, values in seen.items():
        torch.testing.assert_close(episode[name], torch.cat(values).nanmean()[None])
    assert math.isnan(seen["contact_distance_m"][1].item())  # step 2: no contact yet
    assert not math.isnan(seen["contact_distance_m"][2].item())
    again = steps(env, 1)  # the next episode starts with empty sums
    torch.testing.assert_close(env._episodes._measured[0, 0], again["measures"]["hand_error_m"])


def test_a_lost_hand_terminates_an_episode_after_the_grace_steps_and_is_counted(
    library_home: Path,
) -> None:
    # The made-up fingertips are far above the table: lost at the first check.
    env = build("method=deepmimic", "method.imitation.grace_steps=4").make(2, 1)
    assert not any(steps(env, 1)["ends"]["hand_lost"].any() for _ in range(4))
    info = steps(env, 1)
    assert info["ends"]["hand_lost"].tolist() == [True, True]
    episodes = info["episodes"].metrics()
    assert episodes["end/hand_lost"].tolist() == [1.0, 1.0]
    assert episodes["length"].tolist() == [5.0, 5.0]
    assert "raw/imitation" in episodes and "term/imitation" in episodes


def test_restored_states_continue_bit_exactly(library_home: Path) -> None:
    builder = build("method=full")
    one, other = builder.make(2, 1), builder.make(2, 1)
    steps(one, 7)
    other.load_state_dict(one.state_dict())
    ended = None
    while ended is None:
        ended, same = steps(one, 1)["episodes"], steps(other, 1)["episodes"]
    again = same.metrics()
    for name, value in ended.metrics().items():
        assert torch.equal(value.nan_to_num(), again[name].nan_to_num())


def test_a_task_or_hand_without_expert_is_an_error_that_names_those_with_one() -> None:
    """The error comes before anything is fetched, computed or started."""
    with pytest.raises(
        ConfigError, match=r"none for .*'door-open'.* adroit40.*cup-pour1.* pgdm, c"
    ):
        compose(["task=door-open", "method=deepmimic"])
    with pytest.raises(ConfigError, match=r"'dhand' with .* cannot follow it"):
        compose(["task=cup-pour1", "hand=dhand", "method=graff"])
    with pytest.raises(ConfigError, match=r"'adroit' with thdistal_point, .* cannot follow it"):
        compose(["task=cup-pour1", "method=graff", "hand.fingertips=[15,3]"])
    compose(["task=door-open", "method=full", "method.imitation=null", "method.contact=null"])
    sweep = command("pgdm-run", "-m", "task=cup-pour1,dhand-cup", "method=graff", "--dry-run")
    assert sweep.code == 2 and "task=dhand-cup seed=0; none was started" in sweep.err


@pytest.mark.usefixtures("library_home")
def test_an_expert_missing_from_the_library_is_an_error_at_construction() -> None:
    with pytest.raises(UnknownNameError, match=r"'duck-lift'.*cup-pour1"):
        build("task=duck-lift", "method=deepmimic")


@pytest.mark.slow
@pytest.mark.usefixtures("expert_home")
def test_the_experts_hand_is_lost_where_the_deepmimic_page_states() -> None:
    library = open_library()
    kinematics = ExpertHand(library.hand_xml("adroit"))
    starts, at_rest, recorded = [], 0, {}
    for task in library.experts().experts:
        cfg = compose([f"task={task}", "method=deepmimic", "pregrasp=none"])
        builder = env_builder(cfg, library)
        env, (lost,) = (
            builder.make(1, 1),
            [e for e in builder.mdp.recipe.ends if e.name == "hand_lost"],
        )
        state = env.sim.read()
        starts.append(env._context(state).hand_error("fingertips", "squared").item())
        env._t[:] = 11
        at_rest += int(lost.reached(env._context(state)))
        # The expert's own fingertips, as recorded and not clipped, instead of the robot's.
        expert = library.expert(task)
        offset = (
            torch.from_numpy(kinematics.fingertips(expert.qpos)) - builder.mdp.expert.fingertips
        )
        steps = (offset.square().sum((1, 2)) > 0.1).nonzero()[:, 0]
        if len(steps := steps[steps > 10]):
            recorded[task] = int(steps[0]), len(steps)
    assert (round(min(starts), 2), round(max(starts), 2)) == (0.17, 0.32)
    assert (at_rest, len(starts)) == (26, 36)
    assert recorded == {
        "elephant-pass1": (19, 33),
        "flute-pass1": (27, 6),
        "lightbulb-pass1": (28, 14),
        "headphones-pass1": (38, 19),
        "toruslarge-inspect1": (69, 11),
    }


@pytest.mark.slow
@pytest.mark.usefixtures("expert_home")
@pytest.mark.parametrize("task", ["hammer-use1", "elephant-pass1"])
def test_a_hand_at_the_experts_joints_is_where_the_expert_is(task: str) -> None:
    """Real expert and real scene, for each finger and several rows; clipping is reported."""
    builder = env_builder(compose([f"task={task}", "method=graff"]), open_library())
    expert, env = builder.mdp.expert, builder.make(1, 1)
    assert expert is not None
    for t in (0, len(expert) // 2, len(expert) - 1):
        qpos = env.mdp.start.qpos.copy()
        qpos[:30] = expert.joints[t].numpy()
        env.sim.reset(np.array([0]), qpos, np.zeros_like(env.mdp.start.qvel))
        env._t[:] = t
        context = env._context(env.sim.read())
        for space in SPACES:
            assert context.hand_error(space, "norm").item() == pytest.approx(0, abs=1e-9)
    far = any("leaves the robot's limits by up to 0.26 m" in note for note in builder.notes)
    assert far is (task == "elephant-pass1")


def test_a_curriculum_is_recorded_and_does_not_affect_evaluations(library_home: Path) -> None:
    outcome = command(
        "pgdm-run", *TINY, "task=cup-pour1", "method=curriculum", "run_dir=run", "--offline",
        "method.curriculum.ramp_frames=32",
    )  # fmt: skip
    assert outcome.code == 0, outcome.err
    assert "rewards tracking 10, scheduled from 0, lift 2.5; terminations" in outcome.err
    assert "cup-pour1: method curriculum, hand adroit, pregrasp planned, " in outcome.err
    lines = RunLog(Path("run/metrics.jsonl")).read()
    trained = [line for line in lines if line["kind"] == "train"]
    assert [line["train/weight/tracking"] for line in trained] == [0.0, 5.0]
    evaluated = [line for line in lines if line["kind"] == "eval"]
    assert len(evaluated) > 1  # the training weight is 5 at the last one
    for line in evaluated:
        whole = 10 * float(line["eval_sampled/raw/tracking"])
        assert float(line["eval_sampled/term/tracking"]) == pytest.approx(whole)
        assert whole > 0


BROKEN = """
from dataclasses import replace
{top}
from pgdm.mdp.recipe import RewardTerm
from pgdm.methods import Method, MethodCfg, pgdm

def recipe(cfg):
    base = pgdm.recipe(cfg)
    return replace(base, rewards=(*base.rewards, RewardTerm({name!r}, 1.0, lambda c: {value})))

OWN = Method(MethodCfg, recipe)
"""


@pytest.mark.parametrize(
    ("top", "name", "value", "said"),
    [
        ("", "mine", "c.object_eror", "mine_method.py, line 9; --debug shows"),
        ("", "mine", "c.target_pos", "reward 'mine' of this method returns shape (1, 3)"),
        ("", "lift", "c.object_error", "has the RewardTerm 'lift' twice"),
        ("import torchh", "mine", "c.object_error", "the module exists, but something it imports"),
    ],
)
def test_a_defect_of_an_own_method_is_reported_with_its_place(
    top: str, name: str, value: str, said: str, tmp_path: Path, library_home: Path
) -> None:
    text = BROKEN.format(top=top, name=name, value=value)
    (tmp_path / "mine_method.py").write_text(text)
    outcome = process(
        *("pgdm-run", *TINY, "task=cup-pour1", "method.name='mine_method:OWN'", "--offline"),
        "run_dir=run",
        env={"PYTHONPATH": os.pathsep.join([str(REPOSITORY / "src"), str(tmp_path)])},
    )
    assert outcome.code != 0 and len(outcome.errors) == 1, outcome.err
    assert said in outcome.errors[0]


def test_an_own_method_needs_no_change_of_pgdm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "own_method.py").write_text(
        "from pgdm.methods import Method, MethodCfg\nfrom pgdm.methods.pgdm import recipe\n"
        "OWN = Method(MethodCfg, recipe)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    cfg = compose(["method.name='own_method:OWN'", f"run_dir={tmp_path / 'run'}"])
    assert [term.name for term in recipe(cfg.method).rewards] == ["tracking", "lift"]
    assert "/own_method.OWN/" in default_run_dir(cfg)
    save_config(cfg, tmp_path / "run")
    assert load_config(tmp_path / "run") == cfg
    with pytest.raises(ConfigError, match=r"'OWNN' of .* it has: OWN"):
        compose(["method.name='own_method:OWNN'"])
    sys.modules.pop("own_method")
