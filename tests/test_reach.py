"""The reach planner: its parts by hand, its plans on real scenes, and their users."""

from __future__ import annotations

import signal
import subprocess
import sys
import time
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

import pgdm
from command_line import command
from pgdm.cem import CemCfg, CrossEntropy
from pgdm.errors import ConfigError, SceneError
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.make import make_gym
from pgdm.pregrasp.hand_geometry import opposing_finger
from pgdm.pregrasp.reach import stored as plans
from pgdm.pregrasp.reach.plan import Goal, ReachPlan, measure
from pgdm.pregrasp.reach.planner import REACH, default_steps, plan_reach
from pgdm.pregrasp.reach.rollout import Rollouts, play, to_actions, to_targets
from pgdm.pregrasp.reach.waypoints import Waypoints
from pgdm.pregrasp.sources import reset_pose
from pgdm.sim.contact import HandContact
from task_scenes import opened

EASY = "banana-pass1"
"""A task whose first candidates already reach the pre-grasp."""


@cache
def planned(task: str) -> ReachPlan:
    scene, motion = opened(task)
    target = plans.pose_of("mined", motion, scene)
    return plan_reach(scene, target, motion.substeps, num_threads=1)


def store(task: str) -> ReachPlan:
    scene, motion = opened(task)
    plan = planned(task)
    plans.store(scene, "mined", plans.pose_of("mined", motion, scene), plan)
    return plan


def test_the_search_finds_the_minimum_of_a_quadratic() -> None:
    goal = np.array([1.0, -2.0, 0.5])
    search = CrossEntropy(
        np.zeros(3), np.ones(3), CemCfg(40, 6, 0.2, least=0.1), np.random.default_rng(0)
    )
    for _ in range(30):
        samples = search.ask()
        search.tell(samples, ((samples - goal) ** 2).sum(1))
    np.testing.assert_allclose(search.mean, goal, atol=0.15)


def test_a_round_of_the_search_by_hand() -> None:
    cfg = CemCfg(population=4, elites=2, smoothing=0.5)
    search = CrossEntropy(np.zeros(1), np.ones(1), cfg, np.random.default_rng(0))
    asked = search.ask()
    np.testing.assert_array_equal(asked[:, 0], np.random.default_rng(0).standard_normal(4))
    samples = np.array([[4.0], [2.0], [9.0], [0.0]])
    elites = search.tell(samples, np.array([1.0, 0.5, np.inf, 3.0]))
    assert elites.tolist() == [1, 0]
    assert search.mean[0] == pytest.approx(0.5 * 0.0 + 0.5 * 3.0)
    assert search.std[0] == pytest.approx(0.5 * 1.0 + 0.5 * 1.0)  # of 2 and 4
    wide = CrossEntropy(np.zeros(1), np.ones(1), replace(cfg, added=0.1), np.random.default_rng(0))
    wide.tell(samples, np.array([1.0, 0.5, np.inf, 3.0]))
    assert wide.std[0] == pytest.approx(1.1)
    frozen = CrossEntropy(np.zeros(1), np.full(1, 2.0), CemCfg(4, 1, least=0.3), None)
    frozen.tell(samples, np.arange(4.0))
    assert frozen.std[0] == pytest.approx(0.6)
    # If everything diverged, the mean stays.
    assert not len(search.tell(samples, np.full(4, np.inf)))
    assert search.mean[0] == pytest.approx(1.5)


@pytest.mark.usefixtures("library_home")
def test_actions_scale_with_half_the_control_range() -> None:
    index = opened("hammer-use1")[0].index
    targets = np.zeros(index.num_actuators)
    targets[2] = 0.3  # of -0.3..0.5
    actions = to_actions(index, targets)
    assert actions[2] == pytest.approx((0.3 - 0.1) / 0.4)
    np.testing.assert_allclose(to_targets(index, actions), targets, atol=1e-12)
    assert to_targets(index, np.full_like(actions, 9.0))[2] == pytest.approx(0.5)


