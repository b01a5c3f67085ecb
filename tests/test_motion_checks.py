"""Checks and corrections of motions, and reading them from files."""

from __future__ import annotations

import json
from pathlib import Path

import mujoco
import numpy as np
import pytest

from pgdm.errors import ConfigError, CorruptAssetError
from pgdm.library.checks.motion import Poses, TableCheck, check_motion, slower, smoothed, speeds
from pgdm.library.files import poses as pose_file
from recorded_poses import UNTURNED, line


def poses(rows: np.ndarray) -> Poses:
    return Poses(rows[:, :3], rows[:, 3:])


def test_speeds_are_those_of_a_line_and_a_turn() -> None:
    angle = 0.1 * np.arange(5)
    quat = np.column_stack((np.cos(angle / 2), np.zeros((5, 2)), np.sin(angle / 2)))
    moved, turned = speeds(Poses(np.outer(np.arange(5), [0.02, 0, 0]), quat))
    assert moved == pytest.approx(0.5) and turned == pytest.approx(2.5)


def test_a_calm_motion_passes() -> None:
    check_motion(poses(line(0.5)), "it")


def turned_back() -> np.ndarray:
    """Return rows that reach 1.2 m/s and from one step to the next go back as fast."""
    rows = line(1.2)
    rows[15:, 0] = 2 * rows[14, 0] - rows[15:, 0]
    return rows


def with_jump(at: int, by: float) -> np.ndarray:
    rows = line(0.2)
    rows[at:, 1] += by
    return rows


