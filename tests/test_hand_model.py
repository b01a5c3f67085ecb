"""The contract of a hand's model: what breaks it is named; actuators may come in any order."""

from __future__ import annotations

import hashlib
import re
import shutil
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from command_line import TINY, command
from pgdm.config.compose import compose
from pgdm.errors import SceneError
from pgdm.library import open_library
from pgdm.library.couplings import Couplings
from pgdm.sim.batch import SimBatch
from pgdm.sim.hand_model import BASE, joint_actuators, reset_joints, six_joints
from pgdm.sim.scene import HandCfg, Scene, build_scene

HAND = HandCfg("h", [], [], [], "all", 6, 0, [], "arm")
AXES = ("1 0 0", "0 1 0", "0 0 1")
JOINTS = "".join(
    f'<joint name="h/b{i}" type="{kind}" axis="{AXES[i % 3]}" range="-1 1"/>\n'
    for i, kind in enumerate(("slide",) * 3 + ("hinge",) * 3)
)
SERVOS = "".join(
    f'<position name="h/m{i}" joint="h/{joint}" kp="5" ctrlrange="-1 1"/>\n'
    for i, joint in enumerate((*(f"b{i}" for i in range(6)), "f0", "f1"))
)
OBJECT = """<body name="object" pos="0 1 0"><geom size=".1"/>
<joint name="fall" type="slide" axis="0 0 1"/></body>"""
XML = f"""<mujoco><compiler angle="radian"/><worldbody>
<body name="h/arm"><geom size=".1"/>
{JOINTS}<body name="h/finger" pos="0 0 .1"><geom size=".1"/><joint name="h/f0" range="-1 1"/>
<body name="h/tip" pos="0 0 .1"><geom size=".1"/><joint name="h/f1" range="-1 1"/></body>
</body></body>
{OBJECT}</worldbody>
<tendon><fixed name="h/both"><joint joint="h/f0" coef="1"/><joint joint="h/f1" coef="1"/>
</fixed></tendon>
<actuator>
{SERVOS}</actuator><equality></equality></mujoco>"""


def servo(number: int) -> str:
    return SERVOS.splitlines()[number]


M7 = servo(7)
BROKEN = {
    "no ctrlrange": (M7, M7.replace(' ctrlrange="-1 1"', ""), "'h/m7' has no ctrlrange"),
    "torque motor": (
        M7,
        '<motor name="m" joint="h/f1" ctrlrange="-1 1"/>',
        "'m' is not a position",
    ),
    "velocity": (M7, '<velocity name="m" joint="h/f1" ctrlrange="-1 1"/>', "'m' is not a position"),
    "filtered": (M7, M7.replace("kp=", 'timeconst=".1" kp='), "'h/m7' is not a position"),
    "gear": (M7, M7.replace("kp=", 'gear="2" kp='), "'h/m7' is not a position"),
    "tendon": (M7, M7.replace("joint=", "tendon=").replace("h/f1", "h/both"), "drives a tendon"),
    "passive": (M7, "", "joint 'h/f1' has no actuator"),
    "two": (M7, M7.replace("h/f1", "h/f0"), "joint 'h/f0' has a second actuator 'h/m7'"),
    "of the object": (M7, M7.replace("h/f1", "fall"), "'h/m7' drives 'fall', not the hand"),
    "coupled and driven": (
        "<equality>",
        '<equality><joint joint1="h/f1" joint2="h/f0"/>',
        "'h/m7' drives 'h/f1', which an equality constraint makes follow another joint",
    ),
    "held": (
        "<equality>",
        '<equality><joint joint1="h/f0"/>',
        "an equality constraint acts on 'h/f0'",
    ),
    "base coupled": (
        "<equality>",
        '<equality><joint joint1="h/f1" joint2="h/b3"/>',
        "joint 'h/f1' follows 'h/b3'; neither may be a base joint",
    ),
    "out of range": (
        "<equality>",
        '<equality><joint joint1="h/f1" joint2="h/f0" polycoef="0 1.5 0 0 0"/>',
        "joint 'h/f1' leaves its range by 0.500 when 'h/f0' moves over its range",
    ),
    "not active": (
        "<equality>",
        '<equality><joint joint1="h/f1" joint2="h/f0" active="false"/>',
        "but the constraint is not active",
    ),
    "reset": (
        "</mujoco>",
        '<keyframe><key name="h/reset" qpos="0 0 0 0 0 0 0 1.2 0"/></keyframe></mujoco>',
        "keyframe 'reset' has joint 'h/f1' at 1.200",
    ),
    "reset base": (
        "</mujoco>",
        '<keyframe><key name="h/reset" qpos="0 .1 0 0 0 0 0 0 0"/></keyframe></mujoco>',
        "keyframe 'reset' has joint 'h/b1' at 0.100",
    ),
    "closed loop": (
        "<equality>",
        '<equality><weld body1="object" body2="h/tip"/>',
        "an equality constraint acts on 'h/tip'",
    ),
    "coupled tendon": (
        "<equality>",
        '<equality><tendon tendon1="h/both"/>',
        "an equality constraint acts on 'h/both'",
    ),
    "free base": (JOINTS, '<freejoint name="h/free"/>', "joint 'h/free' is a free joint"),
    "ball object": ('type="slide" axis="0 0 1"/></body>', 'type="ball"/></body>', "a ball joint"),
    "free object": (
        '<joint name="fall" type="slide" axis="0 0 1"/>',
        '<freejoint name="fall"/>',
        "'fall' is a free joint",
    ),
    "unlimited": ('"h/f1" range="-1 1"', '"h/f1"', "joint 'h/f1' has no range"),
    "ref": ('"h/f1" range', '"h/f1" ref=".3" range', "joint 'h/f1' has ref 0.3"),
    "base short": (
        JOINTS.splitlines()[5],
        "",
        "joint number 6 is 'h/f0'; .* must be a hinge about z",
    ),
    "base order": (
        'axis="1 0 0"',
        'axis="0 1 0"',
        f"joint number 1 is 'h/b0'; .* must be a {BASE[0]}",
    ),
    "base kind": ('"h/b3" type="hinge"', '"h/b3" type="slide"', "joint number 4 is 'h/b3'"),
    "base away": ('"h/b4" type', '"h/b4" pos="0 0 1" type', "joint number 5 is 'h/b4'"),
}


