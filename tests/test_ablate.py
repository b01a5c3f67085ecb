"""Ablated starts: what is wanted, what is free, and what is reported if the two differ."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pytest

import pgdm
from command_line import command
from pgdm.config.compose import compose
from pgdm.config.groups import available
from pgdm.config.suites import suite
from pgdm.envs.build import EnvBuilder
from pgdm.errors import ConfigError, UnknownNameError
from pgdm.experiment import env_builder
from pgdm.library import open_library
from pgdm.pregrasp.ablation.ablate import OVERLAP_M, Ablated, AblationCfg, ablate
from pgdm.pregrasp.hand_geometry import posed
from pgdm.pregrasp.sources import StartState, start_state
from pgdm.sim.contact import HandContact

ALL = ("open_hand", "mean_hand", "distance_15cm", "distance_25cm")
# A plan next to a tool, a stem between fingers, a start inside its object, and other hands.
TASKS = ("hammer-use1", "wineglass-drink2", "fryingpan-cook2", "dhand-cup", "dmanus-crackerbox")

RETREAT_M = {"dhand-stanfordbunny-inspect": 0.13}
"""Its fingers enclose the bunny: to be straight, they have to move off it."""


@cache
def builder(task: str) -> EnvBuilder:
    return env_builder(compose([f"task={task}"]), open_library())


def made(task: str, pregrasp: str, ablation: str) -> tuple[StartState, Ablated]:
    one = builder(task)
    cfg = compose([f"pregrasp={pregrasp}", f"ablation={ablation}"])
    stored = start_state(cfg.pregrasp, one.motion, one.scene)
    return stored, ablate(cfg.ablation, stored, one.scene, one.motion.substeps)


def check(task: str, pregrasp: str, ablation: str) -> Ablated:
    """Check what holds for every ablated start."""
    stored, found = made(task, pregrasp, ablation)
    scene = builder(task).scene
    nu, base = scene.model.nu, scene.hand.num_base_joints
    first, qpos = base + scene.hand.num_wrist_joints, found.start.qpos
    np.testing.assert_array_equal(qpos[nu:], stored.qpos[nu:])  # the object stays
    np.testing.assert_array_equal(found.start.qvel[nu:], stored.qvel[nu:])
    assert not found.start.qvel[:nu].any()
    np.testing.assert_array_equal(qpos[3:first], stored.qpos[3:first])  # and so does the rotation
    # Mined slides may exceed their range, but none exceeds it further.
    low, high = scene.model.jnt_range[:3].T
    low, high = np.minimum(low, stored.qpos[:3]), np.maximum(high, stored.qpos[:3])
    assert ((qpos[:3] > low - 1e-9) & (qpos[:3] < high + 1e-9)).all()
    contact = HandContact(scene)
    assert (contact.depths(qpos) <= contact.depths(stored.qpos) + 1e-9).all()
    assert found.depth_m == contact.depth(qpos) <= OVERLAP_M + 1e-9
    assert found.object_moved_m <= 0.005
    way = np.linalg.norm(qpos[:3] - stored.qpos[:3])
    assert found.distance_m == pytest.approx(way)
    if ablation.startswith("distance"):
        np.testing.assert_array_equal(qpos[first:nu], stored.qpos[first:nu])
        wanted = float(ablation[9:11]) / 100
        assert abs(way - wanted) <= found.retreat_m + 1e-9 or task == "hammer-strike"
    else:
        mean = np.array(scene.hand.mean_fingers_rad)
        goal = np.zeros(nu - first) if ablation == "open_hand" else mean
        off = np.abs(qpos[first:nu] - goal.clip(*scene.model.jnt_range[first:nu].T)).max()
        assert off == pytest.approx(found.finger_error_rad)
        assert way == pytest.approx(found.retreat_m, abs=1e-9)
    return found


@pytest.mark.usefixtures("library_home")
@pytest.mark.parametrize("ablation", ALL)
@pytest.mark.parametrize("task", TASKS)
def test_ablated_starts_of_a_few_tasks(task: str, ablation: str) -> None:
    for pregrasp in ("planned", "mined"):
        check(task, pregrasp, ablation)


@pytest.mark.slow
@pytest.mark.usefixtures("library_home")
def test_ablated_starts_of_all_tasks() -> None:
    """The bounds that docs/ablations.md states."""
    for task in available("task"):
        for pregrasp in ("planned", "mined"):
            for ablation in ALL:
                found = check(task, pregrasp, ablation)
                assert found.retreat_m < RETREAT_M.get(task, 0.07)
                assert found.finger_error_rad < 0.6


@pytest.mark.usefixtures("library_home")
def test_the_hammer_task_hand_moves_by_the_distance_in_the_world() -> None:
    scene = builder("hammer-use1").scene
    near, middle, far = (
        posed(scene, made("hammer-use1", "planned", ablation)[1].start.qpos).geom_xpos[
            scene.index.point_geoms
        ]
        for ablation in ("none", "distance_15cm", "distance_25cm")
    )
    np.testing.assert_allclose(np.linalg.norm(middle - near, axis=1), 0.15)
    np.testing.assert_allclose(np.linalg.norm(far - near, axis=1), 0.25)
    np.testing.assert_allclose((far - near) * 0.6, middle - near, atol=1e-12)  # one line
    assert (far - near)[0, 2] > 0.1  # up, and back to where the forearm's mount is
    assert (far - near)[0, 1] < -0.1


@pytest.mark.usefixtures("library_home")
def test_a_reset_pose_that_is_nearer_is_passed() -> None:
    stored, found = made("duck-inspect1", "planned", "distance_25cm")
    to_reset = np.linalg.norm(stored.qpos[:3])
    assert to_reset == pytest.approx(0.180, abs=1e-3)
    beyond = stored.qpos[:3] * (1 - 0.25 / to_reset)
    np.testing.assert_allclose(found.start.qpos[:3], beyond, rtol=1e-9)


@pytest.mark.usefixtures("library_home")
def test_the_line_ends_at_the_limit_of_a_slide() -> None:
    _, found = made("hammer-strike", "planned", "distance_25cm")
    assert found.distance_m == pytest.approx(0.1863, abs=1e-4)
    low, high = builder("hammer-strike").scene.model.jnt_range[:3].T
    ends = np.minimum(found.start.qpos[:3] - low, high - found.start.qpos[:3])
    assert ends.min() == pytest.approx(0, abs=1e-12)


@pytest.mark.usefixtures("library_home")
def test_the_same_start_gives_the_same_result() -> None:
    first, second = (made("dhand-cup", "planned", "mean_hand")[1] for _ in range(2))
    assert first.simulated and first.finger_error_rad > 0.1
    np.testing.assert_array_equal(first.start.qpos, second.start.qpos)


@pytest.mark.usefixtures("library_home")
def test_without_an_ablation_the_start_is_the_stored_one() -> None:
    stored, found = made("hammer-use1", "planned", "none")
    assert found.start is stored
    facts = env_builder(compose(["task=hammer-use1"]), open_library()).facts()
    assert not any(name.startswith("ablation") for name in facts)


@pytest.mark.usefixtures("library_home")
def test_deviations_are_reported_in_words() -> None:
    stored, _ = made("duck-lift", "planned", "none")
    exact = Ablated(stored, 0.15, 0.0, 0.0, 0.0, False, 0.0)
    assert exact.compromises(0.15) == ""
    assert exact.compromises(0.25) == "a slide reaches its limit at 15.0 cm instead of 25.0"
    off = replace(exact, retreat_m=0.012, finger_error_rad=0.48)
    assert off.compromises(0.15) == (
        "the hand retreats 1.2 cm to touch nothing, fingers stop 0.48 rad short of their pose"
    )
    cfg = compose(["task=hammer-strike", "ablation=distance_25cm"])
    (note,) = env_builder(cfg, open_library()).notes
    assert note == (
        "ablation=distance_25cm of hammer-strike: a slide reaches its limit at 18.6 cm instead of "
        "25.0"
    )


@pytest.mark.usefixtures("library_home")
def test_envs_start_ablated_and_runs_record_it() -> None:
    env = pgdm.make_batch("dhand-cup", num_envs=2, num_threads=1, ablation="mean_hand")
    _, found = made("dhand-cup", "planned", "mean_hand")
    np.testing.assert_array_equal(env.sim.read().qpos[1].numpy(), found.start.qpos)
    cfg = compose(["task=dhand-cup", "ablation=mean_hand"])
    facts = env_builder(cfg, open_library()).facts()
    assert facts["ablation_retreat_mm"] == "0.0"
    assert float(facts["ablation_finger_error_rad"]) == pytest.approx(found.finger_error_rad, 1e-2)
    assert facts["ablation_reached_by"] == "simulation"
    assert facts["ablation_depth_mm"] == f"{1e3 * found.depth_m:.1f}"


@pytest.mark.usefixtures("library_home")
def test_a_residual_actions_path_starts_at_the_ablated_start() -> None:
    """Else the path would restore the proximity that the ablation removes."""
    overrides = ["action=residual", "ablation=distance_15cm", "action.lead_steps=0"]
    env = pgdm.make_batch("hammer-use1", num_envs=1, num_threads=1, overrides=overrides)
    still = env.mdp.actions.act(env.warm_start()[None], env.t)
    np.testing.assert_allclose(still[0, :6].numpy(), env.mdp.start.qpos[:6], atol=1e-9)


@pytest.mark.usefixtures("library_home")
def test_mean_fingers_are_those_of_the_mined_pre_grasps() -> None:
    library, rows = open_library(), {}
    hands = {name: compose([f"hand={name}"]).hand for name in available("hand")}
    models = {
        name: mujoco.MjModel.from_xml_path(str(library.hand_xml(name, "checkout")))
        for name in hands
    }
    # Of tcdm50 only: dmanus-sim2real has the pre-grasp of dmanus-crackerbox.
    for task in suite("tcdm50"):
        prefix = task.split("-")[0]
        hand = hands[prefix if prefix in hands else "adroit"]
        model, first = models[hand.name], hand.num_base_joints + hand.num_wrist_joints
        fingers = library.motion(task).starts["mined"].qpos[first : model.nu]
        rows.setdefault(hand.name, []).append(fingers.clip(*model.jnt_range[first:].T))
    assert {name: len(some) for name, some in rows.items()} == {
        "adroit": 43,
        "dhand": 5,
        "dmanus": 2,
    }
    for name, some in rows.items():
        mean = hands[name].mean_fingers_rad
        np.testing.assert_allclose(np.mean(some, axis=0), mean, atol=5.1e-5)


def test_nothing_is_left_to_ablate_without_a_pre_grasp() -> None:
    with pytest.raises(ConfigError, match=r"ablation=open_hand .* pregrasp=none .* ablation=none"):
        compose(["pregrasp=none", "ablation=open_hand"])
    assert compose(["pregrasp=none"]).ablation.name == "none"


@pytest.mark.usefixtures("library_home")
def test_a_stored_reset_pose_is_no_pre_grasp_either() -> None:
    one = builder("duck-lift")
    stored = start_state(compose(["pregrasp=mined"]).pregrasp, one.motion, one.scene)
    qpos = stored.qpos.copy()
    qpos[: one.scene.model.nu] = 0.0
    cfg = compose(["ablation=distance_15cm"]).ablation
    with pytest.raises(ConfigError, match=r"start 'mined' of task 'duck-lift' is .* reset pose"):
        ablate(cfg, replace(stored, qpos=qpos), one.scene, one.motion.substeps)


def test_wrong_values_are_named() -> None:
    good = AblationCfg("mine", "open", 0.1)
    good.check("mined")
    with pytest.raises(UnknownNameError, match="'opne'; did you mean open"):
        replace(good, fingers="opne").check("mined")
    with pytest.raises(ConfigError, match=r"distance_m is -0\.1; it must be at least 0"):
        replace(good, distance_m=-0.1).check("mined")
    with pytest.raises(ConfigError, match=r"name is 'none' with ablation\.fingers 'open'"):
        replace(good, name="none").check("mined")
    with pytest.raises(ConfigError, match=r"name is 'mine' with ablation\.fingers 'keep'"):
        AblationCfg("mine", "keep", 0.0).check("mined")


@pytest.mark.usefixtures("library_home")
def test_a_hand_without_its_mean_is_named() -> None:
    with pytest.raises(ConfigError, match=r"mean_fingers_rad has 1 number, but hand 'adroit'"):
        wrong = ["hand.mean_fingers_rad=[0.5]"]
        pgdm.make_batch("duck-lift", num_envs=1, ablation="mean_hand", overrides=wrong)


@pytest.mark.usefixtures("library_home")
def test_a_contact_sheet_shows_all_ablations(tmp_path: Path) -> None:
    line = ["view", "duck-lift", "--ablations", "--offline"]
    outcome = command("pgdm", *line, "--image", "out/sheet.png")
    if "no OpenGL" in outcome.err:
        pytest.skip(outcome.err)
    assert outcome.code == 0, outcome.err
    assert (tmp_path / "out" / "sheet.png").read_bytes()[1:4] == b"PNG"
    shown = [text.split()[0] for text in outcome.out.splitlines()]
    assert shown == ["none", *ALL, "image:"]
    assert "penetration" in outcome.out
    assert "needs --image FILE that ends in .png" in command("pgdm", *line).err
    assert "without --video" in command("pgdm", "view", "duck-lift", "--image", "a.png").err