@pytest.mark.parametrize(
    ("rows", "said"),
    [
        (line(0.2)[:5], r"5 poses \(0.2 s\); valid: 10 to 500"),
        (with_jump(17, 0.15), "row 17 jumps: it is 0.15 m from row 16"),
        (
            line(3.0),
            r"moves at 3 m/s in row .*a hand can follow 2.5 at most; slow it down \(--slower",
        ),
        (turned_back(), r"accelerates at 60 m/s2 in row .*--smooth or --slower FACTOR help"),
        (
            line(0.5, 60)[12:],
            r"already moves in its first step, 0.5 m/s .*--smooth adds a gradual start",
        ),
    ],
)
def test_what_no_hand_can_do_is_named(rows: np.ndarray, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        check_motion(poses(rows), "it")


def test_a_sudden_turn_is_a_jump_too() -> None:
    rows = line(0.2)
    rows[20:, 3:] = [np.cos(0.6), 0, 0, np.sin(0.6)]
    with pytest.raises(ConfigError, match=r"row 20 jumps: it is 1.2 rad from row 19"):
        check_motion(poses(rows), "it")


def test_smoothing_gives_rests_and_slowing_divides_speeds() -> None:
    cut = poses(line(0.5, 60)[12:])
    smooth = smoothed(cut)
    check_motion(smooth, "it")
    assert smooth.pos[0] == pytest.approx(cut.pos[0], abs=1e-4)
    assert smooth.pos[-1] == pytest.approx(cut.pos[-1], abs=1e-4)
    fast = poses(line(3.0, 60))
    slow = slower(fast, 2.0)
    assert len(slow.pos) == 2 * 60 - 1
    assert speeds(slow)[0].max() == pytest.approx(speeds(fast)[0].max() / 2, rel=0.02)
    with pytest.raises(ConfigError, match=r"--slower is 0.5; valid: 1 to 20"):
        slower(fast, 0.5)


TABLE = """<mujoco><worldbody><body name="object"><joint type="slide" axis="1 0 0"/>
<joint type="slide" axis="0 1 0"/><joint type="slide" axis="0 0 1"/><joint axis="1 0 0"/>
<joint axis="0 1 0"/><joint axis="0 0 1"/><geom type="{kind}" size="{size}"/></body></worldbody>
</mujoco>"""


@pytest.mark.parametrize(
    ("kind", "size", "half"),
    [
        # Turned by 45 degrees about x: half the height of each.
        ("box", "0.02 0.03 0.04", 0.07 / np.sqrt(2)),
        ("sphere", "0.05", 0.05),
        ("cylinder", "0.03 0.04", 0.07 / np.sqrt(2)),
        ("capsule", "0.03 0.04", 0.03 + 0.04 / np.sqrt(2)),
        ("ellipsoid", "0.02 0.03 0.04", 0.05 / np.sqrt(2)),
    ],
)
def test_the_lowest_point_counts(kind: str, size: str, half: float) -> None:
    model = mujoco.MjModel.from_xml_string(TABLE.format(kind=kind, size=size))
    table = TableCheck(model, model.body("object").id)
    heights = half + np.array([0.01, 0.0, -0.02, 0.01])
    turned = [np.cos(np.pi / 8), np.sin(np.pi / 8), 0, 0]
    motion = Poses(np.outer(heights, [0, 0, 1]), np.tile(turned, (4, 1)))
    assert table.depths(motion) == pytest.approx([0, 0, 0.02, 0], abs=1e-9)
    with pytest.raises(
        ConfigError, match=r"20 mm below the table in row 2 \(rows that are too low: 1\)"
    ):
        table.check(motion, "it")
    table.check(table.lifted(motion), "it")


@pytest.mark.parametrize("factor", [1.5, 3.0])
def test_every_length_can_be_resampled(factor: float) -> None:
    for count in range(10, 150):
        poses = line(0.2, count)
        slow = slower(Poses(poses[:, :3], poses[:, 3:]), factor)
        assert len(slow.pos) == int((count - 1) * factor + 1e-9) + 1
        assert slow.pos[0] == pytest.approx(poses[0, :3]) and np.isfinite(slow.quat).all()


def test_poses_come_from_csv_json_and_npz() -> None:
    rows = line(0.2)
    times = 0.02 * np.arange(30)
    header = "time,x,y,z,qw,qx,qy,qz"
    np.savetxt("a.csv", rows, delimiter=",")
    np.savetxt("b.csv", np.column_stack((times, rows)), delimiter=",", header=header, comments="")
    Path("c.json").write_text(json.dumps(rows.tolist()))
    Path("d.json").write_text(json.dumps({"poses": rows.tolist(), "time": times.tolist()}))
    np.savez("e.npz", object=rows, time=times)
    np.savez("f.npz", object_translation=rows[:, :3], object_orientation=rows[:, 3:])
    assumed = ["the columns have no names and were read as x y z qw qx qy qz"]
    for name in ("a.csv", "c.json", "f.npz"):
        found = pose_file.read(Path(name))
        assert found.pos == pytest.approx(rows[:, :3])
        assert found.repairs == ([] if found.named else assumed)
        assert found.named == (name == "f.npz")
    for name in ("b.csv", "d.json", "e.npz"):  # recorded at 50 Hz: every second row
        found = pose_file.read(Path(name))
        assert found.pos == pytest.approx(rows[::2, :3], abs=1e-9)
        resampled = ["resampled 30 rows over 0.58 s to 15 rows 0.04 s apart"]
        assert found.repairs == (resampled if found.named else assumed + resampled)
        assert found.named == (name == "b.csv")


def test_slightly_wrong_quaternions_are_normalised_and_reported() -> None:
    rows = line(0.2)
    rows[:, 3:] *= 1.001
    rows[7, 3:] *= -1
    found = pose_file.resampled(rows, None, "it")
    assert found.quat == pytest.approx(np.tile(UNTURNED, (30, 1)))
    assert "normalised quaternions, whose norms were off by up to 0.001" in found.repairs


def changed(row: int, column: int, value: float) -> np.ndarray:
    rows = line(0.2)
    rows[row, column] = value
    return rows


@pytest.mark.parametrize(
    ("rows", "times", "said"),
    [
        (changed(4, 2, np.nan), None, "row 4 has a NaN or infinite value"),
        (changed(9, 3, 0.4), None, "row 9 has a quaternion of norm 0.4, not 1"),
        (line(0.2)[:, :6], None, r"poses have shape \(30, 6\), expected \(N, 7\)"),
        (line(0.2)[:1], None, r"poses have shape \(1, 7\)"),
        (line(0.2), np.r_[0:29, 28.0] * 0.04, r"row 29 has time 1.12 s, not after 1.12 s"),
        (line(0.2), np.arange(29.0), "has 29 times, needs 30 finite ones"),
        (line(0.2), 1e9 * np.arange(30.0), r"lasts 2.9e\+10 s; valid: 0.04 to 3600 s"),
    ],
)
def test_rows_that_are_no_poses_are_named(
    rows: np.ndarray, times: np.ndarray | None, said: str
) -> None:
    with pytest.raises(CorruptAssetError, match=said):
        pose_file.resampled(rows, times, "it")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.csv", b"1,2,3\n", "columns of the rows: 3, expected 7"),
        ("a.csv", b"", "columns of the rows: 0, expected"),
        ("a.csv", b"a,b,c,d,e,f,g\n1,2,3,1,0,0,0\n", "has 0 columns 'x' among a, b"),
        ("a.csv", b"x_mm,y,z,qx,qy,qz,qw\n1,2,3,0,0,0,1\n", "has 0 columns 'x' among x_mm"),
        ("a.csv", b"x,y,z,w,x,y,z\n1,2,3,1,0,0,0\n", "has 2 columns 'x'"),
        (
            "a.csv",
            b"t,x,y,z,qx,qy,qz,qw,secs\n0,1,2,3,0,0,0,1,0\n",
            "columns t, secs are all times",
        ),
        ("a.csv", b"x,y,z,roll,pitch,yaw\n1,2,3,0,0,0\n", "has 0 columns 'qw'"),
        ("a.csv", b"x,y,z,qx,qy,qz,qw\n1,2,3,0,0,0\n", "columns of the rows: 6, expected 7"),
        ("a.csv", b"vel.x,y,z,qx,qy,qz,qw\n1,2,3,0,0,0,1\n", "has 0 columns 'x'"),
        (
            "a.json",
            b'{"poses": [[1, 2]], "columns": ["x"]}',
            r"rows have shape \(1, 2\) for 1 column:",
        ),
        ("a.json", b'[{"x": 1}, {"y": 2}]', "lacks 'x'"),
        ("a.csv", b"0,0,0,1,0,0,0\n0,0,x,1,0,0,0\n", "row 1 has 'x', not a number"),
        ("a.json", b"{}", "lacks 'poses'"),
        ("a.json", b"[1,", "cannot be read as poses"),
        ("a.npz", b"zip", "not a readable .npz"),
    ],
)
def test_files_that_are_none_are_named(name: str, content: bytes, said: str) -> None:
    Path(name).write_bytes(content)
    with pytest.raises(CorruptAssetError, match=said):
        pose_file.read(Path(name))


def test_formats_and_missing_files_are_named() -> None:
    np.savez("a.npz", x=1)
    with pytest.raises(CorruptAssetError, match=r"has neither 'poses', 'object' nor .*it has x"):
        pose_file.read(Path("a.npz"))
    with pytest.raises(ConfigError, match=r"format '.bag' is not supported; valid: .csv, .npz"):
        pose_file.read(Path("a.bag"))
    with pytest.raises(ConfigError, match="there is no such file"):
        pose_file.read(Path("none.csv"))
