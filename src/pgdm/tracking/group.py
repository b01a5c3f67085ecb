"""An MLflow run under which others are nested, such as the jobs of a sweep."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from pgdm.runs.files import LINK, read_json, write_json
from pgdm.runs.folder import PARENT, RunFolder
from pgdm.tracking.mlflow import STATUS, Store, find_run, one_line_errors
from pgdm.tracking.sync import sync_run


class Group:
    """An MLflow run with others nested below it. Methods raise TrackingError if MLflow fails.

    Args:
        folder: folder of the group; its ``mlflow.json`` names the group's run.
        uri: store of the group.
        experiment: MLflow experiment of the group's runs.
    """

    def __init__(self, folder: Path, uri: str, experiment: str) -> None:
        self.folder, self.uri, self._experiment = folder.absolute(), uri, experiment

    @property
    def opened(self) -> bool:
        """Whether the group's run was created in this store."""
        return self._link.get("uri") == self.uri

    def open(self, name: str, tags: Mapping[str, str]) -> None:
        """Create store, MLflow experiment and run if missing, and set the status to running."""
        from mlflow.entities import RunTag

        with one_line_errors(f"MLflow at {self.uri}"):
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
        """Let the MLflow run of a run folder be nested under the group's, in the same store.

        Only ``mlflow.json`` is written; the run's own tracker or ``pgdm runs sync`` reads it later.
        """
        run_dir.mkdir(parents=True, exist_ok=True)
        parent = {"run_id": self._link.get("run_id"), "uri": self.uri}
        write_json(run_dir / LINK, {**read_json(run_dir / LINK), PARENT: parent})

    def correct(self, run_dir: Path) -> None:
        """Correct the MLflow status of a nested run that was killed, from its folder.

        If the folder shows the run as finished, missing records are added as well.
        """
        folder = RunFolder(run_dir)
        status = folder.status()
        if not folder.parent() or status == "running":
            return
        with one_line_errors(f"MLflow at {self.uri}"):
            store = Store.open(self.uri, self._experiment)
            if status == "finished":  # MLflow may lack its last records, or all
                sync_run(store, folder)
                return
            # The run may have been killed before it wrote mlflow.json.
            run = find_run(store, folder)
            if run is not None and run.info.status == STATUS["running"]:
                ended_ms = int(1000 * folder.modified())
                store.client.set_terminated(run.info.run_id, STATUS[status], ended_ms)

    def close(self, status: str) -> None:
        """Set how the group ended: ``finished``, ``interrupted`` or ``failed``."""
        with one_line_errors(f"MLflow at {self.uri}"):
            client = Store.open(self.uri, self._experiment).client
            client.set_terminated(str(self._link.get("run_id")), STATUS[status])
        write_json(self.folder / LINK, {**self._link, "status": status})

    @property
    def _link(self) -> dict[str, str]:
        return read_json(self.folder / LINK)
