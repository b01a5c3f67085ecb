"""Reading a mesh that somebody brings: repaired where that is safe, refused where it is not."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh

from pgdm.errors import ConfigError, CorruptAssetError

SUFFIXES = (".stl", ".obj", ".ply", ".glb", ".off")
"""Formats that are read."""

UNITS_M = {"mm": 0.001, "cm": 0.01, "m": 1.0}
"""Metres in each unit that a mesh may be in."""

SIZES_M = (0.02, 0.6)
"""Longest side of what a hand can manipulate above the table, m."""

MAX_FACES = 20_000
"""Faces that are kept: more show nothing in a picture, and MuJoCo refuses 200,000."""

_THIN_M = 5e-4  # thinner things fall through the contact margin
_OPEN_SHARE = 0.5  # of its hull that an open surface must enclose for the hull to stand for it
_MAX_BODIES = 50
_LID_SHARE = 0.15  # of the surface that may be filled in
_READ_ERRORS = (
    *(ValueError, TypeError, KeyError, IndexError, AttributeError, AssertionError),
    *(NotImplementedError, ImportError, EOFError, struct.error, OSError, RuntimeError),
)
"""What trimesh's readers raise at damaged files."""


@dataclass(frozen=True)
class SoundMesh:
    """A mesh in metres, ready to become an object."""

    vertices: np.ndarray = field(repr=False)
    """(V, 3) m, axes as in the file."""
    faces: np.ndarray = field(repr=False)
    """(F, 3) vertex numbers, outside counter-clockwise."""
    closed: bool
    """Whether the surface encloses a volume; if not, the hull's volume stands for it."""
    volume_m3: float
    hull_m3: float
    """Volume of the convex hull."""
    num_bodies: int
    """Pieces that do not touch each other."""
    repairs: list[str]
    """What was changed, a sentence each."""

    def trimesh(self) -> trimesh.Trimesh:
        """Return it as trimesh's own class."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)


def read(path: Path, scale: float = 1.0, allow_open: bool = False) -> SoundMesh:
    """Read, check and repair a mesh.

    Args:
        path: STL, OBJ, PLY, GLB or OFF.
        scale: metres in one unit of the file.
        allow_open: accept a surface that is far from closed, as its mass is known.

    Raises:
        ConfigError: the size cannot be right in this unit; names the unit that it looks like.
        CorruptAssetError: the file is unreadable, empty, flat, or encloses nothing.
    """
    mesh = _load(path)
    repairs: list[str] = []
    mesh.apply_scale(scale)
    _check_size(mesh, path.name, scale)
    _clean(mesh, path.name, repairs)
    mesh = _simplified(mesh, repairs)
    _close(mesh, path.name, repairs, allow_open)
    return _measured(mesh, path.name, repairs, allow_open)


def _load(path: Path) -> trimesh.Trimesh:
    if path.suffix.lower() not in SUFFIXES:
        raise ConfigError(
            f"{path}: format '{path.suffix}' is not read; valid: {', '.join(SUFFIXES)}"
        )
    if not path.is_file():
        raise ConfigError(f"{path}: there is no such file")
    try:
        scene = trimesh.load_scene(path, process=False, skip_materials=True)
        mesh = scene.to_mesh() if scene.geometry else trimesh.Trimesh()
    except _READ_ERRORS as error:
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise CorruptAssetError(f"{path}: not a readable mesh ({reason})") from error
    if not len(mesh.faces):
        raise CorruptAssetError(f"{path}: holds no faces")
    bad = np.flatnonzero(~np.isfinite(mesh.vertices).all(axis=1))
    if len(bad):
        raise CorruptAssetError(
            f"{path}: {len(bad)} of {len(mesh.vertices)} vertices are NaN or infinite, the first "
            f"is number {bad[0]}"
        )
    return mesh


def _check_size(mesh: trimesh.Trimesh, label: str, scale: float) -> None:
    longest = float(mesh.extents.max())
    low, high = SIZES_M
    if low <= longest <= high:
        return
    if longest <= 0.0:
        raise CorruptAssetError(f"{label}: all its vertices are one point")
    fitting = {u: longest / scale * f for u, f in UNITS_M.items()}
    fitting = {u: size for u, size in fitting.items() if low <= size <= high}
    # The largest that fits: hands manipulate things of decimetres rather than of centimetres.
    unit = max(fitting, key=lambda u: fitting[u]) if fitting else None
    guess = (
        f"it looks like {unit} ({length(fitting[unit])}): use --unit {unit}"
        if unit is not None
        else f"no unit makes that a thing of {length(low)} to {length(high)}: give --scale S, "
        "the metres in one unit of the file"
    )
    raise ConfigError(f"{label}: its longest side is {length(longest)}; {guess}")


def length(metres: float) -> str:
    """Return a length as people write it, such as ``8 cm``."""
    for unit, factor in (("m", 1.0), ("cm", 0.01), ("mm", 0.001)):
        if metres >= factor:
            return f"{metres / factor:.3g} {unit}"
    return f"{metres / 0.001:.2g} mm"


def _clean(mesh: trimesh.Trimesh, label: str, repairs: list[str]) -> None:
    """Merge equal vertices, drop faces that are none, and turn all faces outward."""
    before = len(mesh.vertices)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if merged := before - len(mesh.vertices):
        repairs.append(f"merged {merged} vertices at the same place")
    # Relative to the size: trimesh's own bound takes the faces of a fine scan for degenerate.
    sound = mesh.area_faces > 1e-12 * mesh.scale**2
    if not sound.any():
        raise CorruptAssetError(f"{label}: none of its {len(sound)} faces has an area")
    if not sound.all():
        repairs.append(f"removed {int((~sound).sum())} faces without area")
        mesh.update_faces(sound)
    unique = mesh.unique_faces()
    if not unique.all():
        repairs.append(f"removed {int((~unique).sum())} faces that are there twice")
        mesh.update_faces(unique)
    mesh.remove_unreferenced_vertices()
    thinnest = float(mesh.extents.min())
    if thinnest < _THIN_M:
        raise CorruptAssetError(
            f"{label}: is flat, its shortest side is {length(thinnest)}; an object needs "
            f"{length(_THIN_M)} or more"
        )


def _simplified(mesh: trimesh.Trimesh, repairs: list[str]) -> trimesh.Trimesh:
    faces = len(mesh.faces)
    if faces <= MAX_FACES:
        return mesh
    size = mesh.extents.copy()
    simple = mesh.simplify_quadric_decimation(face_count=MAX_FACES)
    changed = float(np.abs(simple.extents - size).max())
    repairs.append(
        f"simplified {faces:,} faces to {len(simple.faces):,} (its sides changed by "
        f"{length(changed)} at most)"
    )
    return simple


def _close(mesh: trimesh.Trimesh, label: str, repairs: list[str], allow_open: bool) -> None:
    """Make winding and normals agree and fill holes."""
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)
        repairs.append("turned faces that were wound against their neighbours")
    if len(_rims(mesh)):
        _fill(mesh, label, repairs, allow_open)
    before = mesh.faces.copy()
    trimesh.repair.fix_inversion(mesh, multibody=is_closed(mesh))
    if not np.array_equal(before, mesh.faces):
        repairs.append("turned the surface inside out: it was wound inward")


def _fill(mesh: trimesh.Trimesh, label: str, repairs: list[str], allow_open: bool) -> None:
    """Fill holes, unless the lid would make a bowl a solid."""
    share = opening(mesh) / float(mesh.area)
    if share > _LID_SHARE:
        if not allow_open:
            raise CorruptAssetError(
                f"{label}: its surface is open, a lid would have {share:.0%} of its area, so its "
                "volume is unknown; close it in the program that made it, or give --mass KG"
            )
        repairs.append(f"left its opening open: a lid would have {share:.0%} of its area")
        return
    edges = _rims(mesh)
    hole = _holes(edges, len(mesh.vertices))
    count = int(hole.max()) + 1
    rims = [np.unique(edges[hole == one]) for one in range(count)]
    middles = [mesh.vertices[rim].mean(axis=0) for rim in rims]  # of a fan for each
    fans = np.column_stack((edges[:, ::-1], len(mesh.vertices) + hole))
    mesh.vertices = np.concatenate((mesh.vertices, middles))
    mesh.faces = np.concatenate((mesh.faces, fans))
    holes = "a hole" if count == 1 else f"{count} holes"
    repairs.append(f"filled {holes} with {len(fans)} faces, {share:.1%} of its area")


def is_closed(mesh: trimesh.Trimesh) -> bool:
    """Return whether a surface encloses a volume: each edge is passed as often each way.

    So an edge along which two closed pieces touch, which has four faces, opens nothing.
    """
    edges, count = mesh.edges.astype(np.int64), len(mesh.vertices)
    there, back = edges @ [count, 1], edges @ [1, count]
    return bool(np.array_equal(np.sort(there), np.sort(back)))


def opening(mesh: trimesh.Trimesh) -> float:
    """Return the area of flat lids on all holes of a surface, m2.

    A closed line's area vector is half the sum of a x b over its edges, from wherever measured.
    """
    edges = _rims(mesh)
    if not len(edges):
        return 0.0
    areas = 0.5 * np.cross(mesh.vertices[edges[:, 0]], mesh.vertices[edges[:, 1]])
    hole = _holes(edges, len(mesh.vertices))
    sums = np.zeros((int(hole.max()) + 1, 3))
    np.add.at(sums, hole, areas)
    return float(np.linalg.norm(sums, axis=1).sum())


def _rims(mesh: trimesh.Trimesh) -> np.ndarray:
    """Return the edges (E, 2) that have one face only, in the direction in which it has them."""
    return mesh.edges[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]


def _holes(edges: np.ndarray, num_vertices: int) -> np.ndarray:
    """Return which hole each edge (E, 2) of the rims is of, numbered from 0."""
    label = trimesh.graph.connected_component_labels(edges, node_count=num_vertices)
    return np.unique(label[edges[:, 0]], return_inverse=True)[1]


def _measured(mesh: trimesh.Trimesh, label: str, repairs: list[str], allow_open: bool) -> SoundMesh:
    bodies = int(mesh.body_count)
    if bodies > _MAX_BODIES:
        raise CorruptAssetError(
            f"{label}: falls apart into {bodies} pieces, more than the {_MAX_BODIES} allowed: "
            "join them in the program that made it"
        )
    try:
        hull = float(mesh.convex_hull.volume)
    except (ValueError, RuntimeError, IndexError) as error:  # Qhull: all points in one plane
        raise CorruptAssetError(f"{label}: is flat, it has no convex hull") from error
    closed, volume = is_closed(mesh), abs(float(mesh.volume))
    if closed and volume < 1e-4 * hull:
        raise CorruptAssetError(
            f"{label}: encloses {1e6 * volume:.3g} cm3, nothing beside the {1e6 * hull:.3g} cm3 of "
            "its convex hull"
        )
    if not closed:
        # About its own middle: an open surface's share depends on the point it is measured from.
        centred = mesh.copy()
        centred.apply_translation(-mesh.vertices.mean(axis=0))
        share = abs(float(centred.volume)) / hull
        if share < _OPEN_SHARE and not allow_open:
            raise CorruptAssetError(
                f"{label}: its surface is open and encloses about {share:.0%} of its convex hull, "
                "so its volume is unknown; close it in the program that made it, or give --mass KG"
            )
        repairs.append(
            f"its surface stays open: the convex hull's {1e6 * hull:.3g} cm3 stand for its volume"
        )
        volume = hull
    if bodies > 1:
        repairs.append(f"its {bodies} separate pieces are one rigid object")
    vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    return SoundMesh(vertices, faces, closed, volume, hull, bodies, repairs)
