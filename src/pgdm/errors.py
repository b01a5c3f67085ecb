"""Errors shown to users. Every message names the wrong value and what would be right."""

from __future__ import annotations

import difflib
import sys
from collections.abc import Collection, Iterable, Sequence
from numbers import Integral

_FEW = 12  # a message lists at most this many valid names


class PgdmError(Exception):
    """Base of all errors that pgdm raises deliberately; commands print them as one line."""


class ConfigError(PgdmError):
    """A setting has an invalid name, type or value."""


class UnknownNameError(ConfigError):
    """A task, hand, key or other name does not exist.

    Args:
        kind: what the name stands for, such as ``"task"``.
        name: the name that was not found.
        valid: the names that exist.
        hint: an additional sentence, such as a command that helps.
        meant: names to suggest; if empty, those of similar spelling.
    """

    def __init__(
        self,
        kind: str,
        name: str,
        valid: Iterable[str],
        hint: str = "",
        meant: Sequence[str] = (),
    ) -> None:
        names = sorted(valid)
        close = meant or difflib.get_close_matches(str(name), names, n=3, cutoff=0.5)
        shown = names if len(names) <= _FEW else [*names[:_FEW], f"... ({len(names)} in all)"]
        message = f"unknown {kind} '{name}'"
        if close:
            message += f"; did you mean {' or '.join(close)}?"
        if names and (not close or len(names) <= _FEW):
            message += f"{'' if close else ';'} valid: {', '.join(shown)}."
        super().__init__(f"{message} {hint}".rstrip())
        self.name, self.valid = name, names


def amount(count: int, noun: str, plural: str = "") -> str:
    """Return a count with its noun, such as ``1 joint`` and ``2 joints``.

    Args:
        count: how many.
        noun: the noun in the singular.
        plural: its plural; by default with an s.
    """
    return f"{count} {noun if count == 1 else plural or f'{noun}s'}"


def check_at_least(key: str, value: float, low: float) -> None:
    """Check a numeric setting.

    Raises:
        ConfigError: if it is less than ``low``.
    """
    if value < low:
        raise ConfigError(f"{key} is {value}; it must be at least {low}")


def check_count(key: str, value: object, low: int) -> None:
    """Check an integer argument of the Python API.

    Raises:
        ConfigError: if it is not an integer, or less than ``low``.
    """
    if isinstance(value, bool) or not isinstance(value, Integral):
        raise ConfigError(f"{key} is {value!r}; it must be a whole number, {low} or more")
    check_at_least(key, int(value), low)


def check_above_zero(key: str, value: float) -> None:
    """Check a numeric setting.

    Raises:
        ConfigError: if it is 0 or less.
    """
    if value <= 0:
        raise ConfigError(f"{key} is {value}; it must be above 0")


def check_name(kind: str, name: str, valid: Collection[str]) -> None:
    """Check a name, see :class:`UnknownNameError`.

    Raises:
        UnknownNameError: if it is not among the valid ones.
    """
    if name not in valid:
        raise UnknownNameError(kind, name, valid)


def check_interpreter() -> None:
    """Check that Python keeps docstrings, without which torchrl cannot be imported.

    Raises:
        ConfigError: if it runs with ``-OO``.
    """
    if sys.flags.optimize > 1:
        raise ConfigError(
            "torchrl cannot be imported because Python runs with -OO or PYTHONOPTIMIZE=2; "
            "run Python without them"
        )


class LimitError(PgdmError):
    """Processing a file exceeded its limit of time or memory."""


class LibraryError(PgdmError):
    """The asset library lacks an asset or could not be changed."""


class CorruptAssetError(LibraryError):
    """An asset file is damaged or has impossible values; the message names file and reason."""


class UnsafePickleError(CorruptAssetError):
    """A pickle contains more than arrays, dicts, lists, strings and numbers."""


class SceneError(PgdmError):
    """A scene does not compile, lacks a named part, or violates pgdm's requirements."""


class RenderError(PgdmError):
    """An image or video could not be rendered or written, usually for lack of OpenGL."""


class CheckpointError(PgdmError):
    """A checkpoint is missing, damaged, of another configuration, or cannot be written."""


class RunError(PgdmError):
    """A run folder cannot be used, or a run failed."""


class SweepError(PgdmError):
    """A sweep's folder cannot be used, or does not match the request."""


class TrackingError(PgdmError):
    """A tracker could not be reached or rejected a record."""


class ZooError(PgdmError):
    """A zoo of policies cannot be reached, or is damaged."""
