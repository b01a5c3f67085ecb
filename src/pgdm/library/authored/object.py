"""Creating an object from a mesh: checks, convex parts, mass, drop test; stored in ``own``."""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from pgdm import limited
from pgdm.errors import ConfigError, CorruptAssetError, LimitError
from pgdm.library import manifest
from pgdm.library.authored import mesh as author_mesh
from pgdm.library.authored import own
from pgdm.library.authored.drop import Drop, drop
from pgdm.library.authored.mesh import SoundMesh
from pgdm.library.authored.parts import Part, PartsCfg, convex_parts
from pgdm.library.checks.compiled import compiled
from pgdm.library.files import mjcf
from pgdm.library.files import model as model_file
from pgdm.library.progress import StepProgress, silent

DENSITY = 1250.0
"""Density of the benchmark's 3D-printed objects, kg/m3 (released code)."""

_DENSITIES = (10.0, 20_000.0)  # foam to gold, kg/m3
_UPRIGHT_RAD = 0.1
_READING_S = 60  # CPU time, which includes simplifying large scans
_RGBA = "0.16 0.45 0.65 1"  # blue, as the hands and other objects are brown and black
_MASSES = (0.001, 10.0)  # kg; the benchmark's hands hold 2 kg at most


@dataclass(frozen=True)
class ObjectRequest:
    """Description of an object to create."""

    mesh: Path
    """STL, OBJ, PLY, GLB or OFF."""
    name: str
    """Name of the object in the library."""
    scale: float = 1.0
    """Metres per unit of the file."""
    mass_kg: float | None = None
    """Mass, if known; None: computed from the density."""
    density: float = DENSITY
    """kg/m3; used if no mass is given."""
    parts: PartsCfg = field(default_factory=PartsCfg)
    """How finely the mesh is decomposed into convex parts."""
    licence: str = "unstated"
    """Licence of the mesh, by its SPDX name if it has one."""
    replace: bool = False
    """Replace an object of the same name."""


@dataclass(frozen=True)
class Body:
    """Mass and inertia of a rigid object, in the frame of its mesh."""

    mass_kg: float
    com: np.ndarray  # (3,) m, centre of mass
    inertia: np.ndarray  # (3, 3) kg m2, about the centre of mass, axes of the mesh


@dataclass(frozen=True)
class AuthoredObject:
    """A newly created object."""

    name: str
    folder: Path
    mesh: SoundMesh
    parts: list[Part]
    body: Body
    drop: Drop

    def rows(self) -> list[tuple[str, str]]:
        """Return the object's properties as pairs of name and text, for a table."""
        mesh, sides = self.mesh, np.ptp(self.mesh.vertices, axis=0)
        whole = sum(part.trimesh().volume for part in self.parts)
        kind = "closed" if mesh.closed else "open, its hull is used"
        return [
            ("sides", " x ".join(f"{100 * side:.1f}" for side in sides) + " cm"),
            ("faces", f"{len(mesh.faces):,}"),
            ("surface", f"{kind}; separate pieces: {mesh.num_bodies}"),
            ("volume", f"{1e6 * mesh.volume_m3:.1f} cm3"),
            ("share of its hull", f"{mesh.volume_m3 / mesh.hull_m3:.2f}"),
            ("mass", f"{1e3 * self.body.mass_kg:.1f} g"),
            (
                "convex parts",
                f"{len(self.parts)}, together {whole / mesh.volume_m3:.2f} of the mesh's volume",
            ),
            ("drop test", drop_text(self.drop)),
        ]


def drop_text(found: Drop) -> str:
    """Return the result of a drop test as text."""
    if found.rests and found.turned_rad < _UPRIGHT_RAD:
        return "rests as placed"
    if found.rests:
        return f"falls over and rests, turned by {np.rad2deg(found.turned_rad):.0f} degrees"
    return (
        f"does NOT rest: {100 * found.speed_m_s:.1f} cm/s after 4 s, moved "
        f"{100 * found.drift_m:.1f} cm sideways in the last 2 s, "
        f"{1e3 * found.sunk_m:.1f} mm deep in the table"
    )


def author_object(request: ObjectRequest, progress: StepProgress = silent) -> AuthoredObject:
    """Create an object in the source ``own`` from a mesh.

    The object's frame has the mesh's axes and its origin at the centre of mass.

    Args:
        request: the object to create.
        progress: receives the progress of the convex decomposition.

    Raises:
        ConfigError: a value is out of range, the name is invalid or taken, or the mesh's format or
            size is not accepted.
        CorruptAssetError: the mesh cannot be used; the message gives the reason.
        LibraryError: the mesh cannot be decomposed, the drop test diverges, or the user's folder
            cannot be written.
    """
    _check(request)
    own.check_object_name(request.name, request.replace)
    mesh = _mesh(request)
    parts = convex_parts(mesh, request.parts, progress)
    body = weigh(mesh, parts, request.mass_kg, request.density)
    if not _MASSES[0] <= body.mass_kg <= _MASSES[1]:
        raise ConfigError(
            f"{request.mesh.name}: {1e6 * mesh.volume_m3:.3g} cm3 at {request.density:g} kg/m3 are "
            f"{body.mass_kg:.3g} kg; valid: {_MASSES[0]:g} to {_MASSES[1]:g} kg (--mass, --density)"
        )
    found: list[Drop] = []

    def make(folder: Path) -> list[str]:
        _write(folder, request, mesh, parts, body)
        found.append(drop(folder / "object.xml"))
        _record(folder, request, mesh, body)
        return [*mesh.repairs, f"drop test: {drop_text(found[0])}"]

    folder = own.add_model("objects", request.name, make, request.mesh.name, request.licence)
    return AuthoredObject(request.name, folder, mesh, parts, body, found[0])


