"""Inverse kinematics on the real scenes: targets, limits, obstacles, correspondence of fingers."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from human_hand_points import flat_hand
from pgdm.errors import ConfigError, UnknownNameError
from pgdm.library import open_library
from pgdm.pregrasp.hand_geometry import posed
from pgdm.pregrasp.retarget.hand_ik import HandIk
from pgdm.pregrasp.retarget.ik import solve_hand
from pgdm.pregrasp.retarget.keypoints import FINGERS, Keypoints
from pgdm.pregrasp.retarget.mocap import of_expert, of_hand, retarget
from pgdm.pregrasp.sources import object_joints
from pgdm.sim.scene import Scene
from task_scenes import opened

HANDS = {"adroit": 5, "dhand": 4, "dmanus": 3}
pytestmark = pytest.mark.usefixtures("expert_home")


def scene(task: str, hand: str, *settings: str) -> Scene:
    return opened(task, hand, *settings)[0]


@cache
def ik(task: str, hand: str) -> HandIk:
    return HandIk(scene(task, hand))


def points(one: Scene, qpos: np.ndarray) -> np.ndarray:
    return posed(one, qpos).geom_xpos[one.index.point_geoms]


@pytest.mark.parametrize("hand", HANDS)
def test_a_hand_reaches_its_own_points(hand: str) -> None:
    """The points of a pose are targets that can be reached exactly."""
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
    result = one.result(one.track(targets, one.approach(objects, targets)), targets)
    # The pull towards the mean pre-grasp, 6 mm per radian, leaves a few millimetres.
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
def test_a_human_grasp_is_followed_without_contact(task: str, hand: str) -> None:
    one, library = scene(task, hand), open_library()
    motion = library.motion(task)
    made = retarget(one, library, motion, of_expert(library.expert(task), motion))
    assert made.result.depth_m == 0.0
    assert made.errors_m.mean() < 0.02
    low, high = one.model.jnt_range[: one.model.nu].T
    hand_qpos = made.result.qpos[: one.model.nu]
    assert (hand_qpos >= low).all() and (hand_qpos <= high).all()
    # The thumb is on one side of the object and the fingers are on the other.
    tips = points(one, made.result.qpos)[one.index.fingertips]
    across = tips - posed(one, made.result.qpos).xipos[one.index.object_body]
    if task == "cup-drink1":
        thumb = across[made.fingers.index("thumb")]
        assert all(thumb[:2] @ other[:2] < 0 for other in np.delete(across, -1, axis=0))


def test_equal_arguments_give_an_equal_pose() -> None:
    library, one = open_library(), ik("mouse-use1", "adroit")
    hand = Keypoints.of(library.expert("mouse-use1").human_joints[0])
    objects = object_joints(library.motion("mouse-use1"), one.scene)
    first, second = (solve_hand(one, hand, objects, seed=3) for _ in range(2))
    np.testing.assert_array_equal(first.qpos, second.qpos)


def test_avoidance_keeps_a_free_hand_out_of_the_object() -> None:
    library, one = open_library(), ik("flute-pass1", "adroit")
    objects = object_joints(library.motion("flute-pass1"), one.scene)
    targets = one.shape.targets(Keypoints.of(library.expert("flute-pass1").human_joints[0]))
    begin = one.approach(objects, targets)
    begin[2] -= 0.1  # back along the forearm
    assert one.contact.depth(begin) == 0.0
    through = one.contact.depth(one.track(targets, begin))
    around = one.contact.depth(one.track(targets, begin, steps=60, avoid=True))
    assert through > 0.003 > around


def test_fingers_follow_the_human_fingers_of_the_settings() -> None:
    human = Keypoints.of(flat_hand()).moved(np.eye(3), np.array([0.0, 0.0, 0.3]))
    shape = ik("hammer-use1", "dhand").shape
    assert shape.fingers == ("index", "middle", "little", "thumb")
    targets = shape.targets(human)
    assert targets.anchor == "pads"  # more than twice as long as a person's
    assert 2.0 < targets.scale < 3.0
    for row, name in zip(shape.rows, shape.fingers, strict=True):
        np.testing.assert_allclose(targets.points[row[2]], human.pads[FINGERS.index(name)])
    # Adroit's index knuckle is in the direction of the human one, at Adroit's distance.
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
    """Any task, any hand: D'Hand's pre-grasp of the cup for Adroit and D'Manus."""
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
        ("hand.human_fingers=[index,index,thumb]", "needs its own human finger"),
        ("hand.fingertips=[2,6,9]", "knuckle, middle and distal"),
    ],
)
def test_settings_that_do_not_fit_are_refused(setting: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        HandIk(scene("hammer-use1", "dmanus", setting))
