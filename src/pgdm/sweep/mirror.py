"""A sweep in MLflow: one MLflow run with the jobs' runs nested below it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pgdm import paths
from pgdm.errors import TrackingError
from pgdm.library.progress import Notify
from pgdm.runs.files import LINK, read_json
from pgdm.sweep.ledger import RUNNING

if TYPE_CHECKING:
    from pgdm.sweep.plan import Job, Plan
    from pgdm.tracking.group import Group


class SweepMirror:
    """Mirrors a sweep to MLflow; a failure of MLflow is reported once, and the sweep continues.

    Args:
        group: the sweep's MLflow run; None mirrors nothing.
        notify: called with a sentence if MLflow fails.
    """

    def __init__(self, group: Group | None, notify: Notify) -> None:
        self._group, self._notify = group, notify
        self._plan: Plan | None = None
        self._failed = False

    @classmethod
    def of(cls, plan: Plan, notify: Notify) -> SweepMirror:
        """Return the mirror of a plan; it mirrors nothing if no job uses MLflow.

        Store and MLflow experiment are those of the first job that uses MLflow. If that job's
        settings name no store, the sweep keeps the database that it has, or gets one.
        """
        chosen = next((j.cfg.tracking for j in plan.jobs if j.cfg.tracking.kind == "mlflow"), None)
        if chosen is None:
            return cls(None, notify)
        from pgdm.tracking.group import Group
        from pgdm.tracking.mlflow import is_own, sqlite_file, store_uri

        known = str(read_json(plan.folder / LINK).get("uri", ""))
        file = sqlite_file(known)
        stays = is_own(known, plan.folder) and file is not None and file.exists()
        # A sweep below the folder of runs gets the database of that folder, any other its own.
        runs = paths.runs().absolute()
        here = store_uri(runs if plan.folder.is_relative_to(runs) else plan.folder)
        uri = chosen.uri or (known if stays else here)
        return cls(Group(plan.folder, uri, chosen.experiment), notify)

    @classmethod
    def correct_all(cls, folder: Path, dead: Sequence[Path], status: str, notify: Notify) -> None:
        """Correct in MLflow the status of a sweep that no process drives, and of its dead runs.

        Args:
            folder: folder of the sweep.
            dead: run folders of workers that were found dead.
            status: how the sweep ended; recorded if ``mlflow.json`` still has it as running.
            notify: called with a sentence if MLflow fails, or if the store is not changed because
                it is neither in the sweep's folder nor in a folder above.
        """
        link = read_json(folder / LINK)
        running = link.get("status") == RUNNING
        if not running and not (dead and "uri" in link):
            return
        from pgdm.tracking.group import Group
        from pgdm.tracking.mlflow import is_own

        uri = str(link["uri"])
        if not is_own(uri, folder):
            notify(
                f"MLflow at {uri} was not changed, since it is not a database in the sweep's "
                f"folder or above; `pgdm runs sync --uri {uri}` corrects its runs"
            )
            return
        mirror = cls(Group(folder, uri, link["experiment"]), notify)
        for run_dir in dead:
            mirror.correct(run_dir)
        if running:
            mirror.close(status)

    def open(self, plan: Plan) -> None:
        """Create the sweep's MLflow run, and nest below it the runs that exist already."""
        self._plan = plan
        self._tell(lambda group: group.open(plan.name, {"command": plan.command}))
        for job in plan.jobs:
            if Path(job.cfg.run_dir).exists():
                self.adopt(job)

    def adopt(self, job: Job) -> None:
        """Nest a job's MLflow run below the sweep's, if the job uses MLflow."""
        if job.cfg.tracking.kind == "mlflow":
            self._tell(lambda group: group.adopt(Path(job.cfg.run_dir)))

    def correct(self, run_dir: Path) -> None:
        """Correct the status of a run that was killed."""
        if self._failed:  # do not wait for MLflow at every job: `pgdm runs sync` corrects it later
            return
        self._tell(lambda group: group.correct(run_dir))

    def close(self, status: str) -> None:
        """Record how the sweep ended."""
        if self._plan is not None and self._group is not None and not self._group.opened:
            self.open(self._plan)  # MLflow was unreachable at the start
        self._tell(lambda group: group.close(status))

    def _tell(self, what: Callable[[Group], None]) -> None:
        if self._group is None:
            return
        try:
            what(self._group)
        except TrackingError as error:
            if not self._failed:
                self._notify(
                    f"{error}; the sweep continues, `pgdm runs sync --uri {self._group.uri}` adds "
                    "what is missing in MLflow"
                )
            self._failed = True
