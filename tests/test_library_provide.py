"""A library that is filled automatically when a task is missing."""

from __future__ import annotations

import logging
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from library_trees import make_checkout
from pgdm.errors import LibraryError, UnknownNameError
from pgdm.library import ensure, import_tcdm, open_library, staging
from pgdm.library.progress import ProgressLines


def test_what_is_there_is_not_fetched(tmp_path: Path) -> None:
    import_tcdm(make_checkout(tmp_path / "TCDM"), tmp_path / "library")
    said: list[str] = []
    library = ensure("hammer-use1", False, said.append, tmp_path / "library")
    assert library.source_of("hammer-use1") == "checkout"
    assert said == []


def test_what_another_process_fills_meanwhile_is_not_fetched_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")  # a fetch would fail
    filled, library = tmp_path / "filled", tmp_path / "library"
    import_tcdm(make_checkout(tmp_path / "TCDM"), filled)
    with ThreadPoolExecutor() as pool:
        with staging.locked(library):
            waiting = [pool.submit(ensure, "hammer-use1", False, None, library) for _ in range(2)]
            deadline = time.monotonic() + 30
            while caplog.text.count("waiting for it") < 2 and time.monotonic() < deadline:
                time.sleep(0.05)
            shutil.copytree(filled / "checkout", library / "checkout")
        assert [w.result(timeout=30).source_of("hammer-use1") for w in waiting] == ["checkout"] * 2


def test_offline_refuses_with_the_cure(tmp_path: Path) -> None:
    with pytest.raises(LibraryError, match=r"--offline forbids fetching it; run 'pgdm assets"):
        ensure("cup-pour1", True, root=tmp_path / "library")
    assert list(tmp_path.iterdir()) == []


def test_a_task_that_only_a_checkout_has_is_not_fetched(tmp_path: Path) -> None:
    with pytest.raises(LibraryError, match=r"'door-open' comes only from a TCDM checkout.*import"):
        ensure("door-open", False, root=tmp_path / "library")


def test_a_task_that_does_not_exist_is_an_unknown_name(tmp_path: Path) -> None:
    with pytest.raises(UnknownNameError, match="unknown task 'hammer-use'; did you mean hammer-us"):
        ensure("hammer-use", False, root=tmp_path / "library")


def test_a_fetch_is_announced_with_size_and_licence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(tmp_path))
    said: list[str] = []
    with pytest.raises(LibraryError, match=r"pip finds no robohive==0\.4\.0"):
        ensure("cup-pour1", False, said.append, tmp_path / "library")
    assert "fetching robohive 0.4.0 (101 MB, once)" in said[0]
    assert "GRAB" in said[0]
    assert "non-commercial" in said[0]
    with caplog.at_level(logging.INFO), pytest.raises(LibraryError):
        ensure("cup-pour1", False, None, tmp_path / "library")
    assert "fetching robohive" in caplog.text
    assert open_library(tmp_path / "library").tasks() == {}


def test_progress_lines_come_every_few_seconds_with_an_estimate(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    said: list[str] = []
    lines = ProgressLines(said.append, interval_s=5.0)
    for second in range(11):
        now[0] = 100.0 + second
        lines("download", 10 * second, 200)
    # 10 a second: at 5 s 50 of 200 are done and 150 left, at 10 s 100.
    assert said == ["download: 25%, 15 s left", "download: 50%, 10 s left"]


def test_a_step_that_reports_nothing_more_is_repeated_until_it_is_done(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: now[0])
    said: list[str] = []
    lines = ProgressLines(said.append, interval_s=5.0)
    lines.repeat()
    lines("compiling", 0, 1)
    for second in (4, 6, 8, 11):
        now[0] = 100.0 + second
        lines.repeat()
    assert said == ["compiling: 6 s", "compiling: 11 s"]
    lines("compiling", 1, 1)
    now[0] = 120.0
    lines.repeat()
    assert len(said) == 2
    lines("drawing", 0, 10)  # steps that are short each still show something every few seconds
    assert said[2:] == ["drawing"]
