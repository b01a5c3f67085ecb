"""Where to look from, so that hand, object and goal are seen all along a motion."""

from __future__ import annotations

import math

import mujoco
import numpy as np

# The hand comes from -y over the table's centre: from the front right, hand, object and goal
# are all seen, and the fingers do not hide the object. The others serve where a board or a door
# stands in the way. Directions of view around the vertical; 90 looks along +y.
AZIMUTHS_DEG = (-125.0, -55.0, 180.0, 0.0, 125.0, 55.0)
ELEVATION_DEG = -22.0
ROOM_M = 0.2
"""Free space around the motion of the object's centre: for its size, and for the hand."""
MIN_HEIGHT_M = 0.6
"""How much of the world the picture's height shows at least."""
MIDDLE = np.array([[0.0, -0.05, 0.15]])
"""Shown where no motion is given: above the table's centre, world frame, m."""
_RAYS = 12  # points of a motion that are tried
_SURFACES = 40  # that a ray is followed through at most


def camera_for(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    object_body: int,
    motion: np.ndarray | None,
    aspect: float,
) -> mujoco.MjvCamera:
    """Return the closest camera that shows a motion with least in its way.

    Args:
        model: the scene.
        data: its state, with current kinematics.
        object_body: id of the body that moves along the motion.
        motion: positions of the object's centre of mass, (T, 3) m, world frame, or None.
        aspect: width of the picture over its height.
    """
    shown = MIDDLE if motion is None else np.asarray(motion, float)
    half_angle = math.radians(model.vis.global_.fovy) / 2
    some = shown[np.linspace(0, len(shown) - 1, min(_RAYS, len(shown))).astype(int)]
    see_through = _movers(model, object_body)
    best: tuple[int, mujoco.MjvCamera] | None = None
    for azimuth in AZIMUTHS_DEG:
        lookat, height = _frame(shown, azimuth, aspect)
        camera = mujoco.MjvCamera()
        camera.lookat[:] = lookat
        camera.distance = height / 2 / math.tan(half_angle)
        camera.azimuth, camera.elevation = azimuth, ELEVATION_DEG
        eye = lookat - camera.distance * _axes(azimuth)[0]
        hidden = sum(_is_hidden(model, data, point, eye, see_through) for point in some)
        if best is None or hidden < best[0]:
            best = hidden, camera
        if hidden == 0:
            break
    assert best is not None
    return best[1]


def _frame(positions: np.ndarray, azimuth: float, aspect: float) -> tuple[np.ndarray, float]:
    """Return the point to look at, (3,) m, and how much of the world the height must show, m."""
    forward, right, up = _axes(azimuth)
    across, above = positions @ right, positions @ up  # (T,) m each
    width, height = np.ptp(across) + 2 * ROOM_M, np.ptp(above) + 2 * ROOM_M
    middle = forward * np.mean(positions @ forward)
    middle += right * (across.max() + across.min()) / 2 + up * (above.max() + above.min()) / 2
    return middle, float(max(height, width / aspect, MIN_HEIGHT_M))


def _axes(azimuth_deg: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the camera's forward, right and up directions, (3,) each, world frame."""
    azimuth, elevation = math.radians(azimuth_deg), math.radians(ELEVATION_DEG)
    flat = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    forward = flat * math.cos(elevation) + np.array([0.0, 0.0, math.sin(elevation)])
    right = np.cross(flat, [0.0, 0.0, 1.0])
    return forward, right, np.cross(right, forward)


def _movers(model: mujoco.MjModel, object_body: int) -> np.ndarray:
    """Return which geoms, (ngeom,) bool, belong to the hand or the object: they move away."""
    joints = model.actuator_trnid[model.actuator_trntype == mujoco.mjtTrn.mjTRN_JOINT, 0]
    hands = np.unique(model.body_rootid[model.jnt_bodyid[joints]])
    of_hand = np.isin(model.body_rootid, hands)
    of_object = model.body_weldid == model.body_weldid[object_body]
    return (of_hand | of_object)[model.geom_bodyid]


def _is_hidden(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    point: np.ndarray,
    eye: np.ndarray,
    see_through: np.ndarray,
) -> bool:
    """Return whether something between a point and the eye stays there."""
    ray = (eye - point) / np.linalg.norm(eye - point)
    start, left = point.copy(), float(np.linalg.norm(eye - point))
    geom = np.zeros(1, np.int32)
    for _ in range(_SURFACES):
        distance = mujoco.mj_ray(model, data, start, ray, None, 1, -1, geom, None)
        if distance < 0 or distance > left:
            return False
        if not see_through[geom[0]]:
            return True
        start, left = start + (distance + 1e-3) * ray, left - distance - 1e-3
    return False
