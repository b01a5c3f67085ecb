"""The replay: every frame of a run, in append-only files of its folder."""

from __future__ import annotations

import contextlib
import json
import math
import os
import shutil
import warnings
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pgdm.errors import CheckpointError, RunError
from pgdm.paths import replacing

with warnings.catch_warnings():
    warnings.simplefilter("ignore")  # torchrl's compiled part, unused here, is of another torch
    from tensordict import MemoryMappedTensor, TensorDict
    from torchrl.data import TensorDictReplayBuffer, TensorStorage

_SUFFIX, _ABOUT = ".bin", "columns.json"


@dataclass(frozen=True)
class Column:
    """One number or vector of every frame."""

    dtype: torch.dtype
    shape: tuple[int, ...] = ()
    entries: tuple[str, ...] = ()
    """Names of a vector's entries, for who reads the file."""

    @property
    def nbytes(self) -> int:
        """Bytes of one frame."""
        return math.prod(self.shape) * self.dtype.itemsize


class Replay:
    """Frames in the order in which they were seen, sampled uniformly.

    A column is one file. Files are reserved in full at the start, so that a disk without room is
    an error then and not in the middle of a training; what was appended survives the death of the
    process. A checkpoint holds the number of frames and a checksum of each column instead of a
    copy: whatever was appended after it is written over when the run goes on.

    Args:
        columns: what a frame consists of, by name.
        capacity: frames there is room for.
        batch_size: frames in a sample.
        generator: stream of the sampled rows.
        folder: where the files are, or None to keep the frames in memory.

    Raises:
        RunError: if the disk has no room for the files.
    """

    def __init__(
        self,
        columns: Mapping[str, Column],
        capacity: int,
        batch_size: int,
        generator: torch.Generator,
        folder: Path | None = None,
    ) -> None:
        self.columns, self.capacity, self.folder = dict(columns), capacity, folder
        self._made: list[Path] = []
        if folder is None:
            data = {n: torch.zeros(capacity, *c.shape, dtype=c.dtype) for n, c in columns.items()}
        else:
            self._made = _reserve(folder, self.columns, capacity)
            _describe(folder, self.columns)
            data = {
                name: MemoryMappedTensor.from_filename(
                    str(folder / f"{name}{_SUFFIX}"), c.dtype, torch.Size((capacity, *c.shape))
                )
                for name, c in columns.items()
            }
        self._data = TensorDict(data, batch_size=[capacity])
        self._buffer = TensorDictReplayBuffer(
            storage=TensorStorage(self._data), generator=generator, batch_size=batch_size
        )
        self._crc = dict.fromkeys(columns, 0)
        self._set_length(0)

    def __len__(self) -> int:
        """Return the number of frames so far."""
        return len(self._buffer)

    def append(self, frames: Mapping[str, Tensor]) -> None:
        """Add n frames, each column (n, ...).

        Raises:
            RunError: if there is no room for them.
        """
        count = len(next(iter(frames.values())))
        if len(self) + count > self.capacity:
            raise RunError(f"the replay has room for {self.capacity:,} frames; it is full")
        rows = {
            name: frames[name].to(column.dtype).contiguous()
            for name, column in self.columns.items()
        }
        self._buffer.extend(TensorDict(rows, batch_size=[count]))
        for name, values in rows.items():
            self._crc[name] = zlib.crc32(values.numpy().data, self._crc[name])

    def sample(self) -> TensorDict:
        """Return ``batch_size`` frames drawn uniformly, with replacement, all floats as float32."""
        drawn = self._buffer.sample()
        return drawn.apply(lambda x: x.float() if x.dtype == torch.float16 else x)

    def sync(self) -> None:
        """Wait until the disk has all frames, so that a checkpoint never tells of others."""
        for path in self._files():
            with open(path, "rb") as file:
                os.fsync(file.fileno())

    def state_dict(self) -> dict[str, Any]:
        """Return how many frames there are, and the checksum of each column."""
        self.sync()
        return {"frames": len(self), "crc32": dict(self._crc)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on from the first ``frames`` frames of the files.

        Raises:
            CheckpointError: if the files do not hold these frames; those that were missing, and
                only take room now, are deleted again.
        """
        frames, expected = int(state["frames"]), state["crc32"]
        where = self.folder or "the memory"
        if frames > self.capacity:
            raise CheckpointError(
                f"the checkpoint has {frames:,} frames, {where} {self.capacity:,}"
            )
        if frames and self._made:
            for path in self._made:
                path.unlink(missing_ok=True)
            raise CheckpointError(
                f"the replay in {where} is gone (it lacks {self._made[0].name}): it is removed "
                "when a run has finished, unless keep_replay=true; start anew in another run_dir, "
                "with all the total_frames that you want"
            )
        for name in self.columns:
            found = zlib.crc32(self._data.get(name)[:frames].numpy().data)
            if found != expected.get(name):
                raise CheckpointError(
                    f"the replay in {where} does not hold the {frames:,} frames that the "
                    f"checkpoint was made with (column '{name}' differs): it was cut, altered, "
                    "or is of another run; restore it, or start anew in another run_dir"
                )
        self._crc = {name: int(expected[name]) for name in self.columns}
        self._set_length(frames)

    def _set_length(self, frames: int) -> None:
        storage = {"_storage": {}, "initialized": True, "_len": frames}
        self._buffer.storage.load_state_dict(storage)
        self._buffer.writer.load_state_dict({"_cursor": frames % self.capacity})

    def _files(self) -> list[Path]:
        return [] if self.folder is None else sorted(self.folder.glob(f"*{_SUFFIX}"))


def _describe(folder: Path, columns: Mapping[str, Column]) -> None:
    """Write down what the files hold, for who reads them without pgdm."""
    about = {
        name: {
            "file": f"{name}{_SUFFIX}",
            "dtype": str(column.dtype).removeprefix("torch."),
            "shape": ["frames", *column.shape],
            **({"entries": list(column.entries)} if column.entries else {}),
        }
        for name, column in columns.items()
    }
    with replacing(folder / _ABOUT) as temp:
        temp.write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")


def _reserve(folder: Path, columns: Mapping[str, Column], capacity: int) -> list[Path]:
    """Make each column's file as large as it will be; what is in it stays.

    Returns:
        The files that were missing.

    Raises:
        RunError: if there is no room; the files are then as they were.
    """
    sizes = {folder / f"{name}{_SUFFIX}": c.nbytes * capacity for name, c in columns.items()}
    before = {path: path.stat().st_size for path in sizes if path.exists()}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for path, size in sizes.items():
            # Not in appending mode, and readable: where the file system cannot reserve (NFS), the
            # C library reads and writes a byte of each block instead.
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                os.posix_fallocate(descriptor, 0, size)
            finally:
                os.close(descriptor)
    except OSError as error:
        for path in sizes:
            with contextlib.suppress(OSError):
                os.truncate(path, before[path]) if path in before else path.unlink()
        existing = next(p for p in (folder, *folder.parents) if p.is_dir())
        raise RunError(
            f"cannot reserve {sum(sizes.values()) / 1e9:.1f} GB for the replay in {folder} "
            f"({shutil.disk_usage(existing).free / 1e9:.1f} GB free): {error.strerror or error}; "
            "make room, or choose fewer total_frames or another run_dir"
        ) from error
    return [path for path in sizes if path not in before]
