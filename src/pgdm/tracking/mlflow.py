"""MLflow: a store, and one run in it. Every call here blocks until MLflow has answered."""

from __future__ import annotations

import contextlib
import io
import logging
import os
import shutil
import sqlite3
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock

from pgdm import files
from pgdm.errors import TrackingError
from pgdm.paths import TEMPORARY, as_name, inside, replacing
from pgdm.runs.config_file import as_text, dotted
from pgdm.runs.files import LINK, LOG, VIDEOS, write_json
from pgdm.runs.folder import ARTIFACTS, RunFolder
from pgdm.tracking import metric_names
from pgdm.tracking.thin import Point

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

DATABASE = "mlflow.db"
PARENT_TAG = "mlflow.parentRunId"
SYNCED = "synced"
"""Tag set when MLflow has all records of a run: the fingerprint of its folder."""
STATUS = {
    "running": "RUNNING",
    "finished": "FINISHED",
    "interrupted": "KILLED",
    "failed": "FAILED",
}
_BATCH, _PARAMS = 1000, 100  # the server's limits: metrics and parameters per call
_MACHINE_KEYS = ("run_dir", "resume")  # not parameters: a run may move, and its folder is a tag
# Without this tag MLflow's pages open on its view for traces of language models.
_EXPERIMENT_TAGS = {"mlflow.experimentKind": "custom_model_development"}
_LOCK_S = 120.0
_SETTINGS = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "DO_NOT_TRACK": "true",
    "GIT_PYTHON_REFRESH": "quiet",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",  # stdout is for results
    # If a server does not answer, the tracker retries later instead of waiting in the call.
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
}


def store_uri(root: Path) -> str:
    """Return the address of the SQLite store of a folder of runs."""
    return f"sqlite:///{root.absolute() / DATABASE}"


def is_own(uri: str, folder: Path) -> bool:
    """Return whether a store is the SQLite store of a folder, or of a folder above it.

    Any other store that a file in the folder names is not used: somebody else may have made the
    file.
    """
    file, real = sqlite_file(uri), folder.resolve()
    at = None if file is None else file.parent.resolve()
    return file is not None and file.name == DATABASE and at in (real, *real.parents)


def environment() -> dict[str, str]:
    """Return the environment for MLflow's processes, with its usage reports switched off.

    Variables that the user has set are kept.
    """
    return {**_SETTINGS, **os.environ}


@dataclass(frozen=True)
class Store:
    """An MLflow store, ready for runs of one MLflow experiment."""

    client: MlflowClient
    uri: str
    experiment_id: str

    @classmethod
    def open(cls, uri: str, experiment: str) -> Store:
        """Open a store; the SQLite file and the experiment are created if missing.

        Any number of processes may do so at the same time: a lock lets one at a time create the
        database, since two would corrupt it.

        Raises:
            TrackingError: if another process holds the lock for two minutes.
        """
        file = sqlite_file(uri)
        with _only_one(file):
            if file is not None and not file.exists():
                _create(file)
            elif file is not None:
                _check_writable(file)
            client = connect(uri)
            return cls(client, uri, _experiment(client, experiment, file))


def connect(uri: str) -> MlflowClient:
    """Return a client of a store, and silence MLflow's progress messages."""
    os.environ.update(environment())
    from mlflow import MlflowClient

    # mlflow and alembic log each step of creating a database; the errors that urllib3 warns of are
    # raised as exceptions as well.
    for name, level in (("mlflow", "WARNING"), ("alembic", "WARNING"), ("urllib3", "ERROR")):
        logging.getLogger(name).setLevel(level)
    return MlflowClient(tracking_uri=uri)


def sqlite_file(uri: str) -> Path | None:
    """Return the file of a SQLite address, or None for another kind of store."""
    file = uri.removeprefix("sqlite:///").partition("?")[0]
    return Path(file) if uri.startswith("sqlite:///") else None


@contextlib.contextmanager
def one_line_errors(where: str) -> Iterator[None]:
    """Turn errors of MLflow, its database and files into a TrackingError, ``where: reason``."""
    os.environ.update(environment())  # before the first import of MLflow
    from mlflow.exceptions import MlflowException
    from sqlalchemy.exc import SQLAlchemyError

    try:
        yield
    except (MlflowException, SQLAlchemyError, OSError, ImportError, ValueError) as error:
        raise TrackingError(f"{where}: {first_line(error)}") from error


