"""Writing MJCF: elements, and defaults shared by the models of TCDM (the authors' repository)."""

from __future__ import annotations

import xml.etree.ElementTree as ET

# Taken from the compiled models of a TCDM checkout. Lengths in m, densities in kg/m3.
_COMMON_DEFAULTS: dict[str, dict[str, str]] = {
    "joint": {
        "limited": "true",
        "margin": "0.01",
        "armature": "0.001",
        "damping": "0.05",
        "frictionloss": "0.001",
    },
    "geom": {"friction": "1 0.5 0.01", "margin": "0.0005", "density": "1250"},
    "site": {"size": "0.005 0 0", "rgba": "0.4 0.9 0.4 1"},
    "general": {"ctrllimited": "true", "ctrlrange": "-1 1"},
    "tendon": {"limited": "true"},
}
"""Defaults of objects, Adroit and the table scene; D'Hand and D'Manus use MuJoCo's defaults."""

_OBJECT_CLASSES: dict[str, tuple[str, dict[str, str]]] = {
    "object_visual": (
        "geom",
        {
            "type": "mesh",
            "contype": "0",
            "conaffinity": "0",
            "mass": "0",
            "group": "1",
            "material": "MatObject",
        },
    ),
    "object_contact": ("geom", {"type": "mesh", "density": "1250", "condim": "4"}),
    # TCDM's name for its six object joints (slides and hinges); not MuJoCo's free joint.
    "freejoint": ("joint", {"limited": "false", "damping": "0"}),
}
"""Default classes of the objects' geoms and joints."""

_OBJECT_MATERIAL = {
    "name": "MatObject",
    "specular": "0.75",
    "shininess": "0.1",
    "reflectance": "0.5",
    "rgba": "0.9 0.7 0.5 1",
}

_OBJECT_POS = "0 0 0.035"
"""Position of an object's body when its joints are zero; the scene replaces it."""


def model(name: str) -> ET.Element:
    """Return an empty model."""
    return ET.Element("mujoco", model=name)


def add(parent: ET.Element, tag: str, **attributes: str) -> ET.Element:
    """Append an element and return it; pass the attribute ``class`` as ``class_``."""
    element = ET.SubElement(parent, tag)
    element.attrib.update({key.rstrip("_"): value for key, value in attributes.items()})
    return element


def common_defaults(root: ET.Element) -> ET.Element:
    """Append the defaults shared by TCDM's models and return the section."""
    section = add(root, "default")
    for tag, values in _COMMON_DEFAULTS.items():
        add(section, tag, **values)
    return section


def object_defaults(root: ET.Element) -> None:
    """Append the objects' material, the common defaults and the objects' default classes."""
    add(add(root, "asset"), "material", **_OBJECT_MATERIAL)
    section = common_defaults(root)
    for name, (tag, values) in _OBJECT_CLASSES.items():
        add(add(section, "default", class_=name), tag, **values)


def object_body(root: ET.Element, inertial: dict[str, str] | None = None) -> ET.Element:
    """Append and return an object's body with its six joints: three slides, then three hinges.

    Args:
        root: the model.
        inertial: attributes of an explicit inertial frame, or None to derive it from the geoms.
    """
    body = add(add(root, "worldbody"), "body", name="object", pos=_OBJECT_POS)
    if inertial is not None:
        add(body, "inertial", **inertial)
    for kind, joint_type in (("T", "slide"), ("R", "hinge")):
        for letter, axis in (("x", "1 0 0"), ("y", "0 1 0"), ("z", "0 0 1")):
            place = {"type": joint_type, "axis": axis, "pos": "0 0 0", "class_": "freejoint"}
            add(body, "joint", name=f"OBJ{kind}{letter}", **place)
    return body
