"""Read what a run left in its folder, whatever state it is in."""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import socket
import time
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

import yaml
from filelock import FileLock, Timeout

from pgdm import paths
from pgdm.errors import RunError
from pgdm.tracking.run_log import FILE_NAME, RunLog

CONFIG, RESULT, LINK = "config.yaml", "result.json", "mlflow.json"
PARENT = "parent"
"""Key in ``mlflow.json``: the MLflow run that this one is shown under, and its store."""
ARTIFACTS = "mlflow-artifacts"
"""Folder beside ``mlflow.db`` with MLflow's copies of files."""
STATUSES = ("running", "finished", "interrupted", "failed")
ENDED_BY, TIME_LIMIT = "ended_by", "time_limit"
"""Key in ``result.json`` of a finished run, and its value if the time ended it; else ``frames``."""
WRIST_BOUND = "wrist_bound"
"""Key in ``result.json``: success of the hand alone, if the wrist was planned (0..1)."""
LOCK = ".lock"
"""Held by the process that works in the folder."""
SILENT_S = 600.0
"""Where locks cannot be asked: a run without a result that was silent for so long was killed."""

# Tag of MLflow -> where its value stands in config.yaml.
TAGS = {
    "task": "task.id",
    "hand": "hand.name",
    "method": "method.name",
    "ablation": "ablation.name",
    "pregrasp_source": "pregrasp.source",
    "algo": "algo.name",
    "action": "action.kind",
    "obs": "obs.layout",
    "seed": "seed",
    "budget": "budget",
}
FACTS = ("asset_source", "pregrasp_used", "expert_hand", "motion_sha256", "git")
"""What only the run itself knew, kept in ``result.json`` and ``mlflow.json``."""

_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class RunFolder:
    """One run's folder; nothing is read before it is asked for.

    Args:
        path: the folder, which holds ``config.yaml``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.absolute()
        self.log = RunLog(self.path / FILE_NAME)

    @cached_property
    def config(self) -> dict[str, Any]:
        """The run's configuration as plain containers.

        Raises:
            RunError: if ``config.yaml`` is missing or not a YAML mapping.
        """
        file = self.path / CONFIG
        try:
            config = yaml.load(file.read_text(), Loader=_LOADER)  # as safe, and faster in C
        except (OSError, ValueError, yaml.YAMLError) as error:
            raise RunError(f"cannot read {file}: {_first_line(error)}") from error
        if not isinstance(config, dict):
            raise RunError(f"{file} is not a mapping of settings")
        return config

    @cached_property
    def result(self) -> dict[str, Any]:
        """What ``result.json`` says; empty if the run has not ended in good order."""
        return read_json(self.path / RESULT)

    @property
    def link(self) -> dict[str, Any]:
        """Which MLflow run mirrors this one; empty if none does."""
        return read_json(self.path / LINK)

    def parent(self) -> dict[str, str]:
        """Return ``run_id`` and ``uri`` of the MLflow run that this one belongs to, or nothing."""
        parent = self.link.get(PARENT)
        return parent if isinstance(parent, dict) else {}

    def setting(self, key: str) -> Any:
        """Return a setting by its dotted key, or None if there is none."""
        value: Any = self.config
        for part in key.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        return value

    def tags(self) -> dict[str, str]:
        """Return what identifies the run, as text."""
        found = {tag: self.setting(key) for tag, key in TAGS.items()}
        found |= {fact: self.result.get(fact, self.link.get(fact)) for fact in FACTS}
        texts = {name: _text(value) for name, value in found.items() if value is not None}
        return {**texts, **self.origin()}

    def origin(self) -> dict[str, str]:
        """Return where the run lies; other machines have folders of the same name."""
        return {"run_dir": str(self.path), "host": socket.gethostname()}

    def name(self) -> str:
        """Return a short name for people; what differs most comes first, as lists cut its end."""
        tags = self.tags()
        parts = [tags.get("task"), f"s{tags['seed']}" if "seed" in tags else None]
        parts += [tags.get(tag) for tag in ("method", "algo", "action")]
        return " ".join(part for part in parts if part) or self.path.name

    def status(self) -> str:
        """Return one of ``STATUSES``; a run that was killed counts as interrupted."""
        locked = self._locked()
        if locked:
            return "running"
        status = self.result.get("status")
        if status is not None:
            return status if status in STATUSES else "failed"
        silent = locked is False or time.time() - self.modified() > SILENT_S
        return "interrupted" if silent else "running"

    @property
    def busy(self) -> bool:
        """Whether a process works in the folder, as far as its lock tells."""
        return self._locked() is True

    def _locked(self) -> bool | None:
        """Return whether a process works in the folder; None if that cannot be told."""
        if not (self.path / LOCK).exists():
            return None
        lock = FileLock(self.path / LOCK)
        try:
            lock.acquire(timeout=0)
        except Timeout:
            return True
        except (OSError, NotImplementedError):
            return None
        lock.release()
        return False

    def total_frames(self) -> int:
        """Return how long the run was to be, environment steps; 0 if that is not known."""
        total = self.setting("total_frames")
        return total if isinstance(total, int) else 0

    def modified(self) -> float:
        """Return when the run last wrote something, s since the epoch."""
        files = (self.path / name for name in (FILE_NAME, RESULT, CONFIG))
        return max((file.stat().st_mtime for file in files if file.exists()), default=0.0)

    def started(self) -> float:
        """Return about when the run started, s since the epoch."""
        config, log = self.path / CONFIG, self.log.path
        times = [config.stat().st_mtime] if config.exists() else [time.time()]
        lines = self.log.tail()
        if lines:
            times.append(log.stat().st_mtime - float(lines[-1].get("time_s", 0.0)))
        return min(times)

    def fingerprint(self) -> str:
        """Return a text that changes with the run's records and result."""
        digest = hashlib.sha256()
        for file in (self.log.path, self.path / RESULT):
            digest.update(file.read_bytes() if file.exists() else b"-")
        return digest.hexdigest()[:16]

    def artifacts(self) -> list[tuple[Path, str]]:
        """Return the files worth a copy elsewhere, each with the folder it belongs in."""
        plain = [(self.path / name, "") for name in (CONFIG, RESULT, FILE_NAME)]
        checkpoints = self.path / "checkpoints"
        newest = sorted(checkpoints.glob("frames_*.ckpt"))[-1:]
        videos = sorted((self.path / "videos").glob("*.[mp][pn][4g]"))
        files = plain + [(file, "videos") for file in videos]
        files += [(file, "checkpoints") for file in [checkpoints / "best.ckpt", *newest]]
        return [(file, place) for file, place in files if file.is_file()]