def first_line(error: BaseException) -> str:
    """Return the first line of an error's message or, if that is empty, the error's type."""
    return (str(error).splitlines() or [type(error).__name__])[0]


@contextlib.contextmanager
def _only_one(file: Path | None) -> Iterator[None]:
    if file is None:
        yield
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=file.parent):
        pass  # raises at once if the folder cannot be written
    lock = FileLock(f"{file}.lock", timeout=_LOCK_S)
    try:
        lock.acquire()
    except TimeoutError as error:
        raise TrackingError(f"{file}.lock is held by another process; stop it") from error
    try:
        yield
    finally:
        lock.release()


def _check_writable(file: Path) -> None:
    """Raise at once if a file is not a writable database: MLflow would retry for two minutes."""
    with contextlib.closing(sqlite3.connect(f"{file.as_uri()}?mode=rw", uri=True)) as base:
        try:
            base.execute("BEGIN IMMEDIATE")
            base.execute("PRAGMA user_version = 0")  # undone when the database is closed
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode != sqlite3.SQLITE_BUSY:
                raise OSError(f"{file}: {error}") from error
        except sqlite3.DatabaseError as error:
            raise OSError(f"{file}: {error}") from error


def _create(file: Path) -> None:
    """Create a database atomically, since MLflow cannot use a half-created database."""
    for stale in file.parent.glob(f"{TEMPORARY}*{file.name}*"):  # of a process that was killed
        stale.unlink()
    with replacing(file) as temp:
        connect(f"sqlite:///{temp}")


def _experiment(client: MlflowClient, name: str, file: Path | None) -> str:
    """Return the ID of an MLflow experiment, which is created or restored if necessary."""
    from mlflow.exceptions import MlflowException

    found = client.get_experiment_by_name(name)
    if found is None:
        place = None if file is None else inside(file.parent, ARTIFACTS, as_name(name)).as_uri()
        tags = {"mlflow.note.content": metric_names.markdown(), **_EXPERIMENT_TAGS}
        try:
            return client.create_experiment(name, artifact_location=place, tags=tags)
        except MlflowException:  # another process may have created it on the server first
            found = client.get_experiment_by_name(name)
            if found is None:
                raise
    if found.lifecycle_stage == "deleted":
        client.restore_experiment(found.experiment_id)
    return found.experiment_id


def find_run(store: Store, folder: RunFolder) -> Run | None:
    """Return the MLflow run that mirrors a folder, or None.

    This is the run that ``mlflow.json`` names, unless that run is deleted or in another store, or
    the folder is a copy of another folder that still exists. Otherwise it is the newest run that is
    tagged with this folder and host.
    """
    from mlflow.exceptions import MlflowException

    named = folder.link.get("run_id")
    if isinstance(named, str):
        try:
            run = store.client.get_run(named)
        except MlflowException:
            run = None  # in another store, or deleted
        if run is not None and run.info.lifecycle_stage == "active":
            origin = Path(run.data.tags.get("run_dir", folder.path))
            if origin == folder.path or not origin.exists():
                return run
    origin = {name: text.replace("'", "''") for name, text in folder.origin().items()}
    where = " and ".join(f"tags.{name} = '{text}'" for name, text in origin.items())
    found = store.client.search_runs([store.experiment_id], where, max_results=1)
    return found[0] if found else None


