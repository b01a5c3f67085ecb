"""Expert hand trajectories: files, alignment and contacts, with values computed by hand."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from library_trees import make_checkout
from pgdm.errors import CorruptAssetError, LibraryError, UnknownNameError
from pgdm.library import Expert, Motion, ensure_expert, import_tcdm, open_library
from pgdm.library.checks.explain import explain_expert
from pgdm.library.checks.verify import damaged
from pgdm.library.experts import contacts as expert_contacts
from pgdm.library.experts.kinematics import ExpertHand
from pgdm.library.files import expert as expert_file
from pgdm.library.files import expert_index
from pgdm.library.files.expert_index import ExpertEntry, ExpertIndex
from pgdm.library.manifest import FileEntry
from pgdm.library.robohive import experts as wheel_experts
from pgdm.motion.reference import ExpertReference

STEPS, FRAMES = 6, 8
BLOCK = """<mujoco><worldbody><body name="object" pos="0 0 0.035">
<joint type="slide"/><geom type="box" size="0.02 0.03 0.04"/>
<geom type="sphere" size="0.5" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""
STILL = np.array([1.0, 0.0, 0.0, 0.0])


def arrays(steps: int = STEPS) -> dict[str, np.ndarray]:
    return {
        "qpos": np.full((steps, 30), 0.25),
        "human_joints": np.zeros((steps, 16, 3)),
        "fingertips": np.zeros((steps, 5, 3)),
        "contacts": np.zeros((steps, 5, 3)),
        "in_contact": np.ones((steps, 5), bool),
        "approximate": np.asarray(False),
    }


def changed(key: str, value: Any, where: Any = ...) -> dict[str, np.ndarray]:
    result = {k: v.astype(float) for k, v in arrays().items()}
    result[key][where] = value
    return result


def test_a_file_gives_back_what_was_written_and_always_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.npz", "b.npz"):
        expert_file.write(tmp_path / name, arrays())
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    expert = expert_file.read(tmp_path / "a.npz", "hammer-use1")
    assert (expert.task, expert.approximate) == ("hammer-use1", False)
    for key, value in arrays().items():
        np.testing.assert_array_equal(getattr(expert, key), value)
    assert expert.in_contact.dtype == bool


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (changed("qpos", np.nan, (3, 7)), r"'qpos' has a NaN or infinite value at \(3, 7\)"),
        (changed("contacts", np.inf, (0, 0, 2)), "'contacts' has a NaN or infinite value"),
        (changed("in_contact", 2.0, (1, 1)), "'in_contact' holds values other than 0 and 1"),
        (arrays() | {"qpos": np.zeros((6, 24))}, r"'qpos' has shape \(6, 24\).*\(any, 30\)"),
        (arrays() | {"fingertips": np.zeros((5, 5, 3))}, r"'fingertips' has shape \(5, 5, 3\)"),
        (arrays() | {"qpos": np.array("text")}, "'qpos' is not numeric"),
        (arrays(1), "qpos has 1 row, needs 2"),
        ({"qpos": np.zeros((6, 30))}, "lacks 'human_joints'; it has qpos"),
    ],
)
def test_a_bad_file_is_refused_by_name(
    bad: dict[str, np.ndarray], message: str, tmp_path: Path
) -> None:
    np.savez(tmp_path / "cup-pour1.npz", **bad)  # type: ignore[arg-type]
    with pytest.raises(CorruptAssetError, match=rf"cup-pour1\.npz: {message}"):
        expert_file.read(tmp_path / "cup-pour1.npz", "cup-pour1")
    with pytest.raises(CorruptAssetError, match=message):
        expert_file.write(tmp_path / "x.npz", bad)
    assert not (tmp_path / "x.npz").exists()


# Recordings of the package: eight frames, of which the motion has the last six.


