"""Reading arrays from files that may be hostile, damaged or nonsense."""

from __future__ import annotations

import io
import os
import pickle
import struct
import sys
import zipfile
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as st_numpy

from library_trees import trajectory, write_trajectory
from pgdm.errors import CorruptAssetError, UnsafePickleError
from pgdm.library.files import npz as safe_npz
from pgdm.library.files import pickles as safe_pickle

PROTOCOLS = range(pickle.HIGHEST_PROTOCOL + 1)
MARKER = "pgdm_test_was_executed"


class Calls:
    """Pickles as a call of any function."""

    def __init__(self, function: Any, *args: Any) -> None:
        self.call = (function, args)

    def __reduce__(self) -> tuple[Any, tuple[Any, ...]]:
        return self.call


HOSTILE = {
    "os.system": Calls(os.system, "true"),
    "eval": Calls(eval, f"__import__('sys').__setattr__('{MARKER}', 1)"),
    "getattr": Calls(getattr, "x", "upper"),
    "open": Calls(open, "/dev/null"),
    "numpy.load": Calls(np.load, "x.npy"),
    "numpy.fromfile": Calls(np.fromfile, "x"),
    "a class": OrderedDict(a=1),
    "nested in a dict": {"initialized": {"position": Calls(os.getcwd)}},
}


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_pickle_that_asks_for_more_is_refused_and_nothing_runs(name: str, protocol: int) -> None:
    data = pickle.dumps(HOSTILE[name], protocol)
    with pytest.raises(UnsafePickleError, match=r"some\.npz: s_0: the pickle asks for"):
        safe_pickle.loads(data, "some.npz: s_0")
    assert not hasattr(sys, MARKER)


def test_the_refusal_names_file_and_function(tmp_path: Path) -> None:
    path = write_trajectory(tmp_path / "cup_pour1.npz", trajectory(s_0=Calls(os.getpid)))
    with pytest.raises(UnsafePickleError) as caught:
        safe_npz.read_npz(path)
    assert "cup_pour1.npz" in str(caught.value)
    assert "posix.getpid" in str(caught.value) or "nt.getpid" in str(caught.value)


@pytest.mark.parametrize(
    "opcodes",
    [
        b"\x80\x02c__builtin__\neval\n.",
        b"\x80\x02cnumpy\nndarray\n(K\x01tR.",  # our stand-in, called as it never is
        b"\x80\x02cnumpy\nndarray\n.",
        b"\x80\x02cnumpy\ndtype\n(X\x02\x00\x00\x00V8tR.",
        b"\x80\x02cnumpy\ndtype\n}X\x01\x00\x00\x00aK\x01sb.",  # BUILD: change the helper
        b"\x80\x02c_codecs\nencode\n(X\x01\x00\x00\x00aX\x03\x00\x00\x00rottR.",
        b"\x80\x02(lp0\nh\x00a.",  # a list inside itself
        b"\x80\x02]r\xff\xff\xff\x7f.",  # a memo of two thousand million entries
        b"\x80\x02P1\n.",  # persistent id
        b"\x80\x02\x82\x01.",  # extension registry
        b"\x80\x02(c__main__\nX\nioc__main__\nX\n.",
        b"",
        b".",
        b"\x80",
        b"\x80\x04\x95\xff\xff\xff\xff\xff\xff\xff\xff.",
        b"\x80\x04\x8e\xff\xff\xff\xff\xff\xff\xff\x7fabc.",
    ],
)
def test_crafted_opcodes_end_in_our_error(opcodes: bytes) -> None:
    with pytest.raises(CorruptAssetError, match="crafted"):
        safe_pickle.loads(opcodes, "crafted")


def test_an_array_whose_type_lies_about_pointers_is_not_believed() -> None:
    # The state's last number is numpy's flags; 63 claims that the eight bytes are object pointers.
    lying = (
        b"\x80\x02cnumpy.core.multiarray\n_reconstruct\ncnumpy\nndarray\nK\x00\x85U\x01b\x87R"
        b"(K\x01K\x01\x85cnumpy\ndtype\nU\x02f8K\x00K\x01\x87R(K\x03U\x01<NNNJ\xff\xff\xff\xff"
        b"J\xff\xff\xff\xffK\x3ftb\x89U\x08\x00\x00\x00\x00\x00\x00\xf0?tb."
    )
    result = safe_pickle.loads(lying, "lying")
    assert result.dtype == np.float64
    assert result.tolist() == [1.0]


@pytest.mark.parametrize("protocol", PROTOCOLS)
@pytest.mark.parametrize("dtype", ["<f8", ">f8", "<f4", "<i8", "|b1", "|u1", "<U3", "|S3"])
def test_arrays_of_every_protocol_come_back_as_they_were(protocol: int, dtype: str) -> None:
    array = np.array([[1, 0, 1], [0, 1, 1]]).astype(dtype)
    for value in (array, np.asfortranarray(array), array[:, ::2], array[0, 0], array[:0]):
        back = safe_pickle.loads(pickle.dumps({"a": [value]}, protocol), "x")["a"][0]
        assert np.array_equal(back, value)
        assert back.dtype == value.dtype


def test_a_real_start_state_table_comes_back() -> None:
    table = trajectory()["s_0"]
    stored = np.array(table, dtype=object)
    back = safe_pickle.loads(stored.dumps(), "x")[()]
    assert back.keys() == table.keys()
    assert np.array_equal(back["motion_planned"]["actions"], table["motion_planned"]["actions"])


