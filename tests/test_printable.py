"""Control characters in names do not reach the terminal."""

from __future__ import annotations

import io
from pathlib import Path

import pytest
from rich.table import Table

from command_line import command
from fake_runs import end, make, train
from pgdm.cli.console import screen
from pgdm.cli.console.printable import Printable, printable

pytestmark = pytest.mark.filterwarnings("ignore")  # of MLflow's dependencies

EVIL = "run\x1b[2J\x1b]0;pwned\x07\u202e\x9b31m"


def test_control_characters_are_written_out() -> None:
    assert printable("a\x1b[2Jb\tc\n\udcff") == "a\\x1b[2Jb\tc\n\\udcff"
    stream = io.StringIO()
    print(EVIL, file=Printable(stream))  # type: ignore[arg-type]
    assert stream.getvalue() == printable(EVIL) + "\n"


@pytest.mark.parametrize("command_line", [("runs",), ("runs", "--json"), ("runs", "sync")])
def test_a_run_folder_with_escape_sequences(tmp_path: Path, command_line: tuple[str, ...]) -> None:
    folder = make(tmp_path / "runs" / EVIL, method={"name": EVIL})
    train(folder)
    end(folder, status="failed")
    (tmp_path / "runs" / f"{EVIL}2").mkdir()
    (tmp_path / "runs" / f"{EVIL}2" / "config.yaml").write_text("[")
    outcome = command("pgdm", *command_line, str(tmp_path / "runs"))
    shown = outcome.out + outcome.err
    assert "x1b[2J" in shown or "u001b[2J" in shown
    assert not set("\x1b\x07\u202e\x9b") & set(shown)


def test_errors_with_escape_sequences(tmp_path: Path) -> None:
    outcome = command("pgdm", "eval", str(tmp_path / EVIL))
    assert outcome.code != 0 and "\\x1b[2J" in outcome.errors[0] and "\x1b" not in outcome.err


def test_tables_on_a_terminal_keep_their_own_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("TERM", "xterm")
    out = io.StringIO()
    console = screen.console()
    console.file = out
    table = Table("name")
    table.add_row(f"[red]{EVIL}[/]")
    console.print(table)
    assert "\x1b[" in out.getvalue() and "\\x1b[2J" in out.getvalue()
    assert "\x1b[2J" not in out.getvalue()
