"""Inverse kinematics on the real scenes: targets, limits, obstacles, correspondence of fingers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import mujoco
import numpy as np
import pytest

from human_hand_points import flat_hand
from pgdm.config.store import compose
from pgdm.errors import ConfigError, UnknownNameError
from pgdm.library import open_library
from pgdm.pregrasp.ik import HandIk, solve_hand, solve_targets
from pgdm.pregrasp.keypoints import FINGERS, Keypoints
from pgdm.pregrasp.mocap import object_joints, of_expert, of_hand, retarget
from pgdm.sim.scene import Scene, build_scene

HANDS = {"adroit": 5, "dhand": 4, "dmanus": 3}
pytestmark = pytest.mark.usefixtures("expert_home")


@cache
def scene(task: str, hand: str, *more: str) -> Scene:
    cfg = compose([f"task={task}", f"hand={hand}", *more])
    return build_scene(open_library(), cfg.task, cfg.hand, cfg.sim)


@cache
def ik(task: str, hand: str) -> HandIk:
    return HandIk(scene(task, hand))


def points(one: Scene, qpos: np.ndarray) -> np.ndarray:
    data = mujoco.MjData(one.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(one.model, data)
    return data.geom_xpos[one.index.point_geoms].copy()


@pytest.mark.parametrize("hand", HANDS)
def test_a_hand_reaches_where_it_was(hand: str) -> None:
    """A pose's own points are targets that can be reached exactly."""
    one = ik("hammer-use1", hand)
    model, nu = one.scene.model, one.scene.model.nu
    low, high = model.jnt_range[:nu].T
    goal = np.zeros(model.nq)
    goal[:nu] = 0.7 * low.clip(-0.4, 0) + 0.3 * high.clip(0, 0.5)
    objects = object_joints(open_library().motion("hammer-use1"), one.scene)
    goal[nu:] = objects
    wanted = points(one.scene, goal)
    human = one.shape.keypoints(wanted)
    targets = replace(
        one.shape.targets(human), points=wanted, weights=np.ones(len(wanted)), palm_weight=0.0
    )
    result = solve_targets(one, targets, objects, free=False)
    # The pull to the mean pre-grasp, 6 mm a radian, keeps it from the last millimetres.
    assert result.fingertip_errors_m.max() < 0.006
    assert len(result.fingertip_errors_m) == HANDS[hand]
    np.testing.assert_array_equal(result.qpos[nu:], objects)
    assert (result.qpos[:nu] >= low).all() and (result.qpos[:nu] <= high).all()


@pytest.mark.parametrize(
    ("task", "hand"),
    [
        ("cup-drink1", "adroit"),
        *(
            pytest.param(task, hand, marks=pytest.mark.slow)
            for task, hand in (
                *(("cup-drink1", hand) for hand in ("dhand", "dmanus")),
                *(("flute-pass1", hand) for hand in HANDS),
            )
        ),
    ],
)
def test_a_person_s_grasp_is_taken_up_free_of_everything(task: str, hand: str) -> None:
    one, library = scene(task, hand), open_library()
    motion = library.motion(task)
    made = retarget(one, library, motion, of_expert(library.expert(task), motion))
    assert made.result.depth_m == 0.0
    assert made.errors_m.mean() < 0.02
    low, high = one.model.jnt_range[: one.model.nu].T
    hand_qpos = made.result.qpos[: one.model.nu]
    assert (hand_qpos >= low).all() and (hand_qpos <= high).all()
    # The thumb is on one side of the object and the other fingers on the other.
    tips = points(one, made.result.qpos)[one.index.fingertips]
    data = mujoco.MjData(one.model)
    data.qpos[:] = made.result.qpos
    mujoco.mj_kinematics(one.model, data)
    across = tips - data.xipos[one.index.object_body]
    if task == "cup-drink1":
        thumb = across[made.fingers.index("thumb")]
        assert all(thumb[:2] @ other[:2] < 0 for other in np.delete(across, -1, axis=0))


