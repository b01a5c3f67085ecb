"""The catalogue: the source that serves each task, and errors for what is missing."""

from __future__ import annotations

import json
import shutil
import time
from pathlib import Path

import pytest

from library_trees import make_checkout
from pgdm.errors import CorruptAssetError, LibraryError, UnknownNameError
from pgdm.library import import_tcdm, open_library
from pgdm.library.checks.verify import damaged
from pgdm.library.files import motion as motion_file
from pgdm.library.files.motion import Motion


@pytest.fixture(scope="module")
def filled(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("filled")
    checkout = make_checkout(folder / "TCDM", ("hammer_use1", "cup_pour1", "dhand_cup"))
    import_tcdm(checkout, folder / "library")
    return folder / "library"


@pytest.fixture
def both(filled: Path, tmp_path: Path) -> Path:
    """Return a library with two sources; the second lacks a task and has another."""
    root = tmp_path / "library"
    shutil.copytree(filled, root)
    shutil.copytree(root / "checkout", root / "registry")
    path = root / "registry" / "manifest.json"
    content = json.loads(path.read_text())
    content["source"] = "registry"
    content["tasks"]["cup-drink1"] = content["tasks"].pop("cup-pour1")
    (root / "registry/motions/cup-pour1.npz").rename(root / "registry/motions/cup-drink1.npz")
    path.write_text(json.dumps(content))
    return root


def test_a_checkout_wins_task_by_task(both: Path) -> None:
    library = open_library(both)
    assert library.tasks() == {
        "cup-drink1": "registry",
        "cup-pour1": "checkout",
        "dhand-cup": "checkout",
        "hammer-use1": "checkout",
    }
    assert library.source_of("hammer-use1") == "checkout"
    assert library.motion("hammer-use1").source == "checkout"
    assert library.motion("hammer-use1", "registry").source == "registry"
    assert library.hand_xml("adroit").is_relative_to(both / "checkout")
    assert library.hand_xml("adroit", "registry").is_relative_to(both / "registry")
    assert library.object_xml("cup", "registry").is_relative_to(both / "registry")
    assert library.scene_xml("registry").is_relative_to(both / "registry")


def test_an_entry_has_hand_objects_steps_and_starts(filled: Path) -> None:
    entry = open_library(filled).entry("dhand-cup")
    assert (entry.hand, entry.objects, entry.steps) == ("dhand", ["cup"], 6)
    assert entry.starts == ["planned", "mined"]


def test_what_is_not_there_is_named_with_what_is(filled: Path) -> None:
    library = open_library(filled)
    with pytest.raises(UnknownNameError, match="unknown task 'hammer-use2'; did you mean hammer"):
        library.motion("hammer-use2")
    with pytest.raises(UnknownNameError, match="unknown hand 'adroyt'; did you mean adroit"):
        library.hand_xml("adroyt")
    with pytest.raises(UnknownNameError, match=r"unknown object 'x'; valid: cup, hammer\."):
        library.object_xml("x")
    with pytest.raises(UnknownNameError, match=r"unknown library source 'registry'; .*checkout"):
        library.scene_xml("registry")


def test_the_error_for_an_empty_library_names_the_commands_that_fill_it(tmp_path: Path) -> None:
    library = open_library(tmp_path / "none")
    assert library.tasks() == {}
    with pytest.raises(LibraryError, match=r"is empty.*'pgdm assets fetch' or 'pgdm assets import"):
        library.hand_xml("adroit")
    assert not (tmp_path / "none").exists()


@pytest.mark.parametrize("content", ["", "{", "[]", '{"format": 7}', '{"format": 1, "x": 2}'])
def test_a_damaged_manifest_is_named(tmp_path: Path, content: str) -> None:
    (tmp_path / "checkout").mkdir()
    (tmp_path / "checkout" / "manifest.json").write_text(content)
    with pytest.raises(CorruptAssetError, match=r"manifest\.json: .*pgdm assets fetch") as caught:
        open_library(tmp_path)
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_named(both: Path) -> None:
    (both / "checkout" / "motions" / "hammer-use1.npz").unlink()
    with pytest.raises(LibraryError, match=r"hammer-use1\.npz: missing from the library"):
        open_library(both).motion("hammer-use1")


def test_a_motion_is_read_once_per_source(both: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[str] = []

    def counted(path: Path, motion_id: str, source: str) -> Motion:
        read.append(source)
        return reader(path, motion_id, source)

    reader = motion_file.read
    monkeypatch.setattr(motion_file, "read", counted)
    library = open_library(both)
    for _ in range(2):
        assert library.motion("hammer-use1") is library.motion("hammer-use1", "checkout")
        assert library.motion("hammer-use1", "registry").source == "registry"
    assert read == ["checkout", "registry"]


def test_a_damaged_motion_is_named(both: Path) -> None:
    path = both / "checkout" / "motions" / "hammer-use1.npz"
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(CorruptAssetError, match=r"hammer-use1\.npz: was changed"):
        open_library(both).motion("hammer-use1")


def test_verify_names_missing_changed_and_shortened_files(both: Path) -> None:
    library = open_library(both)
    assert damaged(library) == [
        "registry/motions/cup-pour1.npz: missing"  # the fixture moved it
    ]
    hand = both / "checkout" / "hands" / "adroit" / "hand.xml"
    hand.write_text(hand.read_text().replace("175", "176"))
    mesh = both / "checkout" / "objects" / "cup" / "meshes" / "contact0.stl"
    mesh.write_bytes(mesh.read_bytes()[:-1])
    found = damaged(library)
    assert "checkout/hands/adroit/hand.xml: content changed, its SHA-256" in found[0]
    assert "checkout/objects/cup/meshes/contact0.stl: 283 bytes instead of 284" in found[1]
    assert len(found) == 3


def test_opening_is_quick(library_home: Path) -> None:
    times = []
    for _ in range(5):
        begun = time.perf_counter()
        open_library(library_home / "library").tasks()
        times.append(time.perf_counter() - begun)
    assert sorted(times)[2] < 0.05


@pytest.mark.parametrize("file", ["object.xml", "mesh"])
def test_a_model_that_was_changed_is_refused(filled: Path, tmp_path: Path, file: str) -> None:
    root = tmp_path / "library"
    shutil.copytree(filled, root)
    folder = root / "checkout" / "objects" / "hammer"
    path = folder / file if file.endswith("xml") else next(folder.glob("meshes/*"))
    open_library(root).object_xml("hammer")
    path.write_bytes(path.read_bytes() + b"\n")
    with pytest.raises(CorruptAssetError, match=f"{path.name}: was changed after it came"):
        open_library(root).object_xml("hammer")
    open_library(root).object_xml("cup")
