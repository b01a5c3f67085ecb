"""Reading a user's mesh: repaired if that is safe, otherwise refused."""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import trimesh

from pgdm.errors import ConfigError, CorruptAssetError, amount

SUFFIXES = (".stl", ".obj", ".ply", ".glb", ".off")
"""Supported formats."""

UNITS_M = {"mm": 0.001, "cm": 0.01, "m": 1.0}
"""Length of each mesh unit, m."""

SIZES_M = (0.02, 0.6)
"""Range in which an object's longest side must lie, m, so that a hand can manipulate it."""

MAX_FACES = 20_000
"""Meshes with more faces are simplified, without visible difference. (MuJoCo's own limit is
200,000.)"""

_THIN_M = 5e-4  # the models' contact margin; an object must be at least as thick
# An open surface that encloses a smaller share of its hull is refused, unless a mass is given.
_OPEN_SHARE = 0.5
_MAX_BODIES = 50
_LID_SHARE = 0.15  # holes are filled if the lids have at most this share of the surface's area
_READ_ERRORS = (
    *(ValueError, TypeError, KeyError, IndexError, AttributeError, AssertionError),
    *(NotImplementedError, ImportError, EOFError, struct.error, OSError, RuntimeError),
)
"""What trimesh's readers raise for damaged files."""


@dataclass(frozen=True)
class SoundMesh:
    """A checked mesh in metres."""

    vertices: np.ndarray = field(repr=False)
    """(V, 3) m, axes as in the file."""
    faces: np.ndarray = field(repr=False)
    """(F, 3) vertex numbers, counter-clockwise seen from outside."""
    closed: bool
    """Whether the surface encloses a volume; if not, ``volume_m3`` is the hull's."""
    volume_m3: float
    hull_m3: float
    """Volume of the convex hull."""
    num_bodies: int
    """Number of disconnected pieces."""
    repairs: list[str]
    """What was changed or assumed, one sentence each."""

    def trimesh(self) -> trimesh.Trimesh:
        """Return the mesh as a ``trimesh.Trimesh``."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)


def read(path: Path, scale: float = 1.0, allow_open: bool = False) -> SoundMesh:
    """Read, check and repair a mesh.

    Args:
        path: STL, OBJ, PLY, GLB or OFF.
        scale: metres per unit of the file.
        allow_open: accept a surface that is far from closed; for objects whose mass is given.

    Raises:
        ConfigError: the format is not supported, there is no such file, or the size is implausible
            in this unit; the message suggests a unit if one fits.
        CorruptAssetError: the file is unreadable or empty, has NaN or infinite vertices, is flat,
            encloses almost no volume, has more than 50 pieces, or is far from closed without
            ``allow_open``.
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
            f"{path}: format '{path.suffix}' is not supported; valid: {', '.join(SUFFIXES)}"
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
        raise CorruptAssetError(f"{path}: has no faces")
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
        raise CorruptAssetError(f"{label}: all its vertices coincide")
    fitting = {u: longest / scale * f for u, f in UNITS_M.items()}
    fitting = {u: size for u, size in fitting.items() if low <= size <= high}
    # Prefer the largest plausible size: objects of decimetres are more common than of centimetres.
    unit = max(fitting, key=lambda u: fitting[u]) if fitting else None
    guess = (
        f"it looks like {unit} ({length(fitting[unit])}): use --unit {unit}"
        if unit is not None
        else f"no unit puts that between {length(low)} and {length(high)}: give --scale S, "
        "the metres per unit of the file"
    )
    raise ConfigError(f"{label}: its longest side is {length(longest)}; {guess}")


def length(metres: float) -> str:
    """Return a length as text, such as ``8 cm``."""
    for unit, factor in (("m", 1.0), ("cm", 0.01), ("mm", 0.001)):
        if metres >= factor:
            return f"{metres / factor:.3g} {unit}"
    return f"{metres / 0.001:.2g} mm"


