"""Reading pickles without running code from them.

TCDM stores its start states in a pickled object array; ``numpy.load(allow_pickle=True)`` would run
any code that such a file names. Here a pickle is first read as a list of opcodes; only those that
build plain values are allowed. Then it is loaded with stand-ins for the few NumPy functions that
arrays need, so that not even NumPy's ``__setstate__`` sees the file's bytes.
"""

from __future__ import annotations

import io
import math
import pickle
import pickletools
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from pgdm import files
from pgdm.errors import CorruptAssetError, UnsafePickleError

_MAX_DEPTH = 16
MAX_FILE_BYTES = 512 * 2**20
"""Largest file that is read, bytes."""

PLAIN_KINDS = "biufSU"
"""Kinds of NumPy dtypes with plain values."""
_OPCODE_NAMES = (
    "PROTO FRAME STOP MARK NONE NEWTRUE NEWFALSE BININT BININT1 BININT2 INT LONG LONG1 LONG4 "
    "FLOAT BINFLOAT UNICODE BINUNICODE SHORT_BINUNICODE BINUNICODE8 STRING BINSTRING "
    "SHORT_BINSTRING BINBYTES SHORT_BINBYTES BINBYTES8 BYTEARRAY8 EMPTY_DICT EMPTY_LIST "
    "EMPTY_TUPLE DICT LIST TUPLE TUPLE1 TUPLE2 TUPLE3 APPEND APPENDS SETITEM SETITEMS GET BINGET "
    "LONG_BINGET PUT BINPUT LONG_BINPUT MEMOIZE GLOBAL STACK_GLOBAL REDUCE BUILD"
)
_OPCODES = frozenset(_OPCODE_NAMES.split())
_PUTS = frozenset({"PUT", "BINPUT", "LONG_BINPUT"})
READ_ERRORS = (
    pickle.UnpicklingError,
    ValueError,  # covers UnicodeDecodeError
    TypeError,
    LookupError,
    AttributeError,
    EOFError,
    OverflowError,
    MemoryError,
    RecursionError,
    ImportError,
)
"""What Python and NumPy raise when they read invalid data."""


class _DType:
    """Stands in for a pickled ``numpy.dtype``."""

    __slots__ = ("big", "code")

    def __init__(self, code: str) -> None:
        self.code, self.big = code, False

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        # (version, byte order, subarray, names, fields, size, alignment, flags[, metadata])
        if any(part is not None for part in state[2:5]):
            raise ValueError("a structured dtype")
        if state[1] not in ("<", ">", "|", "="):
            raise ValueError(f"byte order {state[1]!r}")
        self.big = state[1] == ">"

    def real(self) -> np.dtype[Any]:
        """Return the dtype that it replaces: numbers, strings or objects."""
        if self.code in ("O", "O8"):
            return np.dtype(object)
        dtype = np.dtype(self.code)
        if dtype.kind not in PLAIN_KINDS:
            raise ValueError(f"dtype {self.code!r}")
        return dtype.newbyteorder(">") if self.big else dtype


class _Array:
    """Stands in for a pickled ``numpy.ndarray``."""

    __slots__ = ("value",)

    def __init__(self, value: np.ndarray | None = None) -> None:
        self.value = value

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, dtype, fortran, data = state
        self.value = _array(data, dtype, shape, "F" if fortran else "C")


def _array(data: Any, dtype: Any, shape: Any, order: str) -> np.ndarray:
    if not isinstance(dtype, _DType):
        raise ValueError("an array without dtype")
    real = dtype.real()
    shape = tuple(int(n) for n in shape)
    count = math.prod(shape)
    if real.kind == "O":
        if not isinstance(data, list) or len(data) != count:
            raise ValueError("an object array whose items do not match its shape")
        value = np.empty(count, dtype=object)
        for i, item in enumerate(data):
            value[i] = item
    else:
        if isinstance(data, str):
            data = data.encode("latin1")
        if not isinstance(data, bytes | bytearray) or len(data) != count * real.itemsize:
            raise ValueError("an array whose bytes do not match its shape")
        value = np.frombuffer(bytes(data), dtype=real).copy()
    return value.reshape(shape, order="F" if order == "F" else "C")


class _Helper:
    """A callable that a pickle may use; has no ``__dict__``, so that a pickle cannot modify it."""

    __slots__ = ("_name",)

    def __init__(self, name: str) -> None:
        self._name = name

    def __call__(self, *args: Any) -> Any:
        if self._name == "reconstruct":
            return _Array()
        if self._name == "dtype":
            return _DType(str(args[0]))
        if self._name == "scalar":
            dtype, data = args
            return _array(data, dtype, (), "C")[()]
        if self._name == "frombuffer":
            data, dtype, shape, order = args
            return _Array(_array(data, dtype, shape, order))
        if self._name == "bytes" and not args:
            return b""
        if self._name == "encode":
            text, codec = args
            if codec not in ("latin1", "latin-1"):
                raise ValueError(f"encoding {codec!r}")
            return text.encode("latin1")
        raise ValueError(f"calling numpy.{self._name}")


