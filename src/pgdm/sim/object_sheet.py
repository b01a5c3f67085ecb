"""A picture of one object from three sides: its appearance and its collision geometry."""

from __future__ import annotations

import colorsys
from collections.abc import Sequence
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pgdm.errors import SceneError
from pgdm.library.checks.compiled import compile_tracked
from pgdm.sim.render import Renderer, write_image

PANEL = 400, 320  # pixels, width and height
SIDES = (("front", 90.0, -15.0), ("right", 180.0, -15.0), ("top", 90.0, -89.0))
"""Name, azimuth and elevation of the viewing direction, degrees."""
_TITLE_HEIGHT, _TEXT_SIZE, _MARGIN = 34, 18, 8  # pixels
_ROOM = 0.95  # height of the picture at the object, relative to its size
_FOVY_DEG = 25.0
_GOLDEN = 0.618034  # hue step between neighbouring parts: no two look alike
_STAGE = """<mujoco><visual><headlight ambient=".35 .35 .35" diffuse=".35 .35 .35"/>
<global fovy="25"/></visual><asset><texture type="skybox" builtin="flat" rgb1=".93 .94 .95"
rgb2=".93 .94 .95" width="8" height="8"/></asset><worldbody><light pos="-1 -2 3" dir=".3 .6 -.9"
diffuse=".35 .35 .35" castshadow="false"/></worldbody></mujoco>"""


def write_object_sheet(object_xml: Path, title: Sequence[str], path: Path) -> Path:
    """Write a PNG: the object's appearance above, its convex collision parts in colours below.

    Args:
        object_xml: the object's model.
        title: headings of the two rows.
        path: the file to write.

    Raises:
        SceneError: if the model does not compile.
        RenderError: if no OpenGL works here or the file cannot be written.
    """
    model, body = _stage(object_xml)
    middle, size = _extent(model, body)
    width, height = PANEL
    row = height + _TITLE_HEIGHT
    sheet = Image.new("RGB", (len(SIDES) * width, 2 * row), (255, 255, 255))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(_TEXT_SIZE)
    distance = _ROOM * size / 2 / np.tan(np.deg2rad(_FOVY_DEG) / 2)
    with Renderer(model, body, width, height) as renderer:
        for line, parts in enumerate((False, True)):
            _paint(model, body, parts)
            draw.text((_MARGIN, line * row + _MARGIN), title[line], (20, 20, 20), font)
            for column, (_, azimuth, elevation) in enumerate(SIDES):
                renderer.look(middle, float(distance), azimuth, elevation)
                picture = Image.fromarray(renderer.render_qpos(np.zeros(model.nq)))
                sheet.paste(picture, (column * width, line * row + _TITLE_HEIGHT))
    return write_image(path, np.asarray(sheet))


def _stage(object_xml: Path) -> tuple[mujoco.MjModel, int]:
    try:
        spec = mujoco.MjSpec.from_string(_STAGE)
        child = mujoco.MjSpec.from_file(str(object_xml))
        spec.attach(child, prefix="it/", frame=spec.worldbody.add_frame())
        model = compile_tracked(spec, "it/object")
    except ValueError as error:
        raise SceneError(f"{object_xml} does not compile: {error}") from error
    return model, model.body("it/object").id


def _extent(model: mujoco.MjModel, body: int) -> tuple[np.ndarray, float]:
    """Return the centre (3,) m of an object and the largest side of a box around it, m."""
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    geoms = np.flatnonzero(model.geom_bodyid == body)
    places, radii = data.geom_xpos[geoms], model.geom_rbound[geoms][:, None]
    low, high = (places - radii).min(axis=0), (places + radii).max(axis=0)
    return (low + high) / 2, float((high - low).max())


def _paint(model: mujoco.MjModel, body: int, parts: bool) -> None:
    """Show either the visual or the collision geoms of an object, the latter each in a colour."""
    for i, geom in enumerate(np.flatnonzero(model.geom_bodyid == body)):
        touches = bool(model.geom_contype[geom] or model.geom_conaffinity[geom])
        colour = colorsys.hsv_to_rgb(i * _GOLDEN % 1.0, 0.6, 0.95) if parts else (0.8, 0.75, 0.65)
        model.geom_matid[geom] = -1
        model.geom_rgba[geom] = (*colour, 1.0 if touches == parts else 0.0)
