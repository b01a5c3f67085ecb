from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pgdm import paths
from pgdm.config.compose import compose
from pgdm.config.groups import available
from pgdm.errors import ConfigError, CorruptAssetError
from pgdm.experiment import env_builder
from pgdm.library import Start, open_library
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.library.files.pregrasp import Pregrasp


def start(size: int, value: float, plan: int | None = None) -> Start:
    actions = None if plan is None else np.full((plan, 3), 0.5)
    return Start(np.full(size, value), np.zeros(size), actions)


def test_what_is_written_is_read(tmp_path: Path) -> None:
    made = Pregrasp(start(5, 0.25), start(5, 0.5, plan=4), {"made_by": "hand", "depth_m": 0.0})
    path = tmp_path / "a" / "labeled.npz"
    pregrasp_file.write(path, made)
    read = pregrasp_file.read(path)
    assert read.note == {"made_by": "hand", "depth_m": 0.0}
    np.testing.assert_array_equal(read.pose.qpos, np.full(5, 0.25))
    assert read.reached is not None and read.reached.actions is not None
    assert read.reached.actions.shape == (4, 3)
    assert read.start is read.reached  # a plan's end goes before the pose it was meant for
    before = path.read_bytes()
    pregrasp_file.write(path, made)
    assert path.read_bytes() == before


def test_without_a_plan_the_pose_is_the_start(tmp_path: Path) -> None:
    pregrasp_file.write(tmp_path / "x.npz", Pregrasp(start(5, 0.25), None, {}))
    read = pregrasp_file.read(tmp_path / "x.npz")
    assert read.reached is None and read.start is read.pose


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"pose_qpos": np.array([np.nan])}, "NaN"),
        ({"pose_qvel": np.zeros(2)}, "pose_qvel"),
        ({"reached_qpos": np.zeros(3), "reached_qvel": np.zeros(3)}, "reached_qpos"),
        ({"note": np.frombuffer(b"{", np.uint8)}, "not JSON"),
        ({"note": np.frombuffer(b"[]", np.uint8)}, "not a JSON object"),
    ],
)
def test_a_damaged_file_is_named(
    change: dict[str, np.ndarray], message: str, tmp_path: Path
) -> None:
    good = {
        "pose_qpos": np.zeros(1),
        "pose_qvel": np.zeros(1),
        "note": np.frombuffer(b"{}", np.uint8),
    }
    path = tmp_path / "x.npz"
    np.savez(path, **{**good, **change})
    with pytest.raises(CorruptAssetError, match=f"x.npz.*{message}"):
        pregrasp_file.read(path)


def test_a_run_starts_at_the_users_own(library_home: Path) -> None:
    cfg = compose(["task=cup-pour1", "pregrasp=labeled"])
    with pytest.raises(ConfigError, match=r"no stored start 'labeled'.*it has: mined, planned"):
        env_builder(cfg, open_library())
    stored = open_library().motion("cup-pour1").starts["mined"]
    moved = stored.qpos.copy()
    moved[2] += 0.01
    path = pregrasp_file.path_of("cup-pour1", "adroit", "labeled")
    pregrasp_file.write(path, Pregrasp(Start(moved, stored.qvel, None), None, {}))
    builder = env_builder(cfg, open_library())
    np.testing.assert_array_equal(builder.mdp.start.qpos, moved)
    assert builder.facts()["pregrasp_used"] == "labeled"
    assert builder.facts()["pregrasp_sha256"] == pregrasp_file.read(path).sha256
    assert pregrasp_file.own("cup-pour1", "adroit") == ["labeled"]
    moved[8] += 3.0
    pregrasp_file.write(path, Pregrasp(Start(moved, stored.qvel, None), None, {}))
    with pytest.raises(ConfigError, match=r"labeled.npz: joint adroit/FFJ3 is at 3.*its limits"):
        env_builder(cfg, open_library())


def test_the_users_own_settings_are_found_without_a_flag() -> None:
    folder = paths.user_conf() / "budget"
    folder.mkdir(parents=True)
    (folder / "tiny.yaml").write_text("# @package _global_\n# A try.\nbudget: tiny\n")
    assert "tiny" in available("budget")
    assert compose(["budget=tiny"]).budget == "tiny"