def actuators(xml: str, hand: HandCfg = HAND) -> list[int]:
    model = mujoco.MjModel.from_xml_string(xml)
    found = joint_actuators(model, hand)
    reset_joints(model, hand, len(found))
    return found.tolist()


@pytest.mark.parametrize("fault", BROKEN)
def test_what_breaks_the_contract_is_named(fault: str) -> None:
    old, new, said = BROKEN[fault]
    assert old in XML
    xml = XML.replace(old, new, 1)
    if fault in ("free base", "base short"):  # the actuators of joints that are gone
        xml = re.sub(r'<position.*"h/b[0-5]".*\n', "", xml)
    with pytest.raises(SceneError, match=f"hand 'h': .*{said}") as error:
        actuators(xml)
    assert "\n" not in str(error.value) and "docs/extending.md" in str(error.value)


def test_what_the_settings_say_must_be_in_the_model() -> None:
    assert actuators(XML) == list(range(8))
    with pytest.raises(SceneError, match=r"hand.num_base_joints is 3; it must be 6"):
        actuators(XML, replace(HAND, num_base_joints=3))
    with pytest.raises(SceneError, match=r"it has 8 joints 'h/...', fewer than"):
        actuators(XML, replace(HAND, num_wrist_joints=3))
    with pytest.raises(SceneError, match=r"it has 0 joints 'k/...', fewer than .*must be 'k'"):
        actuators(XML, replace(HAND, name="k"))
    with pytest.raises(SceneError, match=r"must be a slide .* mount body 'h/finger'"):
        actuators(XML, replace(HAND, mount_body="finger"))


def test_a_coupled_joint_has_no_actuator_of_its_own() -> None:
    """f1 = 0.1 + 0.5 f0 + 0.2 f0^2: at f0 = 0.5 that is 0.4, with slope 0.7."""
    coupled = '<equality><joint joint1="h/f1" joint2="h/f0" polycoef=".1 .5 .2 0 0"/>'
    xml = XML.replace(M7, "").replace("<equality>", coupled)
    assert actuators(xml) == [0, 1, 2, 3, 4, 5, 6, -1]
    couplings = Couplings(mujoco.MjModel.from_xml_string(xml), 8)
    joints = np.full(9, 0.5)
    np.testing.assert_allclose(couplings.apply(joints)[6:], [0.5, 0.4, 0.5])
    np.testing.assert_allclose(couplings.slopes(joints), [0.7])
    folded = couplings.folded(np.arange(9.0)[None], joints)
    np.testing.assert_allclose(folded[0, 6:], [6.0 + 0.7 * 7.0, 7.0, 8.0])


