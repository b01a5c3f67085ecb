from __future__ import annotations

import math
import threading
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest
import viser

from labeler_scenes import built, poses_of, state_of
from pgdm.config.compose import compose
from pgdm.errors import ConfigError, CorruptAssetError, PgdmError, RunError, UnknownNameError
from pgdm.experiment import env_builder
from pgdm.library import open_library
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.library.files.motion import Start
from pgdm.library.files.pregrasp import Pregrasp
from pgdm.pregrasp.labeler import guard, shapes
from pgdm.pregrasp.labeler import joint_names as names
from pgdm.pregrasp.labeler import poses as store
from pgdm.pregrasp.labeler.kinematics import Kinematics
from pgdm.pregrasp.labeler.mailbox import Mailbox
from pgdm.pregrasp.labeler.poses import Draft
from pgdm.pregrasp.labeler.state import LabelState
from pgdm.sim.contact import HandContact

pytestmark = pytest.mark.usefixtures("library_home")

TASK = "hammer-use1"
HANDS = ("hammer-use1", "dhand-cup", "dmanus-crackerbox")
UP = np.array([0.0, 0.0, 1.0])
INDEX_KNUCKLE = 9  # Adroit's FFJ2 in qpos


def test_joints_have_readable_names() -> None:
    joints = names.joints(built(TASK).scene)
    assert len(joints) == 30
    knuckle = joints[INDEX_KNUCKLE]
    assert (knuckle.group, knuckle.label, knuckle.name) == ("Index", "knuckle", "FFJ2")
    assert knuckle.unit == "deg" and math.isclose(knuckle.scale * math.pi, 180.0)
    # The mount is rotated: its second slide points up in the world.
    assert (joints[1].group, joints[1].label, joints[1].unit) == ("Wrist", "height", "mm")
    assert [j.label for j in joints[:6]] == [
        *("sideways", "height", "forward"),
        *("tilt", "turn", "roll"),
    ]
    for task in HANDS:
        full = [joint.full for joint in names.joints(built(task).scene)]
        assert len(set(full)) == len(full)


def test_fingers_are_the_joints_between_palm_and_tip() -> None:
    adroit = {f.name: f for f in names.fingers(built(TASK).scene)}
    assert set(adroit) == {"index", "middle", "ring", "little", "thumb"}
    assert adroit["index"].joints == (8, 9, 10, 11)
    assert adroit["little"].joints == (20, 21, 22, 23, 24)  # with the joint in the palm
    # D'Manus's second finger is little by its joints, and ring by its points.
    assert [f.name for f in names.fingers(built(HANDS[2]).scene)] == ["index", "little", "thumb"]


@pytest.mark.parametrize("task", HANDS)
def test_placing_the_wrist_is_the_inverse_of_its_pose(task: str) -> None:
    scene = built(task).scene
    kinematics, nu = Kinematics(scene), scene.model.nu
    random = np.random.default_rng(0)
    for _ in range(20):
        qpos, other = state_of(task).qpos, state_of(task).qpos
        qpos[:6] = random.uniform(kinematics.low[:6], kinematics.high[:6])
        pos, quat = kinematics.wrist_pose(qpos)
        np.testing.assert_allclose(kinematics.place_wrist(qpos, pos, quat), qpos[:nu], atol=1e-9)
        # From another pose the same place is found, perhaps by other angles.
        other[:nu] = kinematics.place_wrist(other, pos, quat)
        there, turned = kinematics.wrist_pose(other)
        np.testing.assert_allclose(there, pos, atol=1e-9)
        np.testing.assert_allclose(abs(turned @ quat), 1.0, atol=1e-9)


