"""A run keeps the library source that it was trained with."""

from __future__ import annotations

import io
import shutil
from pathlib import Path

import pytest

from command_line import TINY, command
from pgdm.library import open_library


def test_a_second_source_does_not_lock_earlier_runs_out(
    library_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library, shared = tmp_path / "home" / "library", library_home / "library"
    shutil.copytree(shared / "checkout", library / "registry")
    monkeypatch.setenv("PGDM_HOME", str(library.parent))
    assert open_library().source_of("hammer-use1") == "registry"
    run = ["--offline", *TINY, "run_dir=run"]
    assert command("pgdm-run", *run).code == 0

    (library / "checkout").symlink_to(shared / "checkout")
    assert open_library().source_of("hammer-use1") == "checkout"
    assert open_library().serving("registry").source_of("hammer-use1") == "registry"
    assert open_library().serving(None).source_of("hammer-use1") == "checkout"
    resumed = command("pgdm-run", *run, "total_frames=64")
    assert (resumed.code, resumed.errors) == (0, []), resumed.err
    evaluated = command("pgdm", "eval", "run", "--offline")
    assert (evaluated.code, evaluated.errors) == (0, []), evaluated.err
    # A new run takes the source that comes first.
    assert command("pgdm-run", *run[:-1], "run_dir=new").code == 0
    assert '"asset_source": "checkout"' in Path("new", "result.json").read_text()
    assert '"asset_source": "registry"' in Path("run", "result.json").read_text()


def test_a_dry_run_of_a_run_takes_its_source(
    library_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library, shared = tmp_path / "home" / "library", library_home / "library" / "checkout"
    shutil.copytree(shared, library / "registry")
    monkeypatch.setenv("PGDM_HOME", str(library.parent))
    run = ["--offline", *TINY, "run_dir=run"]
    assert command("pgdm-run", *run).code == 0
    shutil.copytree(shared, library / "checkout")
    shutil.rmtree(library / "checkout" / "hands")  # the first source now, and of no use
    assert command("pgdm-run", *run, "--dry-run").code == 0
    assert command("pgdm-run", *run[:-1], "run_dir=new", "--dry-run").code == 1


def test_a_damaged_source_is_left_out(
    library_home: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    library, shared = tmp_path / "home" / "library", library_home / "library" / "checkout"
    for name in ("registry", "checkout"):
        shutil.copytree(shared, library / name)
    monkeypatch.setenv("PGDM_HOME", str(library.parent))
    (library / "checkout" / "manifest.json").write_text("{")
    listed = command("pgdm", "assets", "list")
    assert listed.code == 0 and "hammer-use1" in listed.out
    assert "continuing without source 'checkout'" in caplog.text
    verified = command("pgdm", "assets", "verify")
    assert verified.code == 1 and "checkout/manifest.json: damaged" in verified.out


def test_a_source_is_chosen_and_removed(
    library_home: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    library, checkout = tmp_path / "home" / "library", library_home / "library" / "checkout"
    for name in ("registry", "checkout"):
        shutil.copytree(checkout, library / name)
    monkeypatch.setenv("PGDM_HOME", str(library.parent))
    assert open_library().source_of("hammer-use1") == "checkout"
    assert command("pgdm", "assets", "use", "registry").code == 0
    assert open_library().source_of("hammer-use1") == "registry"
    assert open_library().serving("checkout").source_of("hammer-use1") == "checkout"
    monkeypatch.setattr("sys.stdin", io.StringIO("n\n"))
    asked = command("pgdm", "assets", "remove", "registry")
    assert asked.code == 0 and "nothing was removed" in asked.out
    assert command("pgdm", "assets", "remove", "registry", "--yes").code == 0
    assert not (library / "registry").exists()
    assert open_library().source_of("hammer-use1") == "checkout"
    for verb in ("use", "remove"):
        refused = command("pgdm", "assets", verb, "registry")
        assert "unknown library source 'registry'; valid: checkout." in refused.errors[0]
