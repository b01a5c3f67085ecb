"""MLflow: a store, and one run in it. Everything here talks to MLflow at once and waits."""

from __future__ import annotations

import contextlib
import logging
import os
import shutil
import tempfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from filelock import FileLock

from pgdm.errors import TrackingError
from pgdm.paths import TEMPORARY, replacing
from pgdm.tracking import metric_names
from pgdm.tracking.run_folder import ARTIFACTS, LINK, RunFolder, flatten, write_json
from pgdm.tracking.run_log import FILE_NAME
from pgdm.tracking.thin import Point

if TYPE_CHECKING:
    from mlflow import MlflowClient
    from mlflow.entities import Run

DATABASE = "mlflow.db"
PARENT_TAG = "mlflow.parentRunId"
SYNCED = "synced"
"""Tag with the fingerprint of the records that are in MLflow, all of them."""
STATUS = {
    "running": "RUNNING",
    "finished": "FINISHED",
    "interrupted": "KILLED",
    "killed": "KILLED",
    "failed": "FAILED",
}
_BATCH = 1000  # metrics in one call, the server's limit
_PARAMS = 100  # parameters in one call, likewise
_MACHINE_KEYS = ("run_dir", "resume")  # where a run lies is a tag: it may move
# Without it the pages open as those of a language model's traces.
_EXPERIMENT_TAGS = {"mlflow.experimentKind": "custom_model_development"}
_LOCK_S = 120.0
_SETTINGS = {
    "MLFLOW_DISABLE_TELEMETRY": "true",
    "DO_NOT_TRACK": "true",
    "GIT_PYTHON_REFRESH": "quiet",
    "MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT": "true",  # stdout is for results
    # A server that does not answer is tried again by the tracker, not waited for in a call.
    "MLFLOW_HTTP_REQUEST_MAX_RETRIES": "1",
    "MLFLOW_HTTP_REQUEST_TIMEOUT": "10",
}


def store_uri(root: Path) -> str:
    """Return the address of the SQLite store of a folder of runs."""
    return f"sqlite:///{root.absolute() / DATABASE}"


def environment() -> dict[str, str]:
    """Return the environment for MLflow: it sends nothing about its use to anybody."""
    return {**_SETTINGS, **os.environ}


@dataclass(frozen=True)
class Store:
    """An MLflow store, ready for runs of one experiment."""

    client: MlflowClient
    uri: str
    experiment_id: str

    @classmethod
    def open(cls, uri: str, experiment: str) -> Store:
        """Open a store; a SQLite file and the experiment are made if they are missing.

        Any number of processes may do so at once: they take turns, because two that create the
        same database break each other.

        Raises:
            TrackingError: if another process holds the lock for minutes.
        """
        file = sqlite_file(uri)
        with _only_one(file):
            if file is not None and not file.exists():
                _create(file)
            client = connect(uri)
            return cls(client, uri, _experiment(client, experiment, file))


def connect(uri: str) -> MlflowClient:
    """Return a quiet client of a store that is there."""
    os.environ.update({k: v for k, v in _SETTINGS.items() if k not in os.environ})
    from mlflow import MlflowClient

    # The first two announce each step of making a database; the third one's complaints come
    # to us as errors as well.
    for name, level in (("mlflow", "WARNING"), ("alembic", "WARNING"), ("urllib3", "ERROR")):
        logging.getLogger(name).setLevel(level)
    return MlflowClient(tracking_uri=uri)


def sqlite_file(uri: str) -> Path | None:
    """Return the file of a SQLite address, or None for another kind of store."""
    return Path(uri.removeprefix("sqlite:///")) if uri.startswith("sqlite:///") else None


@contextlib.contextmanager
def _only_one(file: Path | None) -> Iterator[None]:
    if file is None:
        yield
        return
    file.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(f"{file}.lock", timeout=_LOCK_S)
    try:
        lock.acquire()
    except TimeoutError as error:
        raise TrackingError(f"{file}.lock is held by another process; remove it") from error
    try:
        yield
    finally:
        lock.release()


def _create(file: Path) -> None:
    """Make a database whole or not at all: MLflow does not go on with a half-made one."""
    for stale in file.parent.glob(f"{TEMPORARY}*{file.name}*"):  # of a process that was killed
        stale.unlink()
    with replacing(file) as temp:
        connect(f"sqlite:///{temp}")


