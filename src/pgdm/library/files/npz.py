"""Reading ``.npz`` and ``.npy`` files without running code from them, and writing ``.npz``."""

from __future__ import annotations

import hashlib
import io
import math
import zipfile
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from pgdm.errors import CorruptAssetError
from pgdm.library.files.pickles import (
    MAX_FILE_BYTES,
    PLAIN_KINDS,
    READ_ERRORS,
    loads,
    read_bytes,
    reason,
)

MAX_MEMBER_BYTES = 256 * 2**20
"""Largest array that is read, bytes; the released arrays have a few thousand."""


def read_npz(path: Path) -> dict[str, Any]:
    """Read all arrays of an ``.npz``; pickled arrays through :func:`loads`.

    Returns:
        Name to array; a pickled array without dimensions is returned as its object.

    Raises:
        UnsafePickleError: a pickled array requires more than plain values.
        CorruptAssetError: the file is missing, truncated, too large or not an ``.npz``, or an array
            in it is unreadable.
    """
    return read_hashed(path)[0]


def read_hashed(path: Path) -> tuple[dict[str, Any], str]:
    """Return the arrays of an ``.npz`` as :func:`read_npz` does, and the file's SHA-256 (hex).

    Raises:
        CorruptAssetError: as for :func:`read_npz`, including UnsafePickleError.
    """
    result: dict[str, Any] = {}
    try:
        data = read_bytes(path)
        with zipfile.ZipFile(io.BytesIO(data)) as archive:
            if sum(info.file_size for info in archive.infolist()) > MAX_FILE_BYTES:
                raise CorruptAssetError(f"{path}: would unpack to more than {MAX_FILE_BYTES} bytes")
            for info in archive.infolist():
                name = info.filename.removesuffix(".npy")
                if info.file_size > MAX_MEMBER_BYTES:
                    raise CorruptAssetError(
                        f"{path}: '{name}' would unpack to {info.file_size} bytes, more than the "
                        f"{MAX_MEMBER_BYTES} allowed"
                    )
                result[name] = parse_npy(archive.read(info), f"{path}: {name}")
    except (zipfile.BadZipFile, zlib.error, NotImplementedError, RuntimeError, *READ_ERRORS) as e:
        raise CorruptAssetError(
            f"{path}: not a readable .npz ({reason(e)}); get it again from its source"
        ) from e
    return result, hashlib.sha256(data).hexdigest()


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays as an ``.npz`` and create its folder; equal arrays always give equal bytes."""
    buffer = io.BytesIO()
    # NumPy writes a fixed date into the zip, so the file's hash depends only on the arrays.
    np.savez_compressed(buffer, **arrays)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(buffer.getvalue())


def parse_npy(data: bytes, label: str) -> Any:
    """Parse the content of an ``.npy`` file; a pickled array through :func:`loads`.

    Args:
        data: the file's content.
        label: its name in messages.

    Raises:
        UnsafePickleError: the array is pickled and requires more than plain values.
        CorruptAssetError: the content cannot be read.
    """
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        reader = (
            np.lib.format.read_array_header_1_0
            if version == (1, 0)
            else np.lib.format.read_array_header_2_0
        )
        shape, fortran, dtype = reader(stream)
        body = data[stream.tell() :]
        if dtype.hasobject:
            value = loads(body, label)
            return value[()] if isinstance(value, np.ndarray) and value.ndim == 0 else value
        if dtype.kind not in PLAIN_KINDS:
            raise ValueError(f"dtype {dtype}")
        if any(n < 0 for n in shape) or math.prod(shape) * dtype.itemsize != len(body):
            raise ValueError(f"{len(body)} bytes do not make an array of shape {shape}")
        value = np.frombuffer(body, dtype=dtype).copy()
        return value.reshape(shape, order="F" if fortran else "C")
    except READ_ERRORS as error:
        raise CorruptAssetError(f"{label}: unreadable array ({reason(error)})") from error
