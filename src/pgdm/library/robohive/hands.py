"""D'Hand and D'Manus, built from the fragments in the package ``robohive``."""

from __future__ import annotations

import copy
import itertools
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path

from pgdm.errors import CorruptAssetError
from pgdm.library.files import mjcf
from pgdm.library.files import model as model_file
from pgdm.library.robohive import hand_parts
from pgdm.library.robohive import hand_values as values


def dhand(sims: Path, defects: list[str]) -> ET.Element:
    """Return D'Hand with its six base joints and position actuators.

    Args:
        sims: the package's ``sims`` folder, unpacked.
        defects: messages about repairs are appended.

    Raises:
        CorruptAssetError: a fragment is missing, damaged or not the expected one.
    """
    folder = sims / "robel_sim" / "dhand" / "assets"
    parts = model_file.parse(folder / "dhand_dependencies.xml", defects, sims)
    motors = model_file.parse(folder / "dhand_wrist_dependencies.xml", defects, sims)
    chain = model_file.parse(folder / "dhand_wrist_chain.xml", defects, sims, folder)
    wrist = _first_body(chain, "wrist", folder)
    root = mjcf.model("dhand")
    meshes = folder.parent / "meshes"
    _assets(root, parts, {mesh.attrib["name"]: meshes for mesh in parts.iter("mesh")})
    _dhand_defaults(root, parts)
    wrist.attrib.update(values.DHAND_MOUNT)
    at = hand_parts.first_child_body(wrist)
    hand_parts.base_joints(wrist, at, values.HIGH_BASE_RANGES)
    _dhand_geoms(wrist)
    for carrier, (name, pos) in values.DHAND_POINTS.items():
        hand_parts.add_point(wrist, carrier, _point(name, pos))
    mjcf.add(root, "worldbody").append(wrist)
    hand_parts.contact_pairs(root, _dhand_pairs())
    section = hand_parts.base_actuators(root, values.DHAND_BASE_GAINS)
    section.extend([*_actuators(motors), *_actuators(parts)])
    return root


def _dhand_defaults(root: ET.Element, parts: ET.Element) -> None:
    own = next((d for d in parts.iter("default") if d.get("class") == "dHand"), None)
    if own is None:
        raise CorruptAssetError("dhand_dependencies.xml: no default class 'dHand'")
    for old in [d for d in own.findall("default") if d.get("class") in values.DHAND_CLASSES]:
        own.remove(old)
    look = {"conaffinity": "0", "contype": "0", "rgba": "0.3 0.3 1.0 0.5"}
    for name, attributes in values.DHAND_CLASSES.items():
        mjcf.add(mjcf.add(own, "default", class_=name), "geom", **{**look, **attributes})
    mjcf.add(mjcf.add(own, "default", class_="point"), "geom", **values.POINT_CLASS)
    mjcf.add(root, "default").append(own)


def _dhand_geoms(wrist: ET.Element) -> None:
    bodies = {body.get("name"): body.findall("geom") for body in wrist.iter("body")}
    try:
        for body, indices in values.DHAND_SHOWN.items():
            for index in indices:
                bodies[body][index].set("class", "vis_metal")
        for body, named in values.DHAND_NAMES.items():
            for index, name in named.items():
                bodies[body][index].set("name", name)
    except (KeyError, IndexError) as error:
        raise CorruptAssetError(f"dhand_chain.xml: not the expected one ({error})") from error


def _dhand_pairs() -> Iterable[tuple[str, str]]:
    for finger in ("FF", "PF"):
        for part in ("proximal", "middle", "distal", "tip"):
            yield f"MF_{part}", f"{finger}_{part}"
    for finger in ("FF", "MF", "PF"):
        for thumb, other in itertools.product(("tip", "distal"), ("tip", "distal")):
            yield f"TF_{thumb}", f"{finger}_{other}"
    yield "TF_middle", "FF_tip"
    yield "TF_metacarpel", "FF_tip"
    for finger in ("TF", "FF", "MF", "PF"):
        for part in range(1, 7):
            yield f"{finger}_tip", f"palm_{part}"