@pytest.mark.usefixtures("library_home")
@pytest.mark.parametrize(
    ("task", "first", "steps"),
    [
        ("hammer-use1", "adroit/THJ4", 40),
        ("dhand-cup", "dhand/TF_MCP", 40),
        ("dmanus-crackerbox", "dmanus/TFJ1", 60),
    ],
)
def test_thumb_and_length_of_each_hand(task: str, first: str, steps: int) -> None:
    scene, _ = opened(task)
    contact = HandContact(scene)
    thumb = opposing_finger(scene, contact)
    joint = contact.first_finger_joint + int(np.argmax(contact.finger_of_joint == thumb))
    assert scene.model.joint(joint).name == first
    assert default_steps(scene) == steps


@pytest.mark.usefixtures("library_home")
def test_a_path_has_the_three_stages() -> None:
    scene, motion = opened("hammer-use1")
    goal = Goal(scene, plans.pose_of("mined", motion, scene))
    paths = Waypoints(scene, goal.joints, goal.qpos, 40, 8, 0.04)
    mean, _ = paths.prior((0.003, 0.02, 0.03))
    targets = paths.targets(mean[None])[0]
    np.testing.assert_allclose(targets[-1], goal.joints, atol=1e-9)  # and holds there
    np.testing.assert_allclose(targets[-7], goal.joints, atol=1e-9)
    index = scene.index
    assert (targets >= index.ctrl_low - 1e-12).all()
    assert (targets <= index.ctrl_high + 1e-12).all()
    # The mount's second slide points up: the hand rises above both ends of its path.
    assert targets[:, 1].max() > max(0.0, goal.joints[1]) + 0.05
    # The thumb, joints from 25, arrives before the other fingers.
    off = np.abs(targets - goal.joints) > 0.02
    last = off.cumsum(0).argmax(0)  # last step in which a joint is off
    assert last[25:].max() < last[8:25].max()


@pytest.mark.usefixtures("library_home")
def test_joints_coupled_by_a_tendon_share_the_error_that_remains() -> None:
    scene, motion = opened("flashlight-lift")
    goal = Goal(scene, plans.pose_of("mined", motion, scene))
    rollouts = Rollouts(scene, reset_pose(scene, goal.qpos), 1, motion.substeps, 1)
    paths = Waypoints(scene, goal.joints, goal.qpos, 40, 8, 0.04)
    tolerance = goal.tolerance
    aim, extra = rollouts.settled(paths.above, 0.4 * tolerance, 0.7 * tolerance, 0.6)
    # The little finger's last joints, 23 and 24, are coupled: 0.01 and 0.33 rad is impossible.
    shift = aim - paths.above
    assert shift[23] == pytest.approx(0.07)
    assert shift[24] == pytest.approx(-0.07)
    index = scene.index
    assert (aim + extra >= index.ctrl_low - 1e-12).all()
    assert (aim + extra <= index.ctrl_high + 1e-12).all()


@pytest.mark.usefixtures("library_home")
def test_the_published_plan_is_measured_as_known() -> None:
    scene, motion = opened("hammer-use1")
    stored = plans.published(motion, scene)
    assert stored is not None
    assert stored.actions is not None
    target = plans.pose_of("mined", motion, scene)
    plan = measure(scene, stored.actions, target, motion.substeps)
    assert plan.base_error_m == pytest.approx(0.0072, abs=2e-4)
    assert plan.beyond_rad == pytest.approx(0.1378, abs=1e-3)  # LFJ3 at -0.574 of -0.436
    assert plan.object_moved_m == pytest.approx(0.001, abs=2e-4)
    # Two joints coupled by a tendon cannot bend as in the pre-grasp.
    assert plan.failures == ["fingers 0.112 rad off"]
    plan = replace(plan, finger_error_rad=0.09)
    assert plan.reached
    pushed = replace(plan, object_moved_m=0.0071, depth_m=0.002)
    assert pushed.failures == ["object 7.1 mm moved", "hand 2 mm inside something"]
    assert not pushed.reached
    assert not replace(plan, base_error_m=float("nan")).reached