_GLOBALS: dict[tuple[str, str], _Helper] = {
    ("numpy", "dtype"): _Helper("dtype"),
    ("numpy", "ndarray"): _Helper("ndarray"),
    ("_codecs", "encode"): _Helper("encode"),
    ("__builtin__", "bytes"): _Helper("bytes"),  # how old protocols write empty bytes
    ("builtins", "bytes"): _Helper("bytes"),
}
for _core in ("numpy.core", "numpy._core"):
    _GLOBALS[f"{_core}.multiarray", "_reconstruct"] = _Helper("reconstruct")
    _GLOBALS[f"{_core}.multiarray", "scalar"] = _Helper("scalar")
    _GLOBALS[f"{_core}.numeric", "_frombuffer"] = _Helper("frombuffer")


class _Object:
    """Stands in for an object whose class is not imported: keeps only the pickled state."""

    __slots__ = ("state",)

    def __new__(cls, *args: Any, **kwargs: Any) -> _Object:
        del args, kwargs
        return super().__new__(cls)

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        self.state: Any = {}

    def __setstate__(self, state: Any) -> None:
        self.state = state


_OBJECT_OPCODES = frozenset({"NEWOBJ", "NEWOBJ_EX"})


class _Unpickler(pickle.Unpickler):
    def __init__(self, data: bytes, label: str, objects: Sequence[str]) -> None:
        super().__init__(io.BytesIO(data), encoding="latin1")
        self._label, self._objects = label, objects

    def find_class(self, module: str, name: str) -> Any:
        try:
            return _GLOBALS[module, name]
        except KeyError:
            if module.partition(".")[0] in self._objects:
                return _Object
            raise _refused(self._label, f"{module}.{name}") from None


def _refused(label: str, what: str) -> UnsafePickleError:
    return UnsafePickleError(
        f"{label}: the pickle asks for {what}, which plain arrays do not need; the file may "
        "have been tampered with, get it again from its source"
    )


def _scan(data: bytes, label: str, objects: Sequence[str]) -> None:
    """Refuse opcodes and names that plain values do not need, before loading anything.

    Names that STACK_GLOBAL takes from the stack are checked later, by ``find_class``.
    """
    for opcode, arg, _ in pickletools.genops(data):
        if opcode.name not in _OPCODES and not (objects and opcode.name in _OBJECT_OPCODES):
            raise _refused(label, f"the opcode {opcode.name}")
        if opcode.name == "GLOBAL":
            module, _, name = str(arg).partition(" ")
            if (module, name) not in _GLOBALS and module.partition(".")[0] not in objects:
                raise _refused(label, f"{module}.{name}")
        # A huge index would make the unpickler allocate as many entries.
        if opcode.name in _PUTS and int(arg or 0) > len(data):
            raise ValueError("a memo index beyond the file's size")


def _plain(value: Any, seen: dict[int, Any], depth: int = 0) -> Any:
    """Replace the stand-ins in ``value`` by the plain values that they hold."""
    if depth > _MAX_DEPTH:
        raise ValueError(f"values nested deeper than {_MAX_DEPTH}")
    if isinstance(value, _Helper | _DType | type):
        raise ValueError("a class or NumPy helper in place of a value")
    if id(value) in seen:
        return seen[id(value)]
    result = value
    if isinstance(value, _Object):
        state = value.state
        if isinstance(state, dict):  # drop types, such as the dtype of a Gym space
            state = {k: v for k, v in state.items() if not isinstance(v, _Helper | _DType | type)}
        result = _plain(state, seen, depth + 1)
    elif isinstance(value, _Array):
        if value.value is None:
            raise ValueError("an array without content")
        result = value.value
        if result.dtype.kind == "O":
            flat = [_plain(v, seen, depth + 1) for v in result.ravel()]
            result = _array(flat, _DType("O"), result.shape, "C")
    elif isinstance(value, dict):
        result = {_plain(k, seen, depth + 1): _plain(v, seen, depth + 1) for k, v in value.items()}
    elif isinstance(value, list | tuple):
        result = type(value)(_plain(v, seen, depth + 1) for v in value)
    seen[id(value)] = result
    return result


def loads(data: bytes, label: str, objects: Sequence[str] = ()) -> Any:
    """Load a pickle of arrays, dicts, lists, tuples, strings and numbers only.

    Args:
        data: the pickle.
        label: the file's name in messages.
        objects: packages whose objects are permitted; none is imported, and each object is
            returned as its pickled state, usually a dict of its attributes.

    Raises:
        UnsafePickleError: the pickle requires anything else.
        CorruptAssetError: the pickle cannot be read.
    """
    try:
        with warnings.catch_warnings():
            # Python warns of invalid escapes in pickled strings; the user cannot act on that.
            warnings.simplefilter("ignore", DeprecationWarning)
            _scan(data, label, objects)
            return _plain(_Unpickler(data, label, objects).load(), {})
    except READ_ERRORS as error:
        raise CorruptAssetError(f"{label}: unreadable pickle ({reason(error)})") from error


def read_pickle(path: Path) -> Any:
    """Load a pickle file like :func:`loads`."""
    return loads(read_bytes(path), str(path))


def read_bytes(path: Path) -> bytes:
    """Return a file's content.

    Raises:
        CorruptAssetError: the file cannot be read, or is too large.
    """
    try:
        return files.read_bytes(path, MAX_FILE_BYTES)
    except OSError as error:
        raise CorruptAssetError(f"{path}: cannot be read ({files.reason(error)})") from error


def reason(error: BaseException) -> str:
    """Return an error's text on one short line."""
    return " ".join(str(error).split())[:200] or type(error).__name__
