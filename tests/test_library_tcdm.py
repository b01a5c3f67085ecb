"""Importing a checkout: where it is found, what is refused, and that nothing is lost."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from library_trees import STEPS, make_checkout, snapshot, trajectory, write_trajectory
from pgdm.errors import CorruptAssetError, LibraryError, UnsafePickleError
from pgdm.library import import_tcdm, manifest, open_library, staging
from pgdm.library.checks.compiled import compiled

ROOT = os.environ.get("PGDM_TCDM_ROOT")
TASKS = ("hammer_use1", "cup_pour1", "dhand_cup", "dmanus_cup")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    return make_checkout(tmp_path / "TCDM", TASKS)


@pytest.fixture
def library(tmp_path: Path) -> Path:
    return tmp_path / "library"


def assets(checkout: Path) -> Path:
    return checkout / "tcdm" / "envs" / "assets"


@pytest.mark.parametrize("inner", ["", "tcdm", "tcdm/envs/assets"])
def test_checkout_package_and_data_folder_are_all_found(
    checkout: Path, library: Path, inner: str
) -> None:
    report = import_tcdm(checkout / inner, library)
    assert report.tasks == ["cup-pour1", "dhand-cup", "dmanus-cup", "hammer-use1"]
    assert report.left_out == {}


def test_the_start_states_get_our_names_and_plain_arrays(checkout: Path, library: Path) -> None:
    import_tcdm(checkout, library)
    with np.load(library / "checkout" / "motions" / "hammer-use1.npz") as stored:
        assert sorted(stored.files) == [
            "object_orientation",
            "object_translation",
            "start_mined_qpos",
            "start_mined_qvel",
            "start_planned_actions",
            "start_planned_qpos",
            "start_planned_qvel",
            "substeps",
        ]
        assert all(stored[name].dtype.kind in "fi" for name in stored.files)
    motion = open_library(library).motion("hammer-use1")
    assert motion.source == "checkout"
    assert motion.substeps == 10
    assert motion.translation[:, 2] == pytest.approx(np.linspace(0.0, 0.1, STEPS))
    assert motion.starts["planned"].qpos == pytest.approx([0.1, 0.1, 0.1])
    assert motion.starts["planned"].actions is not None
    assert motion.starts["planned"].actions.shape == (4, 2)
    assert motion.starts["mined"].actions is None


def test_each_model_stands_alone_with_its_actuators(checkout: Path, library: Path) -> None:
    import_tcdm(checkout, library)
    shutil.rmtree(checkout)
    found = open_library(library)
    hand = compiled(found.hand_xml("adroit"), "adroit")
    assert hand.nu == 2
    assert hand.actuator_gainprm[:, 0].tolist() == [175.0, 5.0]
    thing = compiled(found.object_xml("hammer"), "hammer")
    # 0.1 m x 0.1 m x 0.1 m / 6 of plastic with 1250 kg/m3.
    assert thing.body("object").mass[0] == pytest.approx(1250.0 * 1e-3 / 6.0, rel=1e-4)
    scene = compiled(found.scene_xml(), "scene")
    assert scene.opt.timestep == 0.004


def test_defaults_reach_only_the_models_that_include_them(checkout: Path, library: Path) -> None:
    import_tcdm(checkout, library)
    found = open_library(library)
    assert compiled(found.hand_xml("adroit"), "a").dof_damping[0] == 0.05
    assert compiled(found.hand_xml("dhand"), "d").dof_damping[0] == 0.0


def test_the_typing_error_is_read_as_old_mujoco_did_and_reported(
    checkout: Path, library: Path
) -> None:
    report = import_tcdm(checkout, library)
    assert report.defects == [
        'tcdm/envs/assets/robots/dmanus/base.xml: geom euler="0.114 0 0w" read as "0.114 0 0"'
    ]
    assert open_library(library).sources()["checkout"].defects == report.defects
    hand = compiled(open_library(library).hand_xml("dmanus"), "dmanus")
    assert hand.geom_quat[0] == pytest.approx([np.cos(0.057), np.sin(0.057), 0.0, 0.0])


def test_a_motion_longer_than_its_length_is_cut(checkout: Path, library: Path) -> None:
    write_trajectory(checkout / "trajectories" / "cup_pour1.npz", trajectory(length=4))
    import_tcdm(checkout, library)
    found = open_library(library)
    assert len(found.motion("cup-pour1").translation) == 4
    assert found.entry("cup-pour1").steps == 4


def _with(key: str, index: Any, value: float) -> np.ndarray:
    array = np.array(trajectory()[key], float)
    array[index] = value
    return array


def _start(**changes: Any) -> dict[str, Any]:
    table = trajectory()["s_0"]
    table["motion_planned"].update(changes)
    return table


DAMAGE: dict[str, tuple[dict[str, Any], str]] = {
    "NaN": (
        {"object_translation": _with("object_translation", (2, 1), np.nan)},
        r"'object_translation' has a NaN or infinite value at \(2, 1\)",
    ),
    "infinite": (
        {"object_orientation": _with("object_orientation", (0, 3), np.inf)},
        r"'object_orientation' has a NaN or infinite value at \(0, 3\)",
    ),
    "not unit": (
        {"object_orientation": _with("object_orientation", (3, 0), 0.9)},
        "object_orientation row 3 has norm 0.9, not a unit quaternion",
    ),
    "wrong shape": (
        {"object_translation": np.zeros((STEPS, 4))},
        r"'object_translation' has shape \(6, 4\), expected \(any, 3\)",
    ),
    "different lengths": (
        {"object_orientation": np.ones((STEPS - 1, 4)) / 2},
        r"'object_orientation' has shape \(5, 4\), expected \(6, 4\)",
    ),
    "length too large": (
        {"length": STEPS + 1},
        "'length' is 7; valid: a whole number from 2 to 6, the number",
    ),
    "length zero": ({"length": 0}, "'length' is 0"),
    "length an array": ({"length": np.ones(2)}, r"'length' has shape \(2,\)"),
    "no length": ({"length": None}, "lacks 'length'"),
    "no motion": ({"object_translation": None}, "lacks 'object_translation'"),
    "text": ({"object_translation": np.full((STEPS, 3), "x")}, "is not numeric"),
    "no starts": ({"s_0": None}, "'s_0' is not a table of start states"),
    "starts of another kind": ({"s_0": {"other": {}}}, "'s_0' has none of"),
    "start not a table": ({"s_0": {"initialized": 3}}, "s_0 initialized is not a table"),
    "start with NaN": (
        {"s_0": _start(position=np.array([0.0, np.nan, 0.0]))},
        r"s_0 motion_planned: 'position' has a NaN or infinite value at \(1,\)",
    ),
    "start without velocity": (
        {"s_0": {"initialized": {"position": np.zeros(3)}}},
        "s_0 initialized: lacks 'velocity'",
    ),
    "velocity of another size": (
        {"s_0": _start(velocity=np.zeros(2))},
        r"'velocity' has shape \(2,\), expected \(3,\)",
    ),
    "another hand's start": (
        {"s_0": _start(position=np.zeros(5), velocity=np.zeros(5))},
        "start 'planned' has 5 joint positions, but adroit with cup has 3",
    ),
    "another hand's plan": (
        {"s_0": _start(actions=np.zeros((4, 9)))},
        "start 'planned' has 9 actions per step, but adroit has 2 actuators",
    ),
    "two poses a step": ({"DATA_SUBSTEPS": 2}, "DATA_SUBSTEPS is 2"),
    "half a substep": ({"SIM_SUBSTEPS": 0}, "substeps is 0"),
}


@pytest.mark.parametrize("kind", DAMAGE)
def test_a_damaged_motion_is_refused_by_name_and_the_library_stays(
    checkout: Path, library: Path, kind: str
) -> None:
    import_tcdm(checkout, library)
    before = snapshot(library)
    changes, reason = DAMAGE[kind]
    write_trajectory(checkout / "trajectories" / "cup_pour1.npz", trajectory(**changes))
    with pytest.raises(CorruptAssetError, match=reason) as caught:
        import_tcdm(checkout, library)
    assert "trajectories/cup_pour1.npz" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert snapshot(library) == before


class _Hostile:
    def __reduce__(self) -> tuple[Any, tuple[str]]:
        return os.system, ("touch executed",)


def test_a_hostile_pickle_is_refused_and_the_library_stays(checkout: Path, library: Path) -> None:
    import_tcdm(checkout, library)
    before = snapshot(library)
    hostile = trajectory(s_0={"initialized": _Hostile()})
    write_trajectory(checkout / "trajectories" / "cup_pour1.npz", hostile)
    with pytest.raises(UnsafePickleError, match=r"cup_pour1\.npz: s_0: .* posix\.system"):
        import_tcdm(checkout, library)
    assert snapshot(library) == before
    assert not Path("executed").exists()


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        ("robots/adroit/base.xml", "<mujoco><worldbody>", "not well-formed XML"),
        ("robots/adroit/base.xml", "<mujoco><worldbody><nobody/></worldbody></mujoco>", "MuJoCo"),
        ("objects/cup.xml", '<mujoco><include file="cup.xml"/></mujoco>', "includes itself"),
        ("objects/cup.xml", '<mujoco><include file="../gone.xml"/></mujoco>', "cannot be read"),
        (
            "objects/cup.xml",
            '<mujoco><asset><mesh file="../../../../../../etc/passwd"/></asset></mujoco>',
            "outside the imported folder",
        ),
        (
            "objects/cup.xml",
            '<mujoco><worldbody><body pos="a b c"/></worldbody></mujoco>',
            "not numeric",
        ),
        ("meshes/objects/cup/contact0.stl", "solid", "MuJoCo cannot compile it"),
    ],
)
def test_a_damaged_model_is_refused_by_name(
    checkout: Path, library: Path, name: str, content: str, reason: str
) -> None:
    (assets(checkout) / name).write_text(content)
    with pytest.raises(CorruptAssetError, match=reason) as caught:
        import_tcdm(checkout, library)
    assert Path(name).stem in str(caught.value) or "cup" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert open_library(library).tasks() == {}


def test_what_is_not_a_checkout_is_refused_with_what_is_missing(
    tmp_path: Path, checkout: Path, library: Path
) -> None:
    with pytest.raises(LibraryError, match="no such folder"):
        import_tcdm(tmp_path / "none", library)
    (tmp_path / "empty").mkdir()
    with pytest.raises(LibraryError, match=r"it has no tcdm/envs/assets/common\.xml"):
        import_tcdm(tmp_path / "empty", library)
    shutil.rmtree(checkout / "trajectories")
    with pytest.raises(LibraryError, match=r"has no trajectories/\*\.npz"):
        import_tcdm(checkout, library)
    assert not library.exists()


def test_a_checkout_without_a_scene_is_refused(checkout: Path, library: Path) -> None:
    (assets(checkout) / "environments" / "table.xml").unlink()
    with pytest.raises(LibraryError, match=r"table\.xml is missing, every task needs it"):
        import_tcdm(checkout, library)


def test_of_a_partial_checkout_the_complete_tasks_are_imported(
    checkout: Path, library: Path
) -> None:
    shutil.rmtree(assets(checkout) / "meshes" / "objects" / "cup")  # a submodule not fetched
    shutil.rmtree(assets(checkout) / "robots" / "dhand")
    report = import_tcdm(checkout, library)
    assert report.tasks == ["hammer-use1"]
    assert report.left_out == {
        "hands/dhand": "tcdm/envs/assets/robots/dhand/base.xml is missing",
        "objects/cup": "tcdm/envs/assets/meshes/objects/cup/contact0.stl is missing",
        "cup-pour1": "needs object 'cup'",
        "dhand-cup": "needs hand 'dhand' and object 'cup'",
        "dmanus-cup": "needs object 'cup'",
    }


def test_a_checkout_without_any_complete_task_is_refused(checkout: Path, library: Path) -> None:
    shutil.rmtree(assets(checkout) / "robots")
    with pytest.raises(LibraryError, match="has no complete task"):
        import_tcdm(checkout, library)


def test_a_checkout_with_fewer_tasks_replaces_another_only_with_the_option(
    checkout: Path, library: Path
) -> None:
    import_tcdm(checkout, library)
    before = snapshot(library)
    (checkout / "trajectories" / "cup_pour1.npz").unlink()
    with pytest.raises(LibraryError, match=r"this folder lacks: 1 .*cup-pour1.*--replace"):
        import_tcdm(checkout, library)
    assert snapshot(library) == before
    assert "cup-pour1" not in import_tcdm(checkout, library, replace=True).tasks
    assert "cup-pour1" not in open_library(library).tasks()


def test_the_same_checkout_twice_gives_the_same_files(checkout: Path, library: Path) -> None:
    import_tcdm(checkout, library)
    first = snapshot(library)
    import_tcdm(checkout, library)
    second = snapshot(library)
    for name in ("checkout/manifest.json",):  # it holds the time
        first.pop(name), second.pop(name)
    assert first == second


def test_the_manifest_knows_every_file(checkout: Path, library: Path) -> None:
    import_tcdm(checkout, library)
    listed = manifest.read(library / "checkout").files
    found = {name.removeprefix("checkout/") for name in snapshot(library)}
    assert set(listed) == found - {"manifest.json"}
    entry = listed["objects/cup/object.xml"]
    assert entry.origin == "tcdm/envs/assets/objects/cup.xml"
    assert entry.licence == "MIT"
    mesh = listed["objects/cup/meshes/contact0.stl"]
    assert mesh.licence == "Apache-2.0"
    assert mesh.sha256 == manifest.sha256_of(
        assets(checkout) / "meshes" / "objects" / "cup" / "contact0.stl"
    )


def test_progress_counts_to_the_end(checkout: Path, library: Path) -> None:
    seen: list[tuple[str, int, int]] = []
    import_tcdm(checkout, library, lambda step, done, total: seen.append((step, done, total)))
    assert seen[-1] == ("tasks", 4, 4)
    assert all(done <= total for _, done, total in seen)


def _import(checkout: str, library: str, results: Any) -> None:
    results.put(len(import_tcdm(Path(checkout), Path(library)).tasks))


def test_imports_at_the_same_time_wait_for_each_other(checkout: Path, library: Path) -> None:
    context = multiprocessing.get_context("spawn")
    results = context.Queue()
    both = [
        context.Process(target=_import, args=(str(checkout), str(library), results))
        for _ in range(2)
    ]
    for process in both:
        process.start()
    assert [results.get(timeout=120), results.get(timeout=120)] == [4, 4]
    for process in both:
        process.join()
    assert len(open_library(library).tasks()) == 4
    assert sorted(p.name for p in library.iterdir()) == [".lock", "checkout"]


def test_leftovers_of_a_killed_import_are_ignored_and_removed(
    checkout: Path, library: Path
) -> None:
    import_tcdm(checkout, library)
    (library / ".staging-checkout-x").mkdir()
    # Killed between the two renames: the old content waits under its other name.
    (library / "checkout").rename(library / ".previous-checkout")
    assert len(open_library(library).tasks()) == 4
    assert open_library(library).hand_xml("adroit").is_file()
    import_tcdm(checkout, library)
    assert sorted(p.name for p in library.iterdir()) == [".lock", "checkout"]


def test_a_folder_two_levels_below_is_replaced_and_restored(library: Path) -> None:
    with staging.locked(library):
        with staging.replacing_folder(library, "objects/cup") as fresh:
            (fresh / "a").write_bytes(b"1")
        with pytest.raises(KeyError), staging.replacing_folder(library, "objects/cup") as fresh:
            (fresh / "a").write_bytes(b"2")
            raise KeyError
        assert snapshot(library) == {"objects/cup/a": b"1"}
        # Killed between the two renames: the next change restores the old content.
        (library / "objects" / "cup").rename(library / "objects" / ".previous-cup")
        with staging.replacing_folder(library, "objects/mug") as fresh:
            (fresh / "a").write_bytes(b"3")
        assert snapshot(library) == {"objects/cup/a": b"1", "objects/mug/a": b"3"}


def _import_and_die(checkout: str, library: str, steps: int) -> None:
    seen = [0]

    def die(step: str, done: int, total: int) -> None:
        seen[0] += 1
        if seen[0] == steps:
            os.kill(os.getpid(), signal.SIGKILL)

    import_tcdm(Path(checkout), Path(library), die)


@pytest.mark.parametrize("steps", [1, 5, 9])
def test_a_killed_import_changes_nothing_and_leaves_no_lock(
    checkout: Path, library: Path, steps: int
) -> None:
    import_tcdm(checkout, library)
    before = snapshot(library)
    write_trajectory(checkout / "trajectories" / "hammer_use1.npz", trajectory(length=4))
    context = multiprocessing.get_context("spawn")
    process = context.Process(target=_import_and_die, args=(str(checkout), str(library), steps))
    process.start()
    process.join()
    assert process.exitcode == -signal.SIGKILL
    kept = {k: v for k, v in snapshot(library).items() if not k.startswith(".staging-")}
    assert kept == before
    assert open_library(library).entry("hammer-use1").steps == STEPS
    import_tcdm(checkout, library)
    assert open_library(library).entry("hammer-use1").steps == 4
    assert sorted(p.name for p in library.iterdir()) == [".lock", "checkout"]


def test_a_full_disk_is_an_error_of_one_line_and_changes_nothing(
    checkout: Path, library: Path
) -> None:
    import_tcdm(checkout, library)
    before = snapshot(library)
    program = (
        "import resource, sys; from pathlib import Path\n"
        "from pgdm.errors import LibraryError; from pgdm.library import import_tcdm\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (200, 200))\n"  # no file above 200 bytes
        "try: import_tcdm(Path(sys.argv[1]), Path(sys.argv[2]))\n"
        "except LibraryError as error: print(error)\n"
    )
    command = [sys.executable, "-c", program, str(checkout), str(library)]
    answer = subprocess.run(command, capture_output=True, text=True, check=True)
    assert answer.stdout == f"{library}: cannot be written (File too large)\n"
    assert snapshot(library) == before


def test_waiting_for_the_lock_times_out(library: Path) -> None:
    with (
        staging.locked(library),
        pytest.raises(LibraryError, match=r"has been changing the library for 0 s"),
        staging.locked(library, timeout_s=0.1),
    ):
        pass


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_a_library_that_cannot_be_written_is_an_error_of_one_line(
    checkout: Path, tmp_path: Path
) -> None:
    (tmp_path / "locked").mkdir(mode=0o555)
    with pytest.raises(LibraryError, match="cannot be written"):
        import_tcdm(checkout, tmp_path / "locked" / "library")


def test_a_file_in_the_library_s_place_is_an_error_of_one_line(
    checkout: Path, tmp_path: Path
) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(LibraryError, match="cannot be written"):
        import_tcdm(checkout, tmp_path / "file" / "library")


@pytest.mark.skipif(not ROOT, reason="needs a TCDM checkout: name one with PGDM_TCDM_ROOT")
def test_the_real_checkout_has_all_51_tasks(library_home: Path) -> None:
    found = open_library(library_home / "library")
    assert len(found.sources()["checkout"].tasks) == 51
    assert found.hands() == ["adroit", "dhand", "dmanus"]
    content = found.sources()["checkout"]
    assert [d.split(": ", 1)[1] for d in content.defects] == [
        'geom euler="0.114 0 0w" read as "0.114 0 0"'
    ]
    assert list(content.left_out) == ["objects/body"]  # its meshes were never released
    short = {task: found.entry(task).steps for task in ("alarmclock-lift", "duck-lift")}
    assert short == {"alarmclock-lift": 25, "duck-lift": 21}
    learned = [task for task, entry in content.tasks.items() if "learned" in entry.starts]
    assert learned == ["alarmclock-see1", "duck-inspect1", "stanfordbunny-inspect1"]
    assert all(entry.starts[:2] == ["planned", "mined"] for entry in content.tasks.values())
