"""Quality of pre-grasps: how hands close, where palms face, and what lifts."""

from __future__ import annotations

import json
import math
from pathlib import Path

import mujoco
import numpy as np
import pytest

from command_line import command
from pgdm.errors import ConfigError
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.pregrasp.flexion import Flexion
from pgdm.pregrasp.hand_geometry import posed
from pgdm.pregrasp.quality import LiftTest, quality
from pgdm.pregrasp.sources import reset_pose
from pgdm.sim.contact import FAR_M, FingertipDistance
from task_scenes import opened

BOX = "dmanus-crackerbox"


CLOSING = {
    "hammer-use1": "FFJ2+ FFJ1+ FFJ0+ MFJ2+ MFJ1+ MFJ0+ RFJ2+ RFJ1+ RFJ0+ "
    "LFJ4+ LFJ2+ LFJ1+ LFJ0+ THJ1- THJ0-",
    "dhand-cup": "FF_MCP+ FF_PIP+ FF_DIP+ MF_MCP+ MF_PIP+ MF_DIP+ PF_MCP+ PF_PIP+ PF_DIP+ "
    "TF_MCP+ TF_PIP+ TF_DIP+",
    BOX: "TFJ1- TFJ2+ TFJ2e+ TFJ3+ IFJ2+ IFJ3+ LFJ2+ LFJ3+",
}
"""Joints that bend a finger, and the end of their range that is closed, from the models."""


@pytest.mark.usefixtures("library_home")
@pytest.mark.parametrize("task", CLOSING)
def test_which_way_each_hand_closes(task: str) -> None:
    model, flexion = opened(task)[0].model, Flexion(opened(task)[0])
    found = []
    for i, closed in enumerate(flexion.closed):
        if not np.isnan(closed):
            name = model.joint(flexion.first + i).name.split("/")[1]
            found.append(name + "-+"[int(closed == model.jnt_range[flexion.first + i, 1])])
    assert found == CLOSING[task].split()


@pytest.mark.usefixtures("library_home")
@pytest.mark.parametrize("task", CLOSING)
def test_palms_face_down_in_the_reset_pose(task: str) -> None:
    scene, motion = opened(task)
    flexion = Flexion(scene)
    _, normal = flexion.palm(reset_pose(scene, motion.starts["mined"].qpos))
    assert normal @ [0.0, 0.0, -1.0] > 0.99
    # The third base hinge turns the hand about its long axis: after half a turn it faces up.
    turned = reset_pose(scene, motion.starts["mined"].qpos)
    turned[5] = np.pi
    assert flexion.palm(turned)[1] @ [0.0, 0.0, 1.0] > 0.95


@pytest.mark.usefixtures("library_home")
def test_fingertip_distance_follows_the_object() -> None:
    scene, motion = opened("spheremedium-lift")

    def far(shift: tuple[float, float, float]) -> np.ndarray:
        qpos = motion.starts["mined"].qpos.copy()
        qpos[scene.model.nu : scene.model.nu + 3] += shift
        return FingertipDistance(scene)(posed(scene, qpos))

    near = far((0.0, 0.0, 0.0))
    assert near.shape == (5,)
    assert (near < 0.06).all()
    assert (near > 0).all()
    # Far away, moving a ball by 0.1 m changes the distance by 0.1 m.
    gone = far((0.0, 0.3, 0.0))
    np.testing.assert_allclose(far((0.0, 0.4, 0.0)) - gone, 0.1, atol=0.015)
    np.testing.assert_array_equal(far((0.0, 3.0, 0.0)), FAR_M)


@pytest.mark.usefixtures("library_home")
@pytest.mark.parametrize("task", [*CLOSING, "door-open"])
def test_fingertip_distance_is_that_of_the_last_link_with_collision_geoms(task: str) -> None:
    """Some fingertips' points are on separate bodies, which cannot touch anything."""
    scene, motion = opened(task)
    model, index, data = scene.model, scene.index, posed(scene, motion.starts["mined"].qpos)
    of_object = model.body_weldid[model.geom_bodyid] == model.body_weldid[index.object_body]
    solid = (model.geom_contype != 0) & of_object
    for point, distance in zip(index.fingertips, FingertipDistance(scene)(data), strict=True):
        ball = int(index.point_geoms[point])
        apart = (
            mujoco.mj_geomDistance(model, data, ball, geom, FAR_M, None)
            for geom in np.flatnonzero(solid).tolist()
        )
        away = min(apart) + model.geom_size[ball, 0]  # from the point, which is in the link
        assert away - 0.03 < distance < away