def recorded() -> dict[str, np.ndarray]:
    frame = np.arange(FRAMES, dtype=float)
    return {
        "s": np.repeat(frame[:, None], 36, 1) / 100,
        "human_joint_coords": np.tile(frame[:, None, None], (1, 16, 3)),
        "human_obj_contact": frame > 3,
        "object_translation": np.stack((0.01 * frame, 0 * frame, 0 * frame), 1),
        "object_orientation": np.tile(STILL, (FRAMES, 1)),
    }


def motion() -> Motion:
    stored = recorded()
    place, turn = stored["object_translation"][2:], stored["object_orientation"][2:]
    return Motion("hammer-use1", "checkout", place, turn, 10, {}, "")


def write_recording(folder: Path, task: str = "hammer-use1", **values: Any) -> Path:
    path = folder / wheel_experts.file_name(task)
    np.savez(path, **(recorded() | values))
    return path


def test_the_package_has_its_own_names() -> None:
    assert wheel_experts.file_name("hammer-use1") == "Adroit_hammer_use_1.npz"
    assert wheel_experts.file_name("duck-lift") == "Adroit_duck_lift.npz"


def test_a_recording_is_cut_so_that_it_ends_with_the_motion(tmp_path: Path) -> None:
    recording = wheel_experts.read(write_recording(tmp_path), "hammer-use1", motion())
    assert recording.skipped == FRAMES - STEPS
    np.testing.assert_array_equal(recording.qpos[:, 0], np.arange(2, 8) / 100)
    np.testing.assert_array_equal(recording.human_joints[:, 0, 0], np.arange(2, 8))
    assert recording.touching.tolist() == [False, False, True, True, True, True]
    assert recording.qpos.shape == (STEPS, 30)
    assert not recording.shift.any()


def test_a_motion_that_is_used_in_part_begins_where_all_of_it_would(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # Of 6 stored poses 4 are used: the recording's frames 2..7 are the 6, the first 4 are taken.
    monkeypatch.setitem(wheel_experts.STORED_POSES, "duck-lift", 6)
    full = motion()
    cut = Motion("duck-lift", "", full.translation[:4], full.orientation[:4], 10, {}, "")
    recording = wheel_experts.read(write_recording(tmp_path, "duck-lift"), "duck-lift", cut)
    assert recording.skipped == 2
    np.testing.assert_array_equal(recording.qpos[:, 0], np.arange(2, 6) / 100)


def test_a_constant_displacement_is_taken_out_of_the_task_known_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(wheel_experts.STORED_POSES, "alarmclock-lift", STEPS)
    moved = recorded()["object_translation"] + (0.0007, -0.0101, -0.0029)
    path = write_recording(tmp_path, object_translation=moved)
    with pytest.raises(CorruptAssetError, match=r"of hammer-use1: its object is 10\.5 mm away"):
        wheel_experts.read(path, "hammer-use1", motion())
    path = write_recording(tmp_path, "alarmclock-lift", object_translation=moved)
    recording = wheel_experts.read(path, "alarmclock-lift", motion())
    np.testing.assert_allclose(recording.shift, (-0.0007, 0.0101, 0.0029), atol=1e-15)


TURNED = np.tile([np.cos(0.05), np.sin(0.05), 0, 0], (FRAMES, 1))  # by 0.1 rad


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"s": np.full((FRAMES, 36), np.nan)}, "'s' has a NaN"),
        ({"s": np.zeros((FRAMES, 30))}, r"'s' has shape \(8, 30\), expected \(any, 36\)"),
        ({"human_joint_coords": np.zeros((FRAMES, 21, 3))}, "'human_joint_coords' has shape"),
        ({"human_obj_contact": np.full(FRAMES, 7)}, "'human_obj_contact' holds values other"),
        ({"object_orientation": np.ones((FRAMES, 4))}, "object_orientation row 0 has norm 2"),
        ({"object_orientation": TURNED}, r"rotated by up to 5\.7 degrees"),
        ({"s": np.array([{"a": print}], object)}, "builtins.print"),
    ],
)
def test_a_bad_recording_is_refused_by_name(
    values: dict[str, np.ndarray], message: str, tmp_path: Path
) -> None:
    path = write_recording(tmp_path, **values)
    with pytest.raises(CorruptAssetError, match=message) as caught:
        wheel_experts.read(path, "hammer-use1", motion())
    assert "Adroit_hammer_use_1.npz" in str(caught.value)


