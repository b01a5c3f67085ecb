"""Reading a user's hand from MJCF or URDF into one plain MJCF, without executing anything in it.

The XML is checked before MuJoCo sees it: no entities, no macros, no plug-ins, no file outside
a given folder, no NaN or infinity, limited size and depth. MuJoCo then parses and compiles it in a
child process with limits of time and memory.
"""

from __future__ import annotations

import math
import os
import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import mujoco

from pgdm import files, limited
from pgdm.errors import ConfigError, CorruptAssetError, LimitError, amount
from pgdm.library.files import mjcf
from pgdm.library.files.model import check_stays

MESHES = (".stl", ".obj", ".msh")
"""Mesh formats that MuJoCo reads."""
MOST_JOINTS, MOST_BODIES = 60, 300
MOST_JOINT_ELEMENTS = 8 * MOST_JOINTS
"""Most ``<joint>`` elements of a file, among them fixed joints, defaults and references."""

_SECONDS = 60  # limit of CPU time for reading and compiling
_DEFINITIONS = re.compile(rb"<!(DOCTYPE|ENTITY)", re.IGNORECASE)
_REFUSED = ("extension", "plugin", "composite", "flexcomp", "skin", "replicate", "model", "attach")
_SINGLE = ("revolute", "prismatic", "fixed")  # accepted types of URDF joints
_WORDS = re.compile(r"[+-]?(nan|inf|infinity)", re.IGNORECASE)
# Dropped: a hand does not need these, and keyframes and sensors depend on joints that pgdm changes.
_DROPPED = ("keyframe", "sensor", "statistic", "visual", "custom", "size", "option")


@dataclass(frozen=True)
class HandFile:
    """A hand as one MJCF whose meshes have absolute paths, with facts about its file."""

    xml: str = field(repr=False)
    kind: str
    """``MJCF`` or ``URDF``."""
    notes: list[str]
    """What was changed or left out, one sentence each."""
    mimics: list[str]
    """Coupled joints, each as an equation such as ``b = 0.1 + 0.9 a``."""
    bytes: int
    """Total size of the file and its meshes."""


def read(path: Path, root: Path | None = None) -> HandFile:
    """Read a hand's file and check it.

    Args:
        path: MJCF or URDF file.
        root: folder in which its meshes and includes must be; by default the file's folder.

    Raises:
        CorruptAssetError: the file is unreadable, unsafe, or not a hand that MuJoCo can compile.
        ConfigError: the file is outside ``root``.
    """
    path = Path(os.path.abspath(path))
    root = path.parent if root is None else Path(os.path.abspath(root))
    if not path.is_relative_to(root):
        raise ConfigError(f"--root {root}: does not contain {path}")
    try:
        return limited.call(_read, path, root, seconds=_SECONDS)
    except LimitError as error:
        raise CorruptAssetError(f"{path.name}: {error}; simplify its meshes") from error


def _read(path: Path, root: Path) -> HandFile:
    notes: list[str] = []
    element = _element(path, path.name, root, ())
    _check_numbers(element, path.name)
    if element.tag == "robot":
        meshes = _urdf(element, path, root, notes)
        kind = "URDF"
    elif element.tag == "mujoco":
        meshes = _mjcf(element, path, root, notes)
        kind = "MJCF"
    else:
        raise CorruptAssetError(
            f"{path.name}: its root is <{element.tag}>; a hand is MJCF (<mujoco>) or URDF (<robot>)"
        )
    spec = _compiled(ET.tostring(element, encoding="unicode"), path.name, notes)
    mimics = [_mimic(one) for one in spec.equalities if one.type == mujoco.mjtEq.mjEQ_JOINT]
    size = path.stat().st_size + sum(mesh.stat().st_size for mesh in set(meshes))
    return HandFile(spec.to_xml(), kind, notes, [text for text in mimics if text], size)


def _element(path: Path, label: str, root: Path, parents: tuple[Path, ...]) -> ET.Element:
    """Parse a file and insert the content of its includes."""
    if path in parents:
        raise CorruptAssetError(f"{label}: includes itself")
    try:
        text = files.read_bytes(path, files.MOST_TEXT_BYTES)
    except OSError as error:
        raise CorruptAssetError(f"{label}: cannot be read ({files.reason(error)})") from error
    if _DEFINITIONS.search(text):
        raise CorruptAssetError(f"{label}: defines XML entities, which pgdm does not expand")
    try:
        element: ET.Element = ET.fromstring(text)
    except (ET.ParseError, ValueError) as error:
        raise CorruptAssetError(f"{label}: not well-formed XML ({error})") from error
    level, depth = [element], 0
    while level := [child for item in level for child in item]:
        depth += 1
        if depth > 2 * files.MOST_DEPTH:
            raise CorruptAssetError(f"{label}: nested more than {2 * files.MOST_DEPTH} deep")
    if any(tag.startswith("{") for tag in (item.tag for item in element.iter())):
        raise CorruptAssetError(
            f"{label}: has macros or foreign elements; expand it first (xacro FILE > hand.urdf)"
        )
    for item in list(element.iter()):
        children: list[ET.Element] = []
        for child in item:
            if child.tag == "include":
                file = _inside(child.get("file", ""), path.parent, root, label)
                children.extend(_element(file, file.name, root, (*parents, path)))
            else:
                children.append(child)
        item[:] = children
    return element


