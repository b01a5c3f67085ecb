"""Work on files of other people in a child process."""

from __future__ import annotations

import os
import time
from pathlib import Path

import pytest

from library_trees import make_checkout
from pgdm import limited
from pgdm.errors import CorruptAssetError, LibraryError, LimitError
from pgdm.library.checks.compiled import counts
from pgdm.library.tcdm import import_tcdm


def divide(a: int, b: int) -> float:
    return a / b


def compute(_: int) -> None:
    while True:
        pass


def fill(count: int) -> int:
    return len(bytearray(count))


def end(_: int) -> None:
    os.abort()


def test_results_and_errors_come_back_in_order() -> None:
    first, second, third = limited.each(divide, [(1, 2), (1, 0), (3, 1)])
    assert (first, third) == (0.5, 3.0) and isinstance(second, ZeroDivisionError)
    assert limited.call(fill, 7) == 7
    with pytest.raises(ZeroDivisionError):
        limited.call(divide, 1, 0)


def test_time_memory_and_crashes() -> None:
    start = time.monotonic()
    with pytest.raises(LimitError, match="more than 1 s of computing"):
        limited.call(compute, 0, seconds=1)
    with pytest.raises(LimitError, match="more than 4 GB"):
        limited.call(fill, 1 << 40)
    with pytest.raises(LimitError, match="or the library that reads it crashes"):
        limited.call(end, 0)
    assert len(limited.each(fill, [(1,), (1 << 40,), (1,)])) == 2
    assert time.monotonic() - start < 60


GREEDY = {
    "keyframes": '<mujoco><size nkey="2000000000"/><worldbody/></mujoco>',
    "copies": '<mujoco><worldbody><replicate count="100000000" offset="1 0 0"><body>'
    '<geom size="1"/></body></replicate></worldbody></mujoco>',
}


@pytest.mark.parametrize("name", GREEDY)
def test_models_that_ask_for_too_much(tmp_path: Path, name: str) -> None:
    (tmp_path / "model.xml").write_text(GREEDY[name])
    with pytest.raises((LimitError, CorruptAssetError)):
        limited.call(counts, tmp_path / "model.xml", "model", seconds=3)


@pytest.mark.parametrize("name", GREEDY)
def test_a_checkout_with_such_a_model(
    tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limited.each, "__defaults__", (3,))
    checkout = make_checkout(tmp_path / "theirs")
    (checkout / "tcdm" / "envs" / "assets" / "objects" / "cup.xml").write_text(GREEDY[name])
    with pytest.raises(CorruptAssetError, match=r"objects/cup\.xml: MuJoCo cannot compile it"):
        import_tcdm(checkout, tmp_path / "library")
    assert not (tmp_path / "library" / "checkout").exists()


@pytest.mark.parametrize(
    "place",
    [
        "LICENSE.md",
        "tcdm/envs/assets/objects/cup.xml",
        "tcdm/envs/assets/meshes/objects/cup/contact0.stl",
        "trajectories/hammer_use1.npz",
    ],
)
def test_links_out_of_a_checkout(tmp_path: Path, place: str) -> None:
    checkout = make_checkout(tmp_path / "theirs")
    path, secret = checkout / place, tmp_path / "secret"
    if path.exists():
        path.rename(secret)
    else:
        secret.write_text("secret")
    path.symlink_to(secret)
    with pytest.raises(CorruptAssetError, match=f"leads to {secret}, outside of {checkout}"):
        import_tcdm(checkout, tmp_path / "library")
    assert not (tmp_path / "library" / "checkout").exists()


@pytest.mark.parametrize("place", ["common.xml", "objects/cup.xml", "environments/table.xml"])
def test_pipes_and_deep_files_in_a_checkout(tmp_path: Path, place: str) -> None:
    for kind in ("pipe", "deep"):
        checkout = make_checkout(tmp_path / kind)
        path = checkout / "tcdm" / "envs" / "assets" / place
        path.unlink()
        if kind == "pipe":
            os.mkfifo(path)
        else:
            path.write_text("<a>" * 9999 + "</a>" * 9999)
        start = time.monotonic()
        try:
            summary = import_tcdm(checkout, tmp_path / "library")
            assert "objects/cup" in summary.left_out  # a pipe is no file
        except LibraryError:  # the reason is that of the other tests
            pass
        assert time.monotonic() - start < 10
