"""Downloading a file through pip's configuration, and resuming a broken download."""

from __future__ import annotations

import hashlib
import http.server
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from pgdm.errors import LibraryError
from pgdm.library.progress import silent
from pgdm.library.robohive import package_index
from pgdm.library.robohive.package_index import Package

NAME, VERSION = "pgdm-test-data", "1.0"
FILE = "pgdm_test_data-1.0-py3-none-any.whl"


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a real wheel with 2 MB of data."""
    path = tmp_path_factory.mktemp("wheels") / FILE
    info = "pgdm_test_data-1.0.dist-info"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("pgdm_test_data/data.bin", bytes(range(256)) * 8192)
        archive.writestr(
            f"{info}/METADATA", f"Metadata-Version: 2.1\nName: {NAME}\nVersion: {VERSION}\n"
        )
        archive.writestr(f"{info}/WHEEL", "Wheel-Version: 1.0\nTag: py3-none-any\n")
        archive.writestr(f"{info}/RECORD", "")
    return path


@pytest.fixture(scope="module")
def package(wheel: Path) -> Package:
    data = wheel.read_bytes()
    return Package(NAME, VERSION, FILE, hashlib.sha256(data).hexdigest(), len(data))


@pytest.fixture(autouse=True)
def _no_other_index(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PIP_CONFIG_FILE", "/dev/null")
    monkeypatch.setenv("PIP_CACHE_DIR", str(tmp_path / "pip"))
    for name in ("PIP_FIND_LINKS", "PIP_EXTRA_INDEX_URL", "PIP_NO_INDEX", "PIP_INDEX_URL"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(package_index, "_PAUSE_S", 0.0)


class Index(http.server.BaseHTTPRequestHandler):
    """A package index with one file, which can break off and knows ranges."""

    wheel: Path
    address: str  # of the file
    breaks: int = 0  # how many more downloads break off half-way
    ranges: list[str | None]
    status: int = 200
    content: bytes | None = None
    knows_ranges: bool = True

    def do_GET(self) -> None:
        if self.path.startswith("/simple/"):
            metadata = hashlib.sha256(self.metadata()).hexdigest()
            page = f'<a href="/files/{FILE}" data-core-metadata="sha256={metadata}">{FILE}</a>'
            self.reply(200, page.encode(), kind="text/html")
        elif self.path.endswith(".metadata"):
            self.reply(200, self.metadata())
        else:
            self.send_wheel()

    def send_wheel(self) -> None:
        cls = type(self)
        wanted = self.headers.get("Range")
        cls.ranges.append(wanted)
        if cls.status != 200:
            self.reply(cls.status, b"no")
            return
        data = cls.content or cls.wheel.read_bytes()
        start = int(wanted.removeprefix("bytes=").rstrip("-")) if wanted else 0
        if not cls.knows_ranges:
            start = 0
        rest = data[start:]
        status = 206 if start else 200
        if cls.breaks:
            cls.breaks -= 1
            self.reply(status, rest, sent=rest[: len(rest) // 2])
        else:
            self.reply(status, rest)

    def reply(self, status: int, body: bytes, sent: bytes | None = None, kind: str = "x/y") -> None:
        self.send_response(status)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Content-Type", kind)
        self.end_headers()
        self.wfile.write(body if sent is None else sent)

    def metadata(self) -> bytes:
        with zipfile.ZipFile(type(self).wheel) as archive:
            return archive.read("pgdm_test_data-1.0.dist-info/METADATA")

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def index(wheel: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[type[Index]]:
    handler = type("Handler", (Index,), {"wheel": wheel, "ranges": []})
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, args=(0.02,))
    thread.start()
    address = f"http://127.0.0.1:{server.server_port}"
    monkeypatch.setenv("PIP_INDEX_URL", f"{address}/simple")
    monkeypatch.setenv("NO_PROXY", "127.0.0.1")
    handler.address = f"{address}/files/{FILE}"
    yield handler
    server.shutdown()
    server.server_close()
    thread.join()


def test_the_file_comes_from_the_index_with_progress_and_is_kept(
    package: Package, index: type[Index], tmp_path: Path
) -> None:
    seen: list[tuple[str, int, int]] = []
    path = package_index.fetch(package, tmp_path / "d", False, lambda *args: seen.append(args))
    assert path == tmp_path / "d" / FILE
    assert path.read_bytes() == index.wheel.read_bytes()
    assert seen[-1] == ("download", package.bytes, package.bytes)
    assert index.ranges == [None]
    # A second call, and an offline one, find what is there.
    assert package_index.fetch(package, tmp_path / "d", False, silent) == path
    assert package_index.fetch(package, tmp_path / "d", True, silent) == path
    assert index.ranges == [None]


def received(package: Package, index: type[Index], folder: Path) -> Path:
    part = folder / f"{FILE}.part"
    package_index.receive(package, index.address, part, silent)
    return part


def test_a_broken_download_is_continued_where_it_broke(
    package: Package, index: type[Index], tmp_path: Path
) -> None:
    index.breaks = 2
    assert received(package, index, tmp_path).read_bytes() == index.wheel.read_bytes()
    half = package.bytes // 2
    assert index.ranges == [None, f"bytes={half}-", f"bytes={half + (package.bytes - half) // 2}-"]


def test_what_an_earlier_call_left_is_continued(
    package: Package, index: type[Index], tmp_path: Path
) -> None:
    (tmp_path / f"{FILE}.part").write_bytes(index.wheel.read_bytes()[:1000])
    assert received(package, index, tmp_path).read_bytes() == index.wheel.read_bytes()
    assert index.ranges == ["bytes=1000-"]


def test_an_index_that_knows_no_ranges_sends_all_again(
    package: Package, index: type[Index], tmp_path: Path
) -> None:
    index.knows_ranges = False
    (tmp_path / f"{FILE}.part").write_bytes(b"x" * 1000)
    assert received(package, index, tmp_path).read_bytes() == index.wheel.read_bytes()


def test_a_download_that_always_breaks_is_given_up_and_kept(
    package: Package, index: type[Index], tmp_path: Path
) -> None:
    index.breaks = 100
    with pytest.raises(LibraryError, match=r"broke off at 1 of 2 MiB .*run the command again"):
        received(package, index, tmp_path)
    assert (tmp_path / f"{FILE}.part").stat().st_size > package.bytes // 2


def test_a_wrong_part_of_an_earlier_call_is_thrown_away(
    package: Package, index: type[Index], tmp_path: Path
) -> None:
    (tmp_path / f"{FILE}.part").write_bytes(b"x" * 1000)
    assert received(package, index, tmp_path).read_bytes() == index.wheel.read_bytes()
    assert index.ranges == ["bytes=1000-", None]


@pytest.mark.parametrize("change", ["other content", "longer"])
def test_another_file_than_expected_is_refused(
    package: Package, index: type[Index], tmp_path: Path, change: str
) -> None:
    good = index.wheel.read_bytes()
    index.content = b"x" * len(good) if change == "other content" else good + b"x"
    with pytest.raises(LibraryError, match="is not the expected file"):
        received(package, index, tmp_path)
    assert list(tmp_path.glob(f"{FILE}*")) == []


def test_a_damaged_file_in_the_cache_is_fetched_again(
    package: Package, index: type[Index], tmp_path: Path
) -> None:
    (tmp_path / FILE).write_bytes(b"damaged")
    path = package_index.fetch(package, tmp_path, False, silent)
    assert path.read_bytes() == index.wheel.read_bytes()


def test_where_only_pip_has_the_password_pip_fetches(
    package: Package, index: type[Index], tmp_path: Path
) -> None:
    index.status = 403
    # pip is refused as well here, which shows that it was called.
    with pytest.raises(LibraryError, match=r"pip cannot download .*403"):
        package_index.fetch(package, tmp_path, False, silent)
    assert len(index.ranges) == 2


def test_a_folder_of_wheels_serves_without_network(
    package: Package, wheel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    monkeypatch.setenv("PIP_FIND_LINKS", str(wheel.parent))
    path = package_index.fetch(package, tmp_path, False, silent)
    assert path.read_bytes() == wheel.read_bytes()


def test_a_file_index_serves(
    package: Package, wheel: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    page = tmp_path / "simple" / NAME / "index.html"
    page.parent.mkdir(parents=True)
    page.write_text(f'<a href="{wheel.as_uri()}">{FILE}</a>')
    monkeypatch.setenv("PIP_INDEX_URL", (tmp_path / "simple").as_uri())
    assert package_index.fetch(package, tmp_path / "d", False, silent).is_file()


def test_offline_names_the_cure(package: Package, tmp_path: Path) -> None:
    with pytest.raises(LibraryError, match=r"--offline forbids .*'pgdm assets fetch'"):
        package_index.fetch(package, tmp_path / "none", True, silent)
    assert not (tmp_path / "none").exists()


def test_an_index_without_the_package_is_named(
    package: Package, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PIP_NO_INDEX", "1")
    with pytest.raises(LibraryError, match=r"pip finds no pgdm-test-data==1\.0: ERROR: .*config"):
        package_index.fetch(package, tmp_path, False, silent)


def test_the_error_without_pip_names_the_remedies(
    package: Package, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A Python without pip: an isolated one that has nothing but its standard library.
    bare = tmp_path / "bare"
    bare.write_text('#!/bin/sh\necho "python: No module named pip" >&2\nexit 1\n')
    bare.chmod(0o755)
    monkeypatch.setattr(package_index.sys, "executable", str(bare))
    with pytest.raises(LibraryError, match=r"needs pip, .*ensurepip.*PGDM_HOME/downloads yourself"):
        package_index.fetch(package, tmp_path, False, silent)


def test_a_full_disk_is_noticed_before_the_download(
    package: Package, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    huge = Package(NAME, VERSION, FILE, package.sha256, 2**60)
    with pytest.raises(LibraryError, match=r"MiB free, but fetching needs .*PGDM_HOME"):
        package_index.fetch(huge, tmp_path, False, silent)
