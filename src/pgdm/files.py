"""Reading untrusted files: regular files only, of limited size and depth.

Settings, run folders, checkouts and motions are all read with these functions. Without their
checks, reading a pipe or device in place of a file might never end, and a few lines of YAML could
fill the memory. OSError means that the file cannot be read, ValueError that its content is invalid.
"""

from __future__ import annotations

import errno
import io
import json
import os
import pickle
import re
import stat
import warnings
from collections.abc import Iterator
from typing import Any

import yaml
from yaml.composer import Composer
from yaml.constructor import SafeConstructor
from yaml.nodes import Node
from yaml.parser import Parser
from yaml.reader import Reader
from yaml.resolver import Resolver
from yaml.scanner import Scanner

try:
    from yaml.cyaml import CParser as _Parser  # type: ignore[attr-defined]
except ImportError:  # PyYAML was built without libyaml, and is several times slower

    class _Parser(Reader, Scanner, Parser):  # type: ignore[no-redef]
        def __init__(self, text: str) -> None:
            Reader.__init__(self, text)
            Scanner.__init__(self)
            Parser.__init__(self)


MOST_BYTES = 1 << 30
"""Largest file that is read as a whole."""
MOST_JSON_BYTES = 1 << 27
MOST_TEXT_BYTES = 1 << 22
MOST_DEPTH = 50
"""Deepest nesting of YAML, and of folders that are searched."""
MOST_NODES = 100_000
"""Largest number of values in a YAML file; each alias counts as all the values it repeats."""
# What torch.load raises for bad files; its messages, which advise turning `weights_only` off, are
# replaced.
_TORCH_ERRORS = (
    *(pickle.UnpicklingError, RuntimeError, EOFError, ValueError, LookupError, TypeError),
    *(AttributeError, AssertionError, ArithmeticError, ImportError, MemoryError, OSError),
)
_LONG = re.compile(rb"\d{25}")
_MOST_DIGITS = 20  # digits of the largest 64-bit integer


def walk(root: str | os.PathLike[str]) -> Iterator[tuple[str, list[str], list[str]]]:
    """Yield what ``os.walk`` does, ``MOST_DEPTH`` folders deep at most."""
    root = os.fspath(root)
    for folder, subfolders, names in os.walk(root):
        if folder.count(os.sep) - root.count(os.sep) >= MOST_DEPTH:
            subfolders.clear()
        yield folder, subfolders, names


def open_file(path: str | os.PathLike[str]) -> io.BufferedReader:
    """Open a regular file, or a link to one, for reading.

    Raises:
        OSError: if it cannot be opened, or is a folder, a pipe, a socket or a device.
    """
    # Without O_NONBLOCK, opening a pipe waits for a writer.
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    mode = os.fstat(descriptor).st_mode
    if stat.S_ISREG(mode):
        return os.fdopen(descriptor, "rb")
    os.close(descriptor)
    if stat.S_ISDIR(mode):
        raise IsADirectoryError(errno.EISDIR, "it is a folder, not a file", str(path))
    raise OSError(errno.EINVAL, "it is a pipe or a device, not a file", str(path))


def read_bytes(path: str | os.PathLike[str], most: int = MOST_BYTES) -> bytes:
    """Return the content of a regular file.

    Raises:
        OSError: as for ``open_file``, or if it has more than ``most`` bytes.
    """
    with open_file(path) as file:
        return whole(file, most)


def whole(file: io.BufferedReader, most: int = MOST_BYTES) -> bytes:
    """Return the content of an open file.

    Raises:
        OSError: as for ``read_bytes``.
    """
    size = os.fstat(file.fileno()).st_size
    content = file.read(most + 1) if size <= most else b""  # the file may be growing
    if max(size, len(content)) > most:
        reason = f"it has {size:,} bytes, more than the {most:,} allowed"
        raise OSError(errno.EFBIG, reason)
    return content


def reason(error: Exception) -> str:
    """Return why a file could not be read, on one line and without its name."""
    text = error.strerror if isinstance(error, OSError) else None
    return " ".join((text or str(error)).split()) or type(error).__name__


def read_text(path: str | os.PathLike[str], most: int = MOST_TEXT_BYTES) -> str:
    """Return the content of a UTF-8 file.

    Raises:
        OSError: as for ``read_bytes``.
        ValueError: if it is not UTF-8.
    """
    return read_bytes(path, most).decode("utf-8")


