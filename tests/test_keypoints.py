"""Human hands from files: what is read, and what is refused for which reason."""

from __future__ import annotations

import contextlib
import json
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from human_hand_points import flat_hand
from pgdm.errors import ConfigError, CorruptAssetError, PgdmError, UnknownNameError
from pgdm.pregrasp.retarget import recording
from pgdm.pregrasp.retarget.keypoints import FINGERS, Keypoints, filled


def as_openpose(hand: Keypoints) -> np.ndarray:
    rows = [FINGERS.index(name) for name in ("thumb", "index", "middle", "ring", "little")]
    return np.concatenate((hand.wrist[None], hand.fingers[rows].reshape(20, 3)))


def as_mano(hand: Keypoints) -> np.ndarray:
    rows = [FINGERS.index(name) for name in ("thumb", "index", "middle", "ring", "little")]
    return np.concatenate((hand.joints, hand.fingers[rows, 3]))


def test_both_orders_name_the_same_joints() -> None:
    points = flat_hand()
    hand = Keypoints.of(points)
    np.testing.assert_array_equal(hand.wrist, points[0])
    np.testing.assert_array_equal(hand.fingers[0, 0], points[1])  # index finger's knuckle
    np.testing.assert_array_equal(hand.fingers[4, 2], points[15])  # thumb's last joint
    np.testing.assert_array_equal(hand.joints, points)
    # Without tips: 2 cm along the bone before.
    np.testing.assert_allclose(hand.fingers[1, 3] - hand.fingers[1, 2], [0.0, 0.02, 0.0])
    np.testing.assert_allclose(hand.pads[1], hand.fingers[1, 2] + [0.0, 0.01, 0.0])
    for points, order in ((as_openpose(hand), None), (as_mano(hand), "mano")):
        np.testing.assert_allclose(Keypoints.of(points, order).fingers, hand.fingers)


def test_axes_of_a_palm_that_faces_down() -> None:
    hand = Keypoints.of(flat_hand())
    np.testing.assert_allclose(hand.palm()[:, 2], [0, 0, 1], atol=1e-9)  # out of the back
    assert hand.palm()[0, 0] > 0.99  # from the index to the little finger
    # The little finger's knuckle is the farthest, 98.5 mm from the wrist; then 40 + 25 mm, then
    # half of the last 20 mm.
    assert hand.span_m == pytest.approx(np.hypot(0.04, 0.09) + 0.075)


@pytest.mark.parametrize(
    ("factor", "unit"), [(1000.0, "millimetres"), (100.0, "centimetres")], ids=["mm", "cm"]
)
def test_other_units_are_recognised(factor: float, unit: str) -> None:
    with pytest.raises(ConfigError, match=f"look like {unit}.*metres"):
        Keypoints.of(factor * flat_hand())


def test_a_left_hand_is_recognised() -> None:
    with pytest.raises(ConfigError, match="left hand"):
        Keypoints.of(flat_hand() * [-1, 1, 1])


@pytest.mark.usefixtures("expert_home")
def test_every_recorded_hand_is_accepted_and_its_mirror_image_is_not() -> None:
    from pgdm.library import open_library

    library = open_library()
    for task in library.experts().experts:
        joints = library.expert(task).human_joints[::20]
        for points in joints:
            Keypoints.of(points, label=task)
            with pytest.raises(ConfigError, match="left hand"):
                Keypoints.of(points * [1, -1, 1], label=task)


def test_impossible_bones_are_refused() -> None:
    points = flat_hand()
    points[3] = points[2]
    with pytest.raises(ConfigError, match=r"index, middle to distal: 0 m"):
        Keypoints.of(points)
    points = flat_hand()
    points[15] += [0.5, 0.0, 0.0]
    with pytest.raises(ConfigError, match=r"thumb.*0\.481"):
        Keypoints.of(points)
    with pytest.raises(ConfigError, match=r"3 x 3 numbers.*16 joints or 21"):
        Keypoints.of(np.zeros((3, 3)))
    points = flat_hand()
    points[7, 1] = np.nan
    with pytest.raises(ConfigError, match="point 7 has y = nan"):
        Keypoints.of(points)
    with pytest.raises(UnknownNameError, match="order of points 'mediapipe'"):
        Keypoints.of(flat_hand(), "mediapipe")


def test_fingers_that_were_not_measured_are_filled_in() -> None:
    hand = Keypoints.of(flat_hand())
    known = {name: hand.fingers[FINGERS.index(name)] for name in ("index", "ring", "thumb")}
    whole = filled(hand.wrist, known)
    assert whole.own == ("index", "ring", "thumb")
    middle = whole.fingers[FINGERS.index("middle")]
    np.testing.assert_allclose(middle, (known["index"] + known["ring"]) / 2)
    little = whole.fingers[FINGERS.index("little")]
    np.testing.assert_allclose(little - known["ring"], (known["ring"] - known["index"]) / 2)
    with pytest.raises(ConfigError, match="two fingers besides the thumb"):
        filled(hand.wrist, {"index": hand.fingers[0], "thumb": hand.fingers[4]})


def write(path: Path, joints: np.ndarray, **more: object) -> Path:
    """Write a file of joints in the format of its extension."""
    if path.suffix == ".npz":
        np.savez(path, joints=joints, **more)  # type: ignore[arg-type]
    elif path.suffix == ".json":
        lists = {k: np.asarray(v).tolist() for k, v in more.items()}
        path.write_text(json.dumps({"joints": joints.tolist(), **lists}))
    else:
        frames = joints[None] if joints.ndim == 2 else joints
        lines = [
            f"{f},{j},{x!r},{y!r},{z!r}"
            for f, frame in enumerate(frames)
            for j, (x, y, z) in enumerate(frame.tolist())
        ]
        path.write_text("\n".join(["frame,joint,x,y,z", *lines]) + "\n")
    return path


