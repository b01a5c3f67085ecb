"""A run folder: its settings, records, result and status, which can be read in any state."""

from __future__ import annotations

import contextlib
import hashlib
import os
import socket
import time
from collections.abc import Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from pgdm import files, paths
from pgdm.errors import RunError
from pgdm.runs.config_file import as_text, read_config
from pgdm.runs.files import (
    CHECKPOINTS,
    CONFIG,
    CONFIG_KINDS,
    LINK,
    LINK_KINDS,
    LOCK,
    LOG,
    RESULT,
    RESULT_KINDS,
    VIDEOS,
    fault,
    read_json,
)
from pgdm.runs.log import RunLog

PARENT = "parent"
"""Key in ``mlflow.json``: the MLflow run below which this one is nested, and its store."""
ARTIFACTS = "mlflow-artifacts"
"""Folder next to ``mlflow.db`` with MLflow's copies of files; it is not searched for runs."""
STATUSES = ("running", "finished", "interrupted", "failed")
SILENT_S = 600.0
"""If the lock file is missing or locks do not work, a run without a result counts as killed once it
has written nothing for this long."""

# Tag -> key of its value in config.yaml.
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
FACTS = ("asset_source", "pregrasp_used", "expert_hand", "motion_sha256", "git", "ended_by")
"""Tags that are not settings: the run itself writes them to ``result.json`` and ``mlflow.json``."""


class RunFolder:
    """The folder of one run; ``config.yaml`` and ``result.json`` are read once, when first needed.

    Args:
        path: the folder, which holds ``config.yaml``.
    """

    def __init__(self, path: Path) -> None:
        self.path = path.absolute()
        self.log = RunLog(self.path / LOG)

    @cached_property
    def config(self) -> dict[str, Any]:
        """The run's settings as plain containers.

        Raises:
            RunError: if ``config.yaml`` is missing, is not valid YAML, is no mapping or holds
                values of wrong types.
        """
        config = read_config(self.path)
        if wrong := fault(config, CONFIG_KINDS):
            raise RunError(f"cannot read {self.path / CONFIG}: it is damaged ({wrong})")
        return config

    @cached_property
    def result(self) -> dict[str, Any]:
        """Contents of ``result.json``; {} if it is missing or damaged.

        It is missing while the run continues, and if the run was killed.

        Raises:
            RunError: if it holds values of wrong types.
        """
        result = read_json(self.path / RESULT)
        if wrong := fault(result, RESULT_KINDS):
            raise RunError(
                f"cannot read {self.path / RESULT}: it is damaged ({wrong}); remove it, and the "
                "run's own command writes it again"
            )
        return result

    @property
    def link(self) -> dict[str, Any]:
        """Contents of ``mlflow.json``; {} if it is missing or damaged."""
        link = read_json(self.path / LINK)
        return {} if fault(link, LINK_KINDS) else link

    def parent(self) -> dict[str, str]:
        """Return ``run_id`` and ``uri`` of the MLflow run below which this one is nested, or {}."""
        parent = self.link.get(PARENT)
        return parent if isinstance(parent, dict) else {}

    def setting(self, key: str) -> Any:
        """Return a setting by its dotted key, or None if there is none."""
        value: Any = self.config
        for part in key.split("."):
            value = value.get(part) if isinstance(value, Mapping) else None
        return value

    def tags(self) -> dict[str, str]:
        """Return the values of ``TAGS`` and ``FACTS``, folder and host, as text."""
        found = {tag: self.setting(key) for tag, key in TAGS.items()}
        found |= {fact: self.result.get(fact, self.link.get(fact)) for fact in FACTS}
        texts = {name: as_text(value) for name, value in found.items() if value is not None}
        return {**texts, **self.origin()}

    def origin(self) -> dict[str, str]:
        """Return folder and host, since other machines may have folders of the same name."""
        return {"run_dir": str(self.path), "host": socket.gethostname()}

    def name(self) -> str:
        """Return a short display name, most specific part first, since lists cut off the end."""
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
        """Whether a process holds the folder's lock; False where locks do not work."""
        return self._locked() is True

    def _locked(self) -> bool | None:
        """Return whether a process holds the lock; None if there is no lock file or no locking."""
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
        """Return the requested length, frames; 0 if unknown."""
        total = self.setting("total_frames")
        return total if isinstance(total, int) else 0

    def modified(self) -> float:
        """Return when settings, records or result were last written, s since the epoch, or 0."""
        written = (self.path / name for name in (LOG, RESULT, CONFIG))
        return max((file.stat().st_mtime for file in written if file.exists()), default=0.0)

    def started(self) -> float:
        """Return roughly when the run started, s since the epoch."""
        config, log = self.path / CONFIG, self.log.path
        times = [config.stat().st_mtime] if config.exists() else [time.time()]
        lines = self.log.tail()
        if lines:
            times.append(log.stat().st_mtime - float(lines[-1].get("time_s", 0.0)))
        return min(times)

    def fingerprint(self) -> str:
        """Return a hash of the run's records and result.

        Raises:
            RunError: if one of the two files exists but cannot be read.
        """
        digest = hashlib.sha256()
        for file in (self.log.path, self.path / RESULT):
            try:
                digest.update(files.read_bytes(file) if file.is_file() else b"-")
            except OSError as error:
                raise RunError(f"cannot read {file}: {files.reason(error)}") from error
        return digest.hexdigest()[:16]

    def artifacts(self) -> list[tuple[Path, str]]:
        """Return the files that a tracker should copy, each with its subfolder.

        Files of more than ``files.MOST_BYTES`` are left out.
        """
        plain = [(self.path / name, "") for name in (CONFIG, RESULT, LOG)]
        checkpoints = self.path / CHECKPOINTS
        newest = sorted(checkpoints.glob("frames_*.ckpt"))[-1:]
        videos = sorted((self.path / VIDEOS).glob("*.[mp][pn][4g]"))
        found = plain + [(file, VIDEOS) for file in videos]
        found += [(file, CHECKPOINTS) for file in [checkpoints / "best.ckpt", *newest]]
        whole = [(file, place) for file, place in found if file.is_file()]
        return [(f, place) for f, place in whole if f.stat().st_size <= files.MOST_BYTES]