def test_the_reset_pose_is_that_of_the_keyframe() -> None:
    key = '<keyframe><key name="h/reset" qpos="0 0 0 0 0 0 .3 -.2 .7"/></keyframe></mujoco>'
    model = mujoco.MjModel.from_xml_string(XML.replace("</mujoco>", key))
    np.testing.assert_array_equal(reset_joints(model, HAND, 8), [0] * 6 + [0.3, -0.2])
    plain = mujoco.MjModel.from_xml_string(XML)
    np.testing.assert_array_equal(reset_joints(plain, HAND, 8), np.zeros(8))


def test_the_objects_joints_come_after_the_hands() -> None:
    xml = XML.replace(OBJECT, "").replace('<body name="h/arm">', f'{OBJECT}<body name="h/arm">')
    with pytest.raises(SceneError, match="joint 'fall' is not the hand's; the hand's must come"):
        actuators(xml)


def test_an_objects_joints_are_read_too() -> None:
    """An object with other axes, or hinges before slides, does not follow a motion."""
    for old, new, six in (("", "", True), ('axis="0 1 0"', 'axis="0 1 1"', False)):
        model = mujoco.MjModel.from_xml_string(XML.replace(old, new))
        assert six_joints(model, model.body("h/arm").id) is six
        assert not six_joints(model, model.body("object").id)


def test_actuators_may_come_in_any_order() -> None:
    shuffled = XML.replace(SERVOS, "\n".join(servo(i) for i in (6, 7, 1, 0, 2, 3, 5, 4)))
    assert actuators(shuffled) == [3, 2, 4, 5, 7, 6, 0, 1]


@pytest.fixture
def copied(library_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the D'Manus hand's file in a library of the test's own."""
    shutil.copytree(library_home, tmp_path / "home")
    monkeypatch.setenv("PGDM_HOME", str(tmp_path / "home"))
    return tmp_path / "home" / "library" / "checkout" / "hands" / "dmanus" / "hand.xml"


def write(copied: Path, text: str) -> None:
    """Replace the hand's file and what the library recorded of it."""
    recorded = copied.parents[2] / "manifest.json"
    before = hashlib.sha256(copied.read_bytes()).hexdigest()
    copied.write_text(text)
    after = hashlib.sha256(copied.read_bytes()).hexdigest()
    recorded.write_text(recorded.read_text().replace(before, after))


def crackerbox() -> Scene:
    cfg = compose(["task=dmanus-crackerbox"])
    return build_scene(open_library(), cfg.task, cfg.hand, cfg.sim)


def swung(scene: Scene) -> np.ndarray:
    """Return the hand's joints after 20 steps towards targets that differ from joint to joint."""
    sim = SimBatch(scene, 1, 1, 5)
    sim.reset(np.array([0]), np.zeros(scene.model.nq), np.zeros(scene.model.nv))
    index = scene.index
    shares = np.linspace(0.2, 0.8, index.num_actuators)
    for _ in range(20):
        sim.step((index.ctrl_low + shares * (index.ctrl_high - index.ctrl_low))[None])
    return sim.read().qpos[0, : index.num_actuators].numpy()


def test_a_hand_with_its_actuators_reversed_moves_the_same(copied: Path) -> None:
    before = swung(crackerbox())
    text = copied.read_text()
    block = re.search(r"<actuator>(.*?)</actuator>", text, re.DOTALL)
    assert block is not None
    servos = re.findall(r"<[a-z]+ [^>]*/>", block[1])
    assert len(servos) == 16
    write(copied, text.replace(block[1], "\n".join(reversed(servos))))
    scene = crackerbox()
    assert scene.index.actuators.tolist() == list(range(15, -1, -1))
    assert swung(scene) == pytest.approx(before, abs=1e-9)


def test_a_run_with_a_wrong_hand_does_not_start(copied: Path) -> None:
    text = copied.read_text()
    joint = re.search(r'<(?:position|general) [^>]*joint="([^"]+)"[^>]*/>', text)
    assert joint is not None
    write(copied, text.replace(joint[0], f'<motor name="torque" joint="{joint[1]}"/>'))
    run = command("pgdm-run", "task=dmanus-crackerbox", "--offline", *TINY, "run_dir=run")
    assert run.code == 1 and len(run.errors) == 1
    assert "actuator 'dmanus/torque' is not a position servo" in run.errors[0]
    assert not Path("run/metrics.jsonl").exists()
