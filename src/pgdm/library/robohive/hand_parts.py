"""Parts common to all three hands: base joints with actuators, contact pairs, tracked points."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping, Sequence

from pgdm.errors import CorruptAssetError
from pgdm.library.files import mjcf
from pgdm.library.robohive import model_values as values


def base_joints(body: ET.Element, at: int, ranges: Mapping[str, str] | None = None) -> None:
    """Insert the six base joints into the first body of a hand.

    Args:
        body: the hand's first body.
        at: index among the body's children at which to insert.
        ranges: joint ranges that differ from those in ``BASE_JOINTS``, by joint.
    """
    for i, (name, kind, axis, usual) in enumerate(values.BASE_JOINTS):
        joint = ET.Element("joint", name=name, type=kind, axis=axis, pos="0 0 0")
        joint.set("range", (ranges or {}).get(name, usual))
        joint.set("damping", values.BASE_DAMPING)
        body.insert(at + i, joint)


def base_actuators(root: ET.Element, gains: Mapping[str, str]) -> ET.Element:
    """Append an actuator section with the base joints' position actuators and return it.

    Args:
        root: the hand's model.
        gains: gain of the slides (key ``T``) and of the hinges (``R``).
    """
    section = mjcf.add(root, "actuator")
    for name, _, _, control in values.BASE_JOINTS:
        servo(section, f"A_{name}", name, control, gains[name[2]])
    return section


def servo(section: ET.Element, name: str, joint: str, control: str, gain: str) -> None:
    """Append a position actuator of a joint, with its control range and its gain."""
    same = {"name": name, "joint": joint, "ctrllimited": "true", "ctrlrange": control}
    mjcf.add(section, "position", **same, kp=gain)


def contact_pairs(root: ET.Element, pairs: Iterable[Sequence[str]]) -> None:
    """Append a contact section with frictionless contact between pairs of geoms."""
    section = mjcf.add(root, "contact")
    for first, second in pairs:
        mjcf.add(section, "pair", geom1=first, geom2=second, condim="1")


def add_point(root_body: ET.Element, carrier: str, point: ET.Element) -> None:
    """Insert the body of a tracked point into a carrying body, before its child bodies.

    Args:
        root_body: the carrying body or an ancestor.
        carrier: name of the carrying body.
        point: the body to insert.

    Raises:
        CorruptAssetError: there is no carrying body.
    """
    for body in root_body.iter("body"):
        if body.get("name") == carrier:
            body.insert(first_child_body(body), point)
            return
    raise CorruptAssetError(f"hand fragments: no body '{carrier}'")


def first_child_body(body: ET.Element) -> int:
    """Return the index of the first child body among a body's children, or their number if none."""
    return next((i for i, child in enumerate(body) if child.tag == "body"), len(body))


def normalised(numbers: str) -> str:
    """Return a vector, given as text, scaled to length 1, with six significant digits.

    TCDM's Adroit was saved by MuJoCo, which normalises and writes six digits; the package has the
    hand-written original with three digits. This reproduces TCDM's digits exactly.
    """
    vector = [float(n) for n in numbers.split()]
    length = math.sqrt(sum(v * v for v in vector))
    return " ".join(f"{v / length:.6g}" for v in vector)


def quaternion(axis_angle: str) -> str:
    """Return the quaternion (wxyz) of an axis and an angle (rad), with six significant digits."""
    x, y, z, angle = (float(n) for n in axis_angle.split())
    length = math.sqrt(x * x + y * y + z * z)
    s = math.sin(0.5 * angle) / length
    return " ".join(f"{v:.6g}" for v in (math.cos(0.5 * angle), x * s, y * s, z * s))
