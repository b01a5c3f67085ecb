"""Camera placement that keeps hand, object and target visible throughout a motion."""

from __future__ import annotations

import math

import mujoco
import numpy as np

# MuJoCo's camera azimuths, in order of preference; 90 looks along +y. The hand approaches from -y
# over the centre of the table. In the first view, from the hand's front right, its fingers do not
# hide the object. The other views are for scenes in which a board or a door blocks the first.
AZIMUTHS_DEG = (-125.0, -55.0, 180.0, 0.0, 125.0, 55.0)
ELEVATION_DEG = -22.0
ROOM_M = 0.2
"""Margin around the motion of the object's centre, for the object's size and the hand."""
MIN_HEIGHT_M = 0.6
"""Least height of the world shown in the picture."""
MIDDLE = np.array([[0.0, -0.05, 0.15]])
"""Point shown without a motion: above the centre of the table, world frame, m."""
_RAYS = 12  # points of a motion tested for visibility
_SURFACES = 40  # surfaces after which a ray is no longer followed


def camera_for(
    model: mujoco.MjModel,
    data: mujoco.MjData,
    object_body: int,
    motion: np.ndarray | None,
    aspect: float,
) -> mujoco.MjvCamera:
    """Return the closest camera that shows a whole motion, with as little of it hidden as possible.

    Args:
        model: the scene.
        data: a state with current kinematics.
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
    """Return the point to look at, (3,) m, and the height of the world to show, m."""
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
    """Return a mask (ngeom,) of the moving geoms, hand and object: rays may pass through them."""
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
    """Return whether a geom that cannot be seen through lies between a point and the eye."""
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