def test_wrist_goes_where_its_handle_goes() -> None:
    state = state_of(TASK)
    pos, quat = state.kinematics.wrist_pose(state.qpos)
    fingers = state.qpos[6:]
    state.place_wrist(pos + 0.03 * UP, quat)
    moved, same = state.kinematics.wrist_pose(state.qpos)
    np.testing.assert_allclose(moved, pos + 0.03 * UP, atol=1e-9)
    np.testing.assert_allclose(np.abs(same @ quat), 1.0, atol=1e-12)
    # The mount's second slide points up in the world, to the released model's precision.
    assert abs(state.qpos[1] - state_of(TASK).qpos[1] - 0.03) < 1e-4
    turn, turned = np.empty(4), np.empty(4)
    mujoco.mju_axisAngle2Quat(turn, UP, math.radians(20))
    mujoco.mju_mulQuat(turned, turn, quat)
    state.place_wrist(moved, turned)
    here, now = state.kinematics.wrist_pose(state.qpos)
    np.testing.assert_allclose(here, moved, atol=1e-9)  # it turns about the wrist
    assert abs(abs(now @ turned) - 1.0) < 1e-12
    np.testing.assert_array_equal(state.qpos[6:], fingers)


def test_wrist_stops_at_the_limits_of_its_slides() -> None:
    state = state_of(TASK)
    pos, quat = state.kinematics.wrist_pose(state.qpos)
    state.place_wrist(pos + 9.0 * UP, quat)
    assert state.qpos[1] == state.kinematics.high[1]


def test_angles_beyond_a_quarter_turn_are_kept() -> None:
    kinematics = Kinematics(built(TASK).scene)
    qpos = state_of(TASK).qpos
    qpos[3:6] = 0.3, 1.7, -0.4  # the middle angle is beyond pi/2, within its limit of 1.75
    pos, quat = kinematics.wrist_pose(qpos)
    np.testing.assert_allclose(kinematics.place_wrist(qpos, pos, quat)[3:6], [0.3, 1.7, -0.4])


@pytest.mark.parametrize("task", HANDS)
def test_fingertip_goes_where_it_is_dragged(task: str) -> None:
    state = state_of(task)
    kinematics, random = state.kinematics, np.random.default_rng(1)
    for finger, one in enumerate(kinematics.fingers):
        goal = state.qpos
        ids = list(one.joints)
        goal[ids] = random.uniform(kinematics.low[ids], kinematics.high[ids])
        before = state.qpos
        missed = state.place_tip(finger, kinematics.tip(goal, finger))
        assert missed < 2e-3
        others = np.setdiff1d(np.arange(len(before)), ids)
        np.testing.assert_array_equal(state.qpos[others], before[others])


def test_fingertip_out_of_reach_goes_as_near_as_it_can() -> None:
    state = state_of(TASK)
    start = state.kinematics.tip(state.qpos, 0)
    missed = state.place_tip(0, start + UP)
    assert missed > 0.8
    joints = state.qpos[:30]
    assert (joints >= state.kinematics.low).all() and (joints <= state.kinematics.high).all()


def test_drag_forth_and_back_returns_to_the_start() -> None:
    state = state_of(TASK)
    before, home = state.qpos, state.kinematics.tip(state.qpos, 0)
    for share in [*np.linspace(0, 1, 15), *np.linspace(1, 0, 15)]:
        state.place_tip(0, home + share * np.array([0.0, -0.02, 0.02]), "drag")
    assert np.abs(state.qpos - before).max() < 0.1
    state.undo()
    np.testing.assert_array_equal(state.qpos, before)
    assert not state.undo()


def test_undo_and_redo_go_by_gestures() -> None:
    state = state_of(TASK)
    first = state.qpos
    for value in (0.1, 0.2, 0.3):
        state.set_joint(INDEX_KNUCKLE, value, "one movement")
    state.set_joint(INDEX_KNUCKLE, 0.5, "another")
    state.set_joint(INDEX_KNUCKLE, 0.5, "no change")
    assert state.undo() and state.qpos[INDEX_KNUCKLE] == 0.3
    assert state.undo()
    np.testing.assert_array_equal(state.qpos, first)
    assert not state.undo()
    assert state.redo() and state.redo() and not state.redo()
    assert state.qpos[INDEX_KNUCKLE] == 0.5
    state.undo()
    state.set_joint(0, 0.05)
    assert not state.redo()
    state.reset()
    np.testing.assert_array_equal(state.qpos, first)
    assert state.undo() and state.qpos[0] == 0.05


