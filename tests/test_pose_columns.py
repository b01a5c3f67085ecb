"""Poses from other people's files: columns by their names, and the order of a quaternion."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from pgdm.author.motion import MotionRequest
from pgdm.author.task import TaskRequest, author_task
from pgdm.errors import ConfigError, PgdmError
from pgdm.library import open_library
from pgdm.library.authored.object import ObjectRequest, author_object
from pgdm.library.files import keyframes
from pgdm.library.files import poses as pose_file
from pgdm.library.files.columns import check_order
from recorded_poses import line

LAST = ["x", "y", "z", "qx", "qy", "qz", "qw"]
SCALAR_LAST = [0, 1, 2, 4, 5, 6, 3]


def turned(rows: np.ndarray, angle: float = 0.6) -> np.ndarray:
    """Return rows (T, 7), w first, that turn about x."""
    turns = np.linspace(0, angle, len(rows))
    zero = np.zeros(len(rows))
    return np.column_stack((rows[:, :3], np.cos(turns / 2), np.sin(turns / 2), zero, zero))


@pytest.mark.parametrize(
    "header",
    [
        "x,y,z,qx,qy,qz,qw",
        " X , Y , Z , QX , QY , QZ , QW",
        "pos_x,pos_y,pos_z,quat_x,quat_y,quat_z,quat_w",
        "tx,ty,tz,q_x,q_y,q_z,q_w",
        "x_m,y_m,z_m,qx,qy,qz,qw",
        "x [m],y [m],z [m],rotation.x,rotation.y,rotation.z,rotation.w",
        "pose.position.x,pose.position.y,pose.position.z,pose.orientation.x,pose.orientation.y,"
        "pose.orientation.z,pose.orientation.w",
        "# x y z qx qy qz qw",
        "# made by a tracker\n# x,y,z,qx,qy,qz,qw",
    ],
)
def test_a_header_names_the_columns(header: str) -> None:
    rows = turned(line(0.2))
    kept = dict(delimiter=",", header=header, comments="")
    np.savetxt("a.csv", rows[:, SCALAR_LAST], **kept)
    found = pose_file.read(Path("a.csv"))
    assert found.named and found.repairs == []
    assert found.quat == pytest.approx(rows[:, 3:]) and found.pos == pytest.approx(rows[:, :3])


def test_columns_may_come_in_any_order_and_others_are_left_out_with_a_word() -> None:
    rows, times = turned(line(0.2)), 0.02 * np.arange(30)
    table = np.column_stack((rows[:, ::-1], np.arange(30), times))
    names = "qz,qy,qx,qw,z,y,x,frame,timestamp"
    np.savetxt("a.csv", table, delimiter=",", header=names, comments="")
    Path("b.json").write_text(json.dumps({"poses": table.tolist(), "columns": names.split(",")}))
    objects = [dict(zip(names.split(","), row, strict=True)) for row in table.tolist()]
    Path("c.json").write_text(json.dumps(objects))
    np.savez("d.npz", poses=table, columns=names.split(","))
    for name in ("a.csv", "b.json", "c.json", "d.npz"):
        found = pose_file.read(Path(name))
        assert found.named and found.repairs[0] == "left out the columns frame"
        assert found.quat == pytest.approx(rows[::2, 3:]) and "resampled" in found.repairs[1]


def test_what_a_file_says_besides_is_named() -> None:
    rows = line(0.2)
    Path("a.json").write_text(json.dumps({"poses": rows.tolist(), "fps": 120}))
    np.savez("b.npz", object=rows, fps=120)
    for name in ("a.json", "b.npz"):
        assert "left out fps" in pose_file.read(Path(name)).repairs


@pytest.mark.parametrize("yaw", [0, 5, 15, 40, 90, 170])
@pytest.mark.parametrize("rest", [Rotation.identity(), Rotation.from_euler("x", 90, degrees=True)])
def test_a_start_that_makes_sense_only_in_the_other_order_is_refused(
    yaw: float, rest: Rotation
) -> None:
    start = Rotation.from_euler("z", yaw, degrees=True) * rest
    check_order(start.as_quat(scalar_first=True), rest, "it", "name them")
    wrong = start.as_quat(scalar_first=False)
    if np.allclose(wrong, start.as_quat(scalar_first=True)):
        return  # four equal numbers
    with pytest.raises(ConfigError, match=r"it: read as w x y z .* as x y z w .*; name them"):
        check_order(wrong, rest, "it", "name them")


@pytest.mark.parametrize("axis", ["x", "y", "z", "xyz"])
@pytest.mark.parametrize("degrees", [0, 30, 90, 120, 150])
def test_any_usual_start_is_taken(axis: str, degrees: float) -> None:
    vector = np.array([float(name in axis) for name in "xyz"])
    turn = Rotation.from_rotvec(np.deg2rad(degrees) * vector / np.linalg.norm(vector))
    check_order(turn.as_quat(scalar_first=True), Rotation.identity(), "it", "")


def test_a_recording_with_w_last_does_not_become_another_motion(library_home: Path) -> None:
    trimesh.creation.box((0.05, 0.06, 0.12)).export("brick.stl")
    author_object(ObjectRequest(Path("brick.stl"), "brick"))
    rows = line(0.3, 40)
    rows[:, 2], rows[:, 0] = 0.06 + rows[:, 0], 0.0  # up, then poured
    rows = turned(rows)
    np.savetxt("bare.csv", rows[:, SCALAR_LAST], delimiter=",")
    np.savetxt("named.csv", rows[:, SCALAR_LAST], delimiter=",", header=",".join(LAST), comments="")

    def author(name: str) -> object:
        motion = MotionRequest(None, Path(name))
        given = TaskRequest("brick-pour", "brick", "dmanus", motion, pregrasp="later")
        return author_task(given, open_library())

    with pytest.raises(ConfigError, match=r"bare.csv: row 0.* x,y,z,qx,qy,qz,qw"):
        author("bare.csv")
    author("named.csv")
    stored = open_library().motion("brick-pour").orientation
    assert stored[-1] == pytest.approx(rows[-1, 3:], abs=1e-3)


@pytest.mark.parametrize("frame", ["rest", "world"])
def test_keyframes_with_w_last_are_refused(frame: str) -> None:
    text = f"frame: {frame}\nkeyframes: [{{time_s: 0, quat: [0, 0, 0, 1]}}, {{time_s: 1}}]"
    with pytest.raises(ConfigError, match=r"keyframe 0: quat: read as w x y z .*euler_deg"):
        keyframes.parse(text, "a.yaml")
    keyframes.parse(text.replace("quat: [0, 0, 0, 1]", "euler_deg: [0, 0, 180]"), "a.yaml")
    keyframes.parse(text.replace("[0, 0, 0, 1]", "[0.8, 0.6, 0, 0]"), "a.yaml")


def test_columns_of_anything_raise_only_our_errors() -> None:
    for columns in (1, "x", [1, None], [["x"]], {"x": 1}, [], ["x"] * 7):
        Path("a.json").write_text(json.dumps({"poses": line(0.2).tolist(), "columns": columns}))
        with pytest.raises(PgdmError):
            pose_file.read(Path("a.json"))


def test_names_of_columns_that_are_no_names(tmp_path: Path) -> None:
    file = tmp_path / "motion.json"
    file.write_text(json.dumps({"poses": [[0.0] * 7] * 3, "columns": [["x", "y"], ["z"]]}))
    with pytest.raises(PgdmError, match="not a list of names"):
        pose_file.read(file)


def test_times_are_stated_once() -> None:
    names, rows = ["t", "x", "y", "z", "qw", "qx", "qy", "qz"], turned(line(0.2))
    times = 0.02 * np.arange(30)
    content = {"poses": np.column_stack((times, rows)).tolist(), "columns": names}
    Path("a.json").write_text(json.dumps(content))
    assert len(pose_file.read(Path("a.json")).pos) == 15
    Path("a.json").write_text(json.dumps({**content, "time": times.tolist()}))
    with pytest.raises(PgdmError, match="has times in 'time' and in a column; keep one"):
        pose_file.read(Path("a.json"))


@pytest.mark.parametrize(
    ("axes", "degrees", "said"),
    [
        ("z", [170], "is tilted by 170 degrees from .*, as x y z w only by 0;"),
        ("zx", [5, 5], "is turned by 175 degrees from .*, as x y z w only by 7;"),
    ],
)
def test_a_refused_start_is_told_by_the_angles_that_were_compared(
    axes: str, degrees: list[float], said: str
) -> None:
    start = Rotation.from_euler(axes, degrees, degrees=True)
    with pytest.raises(ConfigError, match=said):
        check_order(start.as_quat(scalar_first=False), Rotation.identity(), "it", "name them")
