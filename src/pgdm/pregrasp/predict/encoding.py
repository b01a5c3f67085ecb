"""An object's shape as a vector: distances from a fixed set of points around it to its surface.

The code of a surface S is c_i = min_{s in S} |b_i - s| / r, with the basis points b_i in a ball of
radius r (Prokudin, Lassner, Romero, "Efficient Learning on Point Clouds with Basis Point Sets",
ICCV 2019).
"""

from __future__ import annotations

from functools import lru_cache

import mujoco
import numpy as np
import trimesh
from scipy.spatial import ConvexHull, KDTree

from pgdm.errors import SceneError
from pgdm.pregrasp.hand_geometry import posed
from pgdm.pregrasp.primitives import primitive
from pgdm.sim.scene import Scene

BASIS_POINTS = 256
BASIS_RADIUS_M = 0.15
"""Radius of the ball of basis points: how far a hand reaches around an object's centre. It is
the same for all objects, since only the hand's size matters."""
SURFACE_POINTS = 6000

_INSIDE_M = 1e-4  # a point deeper than this in another part is not on the object's surface
_LEAST_POINTS = 20  # least number sampled on each part


@lru_cache(maxsize=1)
def basis() -> np.ndarray:
    """Return the basis points (B, 3), m, relative to the object's centre of mass, world axes."""
    stream = np.random.Generator(np.random.PCG64(0))
    directions = stream.standard_normal((BASIS_POINTS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = BASIS_RADIUS_M * directions * stream.uniform(size=(BASIS_POINTS, 1)) ** (1 / 3)
    points.flags.writeable = False
    return points


def encode(points: np.ndarray) -> np.ndarray:
    """Return the distance from each basis point to the nearest of an object's points, (B,).

    Args:
        points: points of the object's surface (n, 3) m, relative to its centre of mass. They are in
            world axes, because the possible grasps depend on how the object lies.

    Returns:
        Distances in units of :data:`BASIS_RADIUS_M`.
    """
    return np.asarray(KDTree(points).query(basis())[0]) / BASIS_RADIUS_M


def object_code(scene: Scene, qpos: np.ndarray) -> np.ndarray:
    """Return the code (B,) of a scene's tracked object in its pose at qpos (nq,).

    Raises:
        SceneError: the object has no collision geometry, or a geom without a closed surface.
    """
    data = posed(scene, qpos)
    points = surface_points(scene.model, data, scene.index.object_body)
    return encode(points - data.xipos[scene.index.object_body])


def surface_points(
    model: mujoco.MjModel, data: mujoco.MjData, body: int, count: int = SURFACE_POINTS
) -> np.ndarray:
    """Return points on the collision surface of a body and of everything welded to it.

    Points of one part that lie inside another are left out. Equal arguments give equal points.

    Args:
        model: model of the scene.
        data: state of the scene, with current kinematics.
        body: id of the body.
        count: approximate number of points.

    Returns:
        Points (n, 3) m, world frame.

    Raises:
        SceneError: the body has no collision geom, or one whose type has no closed surface.
    """
    welded = model.body_weldid == model.body_weldid[body]
    touchable = (model.geom_contype | model.geom_conaffinity) != 0
    geoms = np.flatnonzero(welded[model.geom_bodyid] & touchable).tolist()
    parts = [_part(model, data, geom) for geom in geoms]
    if not parts:
        raise SceneError(f"body '{model.body(body).name}' has no collision geom to encode")
    area = sum(part.area for part in parts)
    planes = [ConvexHull(part.vertices).equations for part in parts]  # outward normal, offset
    kept = []
    for i, part in enumerate(parts):
        share = max(_LEAST_POINTS, round(count * part.area / area))
        points = np.asarray(trimesh.sample.sample_surface(part, share, seed=0)[0])
        inside = np.zeros(len(points), bool)
        for j, plane in enumerate(planes):
            if j != i:
                inside |= (points @ plane[:, :3].T + plane[:, 3]).max(axis=1) < -_INSIDE_M
        kept.append(points[~inside])
    return np.concatenate(kept)


def _part(model: mujoco.MjModel, data: mujoco.MjData, geom: int) -> trimesh.Trimesh:
    """Return a geom's collision surface in the world frame: for a mesh, its convex hull."""
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        part = trimesh.convex.convex_hull(np.asarray(vertices, float))
    else:
        part = primitive(model, geom)
    pose = np.eye(4)
    pose[:3, :3] = data.geom_xmat[geom].reshape(3, 3)
    pose[:3, 3] = data.geom_xpos[geom]
    part.apply_transform(pose)
    return part