@pytest.mark.usefixtures("library_home")
def test_a_good_pregrasp_lifts_and_a_hand_far_away_does_not() -> None:
    scene, motion = opened(BOX)
    mined = motion.starts["mined"]
    lift = LiftTest(scene, motion.substeps, num_policies=8, num_threads=1)
    good = quality(scene, mined.qpos, motion.substeps, lift)
    assert good.free
    assert good.lift_rate >= 0.5
    assert good.fingertip_distance_m == pytest.approx(0.0115, abs=0.001)
    assert good.palm_angle_rad < math.radians(30)
    away = quality(scene, reset_pose(scene, mined.qpos), motion.substeps, lift)
    assert away.lift_rate == 0.0
    assert away.fingertip_distance_m > 0.1
    other = LiftTest(scene, motion.substeps, num_policies=8, num_threads=2)
    np.testing.assert_array_equal(lift.lifted(mined), other.lifted(mined))
    without = quality(scene, mined.qpos, motion.substeps, None)
    assert math.isnan(without.lift_rate)
    with pytest.raises(ConfigError, match="another scene or number of substeps"):
        quality(scene, mined.qpos, motion.substeps + 1, lift)


@pytest.mark.usefixtures("library_home")
def test_a_hand_inside_something_is_not_free() -> None:
    scene, motion = opened("mug-drink3")
    found = quality(scene, motion.starts["mined"].qpos, motion.substeps, None)
    assert not found.free
    assert found.depth_m == pytest.approx(0.0153, abs=5e-4)


@pytest.mark.usefixtures("library_home")
def test_a_door_cannot_be_lifted() -> None:
    scene, motion = opened("door-open")
    assert math.isnan(LiftTest(scene, motion.substeps, 2)(motion.starts["mined"]))


@pytest.mark.usefixtures("library_home")
def test_checking_all_sources_and_one_file(tmp_path: Path) -> None:
    motion = opened(BOX)[1]
    path = pregrasp_file.path_of(BOX, "dmanus", "labeled")
    pose = motion.starts["mined"]
    pregrasp_file.write(path, pregrasp_file.Pregrasp(pose, None, {}))
    metrics = tmp_path / "metrics.json"
    quick = "--policies", "2"
    done = command("pgdm", "pregrasp", "check", BOX, *quick, "--json", str(metrics))
    assert done.code == 0
    rows = json.loads(metrics.read_text())
    assert {row["source"] for row in rows} == {"mined", "planned", "labeled"}
    by_source = {row["source"]: row for row in rows}
    assert by_source["labeled"]["reachable"] is None
    assert "not tried (--reach)" in done.out
    assert by_source["mined"]["reachable"] is False  # the released plan is 16.6 mm off
    assert "base 16.6 mm off" in done.out
    assert all(row["free"] for row in rows)
    one = command("pgdm", "pregrasp", "check", str(path), *quick)
    assert one.code == 0
    assert "labeled" in one.out


@pytest.mark.usefixtures("library_home")
def test_what_cannot_be_checked_is_named(tmp_path: Path) -> None:
    missing = command("pgdm", "pregrasp", "check", BOX, "--source", "labeled")
    assert missing.code == 2
    assert missing.errors[0].startswith(f"error: task '{BOX}' has no pre-grasp labeled")
    pose = opened(BOX)[1].starts["mined"]
    stray = tmp_path / "some" / "where" / "pose.npz"
    pregrasp_file.write(stray, pregrasp_file.Pregrasp(pose, None, {}))
    whose = command("pgdm", "pregrasp", "check", str(stray))
    assert "which task and hand is it for?" in whose.errors[0]
    wrong = pregrasp_file.path_of("hammer-use1", "adroit", "labeled")
    pregrasp_file.write(wrong, pregrasp_file.Pregrasp(pose, None, {}))
    misfit = command("pgdm", "pregrasp", "check", str(wrong))
    assert "has 22 positions; the scene of task 'hammer-use1'" in misfit.errors[0]