def test_empty_and_short_recordings_have_different_errors(tmp_path: Path) -> None:
    short = {name: value[:5] for name, value in recorded().items()}
    path = write_recording(tmp_path, **short)
    with pytest.raises(CorruptAssetError, match="has 5 frames, fewer than the 6 poses"):
        wheel_experts.read(path, "hammer-use1", motion())
    path.write_bytes(b"")
    with pytest.raises(CorruptAssetError, match=r"Adroit_hammer_use_1\.npz is empty in the pack"):
        wheel_experts.read(path, "hammer-use1", motion())


# Contacts: a block of 40 x 60 x 80 mm, and a bone of 20 mm that points where PIP to DIP does.


def finger(pip: tuple[float, float, float], dip: tuple[float, float, float]) -> np.ndarray:
    """Return human joints (1, 16, 3) with all five fingers at one place."""
    joints = np.zeros((1, 16, 3))
    joints[:, 2::3], joints[:, 3::3] = pip, dip
    return joints


@pytest.mark.parametrize(
    ("pip", "dip", "distance", "point"),
    [
        # Towards the face x = 20 mm: the tip is 10 mm from it.
        ((0.07, 0.0, 0.0), (0.05, 0.0, 0.0), 0.010, (0.02, 0.0, 0.0)),
        # However long the bone before it is.
        ((0.10, 0.0, 0.0), (0.05, 0.0, 0.0), 0.010, (0.02, 0.0, 0.0)),
        # Away from it: the DIP joint is the closest.
        ((0.04, 0.01, 0.0), (0.05, 0.01, 0.0), 0.030, (0.02, 0.01, 0.0)),
        # Into it by 10 mm: pushed back out by that, through the same face.
        ((0.05, 0.0, 0.0), (0.03, 0.0, 0.0), -0.010, (0.02, 0.0, 0.0)),
        # Towards an edge, 30 mm and 40 mm off: 50 mm.
        ((0.05, 0.11, 0.01), (0.05, 0.09, 0.01), 0.050, (0.02, 0.03, 0.01)),
    ],
)
def test_distance_and_closest_point_of_a_finger(
    pip: tuple[float, float, float],
    dip: tuple[float, float, float],
    distance: float,
    point: tuple[float, float, float],
    tmp_path: Path,
) -> None:
    xml = tmp_path / "object.xml"
    xml.write_text(BLOCK)
    joints = finger(pip, dip)
    here = expert_contacts.measure(xml, np.zeros((1, 3)), STILL[None], joints)
    expected = distance - np.array([[0.008, 0.008, 0.007, 0.008, 0.009]])
    np.testing.assert_allclose(here.distances, expected, atol=1e-5)
    np.testing.assert_allclose(here.points, np.tile(point, (1, 5, 1)), atol=1e-5)
    # The object carried elsewhere and turned by 90 degrees about z: the same point on it.
    turn, place = np.array([[0.5**0.5, 0.0, 0.0, 0.5**0.5]]), np.array([[1.0, 2.0, 3.0]])
    moved = joints[..., [1, 0, 2]] * (-1.0, 1.0, 1.0) + place
    there = expert_contacts.measure(xml, place, turn, moved)
    np.testing.assert_allclose(there.distances, here.distances, atol=1e-6)
    np.testing.assert_allclose(there.points, here.points, atol=1e-5)


def test_contact_needs_closeness_and_the_recordings_flag() -> None:
    distances = np.array([[0.0079, 0.0081, -0.01, 0.0, 0.1]] * 2)
    contacts = expert_contacts.Contacts(np.zeros((2, 5, 3)), distances)
    found = contacts.in_contact(np.array([True, False]))
    assert found.tolist() == [[True, False, True, True, False], [False] * 5]


