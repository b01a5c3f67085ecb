"""Checkpoint files: written atomically, verified when read; reading one never runs code."""

from __future__ import annotations

import hashlib
import io
import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from pgdm import files
from pgdm.errors import CheckpointError, amount
from pgdm.paths import TEMPORARY, free_bytes, replacing

_MAGIC = b"pgdm-checkpoint-1"
_FOOTER_SIZE = len(_MAGIC) + hashlib.sha256().digest_size
_BEST = "best.ckpt"

_log = logging.getLogger(__name__)

State = dict[str, Any]


@dataclass(frozen=True)
class CheckpointCfg:
    """How often a run saves the state it can be resumed from."""

    interval_s: float
    """Time between two checkpoints, s."""
    keep_last: int
    """Number of newest checkpoints that are kept, in addition to the best one."""


Check = Callable[[State], object]


def _any(state: State) -> None:
    """Accept any state."""


class CheckpointFolder:
    """The checkpoints of one run: the newest few, and the best.

    Args:
        folder: folder of the checkpoints; created with the first one.
        keep_last: how many of the newest are kept.
    """

    def __init__(self, folder: Path, keep_last: int) -> None:
        self.folder, self._keep_last = folder, keep_last

    @property
    def best(self) -> Path:
        """File of the best checkpoint so far, by success, then return; may not exist yet."""
        return self.folder / _BEST

    def all(self) -> list[Path]:
        """Return the regular checkpoints, oldest first."""
        return sorted(self.folder.glob("frames_*.ckpt"))

    def save(self, state: State, frames: int) -> Path:
        """Write the state after ``frames`` steps, then delete the oldest beyond ``keep_last``.

        Raises:
            CheckpointError: if it cannot be written; earlier ones are untouched.
        """
        path = self.folder / f"frames_{frames:012d}.ckpt"
        write_checkpoint(path, state)
        for old in self.all()[: -self._keep_last]:
            old.unlink(missing_ok=True)
        return path

    def save_best(self, state: State) -> Path:
        """Write the state as the best checkpoint.

        Raises:
            CheckpointError: if it cannot be written; the best one so far is untouched.
        """
        write_checkpoint(self.best, state)
        return self.best

    def latest(self, check: Check = _any) -> State | None:
        """Return the newest usable state, or None if there is no checkpoint; see ``newest``."""
        found = self.newest(check)
        return None if found is None else found[1]

    def newest(self, check: Check = _any) -> tuple[Path, State] | None:
        """Return the newest usable checkpoint and its state, or None if there is no checkpoint.

        Unusable checkpoints are skipped with a warning. Once a usable one is found, they are
        renamed to ``*.damaged`` so that they do not count towards ``keep_last``.

        Args:
            check: raises CheckpointError if a state cannot be used.

        Raises:
            CheckpointError: if there are checkpoints but none can be used.
        """
        paths, damaged, reason = self.all(), [], ""
        for path in reversed(paths):
            try:
                state = read_checkpoint(path)
                check(state)
            except CheckpointError as error:
                _log.warning("%s: %s; trying the checkpoint before it", path.name, error)
                damaged.append(path)
                reason = str(error)
                continue
            for bad in damaged:
                _set_aside(bad)
            return path, state
        if paths:
            raise CheckpointError(
                f"of {amount(len(paths), 'checkpoint')} in {self.folder} none can be used "
                f"({reason}); start anew in another run_dir"
            )
        return None


def write_checkpoint(path: Path, state: State) -> None:
    """Write tensors and plain values to a file, atomically.

    The path always holds the old or the complete new file, also after a power failure.

    Raises:
        CheckpointError: if the file cannot be written, or ``state`` holds anything other than
            tensors and plain values: it could not be read back.
    """
    payload = _encode(state)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for stale in path.parent.glob(f"{TEMPORARY}*"):  # of a process that was killed
            stale.unlink(missing_ok=True)
        with replacing(path) as temp, open(temp, "wb") as file:
            file.write(payload)
            file.write(_MAGIC + hashlib.sha256(payload).digest())
    except OSError as error:
        raise CheckpointError(
            f"cannot write a checkpoint of {len(payload) / 1e6:.1f} MB to {path.parent} "
            f"({free_bytes(path.parent) / 1e6:.1f} MB free): {error.strerror or error}; make "
            "room or give write access, earlier checkpoints are untouched"
        ) from error


def read_checkpoint(path: Path) -> State:
    """Return the state in a checkpoint file.

    Raises:
        CheckpointError: if the file cannot be read, is damaged, or holds anything other than a
            dictionary of tensors and plain values (nothing in it is ever executed).
    """
    try:
        raw = files.read_bytes(path)
    except OSError as error:
        raise CheckpointError(f"cannot read checkpoint {path}: {files.reason(error)}") from error
    payload, footer = raw[:-_FOOTER_SIZE], raw[-_FOOTER_SIZE:]
    if not footer.startswith(_MAGIC):
        raise CheckpointError(f"{path} is not a pgdm checkpoint, or is cut off ({len(raw)} bytes)")
    if footer[len(_MAGIC) :] != hashlib.sha256(payload).digest():
        raise CheckpointError(f"checkpoint {path} is damaged: its checksum does not match")
    try:
        state = files.parse_tensors(payload)
    except ValueError as error:
        raise CheckpointError(f"checkpoint {path} is refused: {error}") from error
    if not isinstance(state, dict):
        raise CheckpointError(f"checkpoint {path} holds a {type(state).__name__}, not a state")
    return state


def _encode(state: State) -> bytes:
    buffer = io.BytesIO()
    torch.save(state, buffer)
    try:
        # A state that cannot be loaded must fail now, not when the run is resumed.
        files.parse_tensors(buffer.getvalue())
    except ValueError as error:
        raise CheckpointError(
            f"the state holds more than tensors and plain values: {error}"
        ) from error
    return buffer.getvalue()


def _set_aside(path: Path) -> None:
    try:
        path.rename(path.with_suffix(".damaged"))
    except OSError as error:
        _log.warning("cannot rename %s: %s", path, error.strerror)
