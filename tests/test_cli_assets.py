"""``pgdm assets``: tables, one-line errors, exit codes."""

from __future__ import annotations

import io
import os
import re
import shutil
from pathlib import Path

import pytest
from rich.console import Console

from library_trees import make_checkout, snapshot, trajectory, write_trajectory
from pgdm import paths
from pgdm.cli.console.screen import bars
from pgdm.cli.main import main

ROOT = os.environ.get("PGDM_TCDM_ROOT")


@pytest.fixture
def home(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("PGDM_HOME", str(tmp_path / "home"))
    return tmp_path / "home"


@pytest.fixture
def checkout(tmp_path: Path, home: Path) -> Path:
    return make_checkout(tmp_path / "TCDM", ("hammer_use1", "dmanus_cup"))


def run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[int, str, str]:
    code = main(["assets", *words])
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def test_import_reports_tasks_and_defects(
    checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, out, _ = run(capsys, "import", str(checkout))
    assert code == 0
    assert out.splitlines() == [
        "the library has 2 tasks from this source",
        "defect in the source: tcdm/envs/assets/robots/dmanus/base.xml: geom "
        'euler="0.114 0 0w" read as "0.114 0 0"',
    ]


def test_import_names_what_was_left_out(checkout: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shutil.rmtree(checkout / "tcdm/envs/assets/meshes/objects/cup")
    _, out, _ = run(capsys, "import", str(checkout))
    assert "left out: dmanus-cup: needs object 'cup'" in out


def test_list_shows_every_task_in_a_row(checkout: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run(capsys, "import", str(checkout))
    code, out, _ = run(capsys, "list")
    assert code == 0
    lines = [line.split() for line in out.splitlines()]
    assert lines[0] == ["task", "hand", "object", "steps", "sources", "starts", "expert"]
    assert ["hammer-use1", "adroit", "hammer", "6", "checkout", "planned,", "mined", "-"] in lines
    assert "2 tasks in" in out


@pytest.mark.parametrize("command", ["list", "verify"])
def test_an_empty_library_names_how_to_fill_it(
    home: Path, capsys: pytest.CaptureFixture[str], command: str
) -> None:
    code, out, _ = run(capsys, command)
    assert "is empty. Fill the library with 'pgdm assets fetch' or 'pgdm assets import" in out
    assert code == (1 if command == "verify" else 0)


def test_verify_names_what_is_damaged_and_fails(
    checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(capsys, "import", str(checkout))
    code, out, _ = run(capsys, "verify")
    assert code == 0
    assert "files of checkout are sound" in out
    mesh = paths.library() / "checkout/objects/cup/meshes/contact0.stl"
    mesh.write_bytes(bytes(len(mesh.read_bytes())))
    code, out, err = run(capsys, "verify")
    assert code == 1
    assert out.splitlines() == [
        "checkout/objects/cup/meshes/contact0.stl: content changed, its SHA-256 differs from the "
        "recorded one"
    ]
    assert err.startswith("error: damaged files: 1 of ") and "'pgdm assets fetch'" in err
    assert err.count("\n") == 1


def test_show_prints_provenance_licence_hash_and_defect(
    checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(capsys, "import", str(checkout))
    code, out, _ = run(capsys, "show", "dmanus-cup")
    assert code == 0
    assert out.startswith("dmanus-cup: dmanus with cup, 6 steps\n")
    assert "source checkout (serves the task): TCDM checkout 'TCDM'" in out
    assert "defect: tcdm/envs/assets/robots/dmanus/base.xml" in out
    motion = [line for line in out.splitlines() if "motions/dmanus-cup.npz" in line]
    assert "sha256" in motion[0]
    assert "  MIT  from trajectories/dmanus_cup.npz" in motion[0]
    _, out, _ = run(capsys, "show", "hammer-use1")
    assert "  MIT, motions derived from GRAB  from trajectories/hammer_use1.npz" in out
    assert "defect" not in out  # it is not in Adroit's file


def assert_one_line(result: tuple[int, str, str], *words: str) -> None:
    code, _, err = result
    assert code != 0
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    for word in words:
        assert word in err


def test_wrong_names_and_folders_are_one_line_errors(
    checkout: Path, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    assert_one_line(run(capsys, "import", str(tmp_path / "none")), "no such folder")
    assert_one_line(run(capsys, "import", str(tmp_path)), "not a TCDM checkout", "common.xml")
    assert_one_line(run(capsys, "import"), "PATH")
    assert_one_line(run(capsys, "show", "hammer-use1"), "is empty")
    run(capsys, "import", str(checkout))
    assert_one_line(run(capsys, "show", "hamer-use1"), "did you mean hammer-use1")
    assert_one_line(run(capsys, "nonsense"), "nonsense")
    assert_one_line(run(capsys, "fetch", "--offline"), "--offline", "pgdm assets fetch")


def test_damage_is_a_one_line_error_and_the_library_stays(
    checkout: Path, home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(capsys, "import", str(checkout))
    before = snapshot(home)
    write_trajectory(checkout / "trajectories" / "hammer_use1.npz", trajectory(length=99))
    assert_one_line(run(capsys, "import", str(checkout)), "hammer_use1.npz", "'length' is 99")
    assert snapshot(home) == before


def test_a_poorer_checkout_needs_replace(
    checkout: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run(capsys, "import", str(checkout))
    (checkout / "trajectories" / "dmanus_cup.npz").unlink()
    assert_one_line(run(capsys, "import", str(checkout)), "dmanus-cup", "--replace")
    assert run(capsys, "import", str(checkout), "--replace")[0] == 0


def test_fetch_prints_package_and_licence_first(
    home: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(home))
    code, out, err = run(capsys, "fetch")
    assert code != 0
    assert out.splitlines()[0] == f"robohive 0.4.0 -> {home / 'library'}"
    assert "GRAB" in out
    assert "pip finds no robohive==0.4.0" in err


def test_the_bars_of_a_terminal_show_bytes_and_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = Console(file=io.StringIO(), force_terminal=True, width=100)
    monkeypatch.setattr("pgdm.cli.console.screen.SCREEN", screen)
    with bars() as progress:
        progress("download", 50_000_000, 100_000_000)
        progress("objects airplane", 3, 57)
    with bars(patience_s=60.0) as progress:
        progress("reading runs", 1, 2)
    assert isinstance(screen.file, io.StringIO)
    shown = screen.file.getvalue()
    assert "50.0/100.0 MB" in shown
    assert "3/57" in shown
    assert "reading runs" not in shown


@pytest.mark.skipif(not ROOT, reason="needs a TCDM checkout: name one with PGDM_TCDM_ROOT")
def test_list_of_the_real_checkout_has_51_rows(
    library_home: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    _, out, _ = run(capsys, "list")
    assert re.search(r"^(51|58) tasks in", out, re.MULTILINE)  # with the animated tasks
    assert "dapg_hammer, nail" in out