class Mirror:
    """Writes one run into a store.

    Args:
        store: the store to write to.
        folder: folder of the run.
        run: its MLflow run; None creates one.
    """

    def __init__(self, store: Store, folder: RunFolder, run: Run | None) -> None:
        self._store, self._client, self._folder = store, store.client, folder
        if run is None:
            start_ms = int(1000 * folder.started())
            # Tagged right away: if the process is killed before it writes mlflow.json, the tags
            # identify the run.
            run = self._client.create_run(
                store.experiment_id,
                start_time=start_ms,
                run_name=folder.name(),
                tags=folder.origin(),
            )
        self.run_id = run.info.run_id
        self._params = dict(run.data.params)

    def link(self, news: Mapping[str, Any]) -> None:
        """Record in ``mlflow.json`` which MLflow run mirrors the folder, and add ``news``."""
        mine = {"run_id": self.run_id, "uri": self._store.uri}
        write_json(self._folder.path / LINK, {**self._folder.link, **news, **mine})

    def refresh(self, folder: RunFolder) -> None:
        """Use ``folder``, the same folder read again."""
        self._folder = folder

    def describe(self, tags: Mapping[str, str]) -> None:
        """Record parameters, tags and the description.

        A parameter cannot change in MLflow: a new value becomes the tag ``now.<name>``.
        """
        from mlflow.entities import Param, RunTag

        config = {k: v for k, v in self._folder.config.items() if k not in _MACHINE_KEYS}
        flat = {name: as_text(value) for name, value in dotted(config).items()}
        new = [Param(name, text) for name, text in flat.items() if name not in self._params]
        changed = {f"now.{n}": t for n, t in flat.items() if self._params.get(n, t) != t}
        texts = {**self._folder.tags(), **tags, **changed}
        texts["mlflow.note.content"] = f"`{self._folder.path}`\n\n{metric_names.markdown()}"
        texts["mlflow.source.name"] = "pgdm-run"
        if parent := self._folder.parent().get("run_id"):
            texts[PARENT_TAG] = parent
        if "git" in texts:
            texts["mlflow.source.git.commit"] = texts["git"].rstrip("+")
        all_tags = [RunTag(name, text) for name, text in texts.items()]
        self._client.log_batch(self.run_id, tags=all_tags)
        for start in range(0, len(new), _PARAMS):
            self._client.log_batch(self.run_id, params=new[start : start + _PARAMS])
        self._params |= {param.key: param.value for param in new}

    def log(self, points: Iterable[Point]) -> None:
        """Record metrics, many in one call."""
        from mlflow.entities import Metric

        metrics = [Metric(k, v, at, step) for step, at, vs in points for k, v in vs.items()]
        for start in range(0, len(metrics), _BATCH):
            self._client.log_batch(self.run_id, metrics=metrics[start : start + _BATCH])

    def artifacts(self) -> None:
        """Copy the run's files that MLflow lacks or has with another size."""
        there: dict[str, dict[str, int | None]] = {}
        for path, place in self._folder.artifacts():
            if place not in there:
                listed = self._client.list_artifacts(self.run_id, place or None)
                there[place] = {item.path: item.file_size for item in listed}
            name = f"{place}/{path.name}" if place else path.name
            with contextlib.suppress(FileNotFoundError):  # a checkpoint that was just removed
                if there[place].get(name) != path.stat().st_size:
                    self.artifact(path, place)

    def artifact(self, path: Path, place: str) -> None:
        """Copy one file."""
        with tempfile.TemporaryDirectory(prefix="pgdm-") as folder:
            if path.name == LOG:
                # The log may grow while it is sent: a server would take the rest for a new request.
                path = Path(shutil.copy2(path, folder))
            self._client.log_artifact(self.run_id, str(path), place or None)

    def poster(self, path: Path, frames: int) -> None:
        """Show a picture on the run's page in MLflow, where a slider selects ``frames``."""
        from PIL import Image

        with Image.open(io.BytesIO(files.read_bytes(path))) as picture:
            self._client.log_image(self.run_id, picture, key="evaluation", step=frames)

    def posters(self) -> None:
        """Show the posters of all videos in the folder."""
        for path in sorted((self._folder.path / VIDEOS).glob("*.png")):
            digits = "".join(filter(str.isdigit, path.stem))
            self.poster(path, int(digits or 0))

    def set_status(self, status: str, end_s: float | None = None) -> None:
        """Set the run's status and, unless it is running, the time it ended, s since the epoch."""
        if status == "running":
            self._client.update_run(self.run_id, status=STATUS[status])
        else:
            end_ms = None if end_s is None else int(1000 * end_s)
            self._client.set_terminated(self.run_id, STATUS.get(status, "FAILED"), end_ms)
