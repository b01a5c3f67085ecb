"""D'Hand and D'Manus made from the fragments in the package ``robohive``."""

from __future__ import annotations

import copy
import itertools
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path

from pgdm.errors import CorruptAssetError
from pgdm.library import hand_figures, mjcf, model_file


def dhand(sims: Path, defects: list[str]) -> ET.Element:
    """Return D'Hand with its six base joints and position actuators.

    Args:
        sims: the package's ``sims`` folder, unpacked.
        defects: messages about what was repaired are added here.

    Raises:
        CorruptAssetError: a fragment is missing, damaged or not the one expected.
    """
    folder = sims / "robel_sim" / "dhand" / "assets"
    parts = model_file.parse(folder / "dhand_dependencies.xml", defects, sims)
    motors = model_file.parse(folder / "dhand_wrist_dependencies.xml", defects, sims)
    chain = model_file.parse(folder / "dhand_wrist_chain.xml", defects, sims, folder)
    wrist = _first_body(chain, "wrist", folder)
    root = mjcf.model("dhand")
    _assets(root, parts, {m: folder.parent / "meshes" for m in _meshes(parts)})
    _dhand_defaults(root, parts)
    wrist.attrib.update(hand_figures.DHAND_MOUNT)
    place = next((i for i, child in enumerate(wrist) if child.tag == "body"), len(wrist))
    mjcf.base_joints(wrist, place, hand_figures.HIGH_BASE_RANGES)
    _dhand_geoms(wrist)
    for carrier, (name, at) in hand_figures.DHAND_POINTS.items():
        mjcf.carry(wrist, carrier, _point(name, at))
    mjcf.add(root, "worldbody").append(wrist)
    contact = mjcf.add(root, "contact")
    for first, second in _dhand_pairs():
        mjcf.add(contact, "pair", geom1=first, geom2=second, condim="1")
    section = mjcf.add(root, "actuator")
    mjcf.base_actuators(section, hand_figures.DHAND_BASE_GAINS)
    section.extend([*_actuators(motors), *_actuators(parts)])
    return root


def _dhand_defaults(root: ET.Element, parts: ET.Element) -> None:
    own = next((d for d in parts.iter("default") if d.get("class") == "dHand"), None)
    if own is None:
        raise CorruptAssetError("dhand_dependencies.xml: has no default class 'dHand'")
    for old in [d for d in own.findall("default") if d.get("class") in hand_figures.DHAND_CLASSES]:
        own.remove(old)
    look = {"conaffinity": "0", "contype": "0", "rgba": "0.3 0.3 1.0 0.5"}
    for name, values in hand_figures.DHAND_CLASSES.items():
        mjcf.add(mjcf.add(own, "default", class_=name), "geom", **{**look, **values})
    mjcf.add(mjcf.add(own, "default", class_="point"), "geom", **hand_figures.POINT_CLASS)
    mjcf.add(root, "default").append(own)


def _dhand_geoms(wrist: ET.Element) -> None:
    bodies = {body.get("name"): body.findall("geom") for body in wrist.iter("body")}
    try:
        for body, places in hand_figures.DHAND_SHOWN.items():
            for place in places:
                bodies[body][place].set("class", "vis_metal")
        for body, named in hand_figures.DHAND_NAMES.items():
            for place, name in named.items():
                bodies[body][place].set("name", name)
    except (KeyError, IndexError) as error:
        raise CorruptAssetError(f"dhand_chain.xml: is not the one expected ({error})") from error


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
        defects: messages about what was repaired are added here.

    Raises:
        CorruptAssetError: a fragment is missing, damaged or not the one expected.
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
    stand = mjcf.add(mjcf.add(root, "worldbody"), "body", name="stand", **hand_figures.DMANUS_MOUNT)
    mjcf.base_joints(stand, 0, hand_figures.HIGH_BASE_RANGES)
    palm.attrib.update({"pos": hand_figures.DMANUS_PALM, "childclass": "dmanus"})
    stand.append(palm)
    _lengthen_thumb(palm)
    _dmanus_body(palm)
    contact = mjcf.add(root, "contact")
    for first, second in hand_figures.DMANUS_PAIRS:
        mjcf.add(contact, "pair", geom1=first, geom2=second, condim="1")
    section = mjcf.add(root, "actuator")
    mjcf.base_actuators(section, hand_figures.DMANUS_BASE_GAINS)
    for joint, control in hand_figures.DMANUS_RANGES.items():
        same = {"joint": joint, "name": joint.replace("J", "A"), "ctrlrange": control}
        mjcf.add(section, "position", ctrllimited="true", kp=hand_figures.DMANUS_GAIN, **same)
    return root


def _dmanus_defaults(root: ET.Element) -> None:
    own = mjcf.add(mjcf.add(root, "default"), "default", class_="dmanus")
    dynamics = {"armature": hand_figures.DMANUS_ARMATURE, "damping": hand_figures.DMANUS_DAMPING}
    mjcf.add(own, "joint", limited="true", **dynamics)
    shown = {"type": "mesh", "group": "1", "contype": "0", "conaffinity": "0"}
    solid = {"contype": "0", "conaffinity": "1", "condim": "4", "margin": "0.0005", "group": "3"}
    for name, values in (
        ("viz_dmanus", {**shown, "rgba": "0.25 0.25 0.25 1"}),
        ("col_dmanus", {**solid, "rgba": "0.4 0.5 0.6 1"}),
        ("point", hand_figures.POINT_CLASS),
    ):
        mjcf.add(mjcf.add(own, "default", class_=name), "geom", **values)


def _lengthen_thumb(palm: ET.Element) -> None:
    """Put a second copy of the thumb's middle link between the first and the fingertip."""
    middle = next((b for b in palm.iter("body") if b.get("name") == "thumb_middle"), None)
    tip = None if middle is None else middle.find("body")
    if middle is None or tip is None:
        raise CorruptAssetError("dmanus_chain.xml: has no body 'thumb_middle' with a fingertip")
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
        if name.endswith("_dhand"):  # the fragments call the classes of both hands so
            item.set("class", name.replace("_dhand", "_dmanus"))
        if item.tag == "joint":
            item.set("range", hand_figures.DMANUS_RANGES[item.attrib["name"]])
    for carrier, (name, place) in hand_figures.DMANUS_POINTS.items():
        mjcf.carry(palm, carrier, _point(name, place))


def _point(name: str, place: str) -> ET.Element:
    body = ET.Element("body", name=name)
    mjcf.add(body, "geom", name=name, pos=place, class_="point")
    return body


def _first_body(chain: ET.Element, name: str, folder: Path) -> ET.Element:
    body = chain.find("body")
    if body is None or body.get("name") != name:
        raise CorruptAssetError(f"{folder.name}: its chain does not begin with a body '{name}'")
    return body


def _meshes(parts: ET.Element) -> list[str]:
    return [mesh.attrib["name"] for mesh in parts.iter("mesh")]


def _assets(root: ET.Element, parts: ET.Element, folders: dict[str, Path]) -> None:
    section = mjcf.add(root, "asset")
    section.extend(parts.iter("material"))
    for mesh in parts.iter("mesh"):
        file = folders[mesh.attrib["name"]] / Path(mesh.attrib["file"]).name
        mesh.set("file", str(file))
        section.append(mesh)


def _actuators(parts: ET.Element) -> list[ET.Element]:
    return [motor for section in parts.findall("actuator") for motor in section]