def _mesh(request: ObjectRequest) -> SoundMesh:
    """Read the mesh in a child process, because it may come from a third party."""
    arguments = request.mesh, request.scale, request.mass_kg is not None
    try:
        return limited.call(author_mesh.read, *arguments, seconds=_READING_S)
    except LimitError as error:
        raise CorruptAssetError(f"{request.mesh}: {error}; simplify the mesh") from error


def weigh(mesh: SoundMesh, parts: list[Part], mass_kg: float | None, density: float) -> Body:
    """Return mass, centre of mass and inertia at uniform density.

    Centre of mass and inertia are those of the enclosed volume if the surface is closed, otherwise
    of the convex parts together (parallel-axis theorem). If no mass is given, it is the
    density times the mesh's volume.

    Args:
        mesh: the mesh.
        parts: its convex parts.
        mass_kg: its mass, None if unknown.
        density: kg/m3; used if no mass is given.
    """
    pieces = [mesh.trimesh()] if mesh.closed else [part.trimesh() for part in parts]
    volumes = np.array([piece.volume for piece in pieces])  # m3; also kg, at a density of 1 kg/m3
    centres = np.array([piece.center_mass for piece in pieces])
    com = volumes @ centres / volumes.sum()
    inertia = np.zeros((3, 3))
    for piece, volume, centre in zip(pieces, volumes, centres - com, strict=True):
        steiner = volume * (centre @ centre * np.eye(3) - np.outer(centre, centre))
        inertia += piece.moment_inertia + steiner
    mass = density * mesh.volume_m3 if mass_kg is None else mass_kg
    return Body(float(mass), com, inertia * mass / volumes.sum())


def _check(request: ObjectRequest) -> None:
    for option, value, (low, high) in (
        ("--density", request.density, _DENSITIES),
        ("--mass", request.mass_kg, _MASSES),
        ("--scale", request.scale, (1e-6, 1e6)),
    ):
        if value is not None and not low <= value <= high:
            raise ConfigError(f"{option} is {value:g}; valid: {low:g} to {high:g}")
    request.parts.check()


def _write(
    folder: Path, request: ObjectRequest, mesh: SoundMesh, parts: list[Part], body: Body
) -> None:
    """Write the model with its meshes, like the library's other objects."""
    name = request.name
    raw = folder / ".raw"
    raw.mkdir()
    root = mjcf.model(name)
    section = mjcf.add(root, "asset")
    shapes = {name: mesh.trimesh()} | {f"contact{i}": p.trimesh() for i, p in enumerate(parts)}
    for title, shape in shapes.items():
        shape.apply_translation(-body.com)
        shape.export(raw / f"{title}.stl")
        # The visual mesh is a shell: MuJoCo would refuse a thin or open surface as a solid.
        kind = {"inertia": "shell"} if title == name else {}
        mjcf.add(section, "mesh", name=title, file=str(raw / f"{title}.stl"), **kind)
    mjcf.object_defaults(root)
    element = mjcf.object_body(root, _inertial(body))
    look = {"mesh": name, "class_": "object_visual", "rgba": _RGBA}
    mjcf.add(element, "geom", name=f"{name}_visual", **look)
    for i in range(len(parts)):
        title = f"contact{i}"
        mjcf.add(element, "geom", name=f"{name}_{title}", mesh=title, class_="object_contact")
    note = f"Made by pgdm from {request.mesh.name} ({request.licence}); do not edit."
    model_file.write(root, folder / "object.xml", note)
    shutil.rmtree(raw)
    compiled(folder / "object.xml", request.mesh.name)


def _inertial(body: Body) -> dict[str, str]:
    matrix = body.inertia
    least = float(np.linalg.eigvalsh(matrix).min())
    if least <= 0.0:
        raise CorruptAssetError(
            f"the mesh's smallest principal inertia is {least:.2g} kg m2, not "
            "positive; repair the mesh in your mesh editor"
        )
    entries = [matrix[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    full = " ".join(f"{entry:.9g}" for entry in entries)
    return {"pos": "0 0 0", "mass": f"{body.mass_kg:.9g}", "fullinertia": full}


def _record(folder: Path, request: ObjectRequest, mesh: SoundMesh, body: Body) -> None:
    """Record how the object was created."""
    facts: dict[str, Any] = {
        "mesh": request.mesh.name,
        "mesh_sha256": manifest.sha256_of(request.mesh),
        "scale": request.scale,
        "threshold": request.parts.threshold,
        "max_parts": request.parts.max_parts,
        "origin_in_mesh_m": body.com.tolist(),
        "mass_kg": body.mass_kg,
        "volume_m3": mesh.volume_m3,
        "repairs": mesh.repairs,
    }
    (folder / "object.json").write_text(json.dumps(facts, indent=1) + "\n", encoding="utf-8")
