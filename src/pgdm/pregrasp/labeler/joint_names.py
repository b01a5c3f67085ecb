"""Readable names of a hand's joints, such as ``index knuckle``."""

from __future__ import annotations

import re
from dataclasses import dataclass

import mujoco
import numpy as np

from pgdm.sim.scene import Scene

PALM = "palm"
FOREARM = "forearm"
"""Parts of the hand that belong to no finger."""
WRIST = "Wrist"
"""Group of the base and wrist joints."""

_SLIDES = ("sideways", "forward", "height")  # along the world's x, y, z
_TURNS = ("tilt", "roll", "turn")  # about the world's x, y, z
_FINGERS = {
    **dict.fromkeys(("ff", "if"), "index"),
    "mf": "middle",
    "rf": "ring",
    **dict.fromkeys(("lf", "pf"), "little"),
    **dict.fromkeys(("th", "tf"), "thumb"),
}
# Labels by hand, then by the ending of the joint's name in the model. For hands that are not listed
# here, the page shows the model's names.
_JOINTS: dict[str, dict[str, str]] = {
    "adroit": {
        **{"WRJ1": "bend sideways", "WRJ0": "bend"},
        **{"THJ4": "swing", "THJ3": "lift", "THJ2": "lean", "THJ1": "knuckle", "THJ0": "tip joint"},
        **{"LFJ4": "palm", "J3": "spread", "J2": "knuckle", "J1": "mid joint", "J0": "tip joint"},
    },
    "dhand": {
        **{"WR_ADB": "bend sideways", "WR_UD": "bend", "TF_MCP": "lift", "TF_ADB": "swing"},
        **{"ADB": "spread", "MCP": "knuckle", "PIP": "mid joint", "DIP": "tip joint"},
    },
    "dmanus": {"J1": "spread", "J2e": "mid joint", "J2": "knuckle", "J3": "tip joint"},
}


@dataclass(frozen=True)
class Joint:
    """A joint of the hand, as the page shows it."""

    index: int
    """Index in qpos."""
    label: str
    """Name within the group, such as ``spread``."""
    group: str
    """``Wrist``, ``Palm``, or the finger's name, such as ``Index``."""
    name: str
    """Name in the model."""
    is_slide: bool
    """Whether the joint is a slide (position in m) and not a hinge (rad)."""

    @property
    def unit(self) -> str:
        """Unit that the page shows."""
        return "mm" if self.is_slide else "deg"

    @property
    def scale(self) -> float:
        """Factor from m or rad to the unit that the page shows."""
        return 1e3 if self.is_slide else 180.0 / np.pi

    @property
    def full(self) -> str:
        """Group and label, such as ``index spread``."""
        return f"{self.group.lower()} {self.label}"


@dataclass(frozen=True)
class Finger:
    """A finger: the joints between the palm and a fingertip."""

    name: str
    """Name, such as ``index``."""
    tip_body: int
    """Body whose origin is the fingertip."""
    joints: tuple[int, ...]
    """Indices in qpos, from the palm outwards."""


def fingers(scene: Scene) -> list[Finger]:
    """Return the scene's fingers, in the order of the fingertips."""
    model, hand, index = scene.model, scene.hand, scene.index
    first = hand.num_base_joints + hand.num_wrist_joints
    found = []
    for point in index.fingertips.tolist():
        body = tip = int(index.point_bodies[point])
        joints: list[int] = []
        while body:
            own = range(model.body_jntadr[body], model.body_jntadr[body] + model.body_jntnum[body])
            of_finger = [j for j in own if first <= j < index.num_joints]
            joints[:0] = of_finger
            body = int(model.body_parentid[body])
        name = _finger_name(model, hand.points[point], joints)
        found.append(Finger(name, tip, tuple(joints)))
    return found


def joints(scene: Scene) -> list[Joint]:
    """Return the joints of the scene's hand, in the order of qpos."""
    model, hand = scene.model, scene.hand
    of_finger = {joint: one.name for one in fingers(scene) for joint in one.joints}
    found = []
    for i in range(scene.index.num_joints):
        name = model.joint(i).name.rpartition("/")[2]
        slide = bool(model.jnt_type[i] == mujoco.mjtJoint.mjJNT_SLIDE)
        if i < hand.num_base_joints:
            names = _SLIDES if slide else _TURNS
            label = names[_world_axis(scene, i)]
        else:
            label = _joint_name(hand.name, name)
        wrist = i < hand.num_base_joints + hand.num_wrist_joints
        group = WRIST if wrist else of_finger.get(i, PALM).capitalize()
        found.append(Joint(i, label, group, name, slide))
    return found


def _world_axis(scene: Scene, joint: int) -> int:
    """Return the world axis (0 to 2) nearest to a base joint's axis if all base joints are zero."""
    turned = np.empty(3)
    mujoco.mju_rotVecQuat(turned, scene.model.jnt_axis[joint], scene.index.mount_quat)
    return int(np.abs(turned).argmax())


def _finger_name(model: mujoco.MjModel, point: str, joints: list[int]) -> str:
    """Return a finger's name, from its joints: D'Manus's points are named after other fingers.

    If the joints' names are unknown, the name comes from the finger's point.
    """
    prefix = model.joint(joints[0]).name.rpartition("/")[2][:2].lower() if joints else ""
    return _FINGERS.get(prefix) or _FINGERS.get(point[:2]) or re.sub(r"[_]?point$", "", point)


def _joint_name(hand: str, joint: str) -> str:
    for ending, label in _JOINTS.get(hand, {}).items():
        if joint.endswith(ending):
            return label
    return joint
