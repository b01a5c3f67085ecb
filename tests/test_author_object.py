"""Objects from meshes: hand-worked figures of good ones, and what is said about bad ones."""

from __future__ import annotations

import io
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from command_line import command
from pgdm import paths
from pgdm.errors import ConfigError, CorruptAssetError, LibraryError, PgdmError, UnknownNameError
from pgdm.library import author_mesh, open_library, own
from pgdm.library.author_object import ObjectRequest, author_object
from pgdm.library.author_parts import PartsCfg, convex_parts
from pgdm.library.verify import damaged

SIDES = np.array([0.04, 0.06, 0.08])  # m
VOLUME, MASS = 192e-6, 0.24  # m3, and kg at 1250 kg/m3


def box() -> trimesh.Trimesh:
    return trimesh.creation.box(SIDES)


def saved(mesh: trimesh.Trimesh, name: str = "it.stl") -> Path:
    mesh.export(name)
    return Path(name).absolute()


def compiled(name: str) -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_path(str(open_library().object_xml(name)))


@pytest.mark.parametrize("name", ["it.stl", "it.obj", "it.ply", "it.glb", "it.off"])
def test_a_box_has_the_volume_mass_and_inertia_of_a_box(name: str) -> None:
    mesh = box().apply_translation([0.3, 0.0, 0.1])
    made = author_object(ObjectRequest(saved(mesh, name), "brick"))
    assert made.mesh.volume_m3 == pytest.approx(VOLUME, rel=1e-5)
    assert len(made.parts) == 1  # it is convex
    model = compiled("brick")
    body = model.body("object")
    assert body.mass[0] == pytest.approx(MASS, rel=1e-5)
    a, b, c = SIDES**2
    inertia = MASS / 12 * np.array([b + c, a + c, a + b])
    assert np.sort(body.inertia) == pytest.approx(np.sort(inertia), rel=1e-4)
    assert body.ipos == pytest.approx(np.zeros(3), abs=1e-7)  # the origin is the centre of mass
    facts = own.facts("brick")
    assert facts["origin_in_mesh_m"] == pytest.approx([0.3, 0.0, 0.1], abs=1e-6)
    assert made.drop.rests and made.drop.com[2] == pytest.approx(0.04, abs=1e-3)


def test_it_has_the_form_of_the_librarys_objects() -> None:
    author_object(ObjectRequest(saved(box()), "brick", licence="CC0-1.0"))
    model = compiled("brick")
    assert [model.joint(i).name for i in range(6)] == [
        f"OBJ{kind}{axis}" for kind in "TR" for axis in "xyz"
    ]
    touching = model.geom("brick_contact0")
    assert touching.friction == pytest.approx([1, 0.5, 0.01])
    assert (touching.condim[0], touching.margin[0]) == (4, 0.0005)
    assert model.geom("brick_visual").contype[0] == 0
    library = open_library()
    assert library.sources()["own"].files["objects/brick/object.xml"].licence == "CC0-1.0"
    assert damaged(library) == []
    mesh = library.folder("own") / "objects/brick/meshes/contact0.stl"
    mesh.write_bytes(mesh.read_bytes()[:-1])
    assert "own/objects/brick/meshes/contact0.stl" in damaged(library)[0]


def test_a_known_mass_counts_and_the_density_otherwise() -> None:
    path = saved(box())
    assert author_object(ObjectRequest(path, "a", mass_kg=0.5)).body.mass_kg == 0.5
    light = author_object(ObjectRequest(path, "b", density=100.0)).body
    assert light.mass_kg == pytest.approx(0.0192, rel=1e-5)


@pytest.mark.parametrize(
    ("factor", "scale", "said"),
    [
        (1000.0, 1.0, "longest side is 80 m; it looks like mm .8 cm.: use --unit mm"),
        (100.0, 1.0, "longest side is 8 m; it looks like cm .8 cm.: use --unit cm"),
        (1.0, 0.001, "longest side is 0.08 mm; it looks like m .8 cm.: use --unit m"),
        (1e6, 1.0, "no unit makes that a thing of 2 cm to 60 cm: give --scale"),
    ],
)
def test_a_wrong_unit_is_guessed(factor: float, scale: float, said: str) -> None:
    path = saved(box().apply_scale(factor))
    with pytest.raises(ConfigError, match=said):
        author_mesh.read(path, scale)