@pytest.mark.usefixtures("library_home")
def test_a_plan_reaches_and_replays_exactly() -> None:
    scene, motion = opened(EASY)
    plan = planned(EASY)
    assert plan.reached
    assert plan.actions.shape == (40, scene.model.nu)
    assert np.abs(plan.actions).max() <= 1.0
    target = plans.pose_of("mined", motion, scene)
    played = play(scene, plan.actions, reset_pose(scene, target), motion.substeps)
    assert not played.qpos[0, : scene.model.nu].any()
    np.testing.assert_array_equal(played.qpos[-1], plan.state.qpos)
    np.testing.assert_array_equal(played.qvel[-1], plan.state.qvel)
    again = measure(scene, plan.actions, target, motion.substeps)
    assert again.base_error_m == plan.base_error_m
    assert again.object_moved_m == plan.object_moved_m


@pytest.mark.usefixtures("library_home")
def test_equal_seeds_give_equal_plans_whatever_the_threads() -> None:
    scene, motion = opened(EASY)
    target = plans.pose_of("mined", motion, scene)
    short = replace(REACH, cem=CemCfg(6, 2, 0.3), rounds=2, margin=0.1)

    def made(seed: int, threads: int) -> np.ndarray:
        return plan_reach(scene, target, motion.substeps, short, seed, threads).actions

    first = made(0, 1)
    np.testing.assert_array_equal(first, made(0, 2))
    assert not np.array_equal(first, made(1, 1))


@pytest.mark.usefixtures("library_home")
def test_a_target_that_does_not_fit_is_refused() -> None:
    scene, motion = opened(EASY)
    with pytest.raises(SceneError, match=r"shape \(3,\).*36 finite positions"):
        plan_reach(scene, np.zeros(3), motion.substeps)
    with pytest.raises(SceneError, match="finite"):
        plan_reach(scene, np.full(scene.model.nq, np.nan), motion.substeps)
    with pytest.raises(ConfigError, match="another hand"):
        play(scene, np.zeros((5, 24)), np.zeros(scene.model.nq), motion.substeps)


@pytest.mark.usefixtures("library_home")
def test_an_episode_can_begin_with_the_reach() -> None:
    plan = store(EASY)
    env = make_gym(EASY)
    at_start, _ = env.reset()
    np.testing.assert_array_equal(env.data.qpos, plan.state.qpos)
    reached, _ = env.reset(options={"reach": True})
    np.testing.assert_array_equal(env.data.qpos, plan.state.qpos)
    np.testing.assert_array_equal(reached, at_start)
    _, _, terminated, truncated, info = env.step(np.zeros(30, np.float32))
    assert not terminated
    assert not truncated
    assert info["object_error_m"] < 0.05
    with pytest.raises(ConfigError, match="unknown reset option 'raech'; did you mean reach"):
        env.reset(options={"raech": True})
    with pytest.raises(ConfigError, match="reset option 'reach' is 'no'; valid: True, False"):
        env.reset(options={"reach": "no"})


@pytest.mark.usefixtures("library_home")
@pytest.mark.parametrize("choice", [{"pregrasp": "none"}, {"ablation": "open_hand"}])
def test_without_a_plan_the_reach_is_an_error(choice: dict[str, str]) -> None:
    env = make_gym(EASY, **choice)
    with pytest.raises(ConfigError, match=f"no plan leads to .*pgdm pregrasp reach {EASY}"):
        env.reset(options={"reach": True})


@pytest.mark.usefixtures("library_home")
def test_plans_are_stored_found_and_kept() -> None:
    kept = command("pgdm", "pregrasp", "reach", EASY)
    assert kept.code == 0
    assert "published plan kept (--replace" in kept.out
    assert pregrasp_file.own(EASY, "adroit") == []
    made = command("pgdm", "pregrasp", "reach", EASY, "--replace")
    assert (made.code, made.errors) == (0, [])
    assert "stored" in made.out
    own = pregrasp_file.find(EASY, "adroit", "planned")
    assert own is not None
    assert own.reached is not None
    np.testing.assert_array_equal(own.reached.qpos, planned(EASY).state.qpos)
    assert own.note["reach"]["reached"] is True
    np.testing.assert_array_equal(own.pose.qpos, opened(EASY)[1].starts["mined"].qpos)
    # The same command resumes: a plan that it has found is not searched again.
    again = command("pgdm", "pregrasp", "reach", EASY, "--replace")
    assert "own plan kept (this search made it)" in again.out


