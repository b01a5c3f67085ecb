"""``metrics.jsonl``, the append-only record of a run's metrics, which trackers mirror."""

from __future__ import annotations

import json
import logging
import math
import os
from collections.abc import Iterable, Mapping
from pathlib import Path

from pgdm import files
from pgdm.errors import RunError
from pgdm.paths import replacing

HEADER = ("frames", "iteration", "time_s", "kind")
"""Keys of a record that are not metrics."""
_TAIL_BYTES = 1 << 18  # a few hundred lines
_EVALUATION = b'"kind": "eval"'  # as `append` writes it

_log = logging.getLogger(__name__)

Record = dict[str, float | int | str]


class RunLog:
    """A file of records, one JSON object per line.

    A process that dies while writing leaves at most one unfinished last line: readers skip it and
    the next ``append`` removes it. Values that are not finite are stored as ``null`` and read back
    as NaN, so that every line is valid JSON.

    Args:
        path: the file; its folder must exist.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def append(
        self, metrics: Mapping[str, float], *, frames: int, iteration: int, time_s: float, kind: str
    ) -> None:
        """Add one line.

        Args:
            metrics: name to value.
            frames: environment steps so far, all simulations together.
            iteration: learner iterations so far.
            time_s: wall time so far, s, all attempts together.
            kind: ``train`` or ``eval``.

        Raises:
            RunError: if the file cannot be written (folder gone, disk full, read-only).
        """
        values = {name: _finite(value) for name, value in metrics.items()}
        record = {"frames": frames, "iteration": iteration, "time_s": round(time_s, 3)}
        line = json.dumps({**record, "kind": kind, **values}, allow_nan=False) + "\n"
        try:
            with open(self.path, "ab") as file:
                _drop_unfinished_line(self.path, file.tell())
                file.write(line.encode())
        except OSError as error:
            raise RunError(
                f"cannot write {self.path}: {error.strerror or error}; make room or give write "
                "access, then start the same command again: it resumes from the last checkpoint"
            ) from error

    def read(self) -> list[Record]:
        """Return all records in order; of those with equal kind and frames only the last one.

        Damaged lines are skipped with a warning.

        Raises:
            RunError: if the file exists but cannot be read.
        """
        records = []
        lines = self._raw().split(b"\n")
        for number, line in enumerate(lines[:-1], start=1):  # the last has no newline: unfinished
            record = _parse(line)
            if record is None:
                _log.warning("%s: line %d is damaged and skipped", self.path, number)
            else:
                records.append(record)
        return _last_of_each(records)

    def tail(self, size_bytes: int = _TAIL_BYTES) -> list[Record]:
        """Return the last records, those in the last ``size_bytes`` of the file.

        Raises:
            RunError: if the file exists but cannot be read.
        """
        lines = self._raw(size_bytes).split(b"\n")[:-1]  # the first line may lack its beginning
        return [record for line in lines if (record := _parse(line))]

    def _raw(self, last_bytes: int | None = None) -> bytes:
        """Return the file's bytes, or its last ones; empty if it is missing."""
        try:
            with files.open_file(self.path) as file:
                if last_bytes is None:
                    return files.whole(file)
                file.seek(max(0, file.seek(0, os.SEEK_END) - last_bytes))
                return file.read(last_bytes)
        except (FileNotFoundError, NotADirectoryError):
            return b""
        except OSError as error:
            raise RunError(f"cannot read {self.path}: {error.strerror or error}") from error

    def thinned(self, points: int) -> list[Record]:
        """Return every evaluation, and about ``points`` other records, evenly spread.

        Only these are parsed: a run of 50M frames has 12,000 lines, of which 50 are evaluations.

        Raises:
            RunError: if the file exists but cannot be read.
        """
        raw = self._raw()
        starts = {raw.rfind(b"\n", 0, len(raw) * i // points) + 1 for i in range(points)}
        at = raw.find(_EVALUATION)
        while at >= 0:
            starts.add(raw.rfind(b"\n", 0, at) + 1)
            at = raw.find(_EVALUATION, at + 1)
        ends = ((start, raw.find(b"\n", start)) for start in sorted(starts))
        records = (_parse(raw[start:end]) for start, end in ends if end >= 0)  # whole lines
        return _last_of_each(record for record in records if record is not None)

    def truncate(self, frames: int) -> int:
        """Drop all records after ``frames``, atomically: a resumed run writes them again.

        Damaged and unfinished lines are dropped as well.

        Returns:
            Number of lines dropped.

        Raises:
            RunError: if the file cannot be read or written.
        """
        if not self.path.exists():
            return 0
        lines = [line for line in self._raw().split(b"\n") if line]
        whole = [line for line in lines if (r := _parse(line)) and int(r["frames"]) <= frames]
        if len(whole) == len(lines):
            return 0
        try:
            with replacing(self.path) as temp:
                temp.write_bytes(b"".join(line + b"\n" for line in whole))
        except OSError as error:
            raise RunError(f"cannot write {self.path}: {error.strerror or error}") from error
        return len(lines) - len(whole)


def metrics_of(record: Record) -> dict[str, float]:
    """Return the finite metrics of a record, without frames, iteration, time and kind."""
    values = {name: float(v) for name, v in record.items() if name not in HEADER}
    return {name: value for name, value in values.items() if math.isfinite(value)}


def _last_of_each(records: Iterable[Record]) -> list[Record]:
    kept: dict[tuple[str, int], Record] = {}
    for record in records:
        key = (str(record["kind"]), int(record["frames"]))
        kept.pop(key, None)  # the later record keeps its position
        kept[key] = record
    return list(kept.values())


def _finite(value: float) -> float | None:
    number = float(value)
    return number if math.isfinite(number) else None


def _drop_unfinished_line(path: Path, size: int) -> None:
    """Cut off what follows the last newline."""
    if size == 0:
        return
    with open(path, "rb+") as file:
        file.seek(size - 1)
        if file.read(1) == b"\n":
            return
        file.seek(0)
        end = file.read().rfind(b"\n") + 1
        file.truncate(end)


def _parse(line: bytes) -> Record | None:
    try:
        record = files.parse_json(line)
    except ValueError:
        return None
    if not isinstance(record, dict) or not isinstance(record.get("frames"), int):
        return None
    if not isinstance(record.get("kind"), str) or not all(
        value is None or isinstance(value, int | float) or name == "kind"
        for name, value in record.items()
    ):
        return None
    return {name: math.nan if value is None else value for name, value in record.items()}
