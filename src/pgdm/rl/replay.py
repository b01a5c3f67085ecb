"""The replay: all frames that an off-policy learner has seen, as files in the run folder."""

from __future__ import annotations

import contextlib
import errno
import json
import math
import os
import shutil
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from tensordict import MemoryMappedTensor, TensorDict
from torch import Tensor
from torchrl.data import TensorDictReplayBuffer, TensorStorage

from pgdm.errors import CheckpointError, RunError
from pgdm.paths import free_bytes, replacing

_SUFFIX, _ABOUT = ".bin", "columns.json"
_COPIED_FRAMES = 65_536


@dataclass(frozen=True)
class Column:
    """One number or vector of every frame."""

    dtype: torch.dtype
    shape: tuple[int, ...] = ()
    entries: tuple[str, ...] = ()
    """Names of a vector's entries, for readers of the file."""

    @property
    def nbytes(self) -> int:
        """Bytes of one frame."""
        return math.prod(self.shape) * self.dtype.itemsize


class Replay:
    """Frames in the order in which they were seen, sampled uniformly.

    Each column is a file. Disk space is reserved in full at the start, so that a full disk is found
    then and not in the middle of a run. Frames in the files survive the death of the process. A
    checkpoint holds the number of frames and a checksum of each column instead of a copy; frames
    appended after the checkpoint are overwritten when the run is resumed.

    Args:
        columns: the values of a frame, by name.
        capacity: number of frames to reserve room for.
        batch_size: frames in a sample.
        generator: random stream of the sampled rows.
        folder: folder of the files, or None to keep the frames in memory.
        mirror: device that holds a copy of all frames and draws the samples; the files are then
            written by ``state_dict`` only, not by every ``append``.

    Raises:
        RunError: if the files cannot be created, for example on a full disk.
    """

    def __init__(
        self,
        columns: Mapping[str, Column],
        capacity: int,
        batch_size: int,
        generator: torch.Generator,
        folder: Path | None = None,
        mirror: torch.device | None = None,
    ) -> None:
        self.columns, self.capacity, self.folder = dict(columns), capacity, folder
        self._made: list[Path] = []
        if folder is None:
            data = {n: torch.zeros(capacity, *c.shape, dtype=c.dtype) for n, c in columns.items()}
        else:
            self._made = _reserve(folder, self.columns, capacity)
            if self._made:  # else the files may be another run's: see load_state_dict
                _describe(folder, self.columns)
            data = {
                name: MemoryMappedTensor.from_filename(
                    str(folder / f"{name}{_SUFFIX}"), c.dtype, torch.Size((capacity, *c.shape))
                )
                for name, c in columns.items()
            }
        self._data = TensorDict(data, batch_size=[capacity])
        self._live = self._data if mirror is None else self._data.to(mirror).clone()
        self._buffer = TensorDictReplayBuffer(
            storage=TensorStorage(self._live), generator=generator, batch_size=batch_size
        )
        self._crc, self._stored = dict.fromkeys(columns, 0), 0
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
        if self._live is self._data:
            self._stored_too(rows, count)

    def sample(self) -> TensorDict:
        """Return ``batch_size`` frames drawn uniformly, with replacement, all floats as float32."""
        drawn = self._buffer.sample()
        return drawn.apply(lambda x: x.float() if x.dtype == torch.float16 else x)

    def sync(self) -> None:
        """Wait until the files are on disk: checkpoints must not refer to unwritten frames."""
        for path in self._files():
            with open(path, "rb") as file:
                os.fsync(file.fileno())

    def state_dict(self) -> dict[str, Any]:
        """Complete the files; return the number of frames and the checksum of each column."""
        for start in range(self._stored, len(self), _COPIED_FRAMES):
            new = slice(start, min(start + _COPIED_FRAMES, len(self)))
            rows = {name: self._live.get(name)[new].cpu() for name in self.columns}
            self._data[new] = TensorDict(rows, batch_size=[new.stop - new.start])
            self._stored_too(rows, new.stop - new.start)
        self.sync()
        return {"frames": len(self), "crc32": dict(self._crc)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue after the first ``frames`` frames of the files, as counted by the state.

        Raises:
            CheckpointError: if there are more frames than the capacity, or the files do not hold
                them. The replay is then as before: a state with fewer frames may be tried.
        """
        frames, expected = int(state["frames"]), state["crc32"]
        where = self.folder or "the memory"
        if frames > self.capacity:
            raise CheckpointError(
                f"the checkpoint has {frames:,} frames, but the replay in {where} has room for "
                f"only {self.capacity:,}; resume with more total_frames"
            )
        if frames and self._made:
            raise CheckpointError(
                f"the replay in {where} is gone (it lacks {self._made[0].name}): it is removed "
                "when a run has finished, unless keep_replay=true; start anew in another run_dir, "
                "with all the total_frames that you want"
            )
        for name in self.columns:
            found = zlib.crc32(self._data.get(name)[:frames].numpy().data)
            if found != expected.get(name):
                raise CheckpointError(
                    f"the replay in {where} does not hold the {frames:,} frames of the "
                    f"checkpoint (column '{name}' differs): it was cut, altered, or is of another "
                    "run; restore it, or start anew in another run_dir"
                )
        if self.folder is not None:
            _describe(self.folder, self.columns)
        self._crc = {name: int(expected[name]) for name in self.columns}
        self._stored = frames
        if self._live is not self._data:
            self._live[:frames].copy_(self._data[:frames])
        self._set_length(frames)

    def _stored_too(self, rows: Mapping[str, Tensor], count: int) -> None:
        """Include the next ``count`` frames of the files in the checksums."""
        self._stored += count
        for name, values in rows.items():
            self._crc[name] = zlib.crc32(values.numpy().data, self._crc[name])

    def _set_length(self, frames: int) -> None:
        storage = {"_storage": {}, "initialized": True, "_len": frames}
        self._buffer.storage.load_state_dict(storage)
        self._buffer.writer.load_state_dict({"_cursor": frames % self.capacity})

    def _files(self) -> list[Path]:
        return [] if self.folder is None else sorted(self.folder.glob(f"*{_SUFFIX}"))


def _describe(folder: Path, columns: Mapping[str, Column]) -> None:
    """Write ``columns.json``, which describes the files to readers without pgdm."""
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
    """Extend each column's file to its final size, keeping its contents.

    Returns:
        The files that were missing.

    Raises:
        RunError: if there is no room or no permission; the files are then as before.
    """
    sizes = {folder / f"{name}{_SUFFIX}": c.nbytes * capacity for name, c in columns.items()}
    before = {path: path.stat().st_size for path in sizes if path.exists()}
    try:
        folder.mkdir(parents=True, exist_ok=True)
        disk = shutil.disk_usage(folder)  # all zero if the file system does not report it
        if disk.total and sum(sizes.values()) - sum(before.values()) > disk.free:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        for path, size in sizes.items():
            # O_RDWR without O_APPEND: on file systems that cannot reserve (NFS), posix_fallocate
            # reads and rewrites a byte of each block instead.
            descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)
            try:
                os.posix_fallocate(descriptor, 0, size)
            finally:
                os.close(descriptor)
    except OSError as error:
        for path in sizes:
            with contextlib.suppress(OSError):
                os.truncate(path, before[path]) if path in before else path.unlink()
        raise RunError(
            f"cannot reserve {sum(sizes.values()) / 1e9:.1f} GB for the replay in {folder} "
            f"({free_bytes(folder) / 1e9:.1f} GB free): {error.strerror or error}; "
            "make room, or choose fewer total_frames or another run_dir"
        ) from error
    return [path for path in sizes if path not in before]
