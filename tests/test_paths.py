"""Files that are replaced whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from pgdm.paths import replacing, restoring


def test_a_file_is_replaced_in_one_step(tmp_path: Path) -> None:
    path = tmp_path / "film.mp4"
    path.write_text("old")
    with replacing(path) as temp:
        temp.write_text("new")
        assert path.read_text() == "old"
        assert temp.suffix == ".mp4"  # by which libraries tell the format
    assert path.read_text() == "new"
    assert list(tmp_path.iterdir()) == [path]


def test_what_fails_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text("old")
    with pytest.raises(OSError, match="no room"), replacing(path) as temp:
        temp.write_text("ha")
        raise OSError("no room")
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


def test_a_folder_that_is_missing(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "none" / "a") as temp:
        temp.write_text("x")


def test_what_fails_leaves_a_folder_as_it_was(tmp_path: Path) -> None:
    folder = tmp_path / "replay"
    for _ in range(2):  # once without the folder
        before = {path: path.read_text() for path in folder.glob("*")}
        with pytest.raises(ValueError, match="refused"), restoring(folder):
            folder.mkdir(exist_ok=True)
            for name in ("a.bin", "b.bin"):
                with open(folder / name, "a") as file:
                    file.write("more")
            raise ValueError("refused")
        assert {path: path.read_text() for path in folder.glob("*")} == before
        assert folder.exists() == bool(before)
        folder.mkdir(exist_ok=True)
        (folder / "a.bin").write_text("old")
    with restoring(folder):
        (folder / "b.bin").touch()
    assert (folder / "b.bin").exists()
