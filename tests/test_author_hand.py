"""Hands from MJCF and URDF: hand-worked values of good ones, one-line errors of bad ones."""

from __future__ import annotations

import contextlib
import json
import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from command_line import TINY, command
from made_hands import FINGERS, LENGTHS, mjcf, saved, urdf
from pgdm import paths
from pgdm.author.hand import AuthoredHand, HandRequest, anatomy, author_hand, remove_hand
from pgdm.author.hand.settings import settings_path
from pgdm.cli.author.hand import angles, numbers, pairs
from pgdm.config.compose import compose
from pgdm.errors import ConfigError, PgdmError, UnknownNameError
from pgdm.library import open_library
from pgdm.library.authored import hand_file, own
from pgdm.library.checks.verify import damaged
from pgdm.pregrasp.hand_geometry import opposing_finger, posed
from pgdm.pregrasp.labeler.kinematics import Kinematics
from pgdm.pregrasp.labeler.measures import Meter
from pgdm.pregrasp.sources import is_reset_pose
from pgdm.sim.batch import SimBatch
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import build_scene

FIVE = ("index", "middle", "ring", "little", "thumb")


def request(path: Path, **changes: object) -> HandRequest:
    given: dict = {"file": path, "name": "made"}
    return HandRequest(**given | changes)


def places(made: AuthoredHand) -> np.ndarray:
    qpos = np.zeros(made.scene.model.nq)
    qpos[: made.scene.index.num_joints] = made.scene.index.reset
    return posed(made.scene, qpos).geom_xpos[made.scene.index.point_geoms]


@pytest.mark.parametrize("side", ["right", "left"])
@pytest.mark.parametrize("kind", ["urdf", "mjcf"])
def test_fingers_point_forward_and_the_palm_down(kind: str, side: str) -> None:
    text = urdf(side=side) if kind == "urdf" else mjcf(side=side)
    made = author_hand(request(saved(text, f"hand.{kind}")))
    assert made.side == side and made.anatomy.found_by == "names"
    assert made.cfg.human_fingers == list(FINGERS)
    assert (made.cfg.num_base_joints, made.cfg.num_wrist_joints) == (6, 0)
    points = dict(zip(made.cfg.points, places(made), strict=True))
    # The palm's box ends 9 cm behind the knuckles; the middle finger is 1 cm off the middle.
    np.testing.assert_allclose(points["wrist_point"], [0.0, -0.27, 0.2], atol=1e-4)
    sign = 1 if side == "right" else -1
    knuckle = points["mfknuckle_point"]
    np.testing.assert_allclose(knuckle[1:], [-0.18, 0.2], atol=1e-3)
    np.testing.assert_allclose(points["mfmiddle_point"] - knuckle, [0, LENGTHS[0], 0], atol=1e-3)
    # 12 mm before the end of a finger of 11 cm, whose box ends 1 mm earlier.
    tip = sum(LENGTHS) - 0.001 - 0.012
    np.testing.assert_allclose(points["mfdistal_point"] - knuckle, [0, tip, 0], atol=2e-3)
    assert sign * points["thdistal_point"][0] < -0.05  # with the palm down
    assert sign * (points["rfknuckle_point"] - points["ffknuckle_point"])[0] > 0.03
    bent = made.scene.index.reset.copy()
    bent[7] = 1.0
    qpos = np.concatenate((bent, np.zeros(6)))
    assert posed(made.scene, qpos).geom_xpos[made.scene.index.point_geoms[3], 2] < 0.17


def test_servos_are_the_files_or_the_stated_ones() -> None:
    made = author_hand(request(saved(mjcf(), "hand.xml"), name="given"))
    model, index = made.scene.model, made.scene.index
    first = index.actuators[6]
    assert model.actuator_gainprm[first, 0] == 2.0
    np.testing.assert_allclose(model.actuator_ctrlrange[first], [-0.08, 1.4])
    assert model.dof_damping[6] == pytest.approx(0.02 + 0.05)  # kv acts as damping
    np.testing.assert_allclose(model.jnt_range[6], np.deg2rad([-6, 90]), atol=1e-5)
    assert model.ntendon == 1  # passive: kept
    made = author_hand(request(saved(urdf()), name="stated", kp=5.0))
    model = made.scene.model
    assert model.actuator_gainprm[made.scene.index.actuators[6:], 0].tolist() == [5.0] * 12
    assert model.jnt_actfrcrange[6].tolist() == [-2.0, 2.0]  # <limit effort="2">
    assert model.dof_damping[6] == pytest.approx(0.25)


