"""Objects, table scene and Adroit, built from the fragments in the package ``robohive``."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

from pgdm.errors import CorruptAssetError
from pgdm.library.files import mjcf
from pgdm.library.files import model as model_file
from pgdm.library.robohive import hand_parts
from pgdm.library.robohive import model_values as values


def grab_object(sims: Path, name: str, defects: list[str]) -> ET.Element:
    """Return the model of an object of the GRAB motions (a ContactDB object).

    Args:
        sims: the package's ``sims`` folder, unpacked.
        name: the object's name.
        defects: messages about repairs are appended.

    Raises:
        CorruptAssetError: a fragment is missing or damaged.
    """
    folder = sims / "object_sim" / name
    assets = model_file.parse(folder / "assets.xml", defects, sims)
    geoms = model_file.parse(folder / "body.xml", defects, sims)
    hull = name in values.HULL_OBJECTS
    root = mjcf.model(name)
    section = mjcf.add(root, "asset")
    for mesh in assets.iter("mesh"):
        if not hull or mesh.get("name") == name:
            mesh.set("file", str(folder / Path(mesh.attrib["file"]).name))
            section.append(mesh)
    mjcf.object_defaults(root)
    body = mjcf.object_body(root)
    for geom in geoms.findall("geom"):
        _add_geom(body, name, geom, hull)
    return root


def _add_geom(body: ET.Element, name: str, geom: ET.Element, hull: bool) -> None:
    attributes = dict(geom.attrib)
    visual = attributes["name"].endswith("_visual")
    attributes["class"] = "object_visual" if visual else "object_contact"
    if hull and not visual:
        if not attributes["name"].endswith("_contact0"):
            return
        attributes["mesh"] = name
    mjcf.add(body, "geom", **attributes)


def ycb_object(sims: Path, name: str) -> ET.Element:
    """Return the model of a YCB object, ``crackerbox`` or ``coffeecan``."""
    given = values.YCB_OBJECTS[name]
    mesh = given["mesh"]["name"]
    folder = sims / "YCB_sim"
    root = mjcf.model(name)
    section = mjcf.add(root, "asset")
    mjcf.add(section, "mesh", name=mesh, file=str(folder / "meshes" / f"{mesh}.msh"))
    texture = str(folder / "textures" / f"{mesh}.png")
    mjcf.add(section, "texture", name=mesh, type="2d", file=texture)
    mjcf.add(section, "material", name=mesh, texture=mesh)
    mjcf.object_defaults(root)
    body = mjcf.object_body(root)
    look = {"class": "object_visual", "mesh": mesh, "material": mesh}
    mjcf.add(body, "geom", name=f"{name}_visual", **look, **given["visual"])
    mjcf.add(body, "geom", name=f"{name}_contact0", class_="object_contact", **given["contact"])
    return root


def table_scene(sims: Path) -> ET.Element:
    """Return the table scene: floor at z = -1 m, table top at z = 0, walls and lights."""
    root = mjcf.model("table-environment")
    mjcf.add(root, "option", iterations="20", noslip_iterations="20", timestep="0.004")
    visual = mjcf.add(root, "visual")
    mjcf.add(visual, "global", offwidth="3024", offheight="1680", fovy="25")
    mjcf.add(visual, "quality", shadowsize="4096", offsamples="8")
    mjcf.add(visual, "map", force="0.1", fogend="5")
    _scene_assets(root, sims)
    mjcf.common_defaults(root)
    world = mjcf.add(root, "worldbody")
    for x, y, z, diffuse in ((-6, -6, 10, ".4 .4 .45"), (6, -6, 10, ".4 .4 .45"), (0, 0, 10, "")):
        place = {"pos": f"{x} {y} {z}", "dir": "0 0 -1", "specular": ".3 .3 .6"}
        mjcf.add(world, "light", diffuse=diffuse or ".6 .6 .6", type="spot", **place)
    mjcf.add(
        world, "geom", name="floor", type="plane", pos="0 0 -1", size="10 10 .1", material="floor"
    )
    bare = {"contype": "0", "conaffinity": "0"}
    far = {"mesh": "skyline", "material": "brick", "rgba": ".4 .4 .4 1", "pos": "0 0 -6"}
    mjcf.add(world, "geom", name="skyline", type="mesh", **bare, **far)
    for x, y, yaw in ((0, 10, 0), (0, -10, -3.14), (10, 0, -1.57), (-10, 0, 1.57)):
        place = {"pos": f"{x} {y} -1", "euler": f"0 0 {yaw}"}
        mjcf.add(world, "geom", type="mesh", mesh="wall", material="brick", **bare, **place)
    for name, place, quat, fovy in values.CAMERAS:
        mjcf.add(world, "camera", name=name, pos=place, quat=quat, fovy=fovy)
    table = mjcf.add(world, "body", name="table")
    box = {"type": "box", "size": "0.45 0.45 0.025", "pos": "0 0 -0.025"}
    mjcf.add(table, "geom", name="table_contact", material="granite", **box)
    for x, y in ((0.4, 0.4), (-0.4, 0.4), (0.4, -0.4), (-0.4, -0.4)):
        place = {"pos": f"{x} {y} -0.501", "quat": "0 1 0 0", "size": "0.04 0.5"}
        mjcf.add(table, "geom", type="cylinder", **bare, **place)
    return root


def _scene_assets(root: ET.Element, sims: Path) -> None:
    section = mjcf.add(root, "asset")
    sky = {"type": "skybox", "builtin": "gradient", "rgb1": ".08 .09 .10", "rgb2": "0 0 0"}
    mjcf.add(section, "texture", name="skybox", width="800", height="800", **sky)
    textures = sims / "scene_sim" / "textures"
    stone = sims / "furniture_sim" / "common" / "textures" / "stone1.png"
    for name, kind, file, look in (
        ("floor", "2d", textures / "white_marble_tile2.png", {"texrepeat": "4 4"}),
        ("brick", "2d", textures / "high_contrast_brick.png", {"texrepeat": "1 2"}),
        ("granite", "cube", stone, {"rgba": "0.8 0.8 0.8 1"}),
    ):
        mjcf.add(section, "texture", name=name, type=kind, file=str(file))
        mjcf.add(section, "material", name=name, texture=name, **look)
    for name, scale in (("wall", "0.002 0.002 0.0002"), ("skyline", "2 2 1")):
        file = sims / "scene_sim" / "meshes" / f"{name}.stl"
        mjcf.add(section, "mesh", name=name, file=str(file), scale=scale)


def adroit(sims: Path, defects: list[str]) -> ET.Element:
    """Return Adroit with its six base joints and position actuators.

    Args:
        sims: the package's ``sims`` folder, unpacked.
        defects: messages about repairs are appended.

    Raises:
        CorruptAssetError: a fragment is missing, damaged or not the expected one.
    """
    folder = sims / "Adroit" / "resources"
    parts = model_file.parse(folder / "assets.xml", defects, sims)
    forearm = model_file.parse(folder / "chain.xml", defects, sims).find("body")
    motors = model_file.parse(folder / "joint_position_actuation.xml", defects, sims)
    if forearm is None or forearm.get("name") != "forearm":
        raise CorruptAssetError("Adroit/resources/chain.xml: no body 'forearm'")
    root = mjcf.model("adroit")
    _adroit_assets(root, parts, folder)
    defaults = mjcf.common_defaults(root)
    wanted = ("D_Touch", "DC_Hand", "D_Vizual")
    defaults.extend(d for d in parts.iter("default") if d.get("class") in wanted)
    _adroit_body(forearm)
    mjcf.add(root, "worldbody").append(forearm)
    _adroit_pairs(root, parts, forearm)
    tendons = mjcf.add(root, "tendon")
    for tendon in parts.iter("fixed"):
        tendon.attrib.pop("user", None)
        tendons.append(tendon)
    section = hand_parts.base_actuators(root, values.ADROIT_BASE_GAINS)
    for motor in motors.iter("position"):
        name, joint = motor.attrib["name"], motor.attrib["joint"]
        control = values.ADROIT_CONTROL_RANGES.get(name, motor.attrib["ctrlrange"])
        gain = values.ADROIT_WRIST_GAIN if joint.startswith("WR") else values.ADROIT_FINGER_GAIN
        hand_parts.servo(section, name, joint, control, gain)
    return root


def _adroit_assets(root: ET.Element, parts: ET.Element, folder: Path) -> None:
    section = mjcf.add(root, "asset")
    for material in parts.iter("material"):
        if material.get("name") in ("MatColl", "MatViz"):
            section.append(material)
    for mesh in parts.iter("mesh"):
        if mesh.get("file") is None or mesh.get("name") == "forearm_cvx":
            continue
        file = folder / "meshes" / Path(mesh.attrib["file"]).name
        attributes = {**mesh.attrib, "name": file.stem, "file": str(file)}
        mjcf.add(section, "mesh", **attributes)


def _adroit_body(forearm: ET.Element) -> None:
    forearm.attrib.pop("childclass", None)
    forearm.attrib.update(values.ADROIT_MOUNT)
    hand_parts.base_joints(forearm, at=1)
    for geom in forearm.findall("geom"):
        if geom.get("name") == "V_forearm":
            geom.set("mesh", "forearm_simple")
        elif geom.get("name") == "C_forearm":
            geom.attrib.clear()
            geom.attrib.update(values.ADROIT_FOREARM)
            geom.attrib.update({"name": "C_forearm1", "class": "DC_Hand"})
            geom.set("rgba", "0.4 0.5 0.6 0.1")
    for geom in forearm.iter("geom"):
        if geom.get("name") in values.ADROIT_SOLID:
            del geom.attrib["class"]
    for item in forearm.iter():
        item.attrib.pop("user", None)
        if "axisangle" in item.attrib:
            item.set("quat", hand_parts.quaternion(item.attrib.pop("axisangle")))
        elif "quat" in item.attrib and item.tag != "site":
            item.set("quat", hand_parts.normalised(item.attrib["quat"]))
        if item.tag == "joint" and "." in item.get("axis", ""):
            item.set("axis", hand_parts.normalised(item.attrib["axis"]))
    _add_points(forearm)


def _add_points(forearm: ET.Element) -> None:
    look = {"type": "sphere", "rgba": "1 0 0 0", "contype": "0", "conaffinity": "0"}
    for carrier, (name, place, size) in values.ADROIT_POINTS.items():
        point = ET.Element("body", name=name, pos=place)
        mjcf.add(point, "geom", name=name, size=size, **look)
        hand_parts.add_point(forearm, carrier, point)


def _adroit_pairs(root: ET.Element, parts: ET.Element, forearm: ET.Element) -> None:
    order = {g.get("name"): i for i, g in enumerate(forearm.iter("geom"))}
    pairs = [
        sorted((pair.attrib["geom1"], pair.attrib["geom2"]), key=order.__getitem__)
        for pair in parts.iter("pair")
    ]
    pairs.sort(key=lambda names: [order[name] for name in names])
    hand_parts.contact_pairs(root, pairs)