def _experiment(client: MlflowClient, name: str, file: Path | None) -> str:
    """Return the id of an experiment, made or brought back if need be."""
    from mlflow.exceptions import MlflowException

    found = client.get_experiment_by_name(name)
    if found is None:
        place = None if file is None else (file.parent / ARTIFACTS / name).as_uri()
        tags = {"mlflow.note.content": metric_names.markdown(), **_EXPERIMENT_TAGS}
        try:
            return client.create_experiment(name, artifact_location=place, tags=tags)
        except MlflowException:  # on a server somebody else may have been faster
            found = client.get_experiment_by_name(name)
            if found is None:
                raise
    if found.lifecycle_stage == "deleted":
        client.restore_experiment(found.experiment_id)
    return found.experiment_id


def find_run(store: Store, folder: RunFolder) -> Run | None:
    """Return the MLflow run that mirrors a folder, or None.

    It is the one that ``mlflow.json`` names, unless the folder is a copy of one that still
    exists; without such a file, the newest one that says it came from this folder.
    """
    from mlflow.exceptions import MlflowException

    named = folder.link.get("run_id")
    if isinstance(named, str):
        try:
            run = store.client.get_run(named)
        except MlflowException:
            run = None  # of another store, or of one that was deleted
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
        store: where to.
        folder: the run.
        run: its MLflow run; None makes a new one.
    """

    def __init__(self, store: Store, folder: RunFolder, run: Run | None) -> None:
        self._store, self._client, self._folder = store, store.client, folder
        if run is None:
            start_ms = int(1000 * folder.started())
            # Named at once: who is killed before the link is written finds it by its folder.
            run = self._client.create_run(
                store.experiment_id,
                start_time=start_ms,
                run_name=folder.name(),
                tags=folder.origin(),
            )
        self.run_id = run.info.run_id
        self._params = dict(run.data.params)

    def link(self, news: Mapping[str, Any]) -> None:
        """Note in the folder which run mirrors it, and what else is new."""
        mine = {"run_id": self.run_id, "uri": self._store.uri}
        write_json(self._folder.path / LINK, {**self._folder.link, **news, **mine})

    def refresh(self, folder: RunFolder) -> None:
        """Go on with the folder read anew."""
        self._folder = folder

    def describe(self, tags: Mapping[str, str]) -> None:
        """Record parameters, tags and the description; a parameter never changes its value."""
        from mlflow.entities import Param, RunTag

        flat = flatten({k: v for k, v in self._folder.config.items() if k not in _MACHINE_KEYS})
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
        """Copy the run's files that are missing there or have another size."""
        there: dict[str, dict[str, int | None]] = {}
        for path, place in self._folder.artifacts():
            if place not in there:
                listed = self._client.list_artifacts(self.run_id, place or None)
                there[place] = {item.path: item.file_size for item in listed}
            name = f"{place}/{path.name}" if place else path.name
            with contextlib.suppress(FileNotFoundError):  # an older checkpoint that just went
                if there[place].get(name) != path.stat().st_size:
                    self.artifact(path, place)

    def artifact(self, path: Path, place: str) -> None:
        """Copy one file."""
        with tempfile.TemporaryDirectory(prefix="pgdm-") as folder:
            if path.name == FILE_NAME:
                # A server takes what is added while it is sent for the start of another request.
                path = Path(shutil.copy2(path, folder))
            self._client.log_artifact(self.run_id, str(path), place or None)

    def poster(self, path: Path, frames: int) -> None:
        """Show a picture on the run's page, with a slider over frames."""
        from PIL import Image

        with Image.open(path) as picture:
            self._client.log_image(self.run_id, picture, key="evaluation", step=frames)

    def posters(self) -> None:
        """Show the posters of all films in the folder."""
        for path in sorted((self._folder.path / "videos").glob("*.png")):
            digits = "".join(filter(str.isdigit, path.stem))
            self.poster(path, int(digits or 0))

    def set_status(self, status: str, end_s: float | None = None) -> None:
        """Set the run's status, and when it ended unless it is running."""
        if status == "running":
            self._client.update_run(self.run_id, status=STATUS[status])
        else:
            end_ms = None if end_s is None else int(1000 * end_s)
            self._client.set_terminated(self.run_id, STATUS.get(status, "FAILED"), end_ms)