def read_json(path: str | os.PathLike[str], most: int = MOST_JSON_BYTES) -> Any:
    """Return the content of a JSON file.

    Raises:
        OSError: as for ``read_bytes``.
        ValueError: as for ``parse_json``.
    """
    return parse_json(read_bytes(path, most))


def parse_json(text: bytes) -> Any:
    """Return the value of a JSON text.

    Raises:
        ValueError: if it is not JSON, is nested too deeply, or has an integer of 25 digits or more.
    """
    try:
        # parse_int makes reading slower; most files have no long number.
        return json.loads(text, parse_int=_whole) if _LONG.search(text) else json.loads(text)
    except RecursionError as error:
        raise ValueError("it is nested too deeply") from error


def _whole(digits: str) -> int:
    if len(digits.lstrip("-")) > _MOST_DIGITS:
        raise ValueError(f"the number {digits[:12]}... has {len(digits)} digits")
    return int(digits)


def read_yaml(path: str | os.PathLike[str]) -> Any:
    """Return the content of a YAML file; None if it is empty.

    Raises:
        OSError: as for ``read_bytes``.
        ValueError: as for ``parse_yaml``.
    """
    return parse_yaml(read_text(path))


# PyYAML raises the last two for a value that does not fit its tag, such as `!!bool maybe`.
_YAML_ERRORS = (yaml.YAMLError, RecursionError, OverflowError, LookupError, AttributeError)


def parse_yaml(text: str) -> Any:
    """Return the plain values of a YAML text; None if it is empty.

    Raises:
        ValueError: if it is not YAML, exceeds ``MOST_DEPTH`` or ``MOST_NODES``, or has an integer
            of more than 20 digits; the message is one line.
    """
    try:
        return _Loader(text).get_single_data()
    except _YAML_ERRORS as error:
        text = " ".join(str(error).replace('in "<unicode string>", ', "in ").split())
        raise ValueError(f"not valid YAML: {text}") from error


class _Loader(Composer, _Parser, SafeConstructor, Resolver):  # type: ignore[misc]
    """PyYAML's safe loader; stops as soon as a text is too deep or has too many values."""

    def __init__(self, text: str) -> None:
        _Parser.__init__(self, text)
        Composer.__init__(self)
        SafeConstructor.__init__(self)
        Resolver.__init__(self)
        self._depth, self._nodes = 0, 0
        self._sizes: dict[int, int] = {}  # values in each anchored node, by its id

    def compose_node(self, parent: Node | None, index: Any) -> Node | None:
        """Compose a node as PyYAML does, counting depth and values."""
        is_alias = self.check_event(yaml.AliasEvent)
        anchored = getattr(self.peek_event(), "anchor", None) is not None
        before = self._nodes
        self._nodes += 1
        self._depth += 1
        if self._depth > MOST_DEPTH:
            raise yaml.YAMLError(f"nested more than {MOST_DEPTH} deep")
        node = super().compose_node(parent, index)
        self._depth -= 1
        if is_alias:
            if id(node) not in self._sizes:
                raise yaml.YAMLError("an alias refers to a value that contains it")
            self._nodes += self._sizes[id(node)]
        elif anchored:
            self._sizes[id(node)] = self._nodes - before
        if self._nodes > MOST_NODES:
            raise yaml.YAMLError(f"more than {MOST_NODES:,} values, with those of aliases")
        return node

    def construct_yaml_int(self, node: Any) -> int:
        """Return an integer; reject one of more than ``_MOST_DIGITS`` digits."""
        number = super().construct_yaml_int(node)
        if abs(number) >= 10**_MOST_DIGITS:
            raise yaml.YAMLError(f"the number {node.value[:12]}... has {len(node.value)} digits")
        return number


_Loader.add_constructor("tag:yaml.org,2002:int", _Loader.construct_yaml_int)


def parse_tensors(content: bytes) -> Any:
    """Return tensors and plain values that ``torch.save`` wrote; no other object is created.

    Raises:
        ValueError: if it is damaged or holds anything else; the message is one line.
    """
    import torch

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # about torch's limits, of no use here
            return torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    except _TORCH_ERRORS as error:
        found = re.search(r"GLOBAL [\w.]+", str(error))
        reason = f"it holds {found[0]}, not a tensor or plain value" if found else "it is damaged"
        raise ValueError(reason) from error