def test_a_hole_is_filled_and_said() -> None:
    mesh = box()
    mesh.update_faces(mesh.face_normals[:, 2] < 0.5)  # the lid is gone
    found = author_mesh.read(saved(mesh))
    assert found.closed and found.volume_m3 == pytest.approx(VOLUME, rel=1e-5)
    assert any("filled holes with 2 faces" in repair for repair in found.repairs)


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
    with pytest.raises(CorruptAssetError, match=r"surface is open, a lid would have .* --mass KG"):
        author_mesh.read(path)
    found = author_mesh.read(path, allow_open=True)
    assert not found.closed and found.volume_m3 == found.hull_m3
    assert any("stays open: the convex hull's" in repair for repair in found.repairs)


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
    assert any("2 faces without area" in repair for repair in found.repairs)
    assert any("2 faces that are there twice" in repair for repair in found.repairs)


def test_pieces_are_counted() -> None:
    pair = trimesh.util.concatenate([box(), box().apply_translation([0.1, 0, 0])])
    found = author_mesh.read(saved(pair))
    assert found.num_bodies == 2
    assert any("2 separate pieces are one rigid object" in repair for repair in found.repairs)


def test_what_cannot_be_a_body_is_refused() -> None:
    flat = trimesh.Trimesh(
        [[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0]], [[0, 1, 2], [0, 2, 3]]
    )
    point = trimesh.Trimesh([[0.1, 0, 0]] * 3, [[0, 1, 2]], process=False)
    line = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0.2, 0, 0]], [[0, 1, 2]], process=False)
    nan = box()
    nan.vertices[3] = np.nan
    for mesh, said in (
        (flat, "is flat"),
        (point, "all its vertices are one point"),
        (line, "none of its 1 faces has an area"),
        (nan, r"1 of 8 vertices are NaN or infinite, the first is number 3"),
    ):
        with pytest.raises(CorruptAssetError, match=said):
            author_mesh.read(saved(mesh, "it.ply"))


def test_a_file_that_is_none_is_named() -> None:
    for name, content, said in (
        ("empty.stl", b"", r"empty\.stl: "),
        ("noise.glb", b"\x01\x02" * 40, "not a readable mesh"),
        ("words.obj", b"hello", "holds no faces|not a readable mesh"),
        ("cut.stl", saved(box()).read_bytes()[:200], r"cut\.stl: "),
    ):
        Path(name).write_bytes(content)
        with pytest.raises(CorruptAssetError, match=said) as caught:
            author_mesh.read(Path(name))
        assert "\n" not in str(caught.value)
    with pytest.raises(ConfigError, match=r"format '\.step' is not read; valid: \.stl"):
        author_mesh.read(Path("it.step"))
    with pytest.raises(ConfigError, match="there is no such file"):
        author_mesh.read(Path("none.stl"))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("hammer", "is the library's own"),
        ("door", "is the library's own"),
        ("dhand", "is the library's own"),
        ("My-Thing", "is not valid: a small letter"),
        ("", "is not valid"),
        ("../x", "is not valid"),
    ],
)
def test_names_are_checked(name: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        author_object(ObjectRequest(saved(box()), name))


def test_an_object_is_replaced_only_on_request_and_removed() -> None:
    path = saved(box())
    first = author_object(ObjectRequest(path, "brick"))
    before = (first.folder / "object.xml").read_bytes()
    with pytest.raises(ConfigError, match="you have an object 'brick' already; --replace"):
        author_object(ObjectRequest(path, "brick"))
    author_object(ObjectRequest(path, "brick", replace=True))
    assert (first.folder / "object.xml").read_bytes() == before  # equal input, equal output
    own.remove("brick")
    assert not first.folder.exists() and own.read().files == {}
    with pytest.raises(UnknownNameError, match="unknown object or task of your own 'brick'"):
        own.remove("brick")


def test_an_object_that_fails_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    from pgdm.library import author_object as module

    def broken(path: Path) -> None:
        raise LibraryError("the simulation of its fall diverges")

    monkeypatch.setattr(module, "drop", broken)
    with pytest.raises(LibraryError, match="diverges"):
        author_object(ObjectRequest(saved(box()), "brick"))
    assert own.read().objects == []
    assert [p.name for p in own.folder().iterdir()] == [".lock"]


def test_what_stands_on_its_tip_falls_over_and_a_ball_stays() -> None:
    cone = trimesh.creation.cone(radius=0.03, height=0.08)
    cone.apply_transform(trimesh.transformations.rotation_matrix(np.pi + 0.05, [1, 0, 0]))
    fallen = author_object(ObjectRequest(saved(cone), "cone"))
    assert fallen.drop.turned_rad > 0.5
    assert dict(fallen.rows())["drop test"].startswith(("falls over and rests", "does NOT rest"))


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"density": 0.0}, "--density is 0; valid: 10 to 20000"),
        ({"mass_kg": -1.0}, "--mass is -1; valid"),
        ({"scale": 0.0}, "--scale is 0; valid"),
        ({"density": 15_000.0, "scale": 5.0}, r"are .* kg; valid: 0.001 to 10 kg"),
        ({"parts": PartsCfg(0.001)}, "--threshold is 0.001; valid: 0.01 to 1"),
        ({"parts": PartsCfg(0.05, 0)}, "--parts is 0; valid: 1 to 64"),
    ],
)
def test_options_are_checked(options: dict, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        author_object(ObjectRequest(saved(box()), "brick", **options))


def test_the_command_says_and_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())  # nobody answers
    saved(box().apply_scale(1000))
    wrong = command("pgdm", "author", "object", "it.stl", "--name", "brick")
    assert wrong.code == 2 and "use --unit mm" in wrong.err
    made = command("pgdm", "author", "object", "it.stl", "--name", "brick", "--unit", "mm")
    assert made.code == 0, made.err
    assert "240.0 g" in made.out and "rests as it was put" in made.out
    if "no picture" not in made.err:
        assert (paths.user() / "library/objects/brick/picture.png").stat().st_size > 2000
    listed = command("pgdm", "author", "list").out
    assert "brick" in listed and "it.stl" in listed
    both = command(
        "pgdm", "author", "object", "it.stl", "--name", "b", "--unit", "mm", "--scale", "1"
    )
    assert both.code == 2 and "say the same" in both.err
    assert "nothing was removed" in command("pgdm", "author", "remove", "brick").out
    assert command("pgdm", "author", "remove", "brick", "--yes").code == 0
    assert "no objects or tasks yet" in command("pgdm", "author", "list").out


