"""Small spheres that point something out in a picture."""

from __future__ import annotations

import mujoco
import numpy as np

MARK_RADIUS_M = 0.005
MARK_RGBA = np.array([0.1, 0.95, 1.0, 1.0], np.float32)


def add_marks(scene: mujoco.MjvScene, points: np.ndarray) -> None:
    """Add a sphere at each point (n, 3) m, world frame, as far as the scene has room."""
    size, turn = np.full(3, MARK_RADIUS_M), np.eye(3).ravel()
    for point in points[: scene.maxgeom - scene.ngeom]:
        mark = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(mark, mujoco.mjtGeom.mjGEOM_SPHERE, size, point, turn, MARK_RGBA)
        mark.emission = 0.6  # seen in the hand's shadow too
        mark.category = mujoco.mjtCatBit.mjCAT_DECOR
        scene.ngeom += 1
