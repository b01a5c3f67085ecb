"""A picture of one hand above a table: reset pose and mean pre-grasp, with its tracked points."""

from __future__ import annotations

import colorsys
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pgdm.sim.render import Renderer, write_image
from pgdm.sim.scene import Scene

PANEL = 480, 360  # pixels, width and height
SIDES = (("from behind", 90.0, -20.0), ("thumb's side", 0.0, -15.0), ("top", 90.0, -89.0))
"""Name, azimuth and elevation of the viewing direction, degrees."""
_TITLE_HEIGHT, _TEXT_SIZE, _MARGIN = 34, 17, 8  # pixels
_FOVY_DEG, _ROOM_M = 25.0, 0.34
_WRIST = (0.9, 0.9, 0.1, 1.0)
_SHOWN = 0.45  # opacity of the hand, so that its points are visible


def write_hand_sheet(scene: Scene, mean: np.ndarray, path: Path) -> Path:
    """Write a PNG: the reset pose above, the mean pre-grasp below, from three sides.

    Tracked points are small balls, in one colour per finger; the wrist's is yellow.

    Args:
        scene: as from :func:`pgdm.sim.scene.bare_scene`; its colours are changed.
        mean: the hand's joints in the mean pre-grasp, (n,) m and rad.
        path: the file to write.

    Raises:
        RenderError: if no OpenGL works here or the file cannot be written.
    """
    width, height = PANEL
    row = height + _TITLE_HEIGHT
    sheet = Image.new("RGB", (len(SIDES) * width, 2 * row), (255, 255, 255))
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(_TEXT_SIZE)
    distance = _ROOM_M / 2 / np.tan(np.deg2rad(_FOVY_DEG) / 2)
    _paint(scene)
    fingers = ", ".join(scene.hand.human_fingers)
    poses = (("reset pose", scene.index.reset), ("mean hand", mean))
    with Renderer(scene.model, scene.index.object_body, width, height) as renderer:
        for line, (name, joints) in enumerate(poses):
            qpos = np.zeros(scene.model.nq)
            qpos[: len(joints)] = joints
            middle = _middle(scene, qpos)
            for column, (side, azimuth, elevation) in enumerate(SIDES):
                renderer.look(middle, float(distance), azimuth, elevation)
                picture = Image.fromarray(renderer.render_qpos(qpos))
                corner = column * width, line * row
                sheet.paste(picture, (corner[0], corner[1] + _TITLE_HEIGHT))
                title = f"{scene.hand.name}, {name}: {fingers}" if column == 0 else side
                draw.text((corner[0] + _MARGIN, corner[1] + _MARGIN), title, (20, 20, 20), font)
    return write_image(path, np.asarray(sheet))


def _middle(scene: Scene, qpos: np.ndarray) -> np.ndarray:
    data = mujoco.MjData(scene.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(scene.model, data)
    places = data.geom_xpos[scene.index.point_geoms]
    return 0.5 * (places.min(axis=0) + places.max(axis=0))


def _paint(scene: Scene) -> None:
    model, points = scene.model, scene.index.point_geoms
    of_hand = model.body_rootid[model.geom_bodyid] == model.jnt_bodyid[0]
    model.geom_matid[of_hand] = -1
    model.geom_rgba[of_hand] = (0.45, 0.47, 0.5, _SHOWN)
    count = len(scene.index.fingertips)
    for number, geom in enumerate(points.tolist()):
        finger = (number - 1) // 3
        colour = colorsys.hsv_to_rgb(finger / max(count, 1), 0.9, 0.9)
        model.geom_rgba[geom] = _WRIST if number == 0 else (*colour, 1.0)
        model.geom_size[geom] = 0.008
        model.geom_group[geom] = 0
