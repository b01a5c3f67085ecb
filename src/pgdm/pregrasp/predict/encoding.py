"""An object's shape as a vector: distances from a fixed set of points around it to its surface.

Basis-point sets: Prokudin, Lassner, Romero, "Efficient Learning on Point Clouds with Basis Point
Sets", ICCV 2019.
"""

from __future__ import annotations

from functools import lru_cache

import mujoco
import numpy as np
import trimesh
from scipy.spatial import ConvexHull, KDTree

from pgdm.errors import SceneError
from pgdm.sim.scene import Scene

BASIS_POINTS = 256
BASIS_RADIUS_M = 0.15
"""Radius of the ball that the basis points fill: what a hand reaches around an object's centre.
The scale is fixed, because hands do not grow with objects."""
SURFACE_POINTS = 6000

_INSIDE_M = 1e-4  # deeper in another part than this a point is not on the object's surface
_LEAST_POINTS = 20  # of each part
_G = mujoco.mjtGeom


@lru_cache(maxsize=1)
def basis() -> np.ndarray:
    """Return the basis points (B, 3), m, around the object's centre of mass, axes of the world."""
    stream = np.random.Generator(np.random.PCG64(0))
    directions = stream.standard_normal((BASIS_POINTS, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    points = BASIS_RADIUS_M * directions * stream.uniform(size=(BASIS_POINTS, 1)) ** (1 / 3)
    points.flags.writeable = False
    return points


def encode(points: np.ndarray) -> np.ndarray:
    """Return the distance from each basis point to the nearest of an object's points, (B,).

    Args:
        points: of the object's surface (n, 3) m, relative to its centre of mass, axes of the
            world: how an object lies decides how it can be grasped.

    Returns:
        Distances in units of :data:`BASIS_RADIUS_M`.
    """
    return np.asarray(KDTree(points).query(basis())[0]) / BASIS_RADIUS_M


def object_code(scene: Scene, qpos: np.ndarray) -> np.ndarray:
    """Return the code (B,) of a scene's tracked object as it lies at qpos (nq,).

    Raises:
        SceneError: the object has nothing to touch.
    """
    data = mujoco.MjData(scene.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(scene.model, data)
    points = surface_points(scene.model, data, scene.index.object_body)
    return encode(points - data.xipos[scene.index.object_body])


def surface_points(
    model: mujoco.MjModel, data: mujoco.MjData, body: int, count: int = SURFACE_POINTS
) -> np.ndarray:
    """Return points spread over the contact surface of a body and all that is welded to it.

    The surface of one part inside of another is left out. Equal arguments give equal points.

    Args:
        model: of the scene.
        data: with current kinematics.
        body: its id.
        count: about how many.

    Returns:
        Points (n, 3) m, world frame.

    Raises:
        SceneError: the body has no geom to touch, or one of a kind without a surface mesh.
    """
    welded = model.body_weldid == model.body_weldid[body]
    touchable = (model.geom_contype | model.geom_conaffinity) != 0
    geoms = np.flatnonzero(welded[model.geom_bodyid] & touchable).tolist()
    parts = [_part(model, data, geom) for geom in geoms]
    if not parts:
        raise SceneError(f"body '{model.body(body).name}' has no geom to touch: no shape to encode")
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
    """Return a geom's contact surface in the world frame; MuJoCo takes meshes for their hulls."""
    size, kind = model.geom_size[geom], int(model.geom_type[geom])
    if kind == _G.mjGEOM_MESH:
        mesh = model.geom_dataid[geom]
        first = model.mesh_vertadr[mesh]
        vertices = model.mesh_vert[first : first + model.mesh_vertnum[mesh]]
        part = trimesh.convex.convex_hull(np.asarray(vertices, float))
    elif kind == _G.mjGEOM_BOX:
        part = trimesh.creation.box(extents=2 * size)
    elif kind in (_G.mjGEOM_SPHERE, _G.mjGEOM_ELLIPSOID):
        part = trimesh.creation.icosphere(subdivisions=3)
        part.apply_scale(size[0] if kind == _G.mjGEOM_SPHERE else size)
    elif kind == _G.mjGEOM_CYLINDER:
        part = trimesh.creation.cylinder(radius=size[0], height=2 * size[1])
    elif kind == _G.mjGEOM_CAPSULE:
        part = trimesh.creation.capsule(radius=size[0], height=2 * size[1])
    else:
        name = model.geom(geom).name
        raise SceneError(
            f"geom '{name}' is of kind {_G(kind).name[7:].lower()}, which has no surface to "
            "encode; valid: mesh, box, sphere, ellipsoid, cylinder, capsule"
        )
    pose = np.eye(4)
    pose[:3, :3] = data.geom_xmat[geom].reshape(3, 3)
    pose[:3, 3] = data.geom_xpos[geom]
    part.apply_transform(pose)
    return part
