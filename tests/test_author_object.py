"""Objects from meshes: hand-worked values of good ones, errors of bad ones."""

from __future__ import annotations

import io
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from brought_meshes import MASS, SIDES, VOLUME, box, saved
from command_line import command
from pgdm import paths
from pgdm.errors import ConfigError, LibraryError, PgdmError, UnknownNameError
from pgdm.library import open_library
from pgdm.library.authored import mesh as author_mesh
from pgdm.library.authored import own
from pgdm.library.authored.object import ObjectRequest, author_object
from pgdm.library.authored.parts import PartsCfg, convex_parts
from pgdm.library.checks.verify import damaged


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
    verified = command("pgdm", "assets", "verify")
    assert verified.code == 1 and "'pgdm author'" in verified.err and "fetch" not in verified.err
    (library.folder("own") / "objects/brick/object.xml").unlink()
    with pytest.raises(LibraryError, match=r"object\.xml: missing .* again with 'pgdm author', or"):
        library.object_xml("brick")


def test_a_known_mass_counts_and_the_density_otherwise() -> None:
    path = saved(box())
    assert author_object(ObjectRequest(path, "a", mass_kg=0.5)).body.mass_kg == 0.5
    light = author_object(ObjectRequest(path, "b", density=100.0)).body
    assert light.mass_kg == pytest.approx(0.0192, rel=1e-5)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("hammer", "is taken by the library"),
        ("door", "is taken by the library"),
        ("dhand", "is taken by the library"),
        ("My-Thing", "is not valid: a lower-case letter"),
        ("", "is not valid"),
        ("../x", "is not valid"),
    ],
)
def test_names_are_checked(name: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        author_object(ObjectRequest(saved(box()), name))


def test_an_object_is_replaced_only_on_request_and_removed() -> None:
    path = saved(box())
    first = author_object(ObjectRequest(path, "brick"))
    before = (first.folder / "object.xml").read_bytes()
    with pytest.raises(ConfigError, match="you already have an object 'brick'; --replace"):
        author_object(ObjectRequest(path, "brick"))
    author_object(ObjectRequest(path, "brick", replace=True))
    assert (first.folder / "object.xml").read_bytes() == before  # equal input, equal output
    own.remove("brick")
    assert not first.folder.exists() and own.read().files == {}
    with pytest.raises(UnknownNameError, match="unknown object, hand or task of your own 'brick'"):
        own.remove("brick")


def test_an_object_that_fails_leaves_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    from pgdm.library.authored import object as module

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
    ("options", "message"),
    [
        ({"density": 0.0}, "--density is 0; valid: 10 to 20000"),
        ({"mass_kg": -1.0}, "--mass is -1; valid"),
        ({"scale": 0.0}, "--scale is 0; valid"),
        ({"density": 15_000.0, "scale": 5.0}, r"are .* kg; valid: 0.001 to 10 kg"),
        ({"parts": PartsCfg(0.001)}, "--threshold is 0.001; valid: 0.01 to 1"),
        ({"parts": PartsCfg(0.05, 0)}, "--parts is 0; valid: 1 to 64"),
    ],
)
def test_options_are_checked(options: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        author_object(ObjectRequest(saved(box()), "brick", **options))


def test_the_command_prints_and_draws(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO())  # no answer
    saved(box().apply_scale(1000))
    wrong = command("pgdm", "author", "object", "it.stl", "--name", "brick")
    assert wrong.code == 2 and "use --unit mm" in wrong.err
    made = command("pgdm", "author", "object", "it.stl", "--name", "brick", "--unit", "mm")
    assert made.code == 0, made.err
    assert "240.0 g" in made.out and "rests as placed" in made.out
    if "no picture" not in made.err:
        assert (paths.user() / "library/objects/brick/picture.png").stat().st_size > 2000
    listed = command("pgdm", "author", "list").out
    assert "brick" in listed and "it.stl" in listed
    both = command(
        "pgdm", "author", "object", "it.stl", "--name", "b", "--unit", "mm", "--scale", "1"
    )
    assert both.code == 2 and "exclude each other" in both.err
    assert "nothing was removed" in command("pgdm", "author", "remove", "brick").out
    assert command("pgdm", "author", "remove", "brick", "--yes").code == 0
    assert "no objects, hands or tasks yet" in command("pgdm", "author", "list").out


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
    steps: list[str] = []
    found = []
    for home in ("one", "two"):
        monkeypatch.setenv("PGDM_HOME", str(tmp_path / home))
        found.append(convex_parts(mesh, PartsCfg(), lambda step, done, total: steps.append(step)))
    assert steps and len(found[0]) == 2
    assert sum(part.trimesh().volume for part in found[0]) == pytest.approx(40e-6, rel=0.05)
    for one, two in zip(*found, strict=True):
        assert np.array_equal(one.vertices, two.vertices)
    steps.clear()
    cached = convex_parts(mesh, PartsCfg(), lambda step, done, total: steps.append(step))
    assert not steps and np.array_equal(cached[0].vertices, found[0][0].vertices)
    (file,) = (tmp_path / "two" / "parts").glob("*.npz")
    file.write_bytes(file.read_bytes()[:-100])
    again = convex_parts(mesh, PartsCfg(), lambda step, done, total: steps.append(step))
    assert steps and np.array_equal(again[0].vertices, found[0][0].vertices)


def test_a_damaged_record_is_named() -> None:
    made = author_object(ObjectRequest(saved(box()), "brick"))
    assert json.loads((made.folder / "object.json").read_text())["scale"] == 1.0
    (made.folder / "object.json").write_text("{")
    with pytest.raises(PgdmError, match=r"object\.json: unreadable"):
        own.facts("brick")


@pytest.mark.parametrize(
    ("error", "expected"),
    [(RuntimeError("no hull"), LibraryError), (ZeroDivisionError("1/0"), ZeroDivisionError)],
)
def test_only_errors_of_coacd_are_blamed_on_the_mesh(
    monkeypatch: pytest.MonkeyPatch, error: Exception, expected: type[Exception]
) -> None:
    def failing(*_: object) -> None:
        raise error

    monkeypatch.setattr("pgdm.library.authored.parts._decomposed", failing)
    with pytest.raises(expected, match=str(error)):
        convex_parts(author_mesh.read(saved(elbow())), PartsCfg())