def elbow() -> trimesh.Trimesh:
    """Return an L of two legs, 6 cm long and 2 cm wide."""
    outline = np.array([[0, 0], [6, 0], [6, 2], [2, 2], [2, 6], [0, 6]]) / 100
    low = np.column_stack((outline, np.zeros(6)))
    vertices = np.concatenate((low, low + np.array([0, 0, 0.02])))
    caps = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]]
    sides = [f for i in range(6) for j in [(i + 1) % 6] for f in ([i, j, i + 6], [j, j + 6, i + 6])]
    faces = [f[::-1] for f in caps] + [[a + 6 for a in f] for f in caps] + sides
    return trimesh.Trimesh(vertices, faces)


@pytest.mark.slow
def test_an_elbow_is_two_parts_equal_each_time(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    mesh = author_mesh.read(saved(elbow()))
    assert mesh.volume_m3 == pytest.approx(40e-6)
    told: list[str] = []
    found = []
    for home in ("one", "two"):
        monkeypatch.setenv("PGDM_HOME", str(tmp_path / home))
        found.append(convex_parts(mesh, PartsCfg(), lambda step, done, total: told.append(step)))
    assert told and len(found[0]) == 2
    assert sum(part.trimesh().volume for part in found[0]) == pytest.approx(40e-6, rel=0.05)
    for one, two in zip(*found, strict=True):
        assert np.array_equal(one.vertices, two.vertices)
    told.clear()
    cached = convex_parts(mesh, PartsCfg(), lambda step, done, total: told.append(step))
    assert not told and np.array_equal(cached[0].vertices, found[0][0].vertices)


@pytest.mark.slow
def test_two_million_faces_are_simplified_and_said() -> None:
    ring = trimesh.creation.torus(0.05, 0.02, major_sections=2000, minor_sections=500)
    assert len(ring.faces) == 2_000_000
    found = author_mesh.read(saved(ring))
    assert len(found.faces) <= author_mesh.MAX_FACES
    assert found.volume_m3 == pytest.approx(2 * np.pi**2 * 0.05 * 0.02**2, rel=0.01)
    assert any(repair.startswith("simplified 2,000,000 faces to") for repair in found.repairs)


def test_a_damaged_record_is_named() -> None:
    made = author_object(ObjectRequest(saved(box()), "brick"))
    assert json.loads((made.folder / "object.json").read_text())["scale"] == 1.0
    (made.folder / "object.json").write_text("{")
    with pytest.raises(PgdmError, match=r"object\.json: unreadable"):
        own.facts("brick")
