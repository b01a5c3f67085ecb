"""The Franka Panda arm, built from the fragments in the package ``robohive``."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from pgdm.errors import CorruptAssetError, amount
from pgdm.library.files import mjcf
from pgdm.library.files import model as model_file

JOINT_RANGES_RAD = (
    "-2.8973 2.8973",
    "-1.7628 1.7628",
    "-2.8973 2.8973",
    "-3.0718 -0.0698",
    "-2.8973 2.8973",
    "-0.0175 3.7525",
    "-2.8973 2.8973",
)
"""Position limits of joints 1 to 7, from the manufacturer's documentation of the Panda."""

FLANGE_M = 0.107
"""Distance of the flange from the last joint along its axis (manufacturer's DH table)."""

_EXACT = "0.7071067811865476 0.7071067811865476 0 0"
_ARMATURE = "0.1"
"""Estimated reflected inertia of the motors, kg m2; the package states none."""
_LOOKS = {"panda_viz": "0.92 0.92 0.95 1", "panda_grey_viz": "0.4 0.4 0.4 1"}


def panda(sims: Path, defects: list[str]) -> ET.Element:
    """Return the arm without gripper: joints ``joint1`` to ``joint7`` and the site ``flange``.

    The package shifts joint 6 by a quarter turn and joint 7 by an eighth, and rounds their frames;
    here all joints have the manufacturer's zeros and limits. There are no actuators. Collision
    geoms touch the objects and the table, but not the hand.

    Args:
        sims: the package's ``sims`` folder, unpacked.
        defects: messages about repairs are appended.

    Raises:
        CorruptAssetError: a fragment is missing, damaged or not the expected one.
    """
    folder = sims / "franka_sim"
    parts = model_file.parse(folder / "assets" / "assets.xml", defects, sims)
    chain = model_file.parse(folder / "assets" / "chain0_nogripper.xml", defects, sims)
    base = chain.find("body")
    links = [] if base is None else list(base.iter("body"))
    if base is None or len(links) != len(JOINT_RANGES_RAD) + 1:
        raise CorruptAssetError(
            f"{folder.name}: its chain has {amount(len(links), 'body', 'bodies')}, not 8"
        )
    root = mjcf.model("panda")
    _defaults(root)
    section = mjcf.add(root, "asset")
    used = {geom.get("mesh") for geom in base.iter("geom")}
    for mesh in parts.iter("mesh"):
        if mesh.get("name") in used:
            kind = "collision" if mesh.attrib["name"].endswith("_col") else "visual"
            mesh.set("file", str(folder / "meshes" / kind / Path(mesh.attrib["file"]).name))
            section.append(mesh)
    for number, link in enumerate(links):
        _rebuild(link, number)
    mjcf.add(links[-1], "site", name="flange", pos=f"0 0 {FLANGE_M}")
    mjcf.add(root, "worldbody").append(base)
    return root


def _defaults(root: ET.Element) -> None:
    own = mjcf.add(mjcf.add(root, "default"), "default", class_="panda")
    mjcf.add(own, "joint", axis="0 0 1", limited="true", armature=_ARMATURE)
    for name, colour in _LOOKS.items():
        bare = {"contype": "0", "conaffinity": "0", "group": "1", "mass": "0"}
        mjcf.add(mjcf.add(own, "default", class_=name), "geom", type="mesh", rgba=colour, **bare)
    solid = {"contype": "0", "conaffinity": "1", "group": "3", "rgba": "0.5 0.6 0.7 1"}
    mjcf.add(mjcf.add(own, "default", class_="panda_col"), "geom", type="mesh", **solid)


def _rebuild(link: ET.Element, number: int) -> None:
    link.set("name", f"link{number}")
    for item in link.findall("camera") + link.findall("site"):
        link.remove(item)
    if number >= 6:  # in the package, frames 6 and 7 include the joint shifts
        link.attrib.pop("euler", None)
        link.set("quat", _EXACT)
    elif "quat" in link.attrib:
        link.set("quat", link.attrib["quat"].replace("0.707107", "0.7071067811865476"))
    joint = link.find("joint")
    if (joint is None) != (number == 0):
        raise CorruptAssetError(
            f"franka_sim: body {number} of its chain: body 0 must have no joint, all others one"
        )
    if joint is not None:
        joint.attrib = {"name": f"joint{number}", "range": JOINT_RANGES_RAD[number - 1]}
