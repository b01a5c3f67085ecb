"""Reading files that somebody else may have written."""

from __future__ import annotations

import os
import threading
from pathlib import Path

import pytest

from pgdm import files, paths
from pgdm.errors import ConfigError

BOMB = "a0: &a0 [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 12)
)


def test_pipes_devices_folders_and_large_files_are_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "zero").symlink_to("/dev/zero")
    with open(tmp_path / "large", "wb") as file:
        file.truncate(files.MOST_BYTES + 1)
    for name, reason in {
        "pipe": "a pipe",
        "zero": "a device",
        ".": "a folder",
        "large": "1,073,741,825 bytes",
        "none": "No such file",
    }.items():
        answer: list[str] = []

        def read(path: Path = tmp_path / name, answer: list[str] = answer) -> None:
            try:
                files.read_bytes(path)
            except OSError as error:
                answer.append(str(error.strerror))

        thread = threading.Thread(target=read, daemon=True)
        thread.start()
        thread.join(5)
        assert answer, f"{name} was still being read after 5 s"
        assert reason in answer[0]


def test_a_link_to_a_regular_file_is_read(tmp_path: Path) -> None:
    (tmp_path / "there").write_text("a: 1\n")
    (tmp_path / "link").symlink_to("there")
    assert files.read_yaml(tmp_path / "link") == {"a": 1}


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (BOMB, "with those of aliases"),
        ("a: &a [*a]", "contains it"),
        ("[" * 200_000, "nested"),
        ("- " * 100_000, "nested"),
        ("{a: " * 50_000, "nested"),
        ("seed: " + "9" * 400, "400 digits"),
        ("x: !!python/object/apply:os.system [ls]", "could not determine a constructor"),
        ("a: 2001-13-45", "month must be"),
        ("? [a]\n: 1", "unhashable"),
        ("a: !!bool maybe", "maybe"),
        ("a: !!timestamp abc", "not valid YAML"),
        ("a: !!int ''", "not valid YAML"),
        ("a: [", "not valid YAML"),
    ],
    ids=lambda value: value[:12],
)
def test_yaml_that_would_fill_the_memory_or_is_wrong(text: str, reason: str) -> None:
    with pytest.raises(ValueError, match=reason) as refused:
        files.parse_yaml(text)
    assert "\n" not in str(refused.value)


def test_yaml_is_read_as_pyyaml_reads_it() -> None:
    text = "a: &a {b: 1, c: [x, 2.5, null, yes]}\nd: {<<: *a, b: 3}\ne: *a\n"
    inner = {"b": 1, "c": ["x", 2.5, None, True]}
    assert files.parse_yaml(text) == {"a": inner, "d": {**inner, "b": 3}, "e": inner}
    assert files.parse_yaml("") is None


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        (b"[" * 200_000, "nested"),
        (b'{"a":' * 100_000, "nested"),
        (b'{"frames": ' + b"9" * 400 + b"}", "400 digits"),
        (b"\xff", "utf-8"),
        (b"{", "Expecting"),
    ],
    ids=["lists", "dicts", "digits", "bytes", "cut off"],
)
def test_json_that_is_refused(text: bytes, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        files.parse_json(text)


def test_long_digits_in_text_and_fractions_are_no_whole_number() -> None:
    assert files.parse_json(b'{"a": "' + b"9" * 400 + b'"}') == {"a": "9" * 400}
    assert files.parse_json(b"[0." + b"3" * 40 + b"]") == [pytest.approx(1 / 3)]


@pytest.mark.parametrize("name", ["../x", "/abs", "a/b", "..", ".", "", ".x", "a\x1b[2J", "a b", 3])
def test_what_is_no_name(name: str) -> None:
    with pytest.raises(ConfigError, match=r"task\.id .* is not valid") as refused:
        paths.inside(Path("runs"), "ok", name, kind="task.id")
    assert "\x1b" not in str(refused.value)


def test_names_are_joined_and_made(tmp_path: Path) -> None:
    assert paths.inside(tmp_path, "cup-pour1", "s0", suffix=".npz") == tmp_path / "cup-pour1/s0.npz"
    for text in ("../../../x", "..", "", "my experiment (5 %)", "x" * 300):
        paths.check_path_part("experiment", paths.as_name(text))
    assert paths.as_name("pgdm") == "pgdm"


def test_links_out_of_a_folder(tmp_path: Path) -> None:
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "checkpoints").symlink_to("/etc")
    (tmp_path / "run" / "inner").symlink_to("there")
    assert paths.leaves(tmp_path / "run" / "checkpoints" / "passwd", tmp_path / "run")
    assert not paths.leaves(tmp_path / "run" / "inner", tmp_path / "run")