def test_an_object_without_solid_parts_is_refused(tmp_path: Path) -> None:
    xml = tmp_path / "object.xml"
    xml.write_text(
        BLOCK.replace('size="0.02 0.03 0.04"', 'size="1 1 1" contype="0" conaffinity="0"')
    )
    with pytest.raises(CorruptAssetError, match="has no collision geom"):
        expert_contacts.measure(xml, np.zeros((1, 3)), STILL[None], finger((1, 0, 0), (2, 0, 0)))


# The library, with one expert trajectory in it.


def entry(**values: Any) -> ExpertEntry:
    values_of = {
        "file": FileEntry("0" * 64, 1, "tmp_data/Adroit_hammer_use_1.npz", "Apache-2.0"),
        "package": "robohive 0.4.0, SHA-256 00",
        "approximate": False,
        "steps": STEPS,
        "skipped": 14,
        "shift_m": [0.0, -0.0101, 0.0],
        "object_mean_m": 0.0012,
        "object_max_m": 0.0034,
        "beyond_limits_m": 0.26,
        "beyond_limits_rad": 0.86,
        "touching_frames": 5,
        "contact_frames": [5, 4, 3, 2, 1],
        "within_5mm": [1.0, 0.8, 0.6, 0.4, 0.2],
    }
    return ExpertEntry(**(values_of | values))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    root = tmp_path / "home" / "library"
    import_tcdm(make_checkout(tmp_path / "TCDM", ("hammer_use1", "dmanus_cup")), root)
    file = root / "experts" / "hammer-use1.npz"
    expert_file.write(file, arrays())
    reasons = {"cup-pour1": "Adroit_cup_pour_1.npz is empty in the package"}
    expert_index.write(file.parent, ExpertIndex("2026", {"hammer-use1": entry()}, reasons))
    return root


def test_the_library_reads_it(root: Path) -> None:
    library = open_library(root)
    assert library.expert("hammer-use1").qpos.shape == (STEPS, 30)
    assert library.expert_entry("hammer-use1") == entry()


def test_a_task_without_one_names_those_that_have_it_and_the_reason(root: Path) -> None:
    library = open_library(root)
    with pytest.raises(UnknownNameError, match=r"unknown expert hand.*'dmanus-cup'.*hammer-use1"):
        library.expert("dmanus-cup")
    with pytest.raises(UnknownNameError, match=r"Left out: Adroit_cup_pour_1\.npz is empty"):
        library.expert("cup-pour1")
    with pytest.raises(UnknownNameError, match="with 'pgdm assets fetch'"):
        open_library(root / "nowhere").expert("hammer-use1")


def test_one_that_does_not_fit_the_motion_is_refused(root: Path) -> None:
    expert_file.write(root / "experts" / "hammer-use1.npz", arrays(STEPS + 1))
    with pytest.raises(LibraryError, match="has 7 poses, its motion 6: they come from different"):
        open_library(root).expert("hammer-use1")


@pytest.mark.parametrize("text", ["{", '{"format": 99}', "[]", '{"format": 1, "experts": {}}'])
def test_the_error_for_a_damaged_index_names_the_command_that_helps(root: Path, text: str) -> None:
    (root / "experts" / "manifest.json").write_text(text)
    with pytest.raises(
        CorruptAssetError, match=r"experts/manifest\.json.*'pgdm assets fetch --experts'"
    ):
        open_library(root).experts()


def test_verify_names_a_changed_one(root: Path) -> None:
    assert damaged(open_library(root))[-1].startswith("experts/hammer-use1.npz: ")
    (root / "experts" / "hammer-use1.npz").unlink()
    assert "experts/hammer-use1.npz: missing" in damaged(open_library(root))


