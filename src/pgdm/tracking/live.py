"""The tracker that mirrors a run to MLflow while it trains."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pgdm.runs.files import VIDEOS
from pgdm.runs.folder import FACTS, RunFolder, runs_root
from pgdm.runs.tracker import Tracker
from pgdm.tracking.mlflow import SYNCED, Mirror, Store, find_run, first_line, is_own, store_uri
from pgdm.tracking.sync import history, lacking
from pgdm.tracking.thin import Point, Thin, points

if TYPE_CHECKING:
    from pgdm.tracking import TrackingCfg

RETRY_S = 30.0
"""Pause after a failure, before MLflow is tried again."""
_POINTS_A_CALL = 20

_log = logging.getLogger(__name__)


class MlflowTracker(Tracker):
    """Mirrors a run from a thread of its own: only ``finish`` waits for MLflow.

    Importing MLflow alone takes two seconds. A failure is reported once and retried later;
    ``pgdm runs sync`` adds from the run folder what is still missing at the end.

    Args:
        cfg: store and MLflow experiment.
        folder: the run, with ``config.yaml`` and, when resumed, its earlier records.
        facts: values of `pgdm.runs.folder.FACTS` before there is a result; None where unknown.
    """

    def __init__(self, cfg: TrackingCfg, folder: RunFolder, facts: Mapping[str, Any]) -> None:
        self._cfg, self._folder = cfg, folder
        group = folder.parent().get("uri", "")
        own = group if is_own(group, folder.path) else store_uri(runs_root(folder.path))
        self._uri = cfg.uri or own
        place = f" --uri {cfg.uri}" if cfg.uri else ""
        self._cure = f"pgdm runs sync {runs_root(folder.path)}{place}"
        self._facts = {name: facts[name] for name in FACTS if facts.get(name) is not None}
        self._attempts = int(folder.link.get("attempts", 0)) + 1
        self._earlier = self._folder.log.read()
        self._thin = Thin(self._folder.total_frames())
        self._points: deque[Point] = deque()
        self._videos: deque[tuple[Path, Path, int]] = deque()
        self._mirror: Mirror | None = None
        self._not_before, self._warned = 0.0, False
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="mlflow")
        self._send()

    def log(self, metrics: Mapping[str, float], frames: int) -> None:
        """Record metrics; values that are not finite are left out."""
        finite = {k: float(v) for k, v in metrics.items() if math.isfinite(float(v))}
        if finite and self._thin.passes(frames, finite):
            self._points.append((frames, int(1000 * time.time()), finite))
            self._send()

    def video(self, path: Path, poster: Path, frames: int) -> None:
        """Copy a video, and show its poster on the run's page; skip files that are gone by then."""
        self._videos.append((path, poster, frames))
        self._send()

    def finish(self, status: str, patience_s: float = 60.0) -> None:
        """Send what is still queued, then the folder's files and the status."""
        last = self._pool.submit(self._end, status)
        wait([last], patience_s)
        self._pool.shutdown(wait=False, cancel_futures=True)
        if last.cancelled() or not last.done() or last.exception() is not None:
            _log.warning("MLflow lacks the last records of this run; `%s` adds them", self._cure)

    def _send(self) -> None:
        self._pool.submit(self._flush).add_done_callback(self._note)

    def _note(self, done: Future[None]) -> None:
        error = None if done.cancelled() else done.exception()
        if error is None or self._warned:
            return
        self._warned = True
        _log.warning(
            "MLflow at %s: %s: %s; training continues, and `%s` adds what is missing",
            self._uri,
            type(error).__name__,
            first_line(error),
            self._cure,
        )

    def _flush(self) -> None:
        """Send the queued points and videos; those that cannot be sent stay queued."""
        if time.monotonic() < self._not_before:
            return
        self._not_before = time.monotonic() + RETRY_S  # reset below if nothing fails
        mirror = self._connected()
        while self._points:
            some = [self._points[i] for i in range(min(_POINTS_A_CALL, len(self._points)))]
            mirror.log(some)
            for _ in some:
                self._points.popleft()
        while self._videos:
            path, poster, frames = self._videos[0]
            if path.exists():
                mirror.artifact(path, VIDEOS)
            if poster.exists():
                mirror.poster(poster, frames)
            self._videos.popleft()
        self._not_before = 0.0

    def _connected(self) -> Mirror:
        """Return the mirror; the first call opens it, and sends records that MLflow lacks."""
        if self._mirror is not None:
            return self._mirror
        store = Store.open(self._uri, self._cfg.experiment)
        run = find_run(store, self._folder)
        mirror = Mirror(store, self._folder, run)
        mirror.link({**self._facts, "attempts": self._attempts})
        earlier = points(self._folder, self._earlier)
        if run is None:
            mirror.log(earlier)
            if earlier:
                mirror.posters()
        else:
            mirror.set_status("running")
            # MLflow lacks records if it was unreachable, or if an earlier process was killed.
            mirror.log(lacking(earlier, history(store, run)))
        mirror.describe({"attempts": str(self._attempts)})
        mirror.artifacts()
        self._mirror = mirror
        return mirror

    def _end(self, status: str) -> None:
        self._not_before = 0.0
        self._flush()
        mirror = self._connected()
        self._folder = RunFolder(self._folder.path)  # reread: the result was written meanwhile
        mirror.refresh(self._folder)
        mirror.describe({SYNCED: self._folder.fingerprint()})
        mirror.artifacts()
        mirror.set_status(status, time.time())