def test_a_mimic_joint_follows_and_has_no_servo() -> None:
    made = author_hand(request(saved(urdf(mimic=True))))
    index, model = made.scene.index, made.scene.model
    assert (index.num_joints, index.num_actuators, made.checks.coupled) == (18, 14, 4)
    assert made.source.mimics[0] == "index_j2 = 0.1 + 0.8 index_j1"
    # At rest the followers are at 0.1; that is the reset pose, which the settings repeat.
    np.testing.assert_allclose(index.reset[[8, 11, 14, 17]], 0.1)
    assert len(made.cfg.mean_fingers_rad) == 12
    mean = np.array(made.cfg.mean_fingers_rad)
    np.testing.assert_allclose(mean[2::3], 0.1 + 0.8 * mean[1::3], atol=1e-9)
    sim = SimBatch(made.scene, 1, 1, 10)
    begin = np.concatenate((index.reset, [2.0, 0, 0, 0, 0, 0]))
    sim.reset(np.array([0]), begin, np.zeros(model.nv))
    targets = index.reset[index.driven].copy()
    targets[7] = 1.0  # index_j1
    for _ in range(40):
        assert not sim.step(targets[None]).any()
    q = sim.read().qpos[0].numpy()
    assert q[7] == pytest.approx(1.0, abs=0.03)
    assert q[8] == pytest.approx(0.1 + 0.8 * q[7], abs=0.02)


def test_the_labeler_names_a_coupled_joint_outside_its_limits() -> None:
    scene = author_hand(request(saved(urdf(mimic=True)))).scene
    meter = Meter(scene, Kinematics(scene))
    qpos = np.concatenate((scene.index.reset, [2.0, 0, 0, 0, 0, 0]))
    assert meter.measure(qpos).beyond == ()
    qpos[17] = 1.7  # the last finger's follower reaches 1.6; the hand has only 14 actuators
    (named,) = meter.measure(qpos).beyond
    assert named.startswith("thumb")


def test_a_leaders_range_is_narrowed_to_what_its_follower_allows() -> None:
    text = urdf(mimic=True).replace('lower="-0.1" upper="1.6" effort="2" velocity="3"/><mimic', (
        'lower="-0.1" upper="0.9" effort="2" velocity="3"/><mimic'
    ))  # fmt: skip
    made = author_hand(request(saved(text)))
    assert made.scene.model.jnt_range[7, 1] == pytest.approx(1.0, abs=3e-3)  # 0.1 + 0.8 = 0.9
    assert any(
        "'index_j1' goes from -0.10 to 1.00 instead of -0.10 to 1.60" in n for n in made.notes
    )


def test_chains_of_mimics_follow_the_first_joint() -> None:
    text = urdf(mimic=True).replace(
        '<limit lower="-0.1" upper="1.6" effort="2" velocity="3"/></joint>\n<link name="index_2"',
        '<limit lower="-0.1" upper="1.6" effort="2" velocity="3"/>'
        '<mimic joint="index_j0" multiplier=".5" offset=".2"/></joint>\n<link name="index_2"',
    )
    read = hand_file.read(saved(text))
    # 0.8 (0.5 q + 0.2) + 0.1
    assert "index_j2 = 0.26 + 0.4 index_j0" in read.mimics


def test_the_reset_pose_is_inside_the_limits_and_adjustable() -> None:
    """Like Allegro's thumb, whose range is 0.26 to 1.40 rad."""
    made = author_hand(request(saved(urdf(thumb_low=0.3))))
    assert made.scene.index.reset[15] == 0.3 and made.scene.index.reset[:15].tolist() == [0] * 15
    made = author_hand(
        request(Path("hand.urdf"), replace=True, reset={"thumb_j0": 0.5}, place=(0.1, -0.3, 0.4))
    )
    assert made.scene.index.reset[15] == 0.5
    np.testing.assert_allclose(places(made)[0], [0.1, -0.3, 0.4], atol=1e-4)
    turned = author_hand(request(Path("hand.urdf"), replace=True, turn_deg=(0, 0, 90)))
    points = dict(zip(turned.cfg.points, places(turned), strict=True))
    assert points["mfdistal_point"][0] == pytest.approx(-0.187, abs=3e-3)  # from +y to -x


