"""Comparing models: no difference between equal ones, and each kind of change is found."""

from __future__ import annotations

import mujoco
import pytest

from pgdm.library.checks.compare import compare, compare_options

MODEL = """<mujoco><compiler angle="radian"/><option timestep="0.004"/><asset>
<mesh name="m" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1"/></asset><worldbody>
<body name="a"><joint name="j" range="-1 1" limited="true" damping="2"/>
<geom name="g" size=".1"/><geom size=".1 .2" type="cylinder"/>
<geom name="v" size=".1" contype="0" conaffinity="0"/>
<body name="b" pos="0 0 1"><joint name="k"/><geom name="h" type="mesh" mesh="m"/></body></body>
</worldbody>
<contact><pair geom1="g" geom2="h" condim="1"/></contact>
<tendon><fixed name="t" limited="true" range="-1 1"><joint joint="j" coef="1"/>
<joint joint="k" coef="-.5"/></fixed></tendon>
<actuator><position name="p" joint="j" kp="5" ctrlrange="-1 1"/></actuator></mujoco>"""


def build(*change: str) -> mujoco.MjModel:
    assert not change or change[0] in MODEL
    return mujoco.MjModel.from_xml_string(MODEL.replace(*change) if change else MODEL)


def test_a_model_equals_itself() -> None:
    assert compare(build(), build()) == []
    assert compare_options(build(), build()) == []


@pytest.mark.parametrize(
    ("old", "new", "found"),
    [
        ('damping="2"', 'damping="3"', "joint j damping: 2 against 3"),
        ('range="-1 1" limited', 'range="-1 2" limited', "joint j range: -1 1 against -1 2"),
        ('name="g" size=".1"', 'name="g" size=".1" condim="4"', "geom g condim: 3 against 4"),
        ('size=".1 .2"', 'size=".1 .3"', "geom a[1] size: 0.1 0.2 0 against 0.1 0.3 0"),
        ('condim="1"', 'condim="3"', "pair g and h dim: 1 against 3"),
        ('coef="-.5"', 'coef=".5"', "tendon t coefficients: {'j': 1.0, 'k': -0.5} against"),
        ('ctrlrange="-1 1"', 'ctrlrange="-1 0"', "actuator p ctrlrange: -1 1 against -1 0"),
        ('pos="0 0 1"', 'pos="0 0 2"', "body b pos: 0 0 1 against 0 0 2"),
        ('name="k"', 'name="k" armature=".1"', "joint k armature: 0 against 0.1"),
        ('<pair geom1="g" geom2="h" condim="1"/>', "", "pair g and h present: yes against no"),
    ],
)
def test_a_changed_value_is_found_and_named(old: str, new: str, found: str) -> None:
    differences = compare(build(), build(old, new))
    assert any(str(d).startswith(found) for d in differences), [str(d) for d in differences]
    assert all(d.physical for d in differences)


def test_gain_mass_and_mesh_are_found() -> None:
    assert {d.attribute for d in compare(build(), build('kp="5"', 'kp="6"'))} == {
        "gainprm",
        "biasprm",
    }
    denser = compare(build(), build('".1 .2"', '".1 .2" density="5"'))
    assert "mass" in {d.attribute for d in denser}
    changed = compare(build(), build("0 0 .1", "0 0 .2"))
    assert "mesh" in {d.attribute for d in changed if d.element == "geom h"}


def test_what_only_shows_is_not_called_physical() -> None:
    differences = compare(build(), build('name="v" size=".1"', 'name="v" size=".2" mass="0"'))
    assert {d.element for d in differences if not d.physical} == {"geom v"}


def test_another_order_of_joints_is_found() -> None:
    swapped = build(
        '<joint name="k"/>', '<joint name="k"/>', 1
    )  # as it is: the order comes from the bodies
    assert compare(build(), swapped) == []
    one = "<mujoco><worldbody><body><geom size='1'/>{}{}</body></worldbody></mujoco>"
    x, y = "<joint name='x' type='slide'/>", "<joint name='y' type='slide' axis='1 0 0'/>"
    models = [mujoco.MjModel.from_xml_string(one.format(*o)) for o in ((x, y), (y, x))]
    assert [str(d) for d in compare(*models)] == ["joint order: x against y"]


def test_an_option_is_found() -> None:
    other = build('timestep="0.004"', 'timestep="0.002"')
    assert [str(d) for d in compare_options(build(), other)] == [
        "option timestep: 0.004 against 0.002"
    ]


def test_the_sign_of_a_quaternion_does_not_matter() -> None:
    turned = [
        mujoco.MjModel.from_xml_string(
            f'<mujoco><worldbody><body quat="{q}"><geom size="1"/></body></worldbody></mujoco>'
        )
        for q in (".6 .8 0 0", "-.6 -.8 0 0")
    ]
    assert compare(*turned) == []
