"""Small spheres that mark points in a picture."""

from __future__ import annotations

import mujoco
import numpy as np

MARK_RADIUS_M = 0.005
MARK_RGBA = np.array([0.1, 0.95, 1.0, 1.0], np.float32)


def add_marks(scene: mujoco.MjvScene, points: np.ndarray) -> None:
    """Add a sphere at each point (n, 3) m, world frame, up to the scene's capacity."""
    size, rotation = np.full(3, MARK_RADIUS_M), np.eye(3).ravel()
    for point in points[: scene.maxgeom - scene.ngeom]:
        mark = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(mark, mujoco.mjtGeom.mjGEOM_SPHERE, size, point, rotation, MARK_RGBA)
        mark.emission = 0.6  # visible even in the hand's shadow
        mark.category = mujoco.mjtCatBit.mjCAT_DECOR
        scene.ngeom += 1