def test_fingers_without_names_are_found_by_geometry_or_asked_for() -> None:
    names = {name: f"chain{i}" for i, name in enumerate(("thumb", "ring", "index", "middle"))}
    made = author_hand(request(saved(urdf(names=names))))
    assert made.anatomy.found_by == "geometry"
    assert [f.human for f in made.anatomy.fingers] == list(FINGERS)
    assert made.side == "right"
    points = dict(zip(made.cfg.points, places(made), strict=True))
    assert points["thdistal_point"][0] < -0.1
    chosen = {"index": "chain0_2", "thumb": "chain2_j0", "middle": "chain3_1", "ring": "chain1_2"}
    few = {name: link for name, link in chosen.items() if name != "ring"}
    with pytest.raises(ConfigError, match=r"--fingers must name every finger, .* lacks 'chain1_2'"):
        author_hand(request(Path("hand.urdf"), name="x", fingers=few))
    with pytest.raises(ConfigError, match=r"index=nolink must name a link or joint .* 'chain2_2'"):
        author_hand(request(Path("hand.urdf"), name="x", fingers={"index": "nolink"}))
    made = author_hand(request(Path("hand.urdf"), name="asked", fingers=chosen))
    assert made.anatomy.found_by == "--fingers"


def test_it_is_the_users_own_and_can_be_removed() -> None:
    said = command("pgdm", "author", "hand", str(saved(urdf(FIVE, mimic=True))), "--name", "made")
    assert said.code == 0, said.err
    assert "coupled" in said.out and "10 with a servo each, 5 that follow" in said.out
    library = open_library()
    assert library.hands() == ["made"] and damaged(library) == []
    assert own.facts("made", "hand")["side"] == "right"
    folder = paths.user() / "library" / "hands" / "made"
    assert {p.name for p in folder.iterdir()} >= {"hand.xml", "hand.json"}
    assert "made" in command("pgdm", "author", "list").out
    cfg = compose(["task=hammer-use1", "hand=made"]).hand  # the settings are whole
    assert (cfg.name, cfg.mount_body, len(cfg.points)) == ("made", "mount", 16)
    again = command("pgdm", "author", "hand", "hand.urdf", "--name", "made")
    assert again.errors == ["error: you already have a hand 'made'; --replace replaces it"]
    with pytest.raises(ConfigError, match="you have a hand 'made'; choose another id"):
        own.check_task_name("made", (), replace=False)
    assert command("pgdm", "author", "remove", "made", "--yes").code == 0
    assert not settings_path("made").exists() and not folder.exists()
    with pytest.raises(UnknownNameError, match="unknown object, hand or task of your own 'made'"):
        remove_hand("made")


def test_a_scene_with_it_meets_the_contract_and_steps(library_home: Path) -> None:
    author_hand(request(saved(urdf(FIVE, mimic=True, thumb_low=0.2))))
    cfg = compose(["task=cup-pour1", "hand=made"])
    scene = build_scene(open_library(), cfg.task, cfg.hand, cfg.sim)
    assert scene.asset_source == "own+checkout"
    assert opposing_finger(scene, HandContact(scene)) == 4
    ran = command("pgdm-run", "task=cup-pour1", "hand=made", "pregrasp=none", "run_dir=run", *TINY)
    assert ran.code == 0, ran.err
    assert not is_reset_pose(scene, np.zeros(scene.model.nq))
    del library_home


