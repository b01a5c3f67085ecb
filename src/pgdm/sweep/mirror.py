"""A sweep as MLflow shows it: one run, and its jobs below it. MLflow never stops a sweep."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pgdm import paths
from pgdm.errors import TrackingError
from pgdm.sweep.ledger import RUNNING
from pgdm.tracking.run_folder import LINK, read_json

if TYPE_CHECKING:
    from pgdm.sweep.plan import Job, Plan
    from pgdm.tracking.group import Group

Notify = Callable[[str], None]


class SweepMirror:
    """Tells MLflow of a sweep; that it fails there is told once, and the sweep goes on.

    Args:
        group: the sweep's run; None tells nobody.
        notify: told in a sentence if MLflow fails.
    """

    def __init__(self, group: Group | None, notify: Notify) -> None:
        self._group, self._notify = group, notify
        self._plan: Plan | None = None
        self._failed = False

    @classmethod
    def of(cls, plan: Plan, notify: Notify) -> SweepMirror:
        """Return the mirror of a plan: where its first job goes that has one."""
        chosen = next((j.cfg.tracking for j in plan.jobs if j.cfg.tracking.kind == "mlflow"), None)
        if chosen is None:
            return cls(None, notify)
        from pgdm.tracking.group import Group
        from pgdm.tracking.mlflow import sqlite_file, store_uri

        known = read_json(plan.folder / LINK).get("uri", "")
        file = sqlite_file(known)
        stays = known and (file is None or file.exists())
        # Among all runs if the sweep lies there, otherwise in its own folder.
        runs = paths.runs().absolute()
        here = store_uri(runs if plan.folder.is_relative_to(runs) else plan.folder)
        uri = chosen.uri or (known if stays else here)
        return cls(Group(plan.folder, uri, chosen.experiment), notify)

    @classmethod
    def set_right(cls, folder: Path, dead: Sequence[Path], status: str, notify: Notify) -> None:
        """Tell MLflow the truth about a sweep that nobody drives.

        Args:
            folder: of the sweep.
            dead: run folders whose workers were found dead; the sweep may have been closed before.
            status: how the sweep ended, for MLflow that still holds it to be running.
            notify: told in a sentence if MLflow fails.
        """
        link = read_json(folder / LINK)
        running = link.get("status") == RUNNING
        if not running and not (dead and "uri" in link):
            return
        from pgdm.tracking.group import Group

        mirror = cls(Group(folder, link["uri"], link["experiment"]), notify)
        for run_dir in dead:
            mirror.correct(run_dir)
        if running:
            mirror.close(status)

    def open(self, plan: Plan) -> None:
        """Make what MLflow needs, before any job starts."""
        self._plan = plan
        self._tell(lambda group: group.open(plan.name, {"command": plan.command}))
        for job in plan.jobs:
            if Path(job.cfg.run_dir).exists():
                self.adopt(job)

    def adopt(self, job: Job) -> None:
        """Have a job shown under its sweep, if it goes to MLflow."""
        if job.cfg.tracking.kind == "mlflow":
            self._tell(lambda group: group.adopt(Path(job.cfg.run_dir)))

    def correct(self, run_dir: Path) -> None:
        """Give a run that was killed its true status."""
        if self._failed:  # do not wait for it job by job: `pgdm runs sync` does this too
            return
        self._tell(lambda group: group.correct(run_dir))

    def close(self, status: str) -> None:
        """Tell how the sweep ended."""
        if self._plan is not None and self._group is not None and not self._group.opened:
            self.open(self._plan)  # MLflow was out of reach at the start
        self._tell(lambda group: group.close(status))

    def _tell(self, what: Callable[[Group], None]) -> None:
        if self._group is None:
            return
        try:
            what(self._group)
        except TrackingError as error:
            if not self._failed:
                self._notify(
                    f"{error}; the sweep goes on, `pgdm runs sync` fills in what is missing"
                )
            self._failed = True
