"""Triangle meshes of a scene's visible geoms and collision geoms, for display."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import trimesh

from pgdm.pregrasp.primitives import primitive
from pgdm.sim.scene import Scene

OBJECT_RGB = np.array([0.29, 0.55, 0.66])
"""Colour of the tracked object; the released scenes give it the hand's colour."""
TABLE_RGB = np.array([0.52, 0.50, 0.47])
SOLID_RGB = np.array([0.55, 0.62, 0.95])
"""Colour of collision geoms."""
_DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], np.float32)  # MuJoCo's default: use the material
_LAST_GROUP = 2  # MuJoCo's viewers show geom groups 0 to 2
_CREASE_RAD = 0.6  # edges sharper than this are not smoothed
_MAX_FACES = 3000  # per mesh; larger meshes, such as servos with screw threads, are simplified


@dataclass(frozen=True)
class Shape:
    """Triangles of one colour that move with a body."""

    body: int
    vertices: np.ndarray  # (V, 3) m, in the body's frame
    faces: np.ndarray  # (F, 3) indices of vertices
    rgb: tuple[int, int, int]  # 0..255


def visible(scene: Scene) -> list[Shape]:
    """Return the visible shapes of table, hand and objects, without floor and background."""
    model = scene.model
    drawn: dict[tuple[int, tuple[int, int, int]], list[trimesh.Trimesh]] = {}
    meshes: dict[int, trimesh.Trimesh] = {}
    for body in range(1, model.nbody):
        for geom in _seen(model, body):
            key = body, _rgb(scene, geom)
            drawn.setdefault(key, []).append(_triangles(model, geom, meshes))
    return [_shape(body, rgb, parts) for (body, rgb), parts in drawn.items()]


def solid(scene: Scene) -> list[Shape]:
    """Return the collision shapes of hand and objects."""
    model = scene.model
    rgb = _bytes(SOLID_RGB)
    shapes, meshes = [], {}
    for body in range(1, model.nbody):
        geoms = [g for g in _geoms(model, body) if _collides(model, g)]
        if model.body_weldid[body] and geoms:
            shapes.append(_shape(body, rgb, [_triangles(model, geom, meshes) for geom in geoms]))
    return shapes


def _geoms(model: mujoco.MjModel, body: int) -> range:
    first = int(model.body_geomadr[body])
    return range(first, first + int(model.body_geomnum[body]))


def _collides(model: mujoco.MjModel, geom: int) -> bool:
    return bool(model.geom_contype[geom] or model.geom_conaffinity[geom])


def _seen(model: mujoco.MjModel, body: int) -> list[int]:
    """Return a body's visible geoms: only non-colliding ones if it has a visual mesh, else all."""
    shown = [g for g in _geoms(model, body) if model.geom_group[g] <= _LAST_GROUP]
    is_mesh = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    looks = [g for g in shown if is_mesh[g] and not _collides(model, g)]
    # Even transparent visual meshes are shown: some bodies of the released files have only these.
    if looks:
        solid_too = [g for g in shown if not is_mesh[g] and not _collides(model, g)]
        return looks + [g for g in solid_too if _alpha(model, g) > 0]
    return [g for g in shown if _alpha(model, g) > 0]


def _alpha(model: mujoco.MjModel, geom: int) -> float:
    return float(model.geom_rgba[geom, 3])


def _rgb(scene: Scene, geom: int) -> tuple[int, int, int]:
    model = scene.model
    body = int(model.geom_bodyid[geom])
    if model.body_weldid[body] == model.body_weldid[scene.index.object_body]:
        return _bytes(OBJECT_RGB)
    if model.body_weldid[body] == 0:
        return _bytes(TABLE_RGB)
    rgba, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    if material >= 0 and (np.array_equal(rgba, _DEFAULT_RGBA) or rgba[3] == 0):
        rgba = model.mat_rgba[material]
    return _bytes(rgba[:3])


def _bytes(rgb: np.ndarray) -> tuple[int, int, int]:
    red, green, blue = (round(255 * float(value)) for value in rgb)
    return red, green, blue


def _shape(body: int, rgb: tuple[int, int, int], parts: list[trimesh.Trimesh]) -> Shape:
    whole = trimesh.util.append_faces([p.vertices for p in parts], [p.faces for p in parts])
    return Shape(body, *whole, rgb)


def _triangles(
    model: mujoco.MjModel, geom: int, meshes: dict[int, trimesh.Trimesh]
) -> trimesh.Trimesh:
    """Return a geom's surface in its body's frame, with smooth shading except at creases.

    ``meshes`` caches the surfaces of mesh geoms by mesh id.
    """
    if model.geom_type[geom] == mujoco.mjtGeom.mjGEOM_MESH:
        data = int(model.geom_dataid[geom])
        if data not in meshes:
            meshes[data] = trimesh.graph.smooth_shade(_mesh(model, data), angle=_CREASE_RAD)
        mesh = meshes[data].copy()
    else:
        mesh = trimesh.graph.smooth_shade(primitive(model, geom), angle=_CREASE_RAD)
    rotation = np.empty(9)
    mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
    mesh.vertices = np.asarray(mesh.vertices) @ rotation.reshape(3, 3).T + model.geom_pos[geom]
    return mesh


def _mesh(model: mujoco.MjModel, mesh: int) -> trimesh.Trimesh:
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    vertices, corners = model.mesh_vert[first : first + count], model.mesh_face[face : face + faces]
    found = trimesh.Trimesh(vertices, corners)
    if faces <= _MAX_FACES:
        return found
    return found.simplify_quadric_decimation(face_count=_MAX_FACES)