def test_its_quality_is_shown(root: Path) -> None:
    text = "\n".join(explain_expert(open_library(root), "hammer-use1"))
    for words in (
        "(published): robohive 0.4.0, SHA-256 00",
        "Apache-2.0  from tmp_data/Adroit_hammer_use_1.npz",
        "poses: 6, after 14 skipped frames of the recording",
        "the motion's by 1.200 mm (mean), 3.400 mm (max), after a shift by (0.0, -10.1, 0.0)",
        "limits by up to 0.86 rad and, at the base, 0.26 m",
        "touches the object at 5 poses; by finger",
        "th in contact 1, within 5 mm 20%",
    ):
        assert words in text
    write_approximate(root)
    assert "(rebuilt, approximate)" in "\n".join(explain_expert(open_library(root), "hammer-use1"))
    for task, words in (
        ("cup-pour1", "none, Adroit_cup_pour_1.npz is empty"),
        ("mug-drink3", "not fetched yet. Get"),
        ("door-open", "not from motion capture"),
    ):
        assert words in "\n".join(explain_expert(open_library(root), task))


def write_approximate(root: Path) -> None:
    experts, reasons = {"hammer-use1": entry(approximate=True)}, open_library(root).experts()
    expert_index.write(root / "experts", ExpertIndex("2026", experts, reasons.left_out))


def test_what_is_there_is_not_fetched_and_offline_forbids_the_rest(root: Path) -> None:
    said: list[str] = []
    library = ensure_expert("hammer-use1", True, said.append, root)
    assert library.expert_entry("hammer-use1").skipped == 14
    with pytest.raises(UnknownNameError, match="Only motion-capture tasks have one"):
        ensure_expert("dmanus-cup", False, said.append, root)
    manifest = root / "experts" / "manifest.json"
    content = json.loads(manifest.read_text())
    manifest.write_text(json.dumps(content | {"experts": {}}))
    with pytest.raises(LibraryError, match=r"'hammer-use1' is not in the library and --offline"):
        ensure_expert("hammer-use1", True, said.append, root)
    assert said == []


# What methods see.


def test_the_reference_is_clipped_and_counts_from_the_centre_of_mass() -> None:
    stored = arrays(2) | {
        "qpos": np.array([[0.5] * 30, [-0.5] * 30]),
        "contacts": np.full((2, 5, 3), 0.1),
    }
    approximate = bool(stored.pop("approximate"))
    expert = Expert(task="cup-pour1", approximate=approximate, sha256="", **stored)
    low, high = (torch.full((30,), x, dtype=torch.float64) for x in (-0.2, 0.3))
    com = torch.tensor([0.1, 0.0, 0.0], dtype=torch.float64)
    reference = ExpertReference.of(expert, low, high, com)
    assert len(reference) == 2
    np.testing.assert_allclose(reference.joints[:, 4], [0.3, -0.2])
    np.testing.assert_allclose(reference.contacts[0, 0], [0.0, 0.1, 0.1], atol=1e-9)
    # The object's centre of mass at (1, 2, 3), turned by 90 degrees about z: y becomes -x.
    place = torch.tensor([[1.0, 2.0, 3.0]]).double()
    turn = torch.tensor([[0.5**0.5, 0.0, 0.0, 0.5**0.5]]).double()
    points = reference.contact_points(torch.tensor([1]), place, turn)
    np.testing.assert_allclose(points[0, 2], [0.9, 2.0, 3.1], atol=1e-7)


def test_a_shift_of_the_base_moves_the_fingertips_by_as_much(library_home: Path) -> None:
    hand = ExpertHand(open_library(library_home / "library").hand_xml("adroit"))
    qpos, shift = np.full((1, 30), 0.2), np.array([0.01, -0.02, 0.03])
    moved = hand.fingertips(hand.shifted(qpos, shift)) - hand.fingertips(qpos)
    np.testing.assert_allclose(moved, np.tile(shift, (1, 5, 1)), atol=1e-12)


def test_leaving_the_limits_is_measured_for_slides_and_hinges(library_home: Path) -> None:
    hand = ExpertHand(open_library(library_home / "library").hand_xml("adroit"))
    qpos = np.zeros((2, 30))
    qpos[1, 2], qpos[0, 5] = 0.6, -2.8  # ARTz ends at 0.5 m, ARRz at -2.5 rad
    assert hand.beyond_limits(qpos) == pytest.approx((0.1, 0.3))
    assert hand.clipped(qpos)[1, 2] == 0.5