def _check_numbers(element: ET.Element, label: str) -> None:
    for item in element.iter():
        for key, value in item.attrib.items():
            if key not in ("name", "file", "filename") and any(
                _WORDS.fullmatch(word) for word in value.split()
            ):
                name = f" '{item.get('name')}'" if item.get("name") else ""
                raise CorruptAssetError(f'{label}: <{item.tag}>{name} has {key}="{value}"')
    joints = sum(item.tag == "joint" for item in element.iter())
    bodies = sum(item.tag in ("body", "link") for item in element.iter())
    if joints > MOST_JOINT_ELEMENTS or bodies > MOST_BODIES:
        raise CorruptAssetError(
            f"{label}: has {amount(bodies, 'body', 'bodies')} and {joints} <joint> elements; a "
            f"hand's file has at most {MOST_BODIES} and {MOST_JOINT_ELEMENTS}"
        )


def _inside(name: str, folder: Path, root: Path, label: str) -> Path:
    """Resolve a file name; seek ``package://a/b/c`` as ``a/b/c``, ``b/c`` or ``c`` in ``root``."""
    if name.startswith("package://"):
        rest = Path(name.removeprefix("package://"))
        places = [root / rest, *(root / Path(*rest.parts[k:]) for k in range(1, len(rest.parts)))]
        path = next((place for place in places if place.is_file()), places[0])
    else:
        path = folder / name.removeprefix("file://")
    path = Path(os.path.normpath(path))
    if not path.is_relative_to(root):
        raise CorruptAssetError(
            f"{label}: refers to '{name}', outside of {root}; if you trust it, give --root FOLDER"
        )
    check_stays(path, root)
    if not path.is_file():
        raise CorruptAssetError(f"{label}: its file '{name}' is missing")
    return path


def _mjcf(element: ET.Element, path: Path, root: Path, notes: list[str]) -> list[Path]:
    """Check an MJCF, make its paths absolute and simplify it; return the files it refers to."""
    for item in element.iter():
        if item.tag in _REFUSED:
            raise CorruptAssetError(f"{path.name}: has <{item.tag}>, which pgdm does not load")
    folders = {"mesh": "", "texture": "", "hfield": ""}
    for compiler in element.iter("compiler"):
        both = compiler.attrib.pop("assetdir", None)
        folders["mesh"] = compiler.attrib.pop("meshdir", both or folders["mesh"])
        folders["texture"] = compiler.attrib.pop("texturedir", both or folders["texture"])
        strips = compiler.attrib.pop("strippath", "false") == "true"
        if strips:
            notes.append("strippath was ignored: mesh paths keep their folders")
    found = []
    for item in element.iter():
        for key in [key for key in item.attrib if key.startswith("file")]:
            folder = path.parent / folders.get(item.tag, "")
            found.append(_inside(item.attrib[key], folder, root, path.name))
            if item.get("name") is None:
                item.set("name", found[-1].stem)
            item.set(key, str(found[-1]))
    for tag in _DROPPED:
        for section in element.findall(tag):
            element.remove(section)
    for world in element.findall("worldbody"):
        for item in [child for child in world if child.tag in ("light", "camera")]:
            world.remove(item)
        for geom in [g for g in world.findall("geom") if g.get("type") in ("plane", "hfield")]:
            world.remove(geom)
            notes.append("the floor was left out")
        for body in world.iter("body"):
            for joint in [j for j in body if j.tag == "freejoint" or j.get("type") == "free"]:
                body.remove(joint)
                notes.append(f"the free joint of '{body.get('name')}' was left out")
    return found