def _clean(mesh: trimesh.Trimesh, label: str, repairs: list[str]) -> None:
    """Merge equal vertices, remove degenerate and duplicate faces, and refuse a flat mesh."""
    before = len(mesh.vertices)
    mesh.merge_vertices(merge_tex=True, merge_norm=True)
    if merged := before - len(mesh.vertices):
        repairs.append(f"merged {amount(merged, 'vertex', 'vertices')} at the same place")
    # Relative to the mesh's size: trimesh's absolute bound would drop faces of fine scans.
    sound = mesh.area_faces > 1e-12 * mesh.scale**2
    if not sound.any():
        raise CorruptAssetError(f"{label}: all its faces have zero area: {len(sound)}")
    if not sound.all():
        repairs.append(f"removed {amount(int((~sound).sum()), 'face')} of zero area")
        mesh.update_faces(sound)
    unique = mesh.unique_faces()
    if not unique.all():
        repairs.append(f"removed {amount(int((~unique).sum()), 'duplicate face')}")
        mesh.update_faces(unique)
    mesh.remove_unreferenced_vertices()
    thinnest = float(mesh.extents.min())
    if thinnest < _THIN_M:
        raise CorruptAssetError(
            f"{label}: is flat, with a shortest side of {length(thinnest)}; an object needs "
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
    """Make the winding consistent and outward, and fill holes."""
    if not mesh.is_winding_consistent:
        trimesh.repair.fix_winding(mesh)
        repairs.append("flipped faces wound against their neighbours")
    if len(_rims(mesh)):
        _fill(mesh, label, repairs, allow_open)
    before = mesh.faces.copy()
    trimesh.repair.fix_inversion(mesh, multibody=is_closed(mesh))
    if not np.array_equal(before, mesh.faces):
        repairs.append("turned the surface inside out: it was wound inward")


def _fill(mesh: trimesh.Trimesh, label: str, repairs: list[str], allow_open: bool) -> None:
    """Fill all holes if they are small in total.

    Otherwise, as for a bowl, refuse the mesh or leave the surface open if allowed.
    """
    share = opening(mesh) / float(mesh.area)
    if share > _LID_SHARE:
        if not allow_open:
            raise CorruptAssetError(
                f"{label}: its surface is open; a lid would have {share:.0%} of its area, so its "
                "volume is unknown; close it in your mesh editor, or give --mass KG"
            )
        repairs.append(f"left the surface open: a lid would have {share:.0%} of the surface's area")
        return
    edges = _rims(mesh)
    hole = _holes(edges, len(mesh.vertices))
    count = int(hole.max()) + 1
    rims = [np.unique(edges[hole == one]) for one in range(count)]
    middles = [mesh.vertices[rim].mean(axis=0) for rim in rims]  # apex of a fan over each hole
    fans = np.column_stack((edges[:, ::-1], len(mesh.vertices) + hole))
    mesh.vertices = np.concatenate((mesh.vertices, middles))
    mesh.faces = np.concatenate((mesh.faces, fans))
    holes = "a hole" if count == 1 else f"{count} holes"
    repairs.append(f"filled {holes} with {len(fans)} faces, {share:.1%} of the surface's area")


def is_closed(mesh: trimesh.Trimesh) -> bool:
    """Return whether a surface is closed: faces traverse each edge equally often in each direction.

    This also accepts an edge of four faces, along which two closed pieces touch.
    """
    edges, count = mesh.edges.astype(np.int64), len(mesh.vertices)
    there, back = edges @ [count, 1], edges @ [1, count]
    return bool(np.array_equal(np.sort(there), np.sort(back)))


def opening(mesh: trimesh.Trimesh) -> float:
    """Return the total area of flat lids on the holes of a surface, m2.

    The area vector of a closed line is half the sum of a x b over its edges from a to b, for any
    origin.
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
    """Return the edges (E, 2) that only one face has, in the direction of that face's winding."""
    return mesh.edges[trimesh.grouping.group_rows(mesh.edges_sorted, require_count=1)]


def _holes(edges: np.ndarray, num_vertices: int) -> np.ndarray:
    """Return for each rim edge (E, 2) the index (E,) of the hole that it borders."""
    label = trimesh.graph.connected_component_labels(edges, node_count=num_vertices)
    return np.unique(label[edges[:, 0]], return_inverse=True)[1]


def _measured(mesh: trimesh.Trimesh, label: str, repairs: list[str], allow_open: bool) -> SoundMesh:
    bodies = int(mesh.body_count)
    if bodies > _MAX_BODIES:
        raise CorruptAssetError(
            f"{label}: consists of {bodies} pieces, more than the {_MAX_BODIES} allowed: "
            "join them in your mesh editor"
        )
    try:
        hull = float(mesh.convex_hull.volume)
    except (ValueError, RuntimeError, IndexError) as error:  # Qhull: all points in one plane
        raise CorruptAssetError(f"{label}: is flat and has no convex hull") from error
    closed, volume = is_closed(mesh), abs(float(mesh.volume))
    if closed and volume < 1e-4 * hull:
        raise CorruptAssetError(
            f"{label}: encloses {1e6 * volume:.3g} cm3, almost nothing compared with the "
            f"{1e6 * hull:.3g} cm3 of its convex hull"
        )
    if not closed:
        # About the mesh's centre, as the computed volume of an open surface depends on the origin.
        centred = mesh.copy()
        centred.apply_translation(-mesh.vertices.mean(axis=0))
        share = abs(float(centred.volume)) / hull
        if share < _OPEN_SHARE and not allow_open:
            raise CorruptAssetError(
                f"{label}: its surface is open and encloses about {share:.0%} of its convex hull, "
                "so its volume is unknown; close it in your mesh editor, or give --mass KG"
            )
        repairs.append(
            f"its surface is open: its volume is taken as the convex hull's {1e6 * hull:.3g} cm3"
        )
        volume = hull
    if bodies > 1:
        repairs.append(f"its {bodies} separate pieces are one rigid object")
    vertices, faces = np.array(mesh.vertices, np.float64), np.array(mesh.faces, np.int64)
    return SoundMesh(vertices, faces, closed, volume, hull, bodies, repairs)