def test_values_are_clipped_and_invalid_ones_refused() -> None:
    state = state_of(TASK)
    state.set_joint(INDEX_KNUCKLE, 99.0)
    assert state.qpos[INDEX_KNUCKLE] == state.kinematics.high[INDEX_KNUCKLE]
    with pytest.raises(ConfigError, match=r"joint 'FFJ2' \(index knuckle\) is nan"):
        state.set_joint(INDEX_KNUCKLE, math.nan)
    with pytest.raises(ConfigError, match="24 joints does not fit hand 'adroit', which has 30"):
        state.set_joints(np.zeros(24))
    with pytest.raises(ConfigError, match="not a finite po"):
        state.place_wrist(np.array([0, 0, np.inf]), np.array([1.0, 0, 0, 0]))
    with pytest.raises(ConfigError, match="not a finite po"):
        state.place_tip(0, np.full(3, np.nan))


def test_metrics_name_what_penetrates_what() -> None:
    state = state_of(TASK)
    assert state.metrics.free and state.metrics.depth_m == 0.0
    assert state.metrics.tip_distances_m.min() > 0
    state.set_joint(1, state.qpos[1] - 0.03)
    metrics = state.metrics
    contact = HandContact(state.scene)
    assert math.isclose(metrics.depth_m, contact.depth(state.qpos)) and metrics.depth_m > 0.005
    assert {touch.body for touch in metrics.touches} <= {"hammer", "table"}
    assert {touch.part for touch in metrics.touches} <= {
        *(f.name for f in state.kinematics.fingers),
        "palm",
        "forearm",
    }
    parts = {t.part for t in metrics.touches if t.body == "table"}
    assert "forearm" in parts and "palm" not in parts
    assert all(state.scene.model.body(b).name.startswith("adroit/") for b in metrics.links)
    assert f"{1e3 * metrics.depth_m:.1f} mm inside" in metrics.reason
    depths = [touch.depth_m for touch in metrics.touches]
    assert depths == sorted(depths, reverse=True)


def test_joints_outside_their_actuators_range_are_named() -> None:
    state = state_of("dhand-cup")
    assert state.metrics.beyond == ()
    state.set_joint(2, 0.65)  # its slide reaches 0.7 m, its actuator 0.5 m
    assert state.metrics.beyond == ("wrist forward",)


def test_presets() -> None:
    poses, scene = poses_of(TASK), built(TASK).scene
    assert poses.available() == ["mined", "planned", "mean", "open", "none"]
    mined = poses.load("mined")
    assert mined.notes and "adroit/LFJ3 the most, by 0.138" in mined.notes[0]
    low, high = scene.model.jnt_range[:30].T
    assert ((mined.qpos[:30] >= low) & (mined.qpos[:30] <= high)).all()
    np.testing.assert_array_equal(poses.load("open").qpos[8:30], np.zeros(22))
    np.testing.assert_array_equal(poses.load("open").qpos[:8], poses.load("planned").qpos[:8])
    np.testing.assert_allclose(poses.load("mean").qpos[8:30], scene.hand.mean_fingers_rad)
    np.testing.assert_array_equal(poses.load("none").qpos[:30], np.zeros(30))
    for name in poses.available():  # the object stays
        np.testing.assert_array_equal(poses.load(name).qpos[30:], mined.qpos[30:])
    with pytest.raises(UnknownNameError, match="unknown pose to start from 'plannd'; did you mean"):
        poses.load("plannd")
    with pytest.raises(
        ConfigError, match="no stored pose 'mocap' for hand 'adroit'; it has: mined"
    ):
        poses.load("mocap")


def test_other_hand_starts_from_its_reset_pose() -> None:
    poses = poses_of(TASK, "dhand")
    assert poses.available() == ["mean", "open", "none"]
    assert poses.first().origin == "reset pose"
    with pytest.raises(ConfigError, match="it has: mean, open, none"):
        poses.load("mined")