def test_equal_arguments_give_an_equal_pose() -> None:
    library, one = open_library(), ik("mouse-use1", "adroit")
    hand = Keypoints.of(library.expert("mouse-use1").human_joints[0])
    objects = object_joints(library.motion("mouse-use1"), one.scene)
    first, second = (solve_hand(one, hand, objects, seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.qpos, second.qpos)


def test_a_drag_is_quick_and_stays_where_it_was() -> None:
    """Another call from the last pose with one fingertip moved changes little else."""
    library, one = open_library(), ik("flute-pass1", "adroit")
    motion = library.motion("flute-pass1")
    objects = object_joints(motion, one.scene)
    hand = Keypoints.of(library.expert("flute-pass1").human_joints[0])
    first = solve_hand(one, hand, objects, free=False)
    moved = first.targets.points.copy()
    moved[one.shape.rows[0, 2]] += [0.0, 0.0, 0.01]
    targets = replace(first.targets, points=moved)
    second = solve_targets(one, targets, objects, start=first.qpos, free=False)
    assert second.fingertip_errors_m[0] < 0.006
    assert np.abs(second.qpos - first.qpos)[:6].max() < 0.1


def test_avoidance_keeps_what_is_free_out_of_the_object() -> None:
    library, one = open_library(), ik("flute-pass1", "adroit")
    objects = object_joints(library.motion("flute-pass1"), one.scene)
    targets = one.shape.targets(Keypoints.of(library.expert("flute-pass1").human_joints[0]))
    begin = one.approach(objects, targets)
    begin[2] -= 0.1  # back along the forearm
    assert one.contact.depth(begin) == 0.0
    through = one.contact.depth(one.track(targets, begin))
    around = one.contact.depth(one.track(targets, begin, steps=60, avoid=True))
    assert through > 0.003 > around


def test_fingers_follow_those_that_the_settings_name() -> None:
    human = Keypoints.of(flat_hand()).moved(np.eye(3), np.array([0.0, 0.0, 0.3]))
    shape = ik("hammer-use1", "dhand").shape
    assert shape.fingers == ("index", "middle", "little", "thumb")
    targets = shape.targets(human)
    assert targets.anchor == "pads"  # more than twice as long as a person's
    assert 2.0 < targets.scale < 3.0
    for row, name in zip(shape.rows, shape.fingers, strict=True):
        np.testing.assert_allclose(targets.points[row[2]], human.pads[FINGERS.index(name)])
    # Adroit's knuckle of the index finger lies in the human one's direction, at Adroit's distance.
    targets = ik("hammer-use1", "adroit").shape.targets(human)
    assert targets.anchor == "wrist"
    np.testing.assert_array_equal(targets.points[0], human.wrist)
    bone = targets.points[1] - human.wrist
    along = human.fingers[0, 0] - human.wrist
    np.testing.assert_allclose(bone @ along, np.linalg.norm(bone) * np.linalg.norm(along))
    assert np.linalg.norm(bone) == pytest.approx(0.100, abs=0.002)
    with pytest.raises(UnknownNameError, match="anchor 'palm'"):
        shape.targets(human, "palm")


@pytest.mark.slow
def test_a_robot_s_pose_is_a_human_hand_for_another() -> None:
    """Any motion, any hand: D'Hand's labeled pre-grasp of the cup for Adroit and D'Manus."""
    library = open_library()
    motion = library.motion("dhand-cup")
    human = of_hand(scene("dhand-cup", "dhand"), motion.starts["mined"])
    assert human.frames[0].own == ("index", "middle", "little", "thumb")
    for hand in ("adroit", "dmanus"):
        made = retarget(scene("dhand-cup", hand), library, motion, human)
        assert made.result.targets.anchor == "pads"
        assert made.result.depth_m == 0.0 and made.errors_m.mean() < 0.02


@pytest.mark.parametrize(
    ("setting", "message"),
    [
        ("hand.human_fingers=[index,ring]", "names 2 fingers, hand.fingertips has 3"),
        ("hand.human_fingers=[index,ring,toe]", "'toe'"),
        ("hand.human_fingers=[index,index,thumb]", "needs a human finger of its own"),
        ("hand.fingertips=[2,6,9]", "knuckle, middle and distal"),
    ],
)
def test_settings_that_do_not_fit_are_named(setting: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        HandIk(scene("hammer-use1", "dmanus", setting))