@pytest.mark.parametrize("ending", recording.FORMATS)
def test_what_is_written_is_read(ending: str, tmp_path: Path) -> None:
    frames = flat_hand() + np.array([[[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.1]]])
    read = recording.read(write(tmp_path / f"hand{ending}", frames))
    assert len(read.frames) == 2 and read.position is None
    np.testing.assert_allclose(read.frames[1].joints, frames[1])
    one = recording.read(write(tmp_path / f"one{ending}", as_openpose(read.frames[0])))
    np.testing.assert_allclose(one.frames[0].joints, frames[0])


@pytest.mark.parametrize("ending", [".npz", ".json"])
def test_the_objects_pose_comes_with_it(ending: str, tmp_path: Path) -> None:
    pose = {"object_position": [[0.1, 0.0, 0.2]], "object_orientation": [[1.0, 0.0, 0.0, 0.0]]}
    read = recording.read(write(tmp_path / f"hand{ending}", flat_hand(), order="mano", **pose))
    assert read.position is not None and read.orientation is not None
    np.testing.assert_array_equal(read.position, [[0.1, 0.0, 0.2]])


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", "[1, 2]", "not a JSON object"),
        ("a.json", "{", "not JSON"),
        ("a.json", '{"points": []}', r"key in .*'points'; did you mean joints"),
        ("a.json", '{"order": "mano"}', "lacks 'joints'"),
        ("a.json", '{"joints": [[1, 2], [3]]}', "not an array of numbers"),
        ("a.json", '{"joints": [[[]]]}', "16 joints or 21"),
        ("a.csv", "x,y,z\n1,2,3\n", "frame,joint,x,y,z"),
        ("a.csv", "frame,joint,x,y,z\n0,0,1,2\n", "row 2"),
        ("a.csv", "frame,joint,x,y,z\n0,0,1,2,3\n0,0,1,2,3\n", "repeats joint 0 of frame 0"),
        ("a.csv", "frame,joint,x,y,z\n0,15,1,2,3\n", "1 row for 1 frame;"),
        ("a.csv", "", "frame,joint,x,y,z"),
        ("a.npz", "no zip", "not a readable .npz"),
        ("a.txt", "", r"extension of a.txt"),
    ],
)
def test_a_damaged_file_is_named(name: str, content: str, message: str, tmp_path: Path) -> None:
    (tmp_path / name).write_text(content)
    with pytest.raises(PgdmError, match=message):
        recording.read(tmp_path / name)


def test_wrong_poses_are_named(tmp_path: Path) -> None:
    half = write(tmp_path / "a.npz", flat_hand(), object_position=[0.0, 0.0, 0.0])
    with pytest.raises(CorruptAssetError, match="needs both"):
        recording.read(half)
    whole = {"object_position": [0.0, 0.0, 0.0], "object_orientation": [2.0, 0.0, 0.0, 0.0]}
    with pytest.raises(CorruptAssetError, match="not a unit quaternion"):
        recording.read(write(tmp_path / "b.npz", flat_hand(), **whole))
    evil = tmp_path / "c.npz"
    np.savez(evil, joints=np.array([Path("x")], object))
    with pytest.raises(CorruptAssetError, match="pickle asks for"):
        recording.read(evil)


def test_the_order_of_the_objects_quaternion_can_be_named(tmp_path: Path) -> None:
    turned = [0.6, 0.8, 0.0, 0.0]
    pose = {"object_position": [0.0, 0.0, 0.0], "object_orientation": turned}
    bare = recording.read(write(tmp_path / "a.npz", flat_hand(), **pose))
    assert bare.orientation.tolist() == [turned] and not bare.ordered
    assert "read as w x y z" in bare.origin
    pose = {"object_position": [0.0, 0.0, 0.0], "object_orientation": [0.8, 0.0, 0.0, 0.6]}
    named = write(tmp_path / "b.npz", flat_hand(), **pose, object_orientation_order="xyzw")
    assert recording.read(named).orientation.tolist() == [turned]
    assert recording.read(named).ordered
    wrong = write(tmp_path / "c.npz", flat_hand(), **pose, object_orientation_order="wzyx")
    with pytest.raises(PgdmError, match=r"object_orientation_order.*valid: wxyz, xyzw"):
        recording.read(wrong)


@given(
    st.recursive(
        st.none() | st.booleans() | st.floats() | st.text(max_size=5),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner),
        max_leaves=12,
    ),
    st.sampled_from(["joints", "order", "object_position", "object_orientation"]),
)
def test_any_content_raises_only_our_errors(value: object, key: str) -> None:
    with contextlib.suppress(PgdmError):
        recording.parse({"joints": flat_hand().tolist(), key: value}, "file")


def test_ragged_poses_are_named() -> None:
    with pytest.raises(CorruptAssetError, match="'object_position' is not an array of numbers"):
        recording.parse({"joints": flat_hand(), "object_position": [[0, 0, 0], [1]]}, "file")


@given(st.integers(0, 15), st.integers(0, 2), st.floats())
def test_a_changed_number_is_refused_or_still_a_hand(joint: int, axis: int, value: float) -> None:
    points = flat_hand()
    points[joint, axis] = value
    try:
        hand = Keypoints.of(points)
    except ConfigError:
        return
    assert np.isfinite(hand.fingers).all() and hand.span_m < 1.0
