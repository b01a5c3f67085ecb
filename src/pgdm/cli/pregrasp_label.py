"""``pgdm pregrasp label``: pose the hand in the browser."""

from __future__ import annotations

import contextlib
import signal
import sys
import threading
import webbrowser
from collections.abc import Iterator
from types import FrameType

from pgdm.cli.dashboard import free_port
from pgdm.cli.pregrasp_scenes import composed
from pgdm.cli.train import notify
from pgdm.experiment import env_builder
from pgdm.library import ensure
from pgdm.pregrasp.labeler import shapes
from pgdm.pregrasp.labeler.page import LabelPage
from pgdm.pregrasp.labeler.store import Draft, Loaded, Poses, draft_path

_STOPPERS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


def label(
    task: str, hand: str | None, origin: str | None, port: int, browser: bool, offline: bool
) -> None:
    """Serve the page until Ctrl-C.

    Raises:
        PgdmError: the task, the hand or the pose to start from is unknown or damaged, or the task
            is open in another labeler.
    """
    # Any hand has a reset pose; its pre-grasps are looked for afterwards.
    cfg = composed(task, hand, "pregrasp=none")
    builder = env_builder(cfg, ensure(cfg.task.motion, offline, notify))
    scene, substeps = builder.scene, builder.motion.substeps
    poses = Poses(scene, builder.motion)
    loaded = None if origin is None else poses.load(origin)
    draft = Draft(scene)
    try:
        start = _start(poses, draft, loaded)
        print("preparing the pictures of hand and object", file=sys.stderr)
        looks = shapes.visible(scene), shapes.solid(scene)
        with _stoppable() as stop:  # until all is kept: a second Ctrl-C breaks nothing off
            page = LabelPage(scene, poses, start, draft, looks, substeps, free_port(port))
            try:
                _tell(page, start, port)
                if browser:
                    webbrowser.open(page.url)
                while not stop.wait(0.5):
                    pass
            finally:
                page.close()
    finally:
        draft.close()
    kept = f"; what is not saved is kept: {draft_path(scene)}" if draft_path(scene).exists() else ""
    print(f"labeler ended{kept}")


def _start(poses: Poses, draft: Draft, loaded: Loaded | None) -> Loaded:
    """Return the pose to start from: the one asked for, else the draft, else a stored one."""
    if loaded is None:
        return draft.found(poses) or poses.first()
    if draft.found(poses) is None:
        return loaded
    aside = draft.set_aside()
    return Loaded(
        loaded.qpos, loaded.origin, (*loaded.notes, f"an earlier draft is kept as {aside.name}")
    )


def _tell(page: LabelPage, start: Loaded, port: int) -> None:
    for note in start.notes:
        notify(note)
    used = page.server.get_port()
    if port not in (0, used):
        print(f"port {port} is taken, using {used}")
    print(f"starts from the {start.origin}\n{page.url}\nCtrl-C ends it", flush=True)


@contextlib.contextmanager
def _stoppable() -> Iterator[threading.Event]:
    """Give an event that is set once somebody asks the program to end, while inside."""
    stop = threading.Event()

    def end(number: int, frame: FrameType | None) -> None:
        del number, frame
        stop.set()

    before = {number: signal.signal(number, end) for number in _STOPPERS}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
