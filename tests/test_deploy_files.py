"""Playback files: round trips, and files that are damaged or hostile."""

from __future__ import annotations

import io
import json
import os
import pickle
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pgdm.cli.main import main
from pgdm.deploy.limits import JOINTS
from pgdm.deploy.playback import Playback, PlaybackError, read, write
from pgdm.errors import ConfigError

READY = np.array([0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785])


def playback(count: int = 20) -> Playback:
    time_s = np.arange(count) / 100
    return Playback(
        time_s,
        np.tile(READY, (count, 1)),
        np.column_stack((time_s, -time_s)),
        np.tile([0.1, 0.2, 0.3], (count, 1)),
        np.tile([1.0, 0.0, 0.0, 0.0], (count, 1)),
        np.tile([0.0, -0.05, 0.1], (count, 1)),
        np.tile([0.0, 1.0, 0.0, 0.0], (count, 1)),
        JOINTS,
        ("TFJ1", "TFJ2"),
        {"task": "dmanus-sim2real"},
    )


def arrays(path: Path) -> dict[str, np.ndarray]:
    write(path, playback())
    with np.load(path) as stored:
        return dict(stored)


@pytest.mark.parametrize("name", ["a.npz", "a.csv"])
def test_what_is_written_is_read(tmp_path: Path, name: str) -> None:
    before = playback()
    write(tmp_path / name, before)
    after = read(tmp_path / name)
    for key in ("time_s", "arm_joints_rad", "hand_joints_rad", "base_pos_m", "object_quat"):
        np.testing.assert_allclose(getattr(after, key), getattr(before, key), rtol=1e-9)
    assert (after.arm_joints, after.hand_joints) == (before.arm_joints, before.hand_joints)
    assert after.facts == before.facts


def test_the_columns_of_a_csv_have_names_and_units(tmp_path: Path) -> None:
    write(tmp_path / "a.csv", playback())
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[0] == "# pgdm-playback-1" and json.loads(lines[1][2:])["task"]
    assert lines[2].startswith("time_s,joint1_rad,joint2_rad,")
    assert "TFJ1_rad,TFJ2_rad,base_pos_x_m," in lines[2]
    assert lines[2].endswith("object_quat_w,object_quat_x,object_quat_y,object_quat_z")


def wrong(key: str, value: object, name: str) -> pytest.param:
    return pytest.param(key, value, name, id=f"{key}-{name[:20]}")


def _with(key: str, row: int, value: float) -> np.ndarray:
    changed = np.array(getattr(playback(), key))
    changed[row] = value
    return changed


@pytest.mark.parametrize(
    ("key", "value", "message"),
    [
        wrong("arm_joints_rad", _with("arm_joints_rad", 7, np.nan), "is nan in sample 7"),
        wrong("hand_joints_rad", _with("hand_joints_rad", 3, np.inf), "is inf in sample 3"),
        wrong("arm_joints", np.array([f"panda_joint{i}" for i in range(7)]), "they must be"),
        wrong("hand_joints", np.array(["TFJ1", "TFJ1"]), "given twice"),
        wrong("time_s", _with("time_s", 9, 0.05), "does not increase from sample 8 to 9"),
        wrong("time_s", np.arange(20) / 1e5, "steps from"),
        wrong("time_s", np.arange(1, 21) / 100, "begins at 0.01"),
        wrong("base_quat", np.ones((20, 4)), "not unit quaternions"),
        wrong("object_pos_m", np.zeros((19, 3)), "has shape (19, 3)"),
        wrong("format", np.array("other"), "its format is 'other'"),
        wrong("facts", np.array("[" * 100_000), "nested too deeply"),
        wrong("facts", np.array("3"), "not a JSON object"),
        wrong("time_s", np.array(["a"] * 20), "not an array of numbers"),
    ],
)
def test_wrong_content_is_named(tmp_path: Path, key: str, value: object, message: str) -> None:
    content = arrays(tmp_path / "a.npz") | {key: value}
    np.savez(tmp_path / "b.npz", **content)  # type: ignore[arg-type]
    with pytest.raises(PlaybackError) as caught:
        read(tmp_path / "b.npz")
    assert message in str(caught.value) and "b.npz" in str(caught.value)
    assert "\n" not in str(caught.value)