def test_settings_without_a_model_are_found_out_before_the_run(library_home: Path) -> None:
    """A hand's settings alone are no hand: ``--dry-run`` says so, as the run would."""
    author_hand(request(saved(urdf()), name="ghost"))
    own.remove("ghost")
    assert settings_path("ghost").exists()
    ran = command("pgdm-run", "task=cup-pour1", "hand=ghost", "--dry-run")
    assert ran.code != 0
    assert "unknown hand 'ghost'" in ran.errors[0] and "'pgdm author hand'" in ran.errors[0]
    del library_home


FAULTS: dict[str, tuple[str, str]] = {
    "truncated": (urdf()[:900], "not well-formed XML"),
    "empty": ("", "not well-formed XML"),
    "other": ("<html></html>", "its root is <html>"),
    "bomb": (
        '<!DOCTYPE r [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;">]>' + urdf(),
        "defines XML entities",
    ),
    "outside entity": (
        '<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]><robot>&a;</robot>',
        "defines XML entities",
    ),
    "macro": (
        '<robot xmlns:xacro="http://x"><xacro:include filename="a"/></robot>',
        "has macros or foreign elements; expand it first",
    ),
    "nan": (urdf().replace('mass value=".03"', 'mass value="nan"', 1), 'has value="nan"'),
    "no limits": (
        re.sub(r'<limit lower="-0.1"[^/]*/>', "", urdf(), count=1),
        "joint 'index_j0' has no limits",
    ),
    "continuous": (
        urdf().replace('type="revolute"', 'type="continuous"', 1),
        "joint 'index_j0' is continuous; a hand's joints are revolute, prismatic, fixed",
    ),
    "mesh missing": (
        urdf().replace('<box size=".02 .08 .09"/>', '<mesh filename="m/palm.stl"/>'),
        "its file 'm/palm.stl' is missing",
    ),
    "escaping": (
        urdf().replace('<box size=".02 .08 .09"/>', '<mesh filename="../../palm.stl"/>'),
        "refers to '../../palm.stl', outside of",
    ),
    "absolute": (
        urdf().replace('<box size=".02 .08 .09"/>', '<mesh filename="/etc/palm.stl"/>'),
        "refers to '/etc/palm.stl', outside of",
    ),
    "no fingers": (urdf(()), "0 joints; a hand has 1 to"),
    "one finger": (urdf(("index",)), "chains of joints that end in a fingertip: 1 "),
    "mimics nobody": (
        urdf(mimic=True).replace('<mimic joint="index_j1"', '<mimic joint="nobody"'),
        "joint 'index_j2' mimics 'nobody', which is not a joint",
    ),
    "mimics itself": (
        urdf(mimic=True).replace('<mimic joint="index_j1"', '<mimic joint="index_j2"'),
        "joint 'index_j2' mimics itself, forming a cycle",
    ),
    "no contact": (
        re.sub(r"<collision>.*?</collision>", "", urdf()),
        "fingertip 'index_2' has no collision geometry",
    ),
    "heavy": (urdf(mass=400.0), "hand 'made' weighs 400 kg"),
    "loop": (
        mjcf(extra='<equality><connect body1="index_2" body2="ring_2" anchor="0 0 0"/></equality>'),
        "an equality constraint of kind 'connect'",
    ),
    "tendon drive": (
        mjcf().replace('<position name="index_a0" joint="index_j0"', '<position name="index_a0" tendon="passive"'),  # noqa: E501
        "actuator 'index_a0' pulls tendon 'passive'; .* --drop-tendons",
    ),
    "ball": (
        mjcf().replace('<joint name="ring_j0" axis="0 1 0" range="-6 90"/>', '<joint name="ring_j0" type="ball" range="0 90"/>').replace('<position name="ring_a0" joint="ring_j0" kp="2" kv=".05" ctrlrange="-.08 1.4"/>', "").replace("<keyframe>", "<!--").replace("</keyframe>", "-->"),  # noqa: E501
        "joint 'ring_j0' is not a hinge or slide",
    ),
    "plugin": (mjcf(extra='<extension><plugin plugin="x"/></extension>'), "has <extension>"),
    "includes itself": (mjcf(extra='<include file="hand.xml"/>'), "includes itself"),
    "include escapes": (
        mjcf(extra='<include file="../secret.xml"/>'),
        "refers to '../secret.xml', outside of",
    ),
    "deep": ("<mujoco>" + "<a>" * 3000 + "</a>" * 3000 + "</mujoco>", "nested more than"),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_bad_files_are_one_line_and_leave_nothing(fault: str) -> None:
    text, said = FAULTS[fault]
    name = "hand.xml" if text.startswith("<mujoco") else "hand.urdf"
    with pytest.raises(PgdmError, match=said) as error:
        author_hand(request(saved(text, name)))
    assert "\n" not in str(error.value) and "Traceback" not in str(error.value)
    assert not settings_path("made").exists()
    assert list((paths.user() / "library").glob("hands/*")) == []
    assert own.read().hands == []


def test_a_hundred_fingers_are_refused() -> None:
    names = tuple(f"f{i}" for i in range(100))
    links = "".join(
        f'<link name="{n}"><collision><geometry><sphere radius=".01"/></geometry></collision>'
        "</link>"
        f'<joint name="{n}j" type="revolute"><parent link="palm"/><child link="{n}"/>'
        f'<origin xyz="0 {i / 50} .1"/><axis xyz="0 1 0"/>'
        '<limit lower="0" upper="1" effort="1" velocity="1"/></joint>'
        for i, n in enumerate(names)
    )
    path = saved(f'<robot name="r"><link name="palm"/>{links}</robot>')
    with pytest.raises(PgdmError, match="100 joints; a hand has 1 to 60"):
        author_hand(request(path))


def test_a_file_with_too_many_joint_elements_is_refused_with_its_limit() -> None:
    path = saved(f'<robot name="r"><link name="palm"/>{481 * "<joint/>"}</robot>')
    with pytest.raises(PgdmError, match=r"1 bod.* 481 <joint> elements; .* at most 300 and 480$"):
        author_hand(request(path))


def test_a_link_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    secret = tmp_path.parent / "secret.stl"
    trimesh.creation.box((0.02, 0.08, 0.09)).export(secret)
    Path("palm.stl").symlink_to(secret)
    text = urdf().replace('<box size=".02 .08 .09"/>', '<mesh filename="palm.stl"/>')
    with pytest.raises(PgdmError, match=r"palm.stl: leads to .*secret.stl"):
        author_hand(request(saved(text)))


def test_meshes_of_a_package_are_found_and_copied() -> None:
    Path("made_description/meshes").mkdir(parents=True)
    trimesh.creation.box((0.02, 0.08, 0.09)).export("made_description/meshes/palm.stl")
    mesh = '<mesh filename="package://made_description/meshes/palm.stl"/>'
    text = urdf().replace('<box size=".02 .08 .09"/>', mesh)
    made = author_hand(request(saved(text)))
    assert (made.folder / "meshes" / "palm.stl").is_file()
    record = json.loads((made.folder / "hand.json").read_text())
    assert record["kind"] == "URDF" and len(record["sha256"]) == 64
    model = mujoco.MjModel.from_xml_path(str(made.folder / "hand.xml"))
    assert model.nkey == 1 and model.nu == 18


@given(st.text(max_size=30))
def test_options_are_numbers_or_one_line_errors(text: str) -> None:
    for read in (
        lambda: pairs("--x", [text]),
        lambda: numbers("--x", text),
        lambda: angles([text]),
    ):
        with contextlib.suppress(ConfigError):
            read()


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-3, 3))
def test_a_turned_file_gives_the_same_hand(x: float, y: float, z: float) -> None:
    """Whatever the frame of the file, palm and fingers are found where they are."""
    turn = Rotation.from_euler("xyz", (x, y, z))
    quat = " ".join(f"{q:.9f}" for q in turn.as_quat(scalar_first=True))
    text = mjcf().replace('<body name="palm" pos=".1 .2 .3"', f'<body name="palm" quat="{quat}"')
    text = text.replace('<geom name="floor" type="plane" size="1 1 .1"/>', "")
    model = mujoco.MjModel.from_xml_string(text)
    found = anatomy.find(model, {}, "it")
    np.testing.assert_allclose(turn.inv().apply(found.along), [0, 0, 1], atol=1e-3)
    np.testing.assert_allclose(turn.inv().apply(found.wrist), [0, 0.01, 0], atol=1e-3)
