"""Where to look from, so that hand, object and goal are seen all along a motion."""

from __future__ import annotations

import math

import mujoco
import numpy as np

# The hand comes from -y over the table's centre: from the front right, hand, object and goal
# are all seen, and the fingers do not hide the object.
AZIMUTH_DEG, ELEVATION_DEG = -125.0, -22.0
ROOM_M = 0.2
"""Free space around the motion of the object's centre: for its size, and for the hand."""
MIN_HEIGHT_M = 0.6
"""How much of the world the picture's height shows at least."""
MIDDLE = np.array([[0.0, -0.05, 0.15]])
"""Shown where no motion is given: above the table's centre, world frame, m."""


def camera_for(model: mujoco.MjModel, motion: np.ndarray | None, aspect: float) -> mujoco.MjvCamera:
    """Return the closest camera that shows a motion.

    Args:
        model: the scene, for its angle of view.
        motion: positions of the object's centre of mass, (T, 3) m, world frame, or None.
        aspect: width of the picture over its height.
    """
    lookat, height = _frame(MIDDLE if motion is None else np.asarray(motion, float), aspect)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = lookat
    half_angle = math.radians(model.vis.global_.fovy) / 2
    camera.distance = height / 2 / math.tan(half_angle)
    camera.azimuth, camera.elevation = AZIMUTH_DEG, ELEVATION_DEG
    return camera


def _frame(positions: np.ndarray, aspect: float) -> tuple[np.ndarray, float]:
    """Return the point to look at, (3,) m, and how much of the world the height must show, m."""
    forward, right, up = _axes()
    across, above = positions @ right, positions @ up  # (T,) m each
    width, height = np.ptp(across) + 2 * ROOM_M, np.ptp(above) + 2 * ROOM_M
    middle = forward * np.mean(positions @ forward)
    middle += right * (across.max() + across.min()) / 2 + up * (above.max() + above.min()) / 2
    return middle, float(max(height, width / aspect, MIN_HEIGHT_M))


def _axes() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the camera's forward, right and up directions, (3,) each, world frame."""
    azimuth, elevation = math.radians(AZIMUTH_DEG), math.radians(ELEVATION_DEG)
    flat = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    forward = flat * math.cos(elevation) + np.array([0.0, 0.0, math.sin(elevation)])
    right = np.cross(flat, [0.0, 0.0, 1.0])
    return forward, right, np.cross(right, forward)
