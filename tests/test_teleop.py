"""Pre-grasps cut from demonstrations, in the task's real scene.

``PGDM_DAPG_DEMOS`` names DAPG's pickle of the door; tests that need it are skipped without it.
"""

from __future__ import annotations

import os
import pickle
from pathlib import Path

import h5py
import numpy as np
import pytest

from command_line import command
from pgdm.config.compose import compose
from pgdm.errors import ConfigError, CorruptAssetError, PgdmError, UnknownNameError
from pgdm.library import open_library
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.pregrasp.hand_geometry import posed
from pgdm.pregrasp.teleop import cut as teleop
from pgdm.pregrasp.teleop import demonstrations
from pgdm.pregrasp.teleop.demonstrations import Demonstration
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene
from task_scenes import opened

DEMOS = os.environ.get("PGDM_DAPG_DEMOS")
DEMOS = str(Path(DEMOS).absolute()) if DEMOS else None
DOOR = slice(29, 32), slice(32, 35)  # of an observation: palm, handle


def scene() -> Scene:
    return opened("door-open")[0]


def observed(qpos: np.ndarray, door_m: np.ndarray) -> np.ndarray:
    """Return AdroitHandDoor's observation (39,) of a state, the door displaced by a vector (3,)."""
    data = posed(scene(), qpos)
    palm, handle = data.site("adroit/S_grasp").xpos, data.site("door/S_handle").xpos
    row = np.zeros(39)
    row[:27], row[27], row[28] = qpos[3:30], qpos[31], qpos[30]
    row[29:32], row[32:35] = palm - door_m, handle - door_m
    row[35:38] = row[29:32] - row[32:35]
    return row


