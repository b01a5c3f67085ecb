"""Contact sheets: several states of one scene in one labelled image."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from pgdm.sim.render import Renderer, write_image
from pgdm.sim.scene import Scene

PANEL = 640, 480  # pixels, width and height
COLUMNS = 3
_LABEL_HEIGHT, _TITLE_SIZE, _TEXT_SIZE, _MARGIN = 84, 22, 17, 10  # pixels
_CHARACTERS = 72  # per line of text
_PAPER, _INK, _GREY = (255, 255, 255), (20, 20, 20), (90, 90, 90)


@dataclass(frozen=True)
class Panel:
    """One image of a sheet."""

    qpos: np.ndarray  # (nq,) m, rad
    title: str
    text: str
    """Text below the title, at most two lines."""


def write_sheet(scene: Scene, panels: Sequence[Panel], path: Path) -> Path:
    """Write the panels as one PNG, all from the same viewpoint.

    Raises:
        RenderError: if no OpenGL works here or the file cannot be written.
    """
    width, height = PANEL
    rows = -(-len(panels) // COLUMNS)
    size = min(COLUMNS, len(panels)) * width, rows * (height + _LABEL_HEIGHT)
    sheet = Image.new("RGB", size, _PAPER)
    draw = ImageDraw.Draw(sheet)
    places = _places(scene, panels)
    with Renderer(scene.model, scene.index.object_body, width, height, places) as renderer:
        for i, panel in enumerate(panels):
            x, y = i % COLUMNS * width, i // COLUMNS * (height + _LABEL_HEIGHT)
            sheet.paste(Image.fromarray(renderer.render_qpos(panel.qpos)), (x, y))
            corner = x + _MARGIN, y + height + 6
            below = x + _MARGIN, y + height + 10 + _TITLE_SIZE
            draw.text(corner, panel.title, _INK, ImageFont.load_default(_TITLE_SIZE))
            text = textwrap.fill(panel.text, _CHARACTERS)
            draw.text(below, text, _GREY, ImageFont.load_default(_TEXT_SIZE))
    return write_image(path, np.asarray(sheet))


def _places(scene: Scene, panels: Sequence[Panel]) -> np.ndarray:
    """Return the points to keep in view: object and middle of the hand, (2K, 3) m."""
    data = mujoco.MjData(scene.model)
    places = []
    for panel in panels:
        data.qpos[:] = panel.qpos
        mujoco.mj_kinematics(scene.model, data)
        hand = data.geom_xpos[scene.index.point_geoms].mean(axis=0)
        places += [data.xipos[scene.index.object_body].copy(), hand]
    return np.array(places)