def _urdf(robot: ET.Element, path: Path, root: Path, notes: list[str]) -> list[Path]:
    """Check a URDF, make paths absolute and resolve chains of ``<mimic>``; return its meshes."""
    for joint in robot.findall("joint"):
        name, kind = joint.get("name"), joint.get("type", "")
        if kind not in _SINGLE:
            raise CorruptAssetError(
                f"{path.name}: joint '{name}' is {kind or 'of no type'}; a hand's joints are "
                f"{', '.join(_SINGLE)}, with limits"
            )
        limit = joint.find("limit")
        if kind != "fixed" and (limit is None or not _has_range(limit)):
            raise CorruptAssetError(
                f"{path.name}: joint '{name}' has no limits; add <limit lower= upper=> to it, "
                "with two finite numbers, lower < upper"
            )
        if limit is not None and float(limit.get("effort") or 0) <= 0:
            limit.attrib.pop("effort", None)  # otherwise MuJoCo would limit the force to zero
    _resolve_mimics(robot, path.name)
    for old in robot.findall("mujoco"):
        robot.remove(old)
    options = {"strippath": "false", "fusestatic": "false", "discardvisual": "false"}
    mjcf.add(mjcf.add(robot, "mujoco"), "compiler", **options)
    found: list[Path] = []
    unseen = 0
    for link in robot.findall("link"):
        for visual in link.findall("visual"):
            mesh = next(visual.iter("mesh"), None)
            name = "" if mesh is None else mesh.get("filename", "")
            if mesh is not None and Path(name).suffix.lower() not in MESHES:
                link.remove(visual)
                unseen += 1
            for material in visual.findall("material"):
                for texture in material.findall("texture"):
                    material.remove(texture)
    for material in robot.findall("material"):
        for texture in material.findall("texture"):
            material.remove(texture)
    if unseen:
        notes.append(f"visual meshes left out, as they are neither STL, OBJ nor MSH: {unseen}")
    for mesh in robot.iter("mesh"):
        name = mesh.get("filename", "")
        if Path(name).suffix.lower() not in MESHES:
            raise CorruptAssetError(
                f"{path.name}: collision mesh '{name}' is neither STL, OBJ nor MSH; convert it"
            )
        found.append(_inside(name, path.parent, root, path.name))
        mesh.set("filename", str(found[-1]))
    return found


def _has_range(limit: ET.Element) -> bool:
    try:
        low, high = float(limit.get("lower", "nan")), float(limit.get("upper", "nan"))
    except ValueError:
        return False
    return math.isfinite(low) and math.isfinite(high) and low < high


def _resolve_mimics(robot: ET.Element, label: str) -> None:
    """Make each mimic joint follow a joint that mimics no other.

    If the joint's position is m q + o, where q = m' q' + o' is that of its leader, it is set to
    follow q' as m (m' q' + o') + o.
    """
    joints = {joint.get("name"): joint for joint in robot.findall("joint")}
    for name, joint in joints.items():
        mimic = joint.find("mimic")
        if mimic is None:
            continue
        seen = {name}
        while True:
            leader = mimic.get("joint")
            if leader not in joints:
                raise CorruptAssetError(
                    f"{label}: joint '{name}' mimics '{leader}', which is not a joint of the hand"
                )
            if leader in seen:
                raise CorruptAssetError(f"{label}: joint '{name}' mimics itself, forming a cycle")
            above = joints[leader].find("mimic")
            if above is None:
                break
            seen.add(leader)
            factor, offset = _line(mimic, label)
            of_leader = _line(above, label)
            mimic.set("joint", above.get("joint", ""))
            mimic.set("multiplier", repr(factor * of_leader[0]))
            mimic.set("offset", repr(factor * of_leader[1] + offset))


def _line(mimic: ET.Element, label: str) -> tuple[float, float]:
    try:
        return float(mimic.get("multiplier", "1")), float(mimic.get("offset", "0"))
    except ValueError as error:
        raise CorruptAssetError(
            f"{label}: <mimic> has a value that is not a number ({error})"
        ) from error


def _compiled(xml: str, label: str, notes: list[str]) -> mujoco.MjSpec:
    """Return the spec after a test compile; impossible inertias are corrected and noted."""
    for balance in (False, True):
        try:
            spec = mujoco.MjSpec.from_string(xml)
            spec.compiler.balanceinertia = balance
            model = spec.compile()
        except (ValueError, mujoco.FatalError) as error:
            reason = " ".join(str(error).split())[:300]
            if "balanceinertia" in reason and not balance:
                continue
            raise CorruptAssetError(f"{label}: MuJoCo cannot compile it ({reason})") from error
        if balance:
            notes.append("physically impossible inertias (A + B < C) were replaced by their mean")
        if not 0 < model.njnt <= MOST_JOINTS:
            raise CorruptAssetError(f"{label}: {model.njnt} joints; a hand has 1 to {MOST_JOINTS}")
        spec.compiler.balanceinertia = False
        return _explicit(spec, model) if balance else spec
    raise AssertionError


def _explicit(spec: mujoco.MjSpec, model: mujoco.MjModel) -> mujoco.MjSpec:
    """Copy the corrected inertias from the model into the spec."""
    for body in _bodies(spec):
        if body.explicitinertial:
            body.inertia = model.body(body.name).inertia
            body.iquat = model.body(body.name).iquat
            body.ipos = model.body(body.name).ipos
            body.fullinertia = [math.nan] * 6
    spec.compile()
    return spec


def _bodies(spec: mujoco.MjSpec) -> Iterator[mujoco.MjsBody]:
    return (body for body in spec.bodies if body.name != "world")


def _mimic(equality: mujoco.MjsEquality) -> str:
    follower, leader = equality.name1, equality.name2
    if not leader:
        return ""
    offset, *factors = [float(value) for value in equality.data[:5]]
    terms = [
        f"{factor:.4g} {leader}" + (f"^{power}" if power > 1 else "")
        for power, factor in enumerate(factors, 1)
        if factor
    ]
    return f"{follower} = " + " + ".join(([f"{offset:.4g}"] if offset else []) + terms)