def is_whole(
    result: Mapping[str, Any], total_frames: int, time_limit_min: float | None = 0.0
) -> bool:
    """Return whether a run is finished, and has nothing left to do of what is asked for now.

    Args:
        result: what its ``result.json`` says.
        total_frames: length that is asked for.
        time_limit_min: limit that is asked for, None for no limit; 0: the one that it had.
    """
    if result.get("status") != "finished":
        return False
    limited = result.get(ENDED_BY) == TIME_LIMIT and time_limit_min is not None
    in_time = not limited or result.get("wall_time_s", 0.0) < 60 * (time_limit_min or 0.0)
    return result.get("frames", 0) >= total_frames or not in_time


@contextlib.contextmanager
def claimed(run_dir: Path) -> Iterator[None]:
    """Make a run folder if need be, and keep other processes out of it.

    Raises:
        RunError: if another process has it, or it cannot be written.
    """
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        lock = FileLock(run_dir / LOCK)
        lock.acquire(timeout=0.5)  # whoever lists runs holds it for a moment
    except Timeout as error:
        raise RunError(f"another process is using '{run_dir}'; wait for it or end it") from error
    except OSError as error:
        raise RunError(f"cannot write run_dir '{run_dir}': {error.strerror or error}") from error
    try:
        yield
    finally:
        lock.release()


def find_runs(root: Path) -> list[RunFolder]:
    """Return all runs in a folder, at any depth, in the order of their paths."""
    return [RunFolder(path) for path in sorted(_walk(root))]


def runs_root(run_dir: Path) -> Path:
    """Return the folder of runs that a run belongs to, where ``mlflow.db`` lies by default.

    It is ``runs`` under the working directory for the runs inside it, and otherwise the folder
    that holds the run's own.
    """
    run_dir, default = run_dir.absolute(), paths.runs().absolute()
    return default if run_dir.is_relative_to(default) else run_dir.parent


def flatten(config: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return nested settings as dotted key to text."""
    flat: dict[str, str] = {}
    for key, value in config.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{name}.")
        else:
            flat[name] = _text(value)
    return flat


def read_json(path: Path) -> dict[str, Any]:
    """Return a JSON object from a file; empty if it is missing, damaged or something else."""
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return {}
    return found if isinstance(found, dict) else {}


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write a JSON object, whole or not at all."""
    with paths.replacing(path) as temp:
        temp.write_text(json.dumps(content, indent=1) + "\n")


def _walk(root: Path) -> Iterator[Path]:
    for folder, subfolders, files in os.walk(root):
        if CONFIG in files:
            subfolders.clear()  # nothing inside a run is another run
            yield Path(folder)
        else:
            subfolders[:] = [s for s in subfolders if s != ARTIFACTS and not s.startswith(".")]


def _text(value: Any) -> str:
    if value is None or isinstance(value, bool | list | dict):
        return json.dumps(value)
    return str(value)


def _first_line(error: Exception) -> str:
    return (getattr(error, "strerror", None) or str(error)).splitlines()[0]
