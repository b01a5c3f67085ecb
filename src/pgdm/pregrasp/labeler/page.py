"""The labeler's page: all browser tabs share one state, which only one thread changes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pgdm.errors import ConfigError
from pgdm.library.files import pregrasp as pregrasp_file
from pgdm.pregrasp.labeler import guard
from pgdm.pregrasp.labeler import poses as store
from pgdm.pregrasp.labeler.mailbox import Mailbox
from pgdm.pregrasp.labeler.panel import GREEN, Commands, Panel
from pgdm.pregrasp.labeler.poses import Draft, Loaded, Poses
from pgdm.pregrasp.labeler.shapes import Shape
from pgdm.pregrasp.labeler.stage import Stage
from pgdm.pregrasp.labeler.state import LabelState
from pgdm.pregrasp.labeler.trial import Outcome, Trial
from pgdm.sim.scene import Scene


class LabelPage:
    """Serves the page until :meth:`close`.

    Args:
        scene: scene of the task with the hand to pose.
        poses: poses that can be loaded.
        start: the first pose.
        draft: keeps the unsaved pose.
        shapes: visible shapes and collision shapes.
        substeps: physics steps per control step.
        port: port to listen on, on this machine only; if it is taken, the next free port is used.
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
        self.dragged: object = None
        """The handle being dragged: ``wrist`` or the index of a finger; None if none is."""
        self._drags = 0
        self._saved = False  # whether the stored pose is from this page
        self._trial: Trial | None = None
        self._outcome: tuple[int, Outcome] | None = None  # version of the tried state, outcome
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
        """URL of the page."""
        return f"http://{guard.HOST}:{self.server.get_port()}"

    @property
    def idle(self) -> bool:
        """Whether no trial is running."""
        return self._trial is None

    def save(self, anyway: bool = False) -> None:
        """Save the pose.

        Args:
            anyway: also save if the hand touches something or an earlier pose would be replaced.
        """
        self.mailbox.post(lambda: self._save(anyway))

    def close(self) -> None:
        """Stop the server; an unsaved pose is kept as a draft."""
        self._cancel()
        guard.close_server(self.server)
        self.mailbox.close()

    def _commands(self) -> Commands:
        def later(action: Callable[[], None]) -> Callable[[], None]:
            return lambda: self.mailbox.post(action)

        state = self.state
        return Commands(
            set_joint=self.set_joint,
            preset=lambda name: self.mailbox.post(lambda: self._load(name)),
            undo=later(lambda: self._step(state.undo, "undone", "nothing to undo")),
            redo=later(lambda: self._step(state.redo, "redone", "nothing to redo")),
            reset=later(lambda: self._step(state.reset, "back at the start pose", "")),
            try_it=later(self._try_it),
            cancel=later(self._cancel),
            save=self.save,
            handles=lambda which: self.mailbox.post(lambda: self.stage.show_handles(which)),
            solid=lambda shown: self.mailbox.post(lambda: self.stage.show_solid(shown)),
        )

    def set_joint(self, joint: int, value: float, gesture: object) -> None:
        """Set a joint, m or rad; changes with equal ``gesture`` are undone together."""

        def action() -> None:
            self._change(lambda: self.state.set_joint(joint, value, gesture), joint)

        self.mailbox.post(action, gesture)

    def drag_wrist(self, pos: np.ndarray, quat: np.ndarray, phase: str) -> None:
        """Move the wrist to its handle's pose, (3,) m and (4,) wxyz; phase: start, update, end."""
        self._drag("wrist", phase, lambda g: self.state.place_wrist(pos, quat, g))

    def drag_tip(self, finger: int, pos: np.ndarray, phase: str) -> None:
        """Move a fingertip to its handle's position, (3,) m; phase: start, update, end."""
        self._drag(finger, phase, lambda g: self.state.place_tip(finger, pos, g))

    def _drag(self, handle: object, phase: str, move: Callable[[object], object]) -> None:
        """Follow a drag; at its end, the handle returns to the hand, which may not have kept up."""
        self._drags += phase == "start"
        gesture = "drag", handle, self._drags

        def action() -> None:
            self.dragged = None if phase == "end" else handle
            self._change((lambda: None) if phase == "start" else lambda: move(gesture))

        self.mailbox.post(action, gesture if phase == "update" else None)

    def _load(self, name: str) -> None:
        loaded = self._poses.load(name, self.state.qpos[: self._scene.index.num_joints])
        n = self._scene.index.num_joints
        self._change(lambda: self.state.set_joints(loaded.qpos[:n]))
        self.panel.say(". ".join((f"loaded the {loaded.origin}", *loaded.notes)))

    def _step(self, change: Callable[[], object], done: str, nothing: str) -> None:
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
            self.stage.handles(qpos, self.dragged)
            self.stage.warn(self.state.metrics)
            self.panel.show(self.state.metrics, slider)
        if self._draft.error is not None:
            self.panel.complain(f"the draft cannot be written: {self._draft.error.strerror}")

    def _save(self, anyway: bool) -> None:
        outcome = Outcome(None, {})
        if self._outcome is not None and self._outcome[0] == self.state.version:
            outcome = self._outcome[1]
        path = store.path(self._scene)
        earlier = path.exists() and not self._saved
        self.panel.offer_anyway((earlier or not self.state.metrics.free) and not anyway)
        if earlier and not anyway:
            raise ConfigError(
                f"not saved: {path} already holds an earlier pose; 'Save anyway' replaces it"
            )
        pregrasp_file.write(path, store.pregrasp(self.state, outcome.reached, anyway, outcome.note))
        self._saved = True
        self._draft.drop()
        what = "pose" if outcome.reached is None else "pose and reach"
        task, hand = self._scene.task.id, self._scene.hand.name
        use = f"pgdm-run task={task} hand={hand} pregrasp=labeled"
        self.panel.say(f"saved {what}: {path}. To use it: {use}", GREEN)

    def _try_it(self) -> None:
        if self._trial is not None:
            return
        version = self.state.version

        def on_progress(share: float, text: str) -> None:
            self.mailbox.post(lambda: self.panel.progress(share, text), "progress")

        def on_state(qpos: np.ndarray) -> bool:
            if self.state.version != version:
                return False
            self.mailbox.post(lambda: self.stage.pose(qpos), "play")
            return True

        def on_end(outcome: Outcome | None, text: str) -> None:
            def action() -> None:
                self._trial = None
                self._outcome = None if outcome is None else (version, outcome)
                self.panel.progress(None, text)
                self._show(None)

            self.mailbox.post(action)

        self._trial = Trial(
            self._scene, self.state.qpos, self._substeps, on_progress, on_state, on_end
        )

    def _cancel(self) -> None:
        if self._trial is not None:
            self._trial.cancel()
