"""The tracker that mirrors a run to MLflow while it goes on."""

from __future__ import annotations

import logging
import math
import time
from collections import deque
from collections.abc import Mapping
from concurrent.futures import Future, ThreadPoolExecutor, wait
from pathlib import Path
from typing import Any

from pgdm.tracking.mlflow import SYNCED, Mirror, Store, find_run, store_uri
from pgdm.tracking.run_folder import FACTS, RunFolder, runs_root
from pgdm.tracking.sync import history, lacking
from pgdm.tracking.thin import Point, Thin, points
from pgdm.tracking.tracker import Tracker, TrackingCfg

RETRY_S = 30.0
"""Pause after a failure, before MLflow is tried again."""
_POINTS_A_CALL = 20

_log = logging.getLogger(__name__)


class MlflowTracker(Tracker):
    """Mirrors a run from a thread of its own, so that training never waits for MLflow.

    Importing MLflow alone takes two seconds. Whatever fails there is warned of once and tried
    again later; what is still missing at the end, ``pgdm runs sync`` fills in from the folder.

    Args:
        cfg: where to.
        folder: the run, with ``config.yaml`` and, when it is resumed, the records it continues.
        facts: what the folder does not tell yet, see ``run_folder.FACTS``; None where unknown.
    """

    def __init__(self, cfg: TrackingCfg, folder: RunFolder, facts: Mapping[str, Any]) -> None:
        self._cfg, self._folder = cfg, folder
        self._uri = cfg.uri or folder.parent().get("uri") or store_uri(runs_root(folder.path))
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
        """Copy a film, and show its poster on the run's page; what is gone by then is left out."""
        self._videos.append((path, poster, frames))
        self._send()

    def finish(self, status: str, patience_s: float = 60.0) -> None:
        """Send what is left, then the folder's files and the status."""
        last = self._pool.submit(self._end, status)
        wait([last], patience_s)
        self._pool.shutdown(wait=False, cancel_futures=True)
        if not last.done() or last.exception() is not None:
            _log.warning(
                "MLflow lacks the end of this run; `pgdm runs sync %s` fills it in",
                runs_root(self._folder.path),
            )

    def _send(self) -> None:
        self._pool.submit(self._flush).add_done_callback(self._note)

    def _note(self, done: Future[None]) -> None:
        error = None if done.cancelled() else done.exception()
        if error is None or self._warned:
            return
        self._warned = True
        _log.warning(
            "MLflow at %s: %s: %s; training goes on, and `pgdm runs sync` fills in what is missing",
            self._uri,
            type(error).__name__,
            (str(error).splitlines() or [""])[0],
        )

    def _flush(self) -> None:
        """Send what waits; what could not be sent stays in the queues."""
        if time.monotonic() < self._not_before:
            return
        self._not_before = time.monotonic() + RETRY_S  # unless all goes well
        mirror = self._connected()
        while self._points:
            some = [self._points[i] for i in range(min(_POINTS_A_CALL, len(self._points)))]
            mirror.log(some)
            for _ in some:
                self._points.popleft()
        while self._videos:
            path, poster, frames = self._videos[0]
            if path.exists():
                mirror.artifact(path, "videos")
            if poster.exists():
                mirror.poster(poster, frames)
            self._videos.popleft()
        self._not_before = 0.0

    def _connected(self) -> Mirror:
        """Return the mirror, opened at the first call; what is missing of earlier comes first."""
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
            # MLflow was out of reach before, maybe, or the process was killed.
            mirror.log(lacking(earlier, history(store, run)))
        mirror.describe({"attempts": str(self._attempts)})
        mirror.artifacts()
        self._mirror = mirror
        return mirror

    def _end(self, status: str) -> None:
        self._not_before = 0.0
        self._flush()
        mirror = self._connected()
        self._folder = RunFolder(self._folder.path)  # with the result that was written since
        mirror.refresh(self._folder)
        mirror.describe({SYNCED: self._folder.fingerprint()})
        mirror.artifacts()
        mirror.set_status(status, time.time())