def approach(door_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Demonstration:
    """Return a demonstration: from 20 cm away to the published pre-grasp, and through the door."""
    mined = open_library().motion("door-open").starts["mined"].qpos
    rows = []
    for back in np.concatenate((np.linspace(0.2, 0.0, 21), np.linspace(-0.01, -0.1, 10))):
        qpos = mined.copy()
        qpos[2] -= back
        rows.append(observed(qpos, np.array(door_m)))
    return Demonstration(0, np.array(rows))


def objects() -> np.ndarray:
    return open_library().motion("door-open").starts["mined"].qpos[30:]


@pytest.mark.usefixtures("library_home")
def test_a_hand_is_placed_relative_to_the_door() -> None:
    mined = open_library().motion("door-open").starts["mined"].qpos
    # The demonstrations' hand has one slide, along y, and is displaced like its door.
    for door in ((0.0, 0.0, 0.0), (0.0, -0.05, 0.0)):
        made = teleop.replay(scene(), approach(door))
        np.testing.assert_allclose(made.qpos[20], mined, atol=1e-6)
        assert made.shift_m == pytest.approx(np.linalg.norm(door))
        assert made.hold is not None and made.hold > 20
        pose = teleop.cut(scene(), made, objects(), "test").pose
        assert HandContact(scene()).depth(pose.qpos) == 0
        assert pose.qpos[2] >= mined[2] - 1e-6  # at the published pre-grasp or nearer to the door
        np.testing.assert_array_equal(pose.qpos[30:], objects())


@pytest.mark.usefixtures("library_home")
def test_a_short_contact_is_no_hold() -> None:
    rows = approach().observations
    brush = np.concatenate((rows[:15], rows[-2:], rows[:15], rows[-9:]))
    made = teleop.replay(scene(), Demonstration(0, brush))
    assert made.touching[15:17].all()
    assert made.hold is not None and made.hold >= 32
    with pytest.raises(ConfigError, match="never touches anything"):
        calm = teleop.replay(scene(), Demonstration(0, rows[:10]))
        teleop.cut(scene(), calm, objects(), "test")
    with pytest.raises(ConfigError, match="already holds something in the first step"):
        held = teleop.replay(scene(), Demonstration(0, rows[-6:]))
        teleop.cut(scene(), held, objects(), "test")


@pytest.mark.usefixtures("library_home")
def test_demonstrations_that_cannot_be_followed_are_refused() -> None:
    low = approach().observations.copy()
    low[:, DOOR[1]] -= [0.0, 0.0, 0.15]
    far = teleop.replay(scene(), Demonstration(0, low))
    with pytest.raises(ConfigError, match=r"15 cm from the task's.*exceed their ranges"):
        teleop.cut(scene(), far, objects(), "test")
    with pytest.raises(ConfigError, match="none of 1 demonstrations"):
        teleop.nearest([far])
    other = approach().observations.copy()
    other[:, DOOR[0]] += [0.05, 0.0, 0.0]
    with pytest.raises(ConfigError, match="another hand"):
        teleop.replay(scene(), Demonstration(0, other))
    with pytest.raises(ConfigError, match="observations of 46 numbers"):
        teleop.replay(scene(), Demonstration(0, np.zeros((3, 46))))
    with pytest.raises(UnknownNameError, match="'cup-pour1'; valid: door-open"):
        teleop.layout_of("cup-pour1")


def minari(path: Path, episodes: list[np.ndarray]) -> Path:
    """Write episodes as Minari stores them: T + 1 observations, T of everything else."""
    path.parent.mkdir(parents=True)
    with h5py.File(path, "w", track_order=True) as file:
        for i, observations in enumerate(episodes):
            steps = len(observations) - 1
            group = file.create_group(f"episode_{i}")
            group.attrs.update({"id": i, "total_steps": steps})
            rows = {"chunks": True, "maxshape": (None, 39)}
            group.create_dataset("observations", data=observations, **rows)
            group.create_dataset("actions", data=np.zeros((steps, 28)))
            group.create_dataset("rewards", data=np.zeros(steps))
            for name in ("terminations", "truncations"):
                group.create_dataset(name, data=np.zeros(steps, bool))
            group.create_group("infos").create_dataset("success", data=np.zeros(steps + 1, bool))
    return path


@pytest.mark.usefixtures("library_home")
def test_a_minari_dataset_is_read_in_the_order_of_its_numbers(tmp_path: Path) -> None:
    near, far = (approach(door).observations for door in ((0, 0, 0), (0, 0.05, 0)))
    # More than ten: names sort as text, which is not the order of the numbers.
    file = minari(tmp_path / "human-v2" / "data" / "main_data.hdf5", [far] * 10 + [near])
    for path in (file, tmp_path / "human-v2"):
        found = demonstrations.read(path)
        assert [one.number for one in found] == list(range(11))
        np.testing.assert_array_equal(found[10].observations, near)
    taken = teleop.nearest([teleop.replay(scene(), one) for one in found[8:]])
    assert taken.number == 10
    with pytest.raises(ConfigError, match=r"demonstration 11 is not in .* 0 to 10"):
        demonstrations.chosen(found, 11, "it")


def test_damaged_files_are_named(tmp_path: Path) -> None:
    cases: dict[str, tuple[bytes, str]] = {
        "a.hdf5": (b"no hdf5", "not readable as HDF5"),
        "a.pickle": (pickle.dumps(Path("x")), "pickle asks for"),
        "b.pickle": (pickle.dumps({"a": 1}), "is not a list of demonstrations"),
        "c.pickle": (pickle.dumps([{"actions": np.zeros((2, 2))}]), "lacks 'observations'"),
        "d.pickle": (pickle.dumps([]), "contains no demonstrations"),
        "e.pickle": (pickle.dumps([{"observations": np.full((2, 39), np.nan)}]), "NaN"),
        "f.txt": (b"", "extension of f.txt"),
    }
    for name, (content, message) in cases.items():
        (tmp_path / name).write_bytes(content)
        with pytest.raises(PgdmError, match=message):
            demonstrations.read(tmp_path / name)
    with h5py.File(tmp_path / "b.hdf5", "w") as file:
        file.create_group("episode_0").create_group("observations")
    for name in ("b.hdf5", "nothing.hdf5"):
        with pytest.raises(CorruptAssetError, match=name):
            demonstrations.read(tmp_path / name)


@pytest.mark.skipif(DEMOS is None, reason="needs DAPG's door demonstrations: PGDM_DAPG_DEMOS")
@pytest.mark.usefixtures("library_home")
def test_the_published_pregrasp_of_the_door_is_in_the_demonstrations() -> None:
    assert DEMOS is not None
    found = demonstrations.read(Path(DEMOS))
    assert len(found) == 25
    mined = open_library().motion("door-open").starts["mined"].qpos
    replays = [teleop.replay(scene(), one) for one in found]
    assert max(made.palm_error_m for made in replays) < 0.009
    # Demonstration 0, step 70, within 8 mm and 8 mrad: ours is cut four steps later.
    first = teleop.nearest(replays)
    assert first.number == 0 and first.shift_m < 1e-3
    assert np.abs(first.qpos[:, :30] - mined[:30]).max(axis=1).argmin() == 70
    assert np.abs(first.qpos[70, :30] - mined[:30]).max() < 0.01
    pose = teleop.cut(scene(), first, objects(), "door").pose
    assert np.sqrt(((pose.qpos - mined)[6:30] ** 2).mean()) < 0.05
    for made in replays:
        cut = teleop.cut(scene(), made, objects(), "door")
        assert HandContact(scene()).depth(cut.pose.qpos) == 0


@pytest.mark.usefixtures("library_home")
def test_the_command_stores_what_a_run_starts_from(tmp_path: Path) -> None:
    from pgdm.experiment import env_builder

    file = minari(tmp_path / "data" / "main_data.hdf5", [approach().observations])
    done = command("pgdm", "pregrasp", "teleop", "door-open", str(file), "--no-reach")
    assert done.code == 0, done.err
    assert "takes hold at step" in done.out
    stored = pregrasp_file.find("door-open", "adroit", "teleop")
    assert stored is not None and stored.note["demonstration"] == 0
    builder = env_builder(compose(["task=door-open", "pregrasp=teleop"]), open_library())
    np.testing.assert_array_equal(builder.mdp.start.qpos, stored.pose.qpos)
    wrong = command("pgdm", "pregrasp", "teleop", "cup-pour1", str(file))
    assert wrong.code != 0 and "valid: door-open" in wrong.err