@pytest.mark.usefixtures("library_home")
def test_plans_to_own_pregrasps_are_stored_with_them() -> None:
    scene, motion = opened(EASY)
    pose = motion.starts["mined"]
    path = pregrasp_file.path_of(EASY, "adroit", "labeled")
    pregrasp_file.write(path, pregrasp_file.Pregrasp(pose, None, {"by": "me"}))
    made = command("pgdm", "pregrasp", "reach", EASY, "--source", "labeled")
    assert made.code == 0
    own = pregrasp_file.read(path)
    assert own.reached is not None
    assert own.note["by"] == "me"
    assert "own plan kept" in command("pgdm", "pregrasp", "reach", EASY, "--source", "labeled").out
    start = pgdm.make_batch(EASY, num_envs=1, pregrasp="labeled").mdp.start
    np.testing.assert_array_equal(start.qpos, own.reached.qpos)
    assert start.reach is not None
    assert not start.reach.qpos[: scene.model.nu].any()


@pytest.mark.usefixtures("library_home")
def test_failures_are_listed_and_set_the_exit_code() -> None:
    failed = command("pgdm", "pregrasp", "reach", EASY, "--source", "mocap")
    assert failed.code == 1
    assert f"failed: {EASY}: task '{EASY}' has no pre-grasp 'mocap'" in failed.err
    wrong = command("pgdm", "pregrasp", "reach", EASY, "--source", "moccap")
    assert wrong.code == 2
    assert "unknown --source 'moccap'; did you mean mocap? valid: labeled" in wrong.errors[0]
    both = command("pgdm", "view", EASY, "--reach", "--expert")
    told = "error: --reach, --wrist, --ablations and --expert exclude each other"
    assert both.errors == [told]


@pytest.mark.slow
@pytest.mark.usefixtures("library_home")
def test_a_plan_is_filmed(tmp_path: Path) -> None:
    film = tmp_path / "reach.mp4"
    assert command("pgdm", "view", EASY, "--reach", "--video", str(film)).code == 0
    assert film.stat().st_size > 10_000
    none = command("pgdm", "view", EASY, "--reach", "--pregrasp", "mined", "--video", str(film))
    assert none.errors[0].startswith(f"error: no plan leads to the start 'mined' of task '{EASY}'")


@pytest.mark.slow
@pytest.mark.usefixtures("library_home")
def test_a_stopped_command_keeps_finished_plans() -> None:
    code = "import sys; from pgdm.cli.main import main; sys.exit(main(sys.argv[1:]))"
    words = "pregrasp", "reach", EASY, "mug-drink3", "--replace"
    running = subprocess.Popen(
        [sys.executable, "-c", code, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    path = pregrasp_file.path_of(EASY, "adroit", "planned")
    for _ in range(600):
        if path.is_file() or running.poll() is not None:
            break
        time.sleep(0.1)
    time.sleep(1)  # until it is also in the table
    running.send_signal(signal.SIGINT)
    out, err = running.communicate(timeout=300)
    assert running.returncode == 130
    assert "plans that the table shows as stored are kept" in err
    assert f"{EASY}  stored" in out
    assert pregrasp_file.own(EASY, "adroit") == ["planned"]


@pytest.mark.slow
@pytest.mark.usefixtures("library_home")
@pytest.mark.parametrize("task", ["wineglass-drink1", "dmanus-crackerbox", "door-open"])
def test_plans_of_other_hands_and_scenes(task: str) -> None:
    assert planned(task).reached


def test_a_search_that_cannot_work_is_refused() -> None:
    REACH.check()
    with pytest.raises(ConfigError, match="8 steps has no time to move: during the last 8"):
        replace(REACH, steps=8).check()
    with pytest.raises(ConfigError, match="4 elites of 4 candidates"):
        replace(REACH, cem=CemCfg(4, 4, 0.3)).check()
