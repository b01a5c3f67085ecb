"""Reading ``.npz`` and ``.npy`` files without running code from them."""

from __future__ import annotations

import io
import math
import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np

from pgdm.errors import CorruptAssetError
from pgdm.library.safe_pickle import PLAIN_KINDS, READ_ERRORS, loads, read_bytes, reason

MAX_MEMBER_BYTES = 256 * 2**20
"""Largest array file that is read, bytes; the real ones have a few thousand."""


def read_npz(path: Path) -> dict[str, Any]:
    """Read all arrays of an ``.npz``; pickled ones through :func:`loads`.

    Returns:
        Name to array; a pickled array of no dimension comes as the object in it.

    Raises:
        UnsafePickleError: a pickled array asks for more than plain values.
        CorruptAssetError: the file is missing, truncated or not an ``.npz``; names file and reason.
    """
    result: dict[str, Any] = {}
    try:
        with zipfile.ZipFile(io.BytesIO(read_bytes(path))) as archive:
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
    return result


def parse_npy(data: bytes, label: str) -> Any:
    """Parse the content of an ``.npy`` file; a pickled one through :func:`loads`.

    Args:
        data: the file's content.
        label: what to call it in messages.

    Raises:
        UnsafePickleError: it is a pickle that asks for more than plain values.
        CorruptAssetError: it cannot be read.
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
