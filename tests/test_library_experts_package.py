"""The 36 published expert trajectories, as they come out of the package and into the library."""

from __future__ import annotations

import io
import shutil
import zipfile
from pathlib import Path

import mujoco
import numpy as np
import pytest

from conftest import DOWNLOADS
from library_trees import snapshot
from pgdm.cli.main import main
from pgdm.library import (
    Library,
    ensure_expert,
    experts,
    figures,
    open_library,
    registry,
    wheel_experts,
)
from pgdm.library.check import compiled
from pgdm.library.expert_contacts import BONE_M, CONTACT_M, bones
from pgdm.library.verify import damaged

pytestmark = pytest.mark.slow

MISSING = {"alarmclock-see1", "binoculars-pass1", "piggybank-use1", "waterbottle-shake1"}
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
    assert set(index.experts) == set(figures.GRAB_TASKS) - MISSING
    assert all("is empty in the package" in reason for reason in index.left_out.values())
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
    assert max(worst.values()) < 1e-4, worst
    assert max(worst.values()) < 1e-9  # and in truth to rounding


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
            # besides what the recording's object is off the motion's.
            at = np.clip(((points - start[t]) * along[t]).sum(axis=1), 0, BONE_M)
            away = np.linalg.norm(points - start[t] - at[:, None] * along[t], axis=1)
            assert away[expert.in_contact[t]].max(initial=0) < CONTACT_M + 0.009 + 0.004, (task, t)
        for finger in range(5):
            there = expert.contacts[expert.in_contact[:, finger], finger]
            if len(there) > 5:
                spreads.append(np.sqrt(((there - there.mean(axis=0)) ** 2).sum(axis=1).mean()))
    assert np.median(spreads) < 0.004


def test_the_documentation_has_these_figures(library: Library) -> None:
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
    assert said[0].startswith("the expert hand trajectories are not in the library yet: reading")
    assert "non-commercial" in said[0]
    one, two = (snapshot(h / "library" / "experts") for h in (expert_home, home))
    one.pop("manifest.json"), two.pop("manifest.json")  # they hold the time
    assert one == two
    assert sorted(p.name for p in (home / "library").iterdir()) == [".lock", "checkout", "experts"]


def test_a_recording_that_does_not_fit_leaves_out_one_task_only(
    expert_home: Path, tmp_path: Path
) -> None:
    """As with a checkout whose motion is another one."""
    shutil.copytree(expert_home / "library" / "checkout", tmp_path / "checkout")
    motions = tmp_path / "checkout" / "motions"
    shutil.copy(motions / "cup-pour1.npz", motions / "hammer-use1.npz")
    index = experts.fill(tmp_path, registry.PACKAGE, DOWNLOADS / registry.PACKAGE.file)
    assert set(index.left_out) == {*MISSING, "hammer-use1"}
    assert "not a recording of it" in index.left_out["hammer-use1"]


def test_the_command_line_tells_and_shows(
    expert_home: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["assets", "verify"]) == 0
    assert "checkout and 36 expert hand trajectories are sound" in capsys.readouterr().out
    assert main(["assets", "list"]) == 0
    rows = {line.split()[0]: line.split()[-1] for line in capsys.readouterr().out.splitlines()}
    assert (rows["hammer-use1"], rows["piggybank-use1"], rows["dhand-cup"]) == ("yes", "-", "-")
    assert main(["view", "piggybank-use1", "--expert"]) != 0
    assert "Left out: Adroit_piggybank_use_1.npz: is empty" in capsys.readouterr().err
    code = main(["view", "eyeglasses-pass1", "--expert", "--offline", "--video", "out/a.mp4"])
    captured = capsys.readouterr()
    if "no OpenGL" in captured.err:
        pytest.skip(captured.err)
    assert code == 0, captured.err
    assert "base leaves the robot's limits by up to 0.14 m" in captured.err
    assert (tmp_path / "out" / "a.mp4").read_bytes()[4:8] == b"ftyp"
