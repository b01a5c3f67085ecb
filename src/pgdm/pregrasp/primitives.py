"""Surfaces of MuJoCo's primitive geoms as triangle meshes."""

from __future__ import annotations

import mujoco
import trimesh

from pgdm.errors import SceneError

_G = mujoco.mjtGeom


def primitive(model: mujoco.MjModel, geom: int) -> trimesh.Trimesh:
    """Return the surface of a geom that is not a mesh, in the geom's frame, m.

    Raises:
        SceneError: the geom's type, such as a plane, has no closed surface.
    """
    size, kind = model.geom_size[geom], int(model.geom_type[geom])
    if kind == _G.mjGEOM_BOX:
        return trimesh.creation.box(extents=2 * size)
    if kind in (_G.mjGEOM_SPHERE, _G.mjGEOM_ELLIPSOID):
        ball = trimesh.creation.icosphere(subdivisions=3)
        ball.apply_scale(size[0] if kind == _G.mjGEOM_SPHERE else size)
        return ball
    if kind == _G.mjGEOM_CYLINDER:
        return trimesh.creation.cylinder(radius=size[0], height=2 * size[1])
    if kind == _G.mjGEOM_CAPSULE:
        return trimesh.creation.capsule(radius=size[0], height=2 * size[1])
    raise SceneError(
        f"geom '{model.geom(geom).name}' has type {_G(kind).name[7:].lower()}, without a closed "
        "surface; valid: mesh, box, sphere, ellipsoid, cylinder, capsule"
    )
