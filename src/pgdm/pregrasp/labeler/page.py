"""The labeler in the browser: pages talk to one state, which one thread changes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pgdm.library import pregrasp_file
from pgdm.pregrasp.labeler import guard, store
from pgdm.pregrasp.labeler.mailbox import Mailbox
from pgdm.pregrasp.labeler.panel import Commands, Panel
from pgdm.pregrasp.labeler.shapes import Shape
from pgdm.pregrasp.labeler.stage import Stage
from pgdm.pregrasp.labeler.state import LabelState
from pgdm.pregrasp.labeler.store import Draft, Loaded, Poses
from pgdm.pregrasp.labeler.trial import Outcome, Trial
from pgdm.sim.scene import Scene


class LabelPage:
    """Serves the page until it is closed.

    Args:
        scene: the task's, with the hand.
        poses: that can be taken.
        start: the pose to begin with.
        draft: where the pose is kept while it is made.
        shapes: what is seen of the scene, and what contacts are computed with.
        substeps: physics steps per control step.
        port: to listen at, on this machine only; the next free one if it is taken.
    """

    def __init__(
        self,
        scene: Scene,
        poses: Poses,
        start: Loaded,
        draft: Draft,
        shapes: tuple[list[Shape], list[Shape]],
        substeps: int,
        port: int,
    ) -> None:
        self.state = LabelState(scene, start.qpos)
        self._scene, self._poses, self._draft, self._substeps = scene, poses, draft, substeps
        self._dragged: object = None
        self._drags = 0
        self._trial: Trial | None = None
        self._outcome: tuple[int, Outcome] | None = None  # with the state's version it is of
        self.mailbox = Mailbox(lambda text: self.panel.complain(text))
        self.server = guard.open_server(port)
        self.stage = Stage(self.server, scene, self.state.kinematics, *shapes)
        self.panel = Panel(self.server, self.state, poses.available(), self._commands())
        self.stage.on_drag(self.drag_wrist, self.drag_tip)
        self.stage.aim(self.server, start.qpos)
        self.panel.say(". ".join((f"starts from the {start.origin}", *start.notes)))
        self._show(None)

    @property
    def url(self) -> str:
        """Address of the page."""
        return f"http://{guard.HOST}:{self.server.get_port()}"

    @property
    def idle(self) -> bool:
        """Whether no trial runs."""
        return self._trial is None

    def save(self, anyway: bool = False) -> None:
        """Have the pose saved, also one that touches something if it shall be so."""
        self.mailbox.post(lambda: self._save(anyway))

    def close(self) -> None:
        """End the server; the pose that is not saved stays as a draft."""
        if self._trial is not None:
            self._trial.cancel()
        guard.close_server(self.server)
        self.mailbox.close()

    def _commands(self) -> Commands:
        def later(action: Callable[[], None]) -> Callable[[], None]:
            return lambda: self.mailbox.post(action)

        state = self.state
        return Commands(
            set_joint=self.set_joint,
            preset=lambda name: self.mailbox.post(lambda: self._take(name)),
            undo=later(lambda: self._went(state.undo, "undone", "nothing to undo")),
            redo=later(lambda: self._went(state.redo, "done again", "nothing to do again")),
            reset=later(lambda: self._went(state.reset, "back at the first pose", "")),
            try_it=later(self._try_it),
            cancel=later(self._cancel),
            save=self.save,
            handles=lambda which: self.mailbox.post(lambda: self.stage.show_handles(which)),
            solid=lambda shown: self.mailbox.post(lambda: self.stage.show_solid(shown)),
        )

    def set_joint(self, joint: int, value: float, gesture: object) -> None:
        """Have a joint set, m or rad, as by a slider."""

        def action() -> None:
            self._change(lambda: self.state.set_joint(joint, value, gesture), joint)

        self.mailbox.post(action, gesture)

    def drag_wrist(self, pos: np.ndarray, quat: np.ndarray, phase: str) -> None:
        """Have the wrist follow its handle: (3,) m, (4,) wxyz, and start, update or end."""
        self._drag("wrist", phase, lambda g: self.state.place_wrist(pos, quat, g))

    def drag_tip(self, finger: int, pos: np.ndarray, phase: str) -> None:
        """Have a fingertip follow its handle: (3,) m, and start, update or end."""
        self._drag(finger, phase, lambda g: self.state.place_tip(finger, pos, g))

    def _drag(self, handle: object, phase: str, move: Callable[[object], object]) -> None:
        """Follow a drag; grabbing a handle moves nothing yet, letting go puts it on the hand."""
        self._drags += phase == "start"
        gesture = "drag", handle, self._drags

        def action() -> None:
            self._dragged = None if phase == "end" else handle
            self._change((lambda: None) if phase == "start" else lambda: move(gesture))

        self.mailbox.post(action, gesture if phase == "update" else None)

    def _take(self, name: str) -> None:
        loaded = self._poses.load(name, self.state.qpos[: self._scene.model.nu])
        nu = self._scene.model.nu
        self._change(lambda: self.state.set_joints(loaded.qpos[:nu]))
        self.panel.say(". ".join((f"took the {loaded.origin}", *loaded.notes)))

    def _went(self, change: Callable[[], object], done: str, nothing: str) -> None:
        before = self.state.version
        self._change(change)
        self.panel.say(done if self.state.version != before else nothing or done)

    def _change(self, change: Callable[[], object], slider: int | None = None) -> None:
        before = self.state.version
        try:
            change()
        finally:
            if self.state.version != before:
                self._draft.keep(self.state.qpos)
                self.panel.offer_anyway(False)
            self._show(slider)

    def _show(self, slider: int | None) -> None:
        qpos = self.state.qpos
        with self.server.atomic():
            self.stage.pose(qpos)
            self.stage.handles(qpos, self._dragged)
            self.stage.warn(self.state.figures)
            self.panel.show(self.state.figures, slider)
        if self._draft.error is not None:
            self.panel.complain(f"the draft is not kept: {self._draft.error.strerror}")

    def _save(self, anyway: bool) -> None:
        figures = self.state.figures
        outcome = self._outcome
        fresh = outcome is not None and outcome[0] == self.state.version
        reached = outcome[1].reached if outcome is not None and fresh else None
        extra = outcome[1].note if outcome is not None and fresh else {}
        self.panel.offer_anyway(not figures.free and not anyway)
        made = store.pregrasp(self.state, reached, anyway, extra)
        path = store.path(self._scene)
        pregrasp_file.write(path, made)
        self._draft.drop()
        way = "with the way there" if reached is not None else "as a pose"
        said = f"saved {way}: {path}. Use it: pgdm-run task={self._scene.task.id} pregrasp=labeled"
        self.panel.say(said, "#2f9e44")

    def _try_it(self) -> None:
        if self._trial is not None:
            return
        version = self.state.version

        def told(share: float, text: str) -> None:
            self.mailbox.post(lambda: self.panel.progress(share, text), "progress")

        def played(qpos: np.ndarray) -> bool:
            if self.state.version != version:
                return False
            self.mailbox.post(lambda: self.stage.pose(qpos), "play")
            return True

        def ended(outcome: Outcome | None, text: str) -> None:
            def action() -> None:
                self._trial = None
                self._outcome = None if outcome is None else (version, outcome)
                self.panel.progress(None, text)
                self._show(None)

            self.mailbox.post(action)

        self._trial = Trial(self._scene, self.state.qpos, self._substeps, told, played, ended)

    def _cancel(self) -> None:
        if self._trial is not None:
            self._trial.cancel()