class Trap:
    """Creates a file when it is unpickled."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return os.mkdir, (str(self.path),)


def test_a_pickle_is_not_run(tmp_path: Path) -> None:
    trap = Trap(tmp_path / "sprung")
    (tmp_path / "a.npz").write_bytes(pickle.dumps(trap))
    content = arrays(tmp_path / "c.npz") | {"hand_joints": np.array([trap, trap], object)}
    np.savez(tmp_path / "b.npz", **content)
    for name in ("a.npz", "b.npz"):
        with pytest.raises(PlaybackError):
            read(tmp_path / name)
    assert not (tmp_path / "sprung").exists()


def test_a_zip_bomb_is_not_unpacked(tmp_path: Path) -> None:
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (1 << 27,)}
    )
    with (
        zipfile.ZipFile(tmp_path / "a.npz", "w", zipfile.ZIP_DEFLATED) as archive,
        archive.open("time_s.npy", "w", force_zip64=True) as member,
    ):
        member.write(header.getvalue())
        for _ in range(64):
            member.write(bytes(1 << 23))
    assert (tmp_path / "a.npz").stat().st_size < 1 << 20
    with pytest.raises(PlaybackError, match="would unpack to"):
        read(tmp_path / "a.npz")


@given(cut=st.floats(0, 0.999), flip=st.integers(0, 255))
@settings(max_examples=40, deadline=None)
def test_a_damaged_file_is_one_error(
    tmp_path_factory: pytest.TempPathFactory, cut: float, flip: int
) -> None:
    folder = tmp_path_factory.mktemp("damaged")
    for name in ("a.npz", "a.csv"):
        path = folder / name
        write(path, playback())
        content = bytearray(path.read_bytes()[: int(cut * path.stat().st_size)])
        if content:
            content[len(content) // 2] ^= flip
        path.write_bytes(content)
        try:
            read(path)  # a CSV may end after any line
        except PlaybackError as error:
            assert "\n" not in str(error)


def test_a_csv_with_a_short_line_is_named(tmp_path: Path) -> None:
    path = tmp_path / "a.csv"
    write(path, playback())
    lines = path.read_text().splitlines()
    lines[6] = "0.03,1,2"
    path.write_text("\n".join(lines))
    with pytest.raises(PlaybackError, match="line 7 has 3 columns, not 24"):
        read(path)


def test_nothing_is_left_where_it_cannot_be_written(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"ends in \.npz or \.csv"):
        write(tmp_path / "a.hdf5", playback())
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="cannot be written"):
        write(tmp_path / "file" / "a.npz", playback())
    (tmp_path / "file").unlink()
    bad = replace(playback(), facts={"x": object()})
    write(tmp_path / "a.npz", playback())
    with pytest.raises(TypeError):
        write(tmp_path / "a.npz", bad)
    assert [p.name for p in tmp_path.iterdir()] == ["a.npz"] and read(tmp_path / "a.npz")


def test_the_command_says_what_a_file_asks_of_the_arm(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write(tmp_path / "a.npz", playback())
    assert main(["deploy", "check", str(tmp_path / "a.npz")]) == 0
    assert "velocity: 0% of its limit" in capsys.readouterr().out
    fast = np.array(playback().arm_joints_rad)
    fast[:, 0] = np.linspace(0.0, 1.0, len(fast))
    write(tmp_path / "b.csv", replace(playback(), arm_joints_rad=fast))
    assert main(["deploy", "check", str(tmp_path / "b.csv")]) == 1
    assert "violation: joint1: velocity" in capsys.readouterr().out
    (tmp_path / "c.npz").write_bytes(b"PK\x03\x04")
    assert main(["deploy", "check", str(tmp_path / "c.npz")]) == 1
    assert capsys.readouterr().err.count("\n") == 1
