"""What a scene looks like: the visible geoms of each body as triangles."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
import trimesh

from pgdm.sim.scene import Scene

OBJECT_RGB = np.array([0.29, 0.55, 0.66])
"""Of the tracked object: the released scenes paint it like the hand."""
TABLE_RGB = np.array([0.52, 0.50, 0.47])
SOLID_RGB = np.array([0.55, 0.62, 0.95])
"""Of the shapes that contacts are computed with."""
_DEFAULT_RGBA = np.array([0.5, 0.5, 0.5, 1.0], np.float32)  # MuJoCo's word for: take the material's
_LAST_GROUP = 2  # MuJoCo's viewers show the first three groups of geoms
_CREASE_RAD = 0.6  # edges sharper than this stay edges
_MAX_FACES = 3000  # of a mesh: the servos' screw threads are not what a browser should draw


@dataclass(frozen=True)
class Shape:
    """Triangles of one colour that move with a body."""

    body: int
    vertices: np.ndarray  # (V, 3) m, the body's frame
    faces: np.ndarray  # (F, 3)
    rgb: tuple[int, int, int]


def visible(scene: Scene) -> list[Shape]:
    """Return what is seen of table, hand and objects; the floor and the skyline are left out."""
    model = scene.model
    drawn: dict[tuple[int, tuple[int, int, int]], list[trimesh.Trimesh]] = {}
    meshes: dict[int, trimesh.Trimesh] = {}
    for body in range(1, model.nbody):
        for geom in _seen(model, body):
            key = body, _rgb(scene, geom)
            drawn.setdefault(key, []).append(_triangles(model, geom, meshes))
    return [_shape(body, rgb, parts) for (body, rgb), parts in drawn.items()]


def solid(scene: Scene) -> list[Shape]:
    """Return the shapes of hand and objects that contacts are computed with."""
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
    """Return a body's visible geoms; where it has a mesh to look at, not those it collides with."""
    shown = [g for g in _geoms(model, body) if model.geom_group[g] <= _LAST_GROUP]
    is_mesh = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
    looks = [g for g in shown if is_mesh[g] and not _collides(model, g)]
    # The released files make some of these transparent; they are what the object looks like.
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
    vertices, faces, count = [], [], 0
    for part in parts:
        vertices.append(np.asarray(part.vertices))
        faces.append(np.asarray(part.faces) + count)
        count += len(part.vertices)
    return Shape(body, np.concatenate(vertices), np.concatenate(faces), rgb)


def _triangles(
    model: mujoco.MjModel, geom: int, meshes: dict[int, trimesh.Trimesh]
) -> trimesh.Trimesh:
    """Return a geom's surface in its body's frame, its creases sharp; remembers meshes."""
    kind, size = int(model.geom_type[geom]), model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        data = int(model.geom_dataid[geom])
        if data not in meshes:
            meshes[data] = trimesh.graph.smooth_shade(_mesh(model, data), angle=_CREASE_RAD)
        mesh = meshes[data].copy()
    elif kind == mujoco.mjtGeom.mjGEOM_BOX:
        mesh = trimesh.creation.box(extents=2 * size)
    elif kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        mesh = trimesh.creation.cylinder(radius=size[0], height=2 * size[1])
    elif kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        mesh = trimesh.creation.capsule(radius=size[0], height=2 * size[1])
        mesh.vertices -= mesh.bounds.mean(axis=0)
    else:
        mesh = trimesh.creation.icosphere(subdivisions=3)
        mesh.vertices *= size if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID else size[0]
    if kind != mujoco.mjtGeom.mjGEOM_MESH:
        mesh = trimesh.graph.smooth_shade(mesh, angle=_CREASE_RAD)
    turn = np.empty(9)
    mujoco.mju_quat2Mat(turn, model.geom_quat[geom])
    mesh.vertices = np.asarray(mesh.vertices) @ turn.reshape(3, 3).T + model.geom_pos[geom]
    return mesh


def _mesh(model: mujoco.MjModel, mesh: int) -> trimesh.Trimesh:
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    face, faces = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    vertices, corners = model.mesh_vert[first : first + count], model.mesh_face[face : face + faces]
    found = trimesh.Trimesh(vertices, corners)
    return (
        found if faces <= _MAX_FACES else found.simplify_quadric_decimation(face_count=_MAX_FACES)
    )
