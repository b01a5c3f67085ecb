"""Build a hand's model as pgdm needs it: on six base joints, with a position servo per joint."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import mujoco
import numpy as np

from pgdm.author.hand.anatomy import Anatomy
from pgdm.author.hand.servos import KP, Servo
from pgdm.errors import ConfigError
from pgdm.library.couplings import Couplings
from pgdm.library.files import mjcf
from pgdm.sim.hand_model import RESET_KEY

MOUNT = "mount"
"""Body that the base joints move; its origin is the wrist."""

WRIST_M = (0.0, -0.27, 0.2)
"""Position of the wrist with the base joints at zero, world frame: Adroit's."""

# Axes of the mount in the world: the slides go left, up and forward, as those of the benchmark's
# hands; the fingers point forward (y) and the palm faces down.
_MOUNT = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, 1.0, 0.0]]).T
_BASE = (
    *(("base_x", (1, 0, 0), (-0.35, 0.35)), ("base_y", (0, 1, 0), (-0.2, 0.5))),
    *(("base_z", (0, 0, 1), (-0.3, 0.5)), ("base_rx", (1, 0, 0), (-1.75, 1.75))),
    *(("base_ry", (0, 1, 0), (-1.75, 1.75)), ("base_rz", (0, 0, 1), (-2.5, 2.5))),
)
"""Name, axis and range [m, rad] of the base joints."""
_BASE_KP, _BASE_DAMPING, _ARMATURE = (175.0, 150.0), 20.0, 0.001  # Adroit's; KP: slides, hinges

_STIFF_S2 = 2e-4  # least armature per servo gain that is stable with substeps of 4 ms
_SURFACE = {"friction": [1.0, 0.5, 0.01], "condim": 4, "margin": 0.0005}  # the benchmark's
# Every attribute is set, since the file's defaults would apply to added elements, too.
_JOINT = {
    **{"damping": f"{_BASE_DAMPING:g}", "armature": f"{_ARMATURE:g}", "limited": "true"},
    **{"frictionloss": "0.001", "stiffness": "0", "margin": "0", "pos": "0 0 0", "ref": "0"},
    **{"actuatorfrclimited": "false", "actuatorgravcomp": "false", "springref": "0"},
}
_SERVO = {
    **{"gear": "1 0 0 0 0 0", "dyntype": "none", "gaintype": "fixed", "biastype": "affine"},
    **{"ctrllimited": "true", "forcelimited": "false", "actlimited": "false"},
}
_POINT_M = 0.01


@dataclass(frozen=True)
class Plan:
    """How to build a hand's model."""

    name: str
    rotation: np.ndarray
    """Orientation (3, 3) of the file's frame in the world, base joints at zero."""
    place: np.ndarray
    """Position of the wrist (3,) m, world frame, base joints at zero."""
    servos: dict[str, Servo]
    """By joint; coupled joints have none."""
    ranges: dict[str, tuple[float, float]]
    """Narrowed ranges, by joint."""
    plain_surface: bool
    """Whether colliding geoms get the benchmark's friction, contact dimension and margin: URDF
    cannot state them."""
    reset: dict[str, float]
    """Reset positions, rad or m, of the joints that are not reset to zero."""
    excluded: list[tuple[str, str]]
    """Pairs of bodies that do not collide: they overlap in the reset pose."""


def named(xml: str) -> mujoco.MjSpec:
    """Return the spec of a hand, with names for the joints and bodies that had none."""
    spec = mujoco.MjSpec.from_string(xml)
    for kind, elements in (("joint", spec.joints), ("link", spec.bodies)):
        for number, element in enumerate(elements):
            if not element.name:
                element.name = f"{kind}{number}"
    return spec


def light(xml: str) -> str:
    """Return a hand with its colliding geoms only: other geoms' meshes take long to compile.

    Masses and inertias stay.
    """
    spec = named(xml)
    model = spec.compile()
    for body in spec.bodies[1:]:  # all but the world; their mass may come from geoms deleted below
        whole = model.body(body.name)
        if whole.mass[0] > 0:
            body.explicitinertial, body.fullinertia = True, [math.nan] * 6
            body.mass, body.inertia = float(whole.mass[0]), whole.inertia
            body.ipos, body.iquat = whole.ipos, whole.iquat
    for geom in [g for g in spec.geoms if not (g.contype or g.conaffinity)]:
        spec.delete(geom)
    used = {geom.meshname for geom in spec.geoms}
    for mesh in [m for m in spec.meshes if m.name not in used]:
        spec.delete(mesh)
    return spec.to_xml()


