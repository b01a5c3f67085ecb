"""Checkpoint files: written whole or not at all, checked when read, never able to run code."""

from __future__ import annotations

import hashlib
import io
import logging
import pickle
import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from pgdm.errors import CheckpointError
from pgdm.paths import TEMPORARY, replacing

_MAGIC = b"pgdm-checkpoint-1"
_FOOTER_SIZE = len(_MAGIC) + hashlib.sha256().digest_size
_BEST = "best.ckpt"

_log = logging.getLogger(__name__)

State = dict[str, Any]


@dataclass(frozen=True)
class CheckpointCfg:
    """What a stopped run goes on from."""

    interval_s: float
    """Time between two checkpoints, s."""
    keep_last: int
    """Checkpoints kept, the newest ones; the best is kept besides."""


class CheckpointFolder:
    """The checkpoints of one run: the last few, and the best.

    Args:
        folder: where they are; made when the first one is written.
        keep_last: how many of the newest are kept.
    """

    def __init__(self, folder: Path, keep_last: int) -> None:
        self.folder, self._keep_last = folder, keep_last

    @property
    def best(self) -> Path:
        """File of the best policy so far; it may not exist yet."""
        return self.folder / _BEST

    def all(self) -> list[Path]:
        """Return the regular checkpoints, oldest first."""
        return sorted(self.folder.glob("frames_*.ckpt"))

    def save(self, state: State, frames: int) -> Path:
        """Write the state reached after ``frames``, then drop the oldest beyond ``keep_last``.

        Raises:
            CheckpointError: if it cannot be written; those already there are untouched.
        """
        path = self.folder / f"frames_{frames:012d}.ckpt"
        write_checkpoint(path, state)
        for old in self.all()[: -self._keep_last]:
            old.unlink(missing_ok=True)
        return path

    def save_best(self, state: State) -> Path:
        """Write the state as the best one.

        Raises:
            CheckpointError: if it cannot be written; the best one so far is untouched.
        """
        write_checkpoint(self.best, state)
        return self.best

    def latest(self) -> State | None:
        """Return the newest state that can be read, or None if there is no checkpoint."""
        found = self.newest()
        return None if found is None else found[1]

    def newest(self) -> tuple[Path, State] | None:
        """Return the newest checkpoint that can be read and its state, or None if there is none.

        A damaged file is passed over for the one before it, with a warning, and renamed so that
        it does not count among the last ones when others are dropped.

        Raises:
            CheckpointError: if there are checkpoints but none can be read.
        """
        paths, damaged, reason = self.all(), [], ""
        for path in reversed(paths):
            try:
                state = read_checkpoint(path)
            except CheckpointError as error:
                _log.warning("%s; going on from the one before", error)
                damaged.append(path)
                reason = str(error)
                continue
            for bad in damaged:
                _set_aside(bad)
            return path, state
        if paths:
            raise CheckpointError(
                f"none of the {len(paths)} checkpoints in {self.folder} can be read ({reason}); "
                "start anew in another run_dir"
            )
        return None


def write_checkpoint(path: Path, state: State) -> None:
    """Write tensors and plain containers to a file, atomically.

    Whoever looks sees the old file or the whole new one, also after a loss of power.

    Raises:
        CheckpointError: if the file cannot be written, or could not be read back because ``state``
            holds something else than tensors and plain values.
    """
    payload = _encode(state)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        for stale in path.parent.glob(f"{TEMPORARY}*"):  # left behind by a process that was killed
            stale.unlink(missing_ok=True)
        with replacing(path) as temp, open(temp, "wb") as file:
            file.write(payload)
            file.write(_MAGIC + hashlib.sha256(payload).digest())
    except OSError as error:
        raise CheckpointError(
            f"cannot write a checkpoint of {len(payload) / 1e6:.1f} MB to {path.parent} "
            f"({_free_space(path.parent)}): {error.strerror or error}; make room or give write "
            "access, earlier checkpoints are untouched"
        ) from error


def read_checkpoint(path: Path) -> State:
    """Return the state in a checkpoint file.

    Raises:
        CheckpointError: if the file is missing, damaged, or holds more than tensors and plain
            values (nothing in it is ever run).
    """
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise CheckpointError(f"cannot read checkpoint {path}: {error.strerror}") from error
    payload, footer = raw[:-_FOOTER_SIZE], raw[-_FOOTER_SIZE:]
    if not footer.startswith(_MAGIC):
        raise CheckpointError(f"{path} is no checkpoint of pgdm, or is cut off ({len(raw)} bytes)")
    if footer[len(_MAGIC) :] != hashlib.sha256(payload).digest():
        raise CheckpointError(f"checkpoint {path} is damaged: its checksum does not fit")
    try:
        state = torch.load(io.BytesIO(payload), map_location="cpu", weights_only=True)
    except (pickle.UnpicklingError, RuntimeError, EOFError, ValueError) as error:
        reason = str(error).splitlines()[0]
        raise CheckpointError(f"checkpoint {path} is refused: {reason}") from error
    if not isinstance(state, dict):
        raise CheckpointError(f"checkpoint {path} holds a {type(state).__name__}, not a state")
    return state


def _encode(state: State) -> bytes:
    buffer = io.BytesIO()
    torch.save(state, buffer)
    try:
        # What cannot be loaded must be found out now, not when the run is to be resumed.
        torch.load(io.BytesIO(buffer.getbuffer()), weights_only=True)
    except pickle.UnpicklingError as error:
        raise CheckpointError(
            f"the state holds more than tensors and plain values: {str(error).splitlines()[0]}"
        ) from error
    return buffer.getvalue()


def _set_aside(path: Path) -> None:
    try:
        path.rename(path.with_suffix(".damaged"))
    except OSError as error:
        _log.warning("cannot rename %s: %s", path, error.strerror)


def _free_space(folder: Path) -> str:
    existing = next((p for p in (folder, *folder.parents) if p.is_dir()), Path("/"))
    return f"{shutil.disk_usage(existing).free / 1e6:.1f} MB free"
