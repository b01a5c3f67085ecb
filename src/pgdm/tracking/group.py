"""A run of MLflow under which others are shown, such as the jobs of a sweep."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path

from pgdm.errors import TrackingError
from pgdm.tracking.mlflow import STATUS, Store, find_run
from pgdm.tracking.run_folder import LINK, PARENT, RunFolder, read_json, write_json
from pgdm.tracking.sync import sync_run


class Group:
    """One such run. Every method that talks to MLflow raises TrackingError if that fails.

    Args:
        folder: of the group; its ``mlflow.json`` says which run it is.
        uri: store of the group.
        experiment: in which its runs are.
    """

    def __init__(self, folder: Path, uri: str, experiment: str) -> None:
        self.folder, self.uri, self._experiment = folder.absolute(), uri, experiment

    @property
    def opened(self) -> bool:
        """Whether its run was made in this store."""
        return self._link.get("uri") == self.uri

    def open(self, name: str, tags: Mapping[str, str]) -> None:
        """Make store, experiment and run if they are missing, and say that it is running."""
        from mlflow.entities import RunTag

        with _told(self.uri):
            store = Store.open(self.uri, self._experiment)
            folder = RunFolder(self.folder)
            mine = {**folder.origin(), "kind": "sweep", **tags}
            run = find_run(store, folder)
            if run is None:
                run = store.client.create_run(store.experiment_id, run_name=name, tags=mine)
            run_id = run.info.run_id
            store.client.log_batch(run_id, tags=[RunTag(key, text) for key, text in mine.items()])
            store.client.update_run(run_id, status=STATUS["running"])
        link = {"run_id": run_id, "uri": self.uri, "experiment": self._experiment}
        write_json(self.folder / LINK, {**link, "status": "running"})

    def adopt(self, run_dir: Path) -> None:
        """Have the run of a folder shown under this one, in the same store."""
        run_dir.mkdir(parents=True, exist_ok=True)
        parent = {"run_id": self._link.get("run_id"), "uri": self.uri}
        write_json(run_dir / LINK, {**read_json(run_dir / LINK), PARENT: parent})

    def correct(self, run_dir: Path) -> None:
        """Give a run that was killed the status that its folder tells, if it is of this group."""
        folder = RunFolder(run_dir)
        status = folder.status()
        if not folder.parent() or status == "running":
            return
        with _told(self.uri):
            store = Store.open(self.uri, self._experiment)
            if status == "finished":  # nobody else tells the rest, or even that it was there
                sync_run(store, folder)
                return
            # Its folder may not name it: it was killed before it could write that down.
            run = find_run(store, folder)
            if run is not None and run.info.status == STATUS["running"]:
                ended_ms = int(1000 * folder.modified())
                store.client.set_terminated(run.info.run_id, STATUS[status], ended_ms)

    def close(self, status: str) -> None:
        """Say how it ended: ``finished``, ``interrupted`` or ``failed``."""
        with _told(self.uri):
            client = Store.open(self.uri, self._experiment).client
            client.set_terminated(str(self._link.get("run_id")), STATUS[status])
        write_json(self.folder / LINK, {**self._link, "status": status})

    @property
    def _link(self) -> dict[str, str]:
        return read_json(self.folder / LINK)


@contextlib.contextmanager
def _told(uri: str) -> Iterator[None]:
    from mlflow.exceptions import MlflowException

    try:
        yield
    except (MlflowException, OSError) as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise TrackingError(f"MLflow at {uri}: {reason}") from error
