"""Errors that people meet. Every message names the wrong value and what would be right."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

_FEW = 12  # names that are all shown


class PgdmError(Exception):
    """Base of all errors that pgdm raises on purpose; commands print it as one line."""


class ConfigError(PgdmError):
    """A setting has a wrong name, type or value."""


class UnknownNameError(ConfigError):
    """A task, hand, key... that does not exist.

    Args:
        kind: what was asked for, such as ``"task"``.
        name: the name that was not found.
        valid: the names that exist.
        hint: one more sentence, such as the command that helps.
    """

    def __init__(self, kind: str, name: str, valid: Iterable[str], hint: str = "") -> None:
        names = sorted(valid)
        close = difflib.get_close_matches(str(name), names, n=3, cutoff=0.5)
        shown = names if len(names) <= _FEW else [*names[:_FEW], f"... ({len(names)} in all)"]
        message = f"unknown {kind} '{name}'"
        if close:
            message += f"; did you mean {' or '.join(close)}?"
        if names and (not close or len(names) <= _FEW):
            message += f"{'' if close else ';'} valid: {', '.join(shown)}."
        super().__init__(f"{message} {hint}".rstrip())
        self.name, self.valid = name, names


class LibraryError(PgdmError):
    """The asset library lacks something or could not be changed."""


class CorruptAssetError(LibraryError):
    """An asset file is damaged or holds values that cannot be right; names file and reason."""


class PlanMissingError(LibraryError):
    """A wrist plan is not made yet, where it may not be made."""


class UnsafePickleError(CorruptAssetError):
    """A pickled object asks for more than arrays, dicts, lists, strings and numbers."""


class SceneError(PgdmError):
    """A scene cannot be compiled, or lacks a body, joint or geom by name."""


class RenderError(PgdmError):
    """No picture could be made, usually because no OpenGL was found."""


class CheckpointError(PgdmError):
    """A checkpoint is missing, damaged, or belongs to another configuration."""


class RunError(PgdmError):
    """A run folder cannot be used, or a run failed."""


class SweepError(PgdmError):
    """A sweep's folder cannot be used, or what was asked does not fit what is in it."""


class TrackingError(PgdmError):
    """A tracker could not be reached or refused a record."""
