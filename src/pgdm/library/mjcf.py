"""Small helpers to write MJCF."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Mapping

from pgdm.errors import CorruptAssetError
from pgdm.library import figures


def model(name: str) -> ET.Element:
    """Return an empty model."""
    return ET.Element("mujoco", model=name)


def add(parent: ET.Element, tag: str, **attributes: str) -> ET.Element:
    """Append an element; ``class_`` stands for ``class``."""
    element = ET.SubElement(parent, tag)
    element.attrib.update({key.rstrip("_"): value for key, value in attributes.items()})
    return element


def common_defaults(root: ET.Element) -> ET.Element:
    """Append the default classes of TCDM's models and return the section."""
    section = add(root, "default")
    for tag, values in figures.COMMON_DEFAULTS.items():
        add(section, tag, **values)
    return section


def object_defaults(root: ET.Element) -> None:
    """Append the common defaults with the objects' classes, and their material."""
    add(add(root, "asset"), "material", **figures.OBJECT_MATERIAL)
    section = common_defaults(root)
    for name, (tag, values) in figures.OBJECT_CLASSES.items():
        add(add(section, "default", class_=name), tag, **values)


def base_joints(body: ET.Element, at: int, ranges: Mapping[str, str] | None = None) -> None:
    """Insert the six joints that place a hand into its first body.

    Args:
        body: the hand's first body.
        at: index among the body's children.
        ranges: joint ranges that differ from the usual ones.
    """
    for i, (name, kind, axis, usual) in enumerate(figures.BASE_JOINTS):
        joint = ET.Element("joint", name=name, type=kind, axis=axis, pos="0 0 0")
        joint.set("range", (ranges or {}).get(name, usual))
        joint.set("damping", figures.BASE_DAMPING)
        body.insert(at + i, joint)


def base_actuators(section: ET.Element, gains: Mapping[str, str]) -> None:
    """Append the position actuators of the base joints.

    Args:
        section: the actuator section.
        gains: gain of the sliding (``T``) and of the turning (``R``) ones.
    """
    for name, _, _, control in figures.BASE_JOINTS:
        add(
            section,
            "position",
            name=f"A_{name}",
            joint=name,
            ctrllimited="true",
            ctrlrange=control,
            kp=gains[name[2]],
        )


def carry(root_body: ET.Element, carrier: str, point: ET.Element) -> None:
    """Put a body with a tracked point into another one, before the bodies that are there.

    Args:
        root_body: body below which the carrying one lies, or itself.
        carrier: name of the carrying body.
        point: what to put there.

    Raises:
        CorruptAssetError: the carrying body is missing.
    """
    for body in root_body.iter("body"):
        if body.get("name") == carrier:
            children = [i for i, child in enumerate(body) if child.tag == "body"]
            body.insert(children[0] if children else len(body), point)
            return
    raise CorruptAssetError(f"hand fragments: have no body '{carrier}'")


def object_joints(body: ET.Element) -> None:
    """Append the six one-degree-of-freedom joints on which an object hangs."""
    for kind, joint_type in (("T", "slide"), ("R", "hinge")):
        for letter, axis in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1")):
            add(
                body,
                "joint",
                name=f"OBJ{kind}{letter}",
                type=joint_type,
                axis=axis,
                pos="0 0 0",
                class_="freejoint",
            )


def normalised(numbers: str) -> str:
    """Return a vector scaled to length 1, six significant digits.

    TCDM's Adroit was saved by MuJoCo, which normalises and writes six digits; the package's is
    the hand-written original with three. This makes the second from the first to the last digit.
    """
    values = [float(n) for n in numbers.split()]
    length = math.sqrt(sum(v * v for v in values))
    return " ".join(f"{v / length:.6g}" for v in values)


def quaternion(axis_angle: str) -> str:
    """Return the quaternion (wxyz) of axis and angle (rad), six significant digits."""
    x, y, z, angle = (float(n) for n in axis_angle.split())
    length = math.sqrt(x * x + y * y + z * z)
    s = math.sin(0.5 * angle) / length
    return " ".join(f"{v:.6g}" for v in (math.cos(0.5 * angle), x * s, y * s, z * s))
