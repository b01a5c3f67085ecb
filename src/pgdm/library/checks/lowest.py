"""Lowest point of a body."""

from __future__ import annotations

import mujoco
import numpy as np


def lowest(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> float:
    """Return the height of the lowest point of a body's collision geoms, m, world frame.

    Args:
        model: the scene.
        data: its state; kinematics are updated.
        body: id of the body; if it has no collision geoms, the height of its origin is returned.
    """
    mujoco.mj_kinematics(model, data)
    solid = (model.geom_contype | model.geom_conaffinity) != 0
    heights = [
        data.geom_xpos[g, 2] - _reach(model, g, data.geom_xmat[g].reshape(3, 3)[2])
        for g in np.flatnonzero((model.geom_bodyid == body) & solid).tolist()
    ]
    return float(min(heights, default=data.xpos[body, 2]))


def _reach(model: mujoco.MjModel, geom: int, up: np.ndarray) -> float:
    """Return how far a geom extends below its centre, m.

    ``up`` is the world's up axis in the geom's frame.
    """
    size, kind = model.geom_size[geom], mujoco.mjtGeom(model.geom_type[geom])
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        points = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        return float(-(points @ up).min())
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return float(size[0])
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return float(size[0] + size[1] * abs(up[2]))
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return float(size[0] * np.hypot(up[0], up[1]) + size[1] * abs(up[2]))
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return float(np.linalg.norm(size * up))
    return float(np.abs(size * up).sum())  # a box
