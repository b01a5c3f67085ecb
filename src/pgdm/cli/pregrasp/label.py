"""``pgdm pregrasp label``: pose the hand in the browser."""

from __future__ import annotations

import threading
import webbrowser

from pgdm.cli.console.screen import notify
from pgdm.cli.dashboard import free_port, on_stop
from pgdm.cli.scenes import composed, open_scene
from pgdm.pregrasp.labeler import shapes
from pgdm.pregrasp.labeler.page import LabelPage
from pgdm.pregrasp.labeler.poses import Draft, Loaded, Poses, draft_path


def run(
    task: str, hand: str | None, origin: str | None, port: int, browser: bool, offline: bool
) -> None:
    """Serve the page until Ctrl-C.

    Raises:
        PgdmError: the task, the hand or the pose to start from is unknown or damaged, or the task
            is open in another labeler.
    """
    _, _, motion, scene = open_scene(composed(task, hand, offline=offline))
    poses = Poses(scene, motion)
    loaded = None if origin is None else poses.load(origin)
    draft = Draft(scene)
    try:
        start = _start(poses, draft, loaded)
        notify("preparing the shapes of hand and object")
        looks = shapes.visible(scene), shapes.solid(scene)
        stop = threading.Event()
        with on_stop(lambda *_: stop.set()):  # a second Ctrl-C must not interrupt the saving
            page = LabelPage(scene, poses, start, draft, looks, motion.substeps, free_port(port))
            try:
                _print_address(page, start, port)
                if browser:
                    webbrowser.open(page.url)
                while not stop.wait(0.5):
                    pass
            finally:
                page.close()
    finally:
        draft.close()
    kept = f"; the unsaved draft is kept: {draft_path(scene)}" if draft_path(scene).exists() else ""
    print(f"labeler closed{kept}")


def _start(poses: Poses, draft: Draft, loaded: Loaded | None) -> Loaded:
    """Return the pose to start from: as requested, else the draft, else the best available."""
    if loaded is None:
        return draft.found(poses) or poses.first()
    if draft.found(poses) is None:
        return loaded
    aside = draft.set_aside()
    return Loaded(
        loaded.qpos, loaded.origin, (*loaded.notes, f"an earlier draft is kept as {aside.name}")
    )


def _print_address(page: LabelPage, start: Loaded, port: int) -> None:
    for note in start.notes:
        notify(note)
    used = page.server.get_port()
    if port not in (0, used):
        print(f"port {port} is taken, using {used}")
    print(f"starts from the {start.origin}\n{page.url}\nCtrl-C quits", flush=True)
