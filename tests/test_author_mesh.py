"""Meshes from users: wrong units, holes, openings; which are repaired and which refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from brought_meshes import VOLUME, box, saved
from pgdm.errors import ConfigError, CorruptAssetError
from pgdm.library.authored import mesh as author_mesh


@pytest.mark.parametrize(
    ("factor", "scale", "message"),
    [
        (1000.0, 1.0, "longest side is 80 m; it looks like mm .8 cm.: use --unit mm"),
        (100.0, 1.0, "longest side is 8 m; it looks like cm .8 cm.: use --unit cm"),
        (1.0, 0.001, "longest side is 0.08 mm; it looks like m .8 cm.: use --unit m"),
        (1e6, 1.0, "no unit puts that between 2 cm and 60 cm: give --scale"),
    ],
)
def test_a_wrong_unit_is_guessed(factor: float, scale: float, message: str) -> None:
    path = saved(box().apply_scale(factor))
    with pytest.raises(ConfigError, match=message):
        author_mesh.read(path, scale)


def test_a_hole_is_filled_and_noted() -> None:
    mesh = box()
    mesh.update_faces(mesh.face_normals[:, 2] < 0.5)  # the lid is gone
    found = author_mesh.read(saved(mesh))
    assert found.closed and found.volume_m3 == pytest.approx(VOLUME, rel=1e-5)
    assert any("filled a hole with 4 faces" in repair for repair in found.repairs)


def test_a_round_hole_is_filled() -> None:
    can = trimesh.creation.cylinder(radius=0.03, height=0.1, sections=32)
    volume = can.volume
    can.update_faces(can.face_normals[:, 2] < 0.5)
    found = author_mesh.read(saved(can))
    assert found.closed and found.volume_m3 == pytest.approx(volume, rel=1e-6)
    assert any("filled a hole with 32 faces, 1" in repair for repair in found.repairs)


def test_pieces_that_touch_along_an_edge_are_closed() -> None:
    """Equal vertices are merged: then that edge has four faces."""
    pieces = [trimesh.creation.box((0.04, 0.04, 0.04)) for _ in range(2)]
    pieces[1].apply_translation([0.04, 0.04, 0.0])
    bracket = trimesh.util.concatenate(pieces)
    found = author_mesh.read(saved(bracket))
    assert found.closed and found.volume_m3 == pytest.approx(2 * 0.04**3, rel=1e-6)


def test_an_opening_is_as_large_as_its_lid() -> None:
    mesh = box().apply_translation([1.0, 2.0, 3.0])
    assert author_mesh.opening(mesh) == 0.0
    mesh.update_faces(np.abs(mesh.face_normals[:, 2]) < 0.5)  # lid and floor are gone
    assert author_mesh.opening(mesh) == pytest.approx(2 * 0.04 * 0.06)


def half_shell() -> trimesh.Trimesh:
    """Return a bowl without a thickness, a third of a sphere's surface."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.05)
    ball.update_faces(ball.triangles_center[:, 2] < -0.015)
    return ball


def test_an_open_surface_is_refused_unless_its_mass_is_known() -> None:
    path = saved(half_shell())
    with pytest.raises(CorruptAssetError, match=r"surface is open; a lid would have .* --mass KG"):
        author_mesh.read(path)
    found = author_mesh.read(path, allow_open=True)
    assert not found.closed and found.volume_m3 == found.hull_m3
    assert any("volume is taken as the convex hull" in repair for repair in found.repairs)


def test_faces_wound_inward_or_mixed_are_turned() -> None:
    inward = box()
    inward.invert()
    assert author_mesh.read(saved(inward)).volume_m3 == pytest.approx(VOLUME, rel=1e-5)
    mixed = box()
    mixed.faces[::3] = mixed.faces[::3, ::-1]
    found = author_mesh.read(saved(mixed, "mixed.ply"))
    assert found.volume_m3 == pytest.approx(VOLUME, rel=1e-5)
    assert any("wound against their neighbours" in repair for repair in found.repairs)


def test_faces_without_area_and_twice_are_removed() -> None:
    mesh = box()
    extra = np.concatenate((mesh.faces, mesh.faces[:2], [[0, 0, 1], [2, 3, 3]]))
    found = author_mesh.read(saved(trimesh.Trimesh(mesh.vertices, extra, process=False), "it.ply"))
    assert len(found.faces) == 12 and found.closed
    assert any("2 faces of zero area" in repair for repair in found.repairs)
    assert any("2 duplicate faces" in repair for repair in found.repairs)


def test_pieces_are_counted() -> None:
    pair = trimesh.util.concatenate([box(), box().apply_translation([0.1, 0, 0])])
    found = author_mesh.read(saved(pair))
    assert found.num_bodies == 2
    assert any("2 separate pieces are one rigid object" in repair for repair in found.repairs)


def test_meshes_without_a_body_are_refused() -> None:
    flat = trimesh.Trimesh(
        [[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]], [[0, 1, 2], [0, 2, 3]]
    )
    point = trimesh.Trimesh([[0.1, 0, 0]] * 3, [[0, 1, 2]], process=False)
    line = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], [[0, 1, 2]], process=False)
    nan = box()
    nan.vertices[3] = np.nan
    for mesh, message in (
        (flat, "is flat"),
        (point, "all its vertices coincide"),
        (line, "all its faces have zero area: 1"),
        (nan, r"1 of 8 vertices are NaN or infinite, the first is number 3"),
    ):
        with pytest.raises(CorruptAssetError, match=message):
            author_mesh.read(saved(mesh, "it.ply"))


def test_files_that_are_no_meshes_are_named() -> None:
    for name, content, message in (
        ("empty.stl", b"", r"empty\.stl: "),
        ("noise.glb", b"\x01\x02" * 40, "not a readable mesh"),
        ("words.obj", b"hello", "has no faces|not a readable mesh"),
        ("cut.stl", saved(box()).read_bytes()[:200], r"cut\.stl: "),
    ):
        Path(name).write_bytes(content)
        with pytest.raises(CorruptAssetError, match=message) as caught:
            author_mesh.read(Path(name))
        assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match=r"format '\.step' is not supported; valid: \.stl"):
        author_mesh.read(Path("it.step"))
    with pytest.raises(ConfigError, match="there is no such file"):
        author_mesh.read(Path("none.stl"))


@pytest.mark.slow
def test_two_million_faces_are_simplified_and_noted() -> None:
    ring = trimesh.creation.torus(0.05, 0.02, major_sections=2000, minor_sections=500)
    assert len(ring.faces) == 2_000_000
    found = author_mesh.read(saved(ring))
    assert len(found.faces) <= author_mesh.MAX_FACES
    assert found.volume_m3 == pytest.approx(2 * np.pi**2 * 0.05 * 0.02**2, rel=0.01)
    assert any(repair.startswith("simplified 2,000,000 faces to") for repair in found.repairs)