def test_bad_files_are_refused_or_repaired(tmp_path: Path) -> None:
    poses, qpos = poses_of(TASK), poses_of(TASK).load("planned").qpos

    def written(name: str, qpos: np.ndarray, **note: str) -> Path:
        path = tmp_path / name
        pregrasp_file.write(path, Pregrasp(Start(qpos, np.zeros(len(qpos)), None), None, note))
        return path

    with pytest.raises(ConfigError, match="is a pose of hand 'dhand', not of 'adroit'"):
        poses.load(str(written("hand.npz", qpos, hand="dhand")))
    with pytest.raises(ConfigError, match="has 30 positions, the scene with hand 'adroit' has 36"):
        poses.load(str(written("short.npz", qpos[:30])))
    nan = qpos.copy()
    nan[3] = np.nan
    with pytest.raises(CorruptAssetError, match=r"nan.npz: 'pose_qpos' has a NaN .* at \(3,\)"):
        poses.load(str(written("nan.npz", nan)))
    far = qpos.copy()
    far[0] = 3.0
    repaired = poses.load(str(written("far.npz", far, task="cup-pour1")))
    assert repaired.qpos[0] == 0.25
    assert repaired.notes[0] == "far.npz is for task cup-pour1"
    assert "adroit/ARTx the most, by 2.750" in repaired.notes[1]
    (tmp_path / "text.npz").write_text("no pre-grasp")
    with pytest.raises(CorruptAssetError, match=r"text\.npz"):
        poses.load(str(tmp_path / "text.npz"))
    with pytest.raises(ConfigError, match="there is no file"):
        poses.load(str(tmp_path / "none.npz"))


def saved(state: LabelState, anyway: bool = False) -> Path:
    path = store.path(state.scene)
    pregrasp_file.write(path, store.pregrasp(state, None, anyway, {}))
    return path


@pytest.mark.parametrize(
    ("task", "hand"), [*((task, None) for task in HANDS), (TASK, "dhand"), ("door-open", None)]
)
def test_a_saved_pose_starts_a_run(task: str, hand: str | None) -> None:
    state = state_of(task, "none" if hand else "planned", hand)
    state.set_joint(state.scene.model.nu - 2, 0.2)
    saved(state, anyway=True)
    chosen = [f"task={task}", "pregrasp=labeled", *([f"hand={hand}"] if hand else [])]
    builder = env_builder(compose(chosen), open_library())
    assert builder.mdp.start.source == "labeled"
    np.testing.assert_array_equal(builder.mdp.start.qpos, state.qpos)
    assert not builder.mdp.start.qvel.any()
    assert poses_of(task, hand).first().origin == "own labeled pre-grasp"


def test_pose_that_touches_something_is_saved_only_if_confirmed() -> None:
    state = state_of(TASK)
    state.set_joint(1, state.qpos[1] - 0.03)
    with pytest.raises(ConfigError, match=r"not saved: .* must touch nothing, but .* inside"):
        saved(state)
    assert not store.path(state.scene).exists()
    note = pregrasp_file.read(saved(state, anyway=True)).note
    assert note["saved_anyway"] == state.metrics.reason
    assert note["depth_m"] == state.metrics.depth_m and note["hand"] == "adroit"


def test_a_damaged_label_is_an_error_that_names_the_file() -> None:
    path = saved(state_of(TASK))
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(CorruptAssetError, match=r"labeled\.npz"):
        env_builder(compose([f"task={TASK}", "pregrasp=labeled"]), open_library())


def wait_for(path: Path, seconds: float = 10.0) -> None:
    end = time.monotonic() + seconds
    while not path.is_file():
        assert time.monotonic() < end
        time.sleep(0.02)


def test_draft_outlives_its_labeler() -> None:
    state = state_of(TASK)
    path = store.draft_path(state.scene)
    draft = Draft(state.scene)
    assert draft.found(poses_of(TASK)) is None
    state.set_joint(0, 0.07)
    draft.keep(state.qpos)
    wait_for(path)
    with pytest.raises(RunError, match=r"hammer-use1' with hand 'adroit' is open in another"):
        Draft(state.scene)
    state.set_joint(0, 0.08)
    draft.keep(state.qpos)
    draft.close()
    assert [p.name for p in path.parent.iterdir() if p.name[0] != "."] == [path.name]
    again = Draft(state.scene)
    found = again.found(poses_of(TASK))
    assert found is not None and found.qpos[0] == 0.08 and "unsaved draft" in found.origin
    again.drop()
    again.close()
    assert not path.exists()