def dmanus(sims: Path, defects: list[str]) -> ET.Element:
    """Return D'Manus with its six base joints and position actuators.

    Args:
        sims: the package's ``sims`` folder, unpacked.
        defects: messages about repairs are appended.

    Raises:
        CorruptAssetError: a fragment is missing, damaged or not the expected one.
    """
    folder = sims / "dmanus_sim"
    parts = model_file.parse(folder / "assets" / "dmanus_assets.xml", defects, sims)
    chain = model_file.parse(folder / "assets" / "dmanus_chain.xml", defects, sims)
    palm = _first_body(chain, "palm", folder)
    root = mjcf.model("dmanus")
    kinds = {
        mesh.attrib["name"]: folder / "meshes" / Path(mesh.attrib["file"]).parent.name
        for mesh in parts.iter("mesh")
    }
    _assets(root, parts, kinds)
    _dmanus_defaults(root)
    stand = mjcf.add(mjcf.add(root, "worldbody"), "body", name="stand", **values.DMANUS_MOUNT)
    hand_parts.base_joints(stand, 0, values.HIGH_BASE_RANGES)
    palm.attrib.update({"pos": values.DMANUS_PALM, "childclass": "dmanus"})
    stand.append(palm)
    _lengthen_thumb(palm)
    _dmanus_body(palm)
    hand_parts.contact_pairs(root, values.DMANUS_PAIRS)
    section = hand_parts.base_actuators(root, values.DMANUS_BASE_GAINS)
    for joint, control in values.DMANUS_RANGES.items():
        same = {"joint": joint, "name": joint.replace("J", "A"), "ctrlrange": control}
        mjcf.add(section, "position", ctrllimited="true", kp=values.DMANUS_GAIN, **same)
    return root


def _dmanus_defaults(root: ET.Element) -> None:
    own = mjcf.add(mjcf.add(root, "default"), "default", class_="dmanus")
    dynamics = {"armature": values.DMANUS_ARMATURE, "damping": values.DMANUS_DAMPING}
    mjcf.add(own, "joint", limited="true", **dynamics)
    shown = {"type": "mesh", "group": "1", "contype": "0", "conaffinity": "0"}
    solid = {"contype": "0", "conaffinity": "1", "condim": "4", "margin": "0.0005", "group": "3"}
    for name, attributes in (
        ("viz_dmanus", {**shown, "rgba": "0.25 0.25 0.25 1"}),
        ("col_dmanus", {**solid, "rgba": "0.4 0.5 0.6 1"}),
        ("point", values.POINT_CLASS),
    ):
        mjcf.add(mjcf.add(own, "default", class_=name), "geom", **attributes)


def _lengthen_thumb(palm: ET.Element) -> None:
    """Insert a copy of the thumb's middle link between that link and the fingertip."""
    middle = next((b for b in palm.iter("body") if b.get("name") == "thumb_middle"), None)
    tip = None if middle is None else middle.find("body")
    if middle is None or tip is None:
        raise CorruptAssetError("dmanus_chain.xml: no body 'thumb_middle' with a fingertip")
    middle.remove(tip)
    extra = copy.deepcopy(middle)
    extra.attrib.update({"name": "thumb_middle_extra", "pos": tip.attrib["pos"]})
    for item in extra:
        name, mesh, shown = item.attrib["name"].partition("_mesh")
        item.set("name", f"{name}e{mesh}{shown}")
    extra.append(tip)
    middle.append(extra)


def _dmanus_body(palm: ET.Element) -> None:
    for item in palm.iter():
        name = item.get("class", "")
        if name.endswith("_dhand"):  # the fragments of both hands use this suffix
            item.set("class", name.replace("_dhand", "_dmanus"))
        if item.tag == "joint":
            item.set("range", values.DMANUS_RANGES[item.attrib["name"]])
    for carrier, (name, pos) in values.DMANUS_POINTS.items():
        hand_parts.add_point(palm, carrier, _point(name, pos))


def _point(name: str, pos: str) -> ET.Element:
    body = ET.Element("body", name=name)
    mjcf.add(body, "geom", name=name, pos=pos, class_="point")
    return body


def _first_body(chain: ET.Element, name: str, folder: Path) -> ET.Element:
    body = chain.find("body")
    if body is None or body.get("name") != name:
        raise CorruptAssetError(f"{folder.name}: the first body of its chain is not '{name}'")
    return body


def _assets(root: ET.Element, parts: ET.Element, folders: dict[str, Path]) -> None:
    section = mjcf.add(root, "asset")
    section.extend(parts.iter("material"))
    for mesh in parts.iter("mesh"):
        file = folders[mesh.attrib["name"]] / Path(mesh.attrib["file"]).name
        mesh.set("file", str(file))
        section.append(mesh)


def _actuators(parts: ET.Element) -> list[ET.Element]:
    return [motor for section in parts.findall("actuator") for motor in section]