leaves = (
    st.none()
    | st.booleans()
    | st.integers(-(2**70), 2**70)
    | st.floats(allow_nan=False)
    | st.text(max_size=8)
    | st_numpy.arrays(
        st.sampled_from([np.dtype("<f8"), np.dtype(">i4"), np.dtype("<f4"), np.dtype("b1")]),
        st_numpy.array_shapes(min_dims=0, max_dims=3, min_side=0, max_side=4),
        elements={"allow_nan": False},
    )
)
plain = st.recursive(
    leaves,
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.tuples(inner, inner)
        | st.dictionaries(st.text(max_size=5), inner, max_size=4)
    ),
    max_leaves=12,
)


def _equal(a: Any, b: Any) -> bool:
    if isinstance(a, np.ndarray):
        return isinstance(b, np.ndarray) and a.dtype == b.dtype and np.array_equal(a, b)
    if isinstance(a, dict):
        return a.keys() == b.keys() and all(_equal(a[k], b[k]) for k in a)
    if isinstance(a, list | tuple):
        return type(a) is type(b) and len(a) == len(b) and all(map(_equal, a, b))
    return type(a) is type(b) and a == b


@given(plain, st.sampled_from(PROTOCOLS))
def test_what_is_plain_survives(value: Any, protocol: int) -> None:
    assert _equal(safe_pickle.loads(pickle.dumps(value, protocol), "x"), value)


@given(st.binary(max_size=200))
def test_any_bytes_give_a_value_or_our_error(data: bytes) -> None:
    for read in (safe_pickle.loads, safe_npz.parse_npy):
        try:
            read(data, "x")
        except CorruptAssetError as error:
            assert str(error).startswith("x: ")
            assert "\n" not in str(error)


@given(st.data())
@settings(max_examples=300)
def test_a_changed_pickle_gives_a_value_or_our_error(data: st.DataObject) -> None:
    good = bytearray(pickle.dumps(np.array(trajectory()["s_0"], dtype=object), 2))
    for _ in range(data.draw(st.integers(1, 4))):
        good[data.draw(st.integers(0, len(good) - 1))] = data.draw(st.integers(0, 255))
    cut = data.draw(st.integers(0, len(good)) | st.just(len(good)))
    try:
        safe_pickle.loads(bytes(good[:cut]), "x")
    except CorruptAssetError as error:
        assert str(error).startswith("x: ")


def test_an_odd_escape_is_no_warning() -> None:
    assert safe_pickle.loads(b"S'\\u'\n.", "x") == "\\u"


@given(st.data())
@settings(max_examples=100, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_changed_file_gives_arrays_or_our_error(tmp_path: Path, data: st.DataObject) -> None:
    path = tmp_path / "good.npz"
    if not path.exists():
        write_trajectory(path, trajectory())
    bad = bytearray(path.read_bytes())
    for _ in range(data.draw(st.integers(1, 6))):
        bad[data.draw(st.integers(0, len(bad) - 1))] = data.draw(st.integers(0, 255))
    changed = tmp_path / "bad.npz"
    changed.write_bytes(bytes(bad[: data.draw(st.integers(0, len(bad)) | st.just(len(bad)))]))
    try:
        assert isinstance(safe_npz.read_npz(changed), dict)
    except CorruptAssetError as error:
        assert "bad.npz" in str(error)


@pytest.mark.parametrize("length", [0, 1, 10, 100, 1000, -1, -30])
def test_a_truncated_file_is_refused_by_name(tmp_path: Path, length: int) -> None:
    path = write_trajectory(tmp_path / "cup.npz", trajectory())
    path.write_bytes(path.read_bytes()[:length])
    with pytest.raises(CorruptAssetError, match=r"cup\.npz"):
        safe_npz.read_npz(path)


def test_a_missing_file_is_refused_by_name(tmp_path: Path) -> None:
    with pytest.raises(CorruptAssetError, match=r"none\.npz: cannot be read \(No such file"):
        safe_npz.read_npz(tmp_path / "none.npz")


def test_a_zip_bomb_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "bomb.npz"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("s_0.npy", bytes(100))
    data = bytearray(path.read_bytes())
    for signature, offset in ((b"PK\x03\x04", 22), (b"PK\x01\x02", 24)):
        at = data.find(signature) + offset
        data[at : at + 4] = struct.pack("<I", 2**31)
    path.write_bytes(bytes(data))
    with pytest.raises(CorruptAssetError, match="would unpack to more than"):
        safe_npz.read_npz(path)


@pytest.mark.parametrize("shape", [(2**40,), (2**32, 2**32), (-1,), (3,)])
def test_an_array_header_that_claims_more_than_there_is_is_refused(shape: tuple[int, ...]) -> None:
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        stream, {"descr": "<f8", "fortran_order": False, "shape": shape}
    )
    with pytest.raises(CorruptAssetError, match="do not make an array of shape"):
        safe_npz.parse_npy(stream.getvalue() + bytes(16), "x")


def test_a_structured_array_is_refused() -> None:
    stream = io.BytesIO()
    np.save(stream, np.zeros(2, dtype=[("a", "f8"), ("b", "i4")]))
    with pytest.raises(CorruptAssetError, match="dtype"):
        safe_npz.parse_npy(stream.getvalue(), "x")


def test_a_pickle_file_is_read_alike(tmp_path: Path) -> None:
    path = tmp_path / "demos.pickle"
    path.write_bytes(pickle.dumps([{"actions": np.ones((3, 2))}]))
    assert safe_pickle.read_pickle(path)[0]["actions"].sum() == 6.0