def build(xml: str, anatomy: Anatomy, plan: Plan) -> ET.Element:
    """Return the model of a hand: base, points, servos and reset pose.

    Args:
        xml: the hand as read.
        anatomy: parts of the hand.
        plan: servos, ranges and poses.
    """
    hand = named(xml)
    for name, (body, place) in anatomy.points.items():
        _point(hand.body(body), name, place)
    _set_joints(hand, plan)
    for element in (*hand.actuators, *_pulled(hand)):
        hand.delete(element)
    _set_surface(hand, plan)
    hand.modelname = plan.name
    hand.compile()
    joints = [joint.name for joint in hand.joints]
    root = ET.fromstring(hand.to_xml())
    for old in root.findall("size"):
        root.remove(old)
    world = root.find("worldbody")
    assert world is not None
    inside = list(world)
    world[:] = []
    mount = mjcf.add(world, "body", name=MOUNT, pos=_text(plan.place), quat=_text(_quat(_MOUNT)))
    for k, (name, axis, span) in enumerate(_BASE):
        kind = "slide" if k < 3 else "hinge"
        mjcf.add(
            mount, "joint", name=name, type=kind, axis=_text(axis), range=_text(span), **_JOINT
        )
    turned = _MOUNT.T @ plan.rotation
    frame = mjcf.add(mount, "frame", pos=_text(-turned @ anatomy.wrist), quat=_text(_quat(turned)))
    frame.extend(inside)
    servos = {n: Servo(_BASE_KP[k // 3], 0.0, *span, False) for k, (n, _, span) in enumerate(_BASE)}
    section = mjcf.add(root, "actuator")
    for name in (*servos, *(name for name in joints if name in plan.servos)):
        servo = servos.get(name) or plan.servos[name]
        low, high = plan.ranges.get(name, (servo.low, servo.high))
        span = max(low, servo.low), min(high, servo.high)
        gains = {"gainprm": _text((servo.kp, 0, 0)), "biasprm": _text((0, -servo.kp, 0))}
        mjcf.add(
            section,
            "general",
            name=f"A_{name}",
            joint=name,
            ctrlrange=_text(span),
            **gains,
            **_SERVO,
        )
    if plan.excluded:
        section = root.find("contact")
        section = mjcf.add(root, "contact") if section is None else section
        for one, two in plan.excluded:
            mjcf.add(section, "exclude", body1=one, body2=two)
    reset = [0.0] * len(_BASE) + [plan.reset.get(name, 0.0) for name in joints]
    mjcf.add(mjcf.add(root, "keyframe"), "key", name=RESET_KEY, qpos=_text(reset))
    return root


def _set_joints(hand: mujoco.MjSpec, plan: Plan) -> None:
    for joint in hand.joints:
        if joint.name in plan.ranges:
            joint.range = plan.ranges[joint.name]
        servo = plan.servos.get(joint.name)
        kp = KP if servo is None else servo.kp
        damping = np.atleast_1d(np.asarray(joint.damping, float))
        damping[0] = servo.damping if servo is not None else max(damping[0], 0.01 * kp)
        joint.damping = damping if np.ndim(joint.damping) else float(damping[0])
        joint.armature = max(float(joint.armature), _ARMATURE, _STIFF_S2 * kp)
    for equality in hand.equalities:
        equality.solref[:2] = (0.01, 1.0)
        equality.solimp[:3] = (0.95, 0.99, 0.001)


def _set_surface(hand: mujoco.MjSpec, plan: Plan) -> None:
    for geom in hand.geoms:
        if plan.plain_surface and (geom.contype or geom.conaffinity):
            geom.friction = _SURFACE["friction"]
            geom.condim, geom.margin = _SURFACE["condim"], _SURFACE["margin"]


def _pulled(hand: mujoco.MjSpec) -> list[mujoco.MjsTendon]:
    """Return the tendons that actuators drive."""
    kinds = mujoco.mjtTrn.mjTRN_TENDON
    names = {a.target for a in hand.actuators if a.trntype == kinds}
    return [tendon for tendon in hand.tendons if tendon.name in names]


def _point(body: mujoco.MjsBody, name: str, place: np.ndarray) -> None:
    child = body.add_body(name=name, pos=place)
    geom = child.add_geom(name=name, size=[_POINT_M, 0, 0], rgba=[1, 0, 0, 0], contype=0)
    geom.type, geom.conaffinity, geom.mass = mujoco.mjtGeom.mjGEOM_SPHERE, 0, 0.0


def reset_of(model: mujoco.MjModel, chosen: Mapping[str, float], label: str) -> dict[str, float]:
    """Return the reset position of each joint that is not at zero.

    A joint takes the position the user chose, else zero, or the limit nearest to zero.

    Args:
        model: the hand as read, with its narrowed ranges.
        chosen: positions by joint, rad or m.
        label: the hand's file, for messages.

    Raises:
        ConfigError: a joint is unknown, follows another, or would leave its range.
    """
    couplings = Couplings(model, model.njnt)
    qpos = np.zeros(model.nq).clip(*model.jnt_range.T)
    names = [model.joint(j).name for j in range(model.njnt)]
    for name, value in chosen.items():
        if name not in names:
            raise ConfigError(
                f"--reset {name}: {label} has no such joint; it has {', '.join(names)}"
            )
        joint = names.index(name)
        if joint in couplings.followers:
            raise ConfigError(f"--reset {name}: this joint follows another; set that one")
        low, high = model.jnt_range[joint]
        if not low <= value <= high:
            raise ConfigError(f"--reset {name}={value:g}: valid: {low:.3f} to {high:.3f}")
        qpos[joint] = value
    couplings.apply(qpos)
    return {name: float(q) for name, q in zip(names, qpos, strict=True) if q}


def _text(numbers: Iterable[float]) -> str:
    return " ".join(f"{float(number):.9g}" for number in numbers)


def _quat(rotation: np.ndarray) -> np.ndarray:
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(rotation).ravel())
    return quat