def test_damaged_draft_is_set_aside() -> None:
    scene = built(TASK).scene
    path = store.draft_path(scene)
    path.parent.mkdir(parents=True)
    path.write_bytes(b"half a file")
    draft = Draft(scene)
    found = draft.found(poses_of(TASK))
    assert found is not None and found.origin == "planned pre-grasp"
    assert "kept as labeled.draft-before-1.npz" in found.notes[-1]
    path.write_bytes(b"half another")
    assert draft.set_aside().name == "labeled.draft-before-2.npz"
    kept = [path.with_name(f"labeled.draft-before-{i}.npz").read_bytes() for i in (1, 2)]
    assert kept == [b"half a file", b"half another"]
    draft.close()


def test_draft_that_cannot_be_written_keeps_the_error() -> None:
    scene = built(TASK).scene
    draft = Draft(scene)
    store.draft_path(scene).mkdir()
    draft.keep(state_of(TASK).qpos)
    draft.close()
    assert draft.error is not None


def test_mailbox_runs_actions_in_order_and_drops_overtaken_ones() -> None:
    told: list[str] = []
    done: list[object] = []
    gate = threading.Event()
    box = Mailbox(told.append)
    box.post(lambda: gate.wait(10) and None)
    for value in range(100):
        box.post(lambda value=value: done.append(value), "slider")
    box.post(lambda: done.append("button"))
    box.post(lambda: done.append("again"), "slider")

    def wrong() -> None:
        raise ConfigError("a wrong value")

    def defect() -> None:
        raise ZeroDivisionError("1/0")

    box.post(wrong)
    box.post(defect)
    gate.set()
    assert box.wait(10)
    assert done == [99, "button", "again"]
    assert told == ["a wrong value", "bug in pgdm: ZeroDivisionError: 1/0"]
    box.close()


@pytest.mark.parametrize("task", HANDS)
def test_shapes_are_where_the_geoms_are(task: str) -> None:
    scene = built(task).scene
    model = scene.model
    drawn = shapes.visible(scene)
    names_ = {model.body(shape.body).name for shape in drawn}
    assert "table" in names_ and model.body(scene.index.object_body).name in names_
    assert sum(len(shape.faces) for shape in drawn) < 120_000
    for shape in [*drawn, *shapes.solid(scene)]:
        assert np.isfinite(shape.vertices).all() and shape.faces.max() < len(shape.vertices)
        first = model.body_geomadr[shape.body]
        ends = []
        for geom in range(first, first + model.body_geomnum[shape.body]):
            middle, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
            turn = np.empty(9)
            mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
            corners = middle + half * np.array(np.meshgrid(*[[-1, 1]] * 3)).reshape(3, 8).T
            ends.append(corners @ turn.reshape(3, 3).T + model.geom_pos[geom])
        low, high = np.concatenate(ends).min(0), np.concatenate(ends).max(0)
        assert (shape.vertices.min(0) >= low - 2e-3).all()
        assert (shape.vertices.max(0) <= high + 2e-3).all()


def test_object_hand_and_table_differ_in_colour() -> None:
    scene = built(TASK).scene
    colours = {scene.model.body(s.body).name: s.rgb for s in shapes.visible(scene)}
    assert colours["hammer/object"] != colours["adroit/palm"] != colours["table"]


def test_the_private_interface_of_viser_is_the_one_checked() -> None:
    assert viser.__version__ == guard.VISER, "check guard.secure against this viser, then set VISER"


def test_a_viser_with_another_private_interface_is_refused() -> None:
    server = guard.open_server(0)
    del server._websock_server._live_connections
    with pytest.raises(PgdmError, match=rf"viser {viser.__version__} cannot be .* viser=="):
        guard.secure(server)
    guard.close_server(server)