def check_links(run_dir: Path) -> None:
    """Refuse a run folder with a link that leads out of it.

    Through such a link pgdm would read or write files elsewhere.

    Raises:
        RunError: if there is such a link.
    """
    for folder, subfolders, names in files.walk(run_dir):
        for path in (Path(folder, name) for name in (*subfolders, *names)):
            if path.is_symlink() and paths.leaves(path, run_dir):
                raise RunError(
                    f"{path} is a link to {os.readlink(path)}, outside of its run folder; if you "
                    "trust it, put a copy in its place"
                )


def holds_run(run_dir: Path, resume: str) -> bool:
    """Return whether a folder holds a run, and check that ``resume`` permits using it.

    Args:
        run_dir: the folder; it may be missing.
        resume: ``must`` permits only an existing run, ``never`` only a new one, ``auto`` both.

    Raises:
        RunError: if ``resume`` forbids the use, the folder holds something other than a run, or a
            link in it leads out of it.
    """
    if run_dir.exists() and not run_dir.is_dir():
        raise RunError(f"run_dir '{run_dir}' is a file; choose a folder")
    if (run_dir / CONFIG).exists():
        if resume == "never":
            raise RunError(f"'{run_dir}' holds a run and resume=never; choose another run_dir")
        check_links(run_dir)
        return True
    if resume == "must":
        raise RunError(f"'{run_dir}' holds no run and resume=must; check run_dir")
    # A run that stopped before it wrote its settings may leave these two files.
    if run_dir.is_dir() and any(path.name not in (LOCK, LINK) for path in run_dir.iterdir()):
        raise RunError(f"'{run_dir}' is not empty and holds no run; choose another run_dir")
    return False


@contextlib.contextmanager
def claimed(run_dir: Path) -> Iterator[None]:
    """Hold the lock of a run folder, which is created if missing.

    Raises:
        RunError: if another process holds it, or the folder cannot be written.
    """
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        lock = FileLock(run_dir / LOCK)
        lock.acquire(timeout=0.5)  # listing runs holds the lock briefly
    except Timeout as error:
        raise RunError(f"another process is using '{run_dir}'; wait for it or stop it") from error
    except OSError as error:
        raise RunError(f"cannot write run_dir '{run_dir}': {error.strerror or error}") from error
    try:
        yield
    finally:
        lock.release()


def located(path: Path) -> Path:
    """Return a path; if it exists only below the folder of runs, put that folder before it.

    ``pgdm runs`` lists runs relative to the folder of runs.
    """
    below = paths.runs() / path
    return below if below.exists() and not path.exists() else path


def folder_of(path: Path) -> Path:
    """Return the run folder that a path refers to.

    Args:
        path: a run folder, or a checkpoint in one; see ``located``.

    Raises:
        RunError: if ``path`` is neither.
    """
    path = located(path)
    if path.is_file():
        for folder in path.absolute().parents[:2]:
            if (folder / CONFIG).is_file():
                return folder
        raise RunError(f"'{path}' is in no run folder: no {CONFIG} next to it or one level up")
    if not path.is_dir():
        raise RunError(f"there is no run folder or checkpoint '{path}'; pgdm runs lists the runs")
    if not (path / CONFIG).is_file():
        raise RunError(f"'{path}' holds no run: it has no {CONFIG}; pgdm runs lists the runs")
    return path


def find_runs(root: Path) -> list[RunFolder]:
    """Return all runs in a folder, at any depth, sorted by path."""
    return [RunFolder(path) for path in sorted(_walk(root))]


def _walk(root: Path) -> Iterator[Path]:
    for folder, subfolders, names in files.walk(root):
        if CONFIG in names:
            subfolders.clear()  # no run is inside another one
            yield Path(folder)
        else:
            subfolders[:] = [s for s in subfolders if s != ARTIFACTS and not s.startswith(".")]


def runs_root(run_dir: Path) -> Path:
    """Return the folder of runs that a run belongs to, where ``mlflow.db`` is by default.

    If the run is below ``runs`` in the working directory, its folder of runs is ``runs``, else the
    parent of the run folder.
    """
    run_dir, default = run_dir.absolute(), paths.runs().absolute()
    return default if run_dir.is_relative_to(default) else run_dir.parent
