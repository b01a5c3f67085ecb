"""Motions in a window of MuJoCo's viewer."""

from __future__ import annotations

import atexit
import os
import sys
import threading
import time
import weakref
from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco import viewer

from pgdm.errors import RenderError
from pgdm.sim.marks import add_marks
from pgdm.sim.render import VIDEO_FPS

_CLOSE_S = 5.0


def show_motion(
    model: mujoco.MjModel, qpos: np.ndarray, marks: Sequence[np.ndarray] | None = None
) -> None:
    """Replay joint positions in a window, in a loop until it is closed.

    Args:
        model: the compiled scene.
        qpos: joint positions (T, nq) at the control steps.
        marks: for each of T steps, points (n, 3) m, world frame, to show as small spheres.

    Raises:
        RenderError: if no window can be opened.
    """
    window = Window(model, "--video FILE")
    try:
        while window.is_open:
            for t, row in enumerate(qpos):
                if not window.is_open:
                    break
                window.show(row, 1 / VIDEO_FPS, None if marks is None else marks[t])
    finally:
        window.close()


class Window:
    """A window of MuJoCo's viewer.

    Args:
        model: the compiled scene.
        instead: what to use if no window can be opened, for the error message.

    Raises:
        RenderError: if no window can be opened.
    """

    def __init__(self, model: mujoco.MjModel, instead: str) -> None:
        if sys.platform.startswith("linux") and not _has_screen():
            raise RenderError(f"no screen to open a window on; use {instead}")
        self._model, self._data = model, mujoco.MjData(model)
        self._shown_s = 0.0
        before = set(threading.enumerate())
        try:
            self._viewer = viewer.launch_passive(model, self._data, show_left_ui=False)
        except RuntimeError as error:
            raise RenderError(f"cannot open a window ({error}); use {instead}") from error
        own = set(threading.enumerate()) - before
        self.close = weakref.finalize(self, _close, self._viewer, own)
        """Close the window; also runs when the program ends, before the viewer's exit handlers."""
        atexit.register(self.close)

    @property
    def is_open(self) -> bool:
        """Whether neither the user nor ``close`` has closed the window."""
        return self._viewer.is_running()

    def show(self, qpos: np.ndarray, period_s: float, marks: np.ndarray | None = None) -> None:
        """Show a state, at least ``period_s`` after the last state.

        Args:
            qpos: joint positions (nq,).
            period_s: least time between two states, s.
            marks: points (n, 3) m, world frame, to show as small spheres.
        """
        time.sleep(max(0.0, self._shown_s + period_s - time.monotonic()))
        self._shown_s = time.monotonic()
        with self._viewer.lock():
            self._data.qpos[:] = qpos
            mujoco.mj_forward(self._model, self._data)
            if marks is not None:
                self._viewer.user_scn.ngeom = 0
                add_marks(self._viewer.user_scn, marks)
        self._viewer.sync()


def _close(window: viewer.Handle, threads: set[threading.Thread]) -> None:
    window.close()
    for thread in threads:  # the program would crash if it ended before them
        thread.join(_CLOSE_S)


def _has_screen() -> bool:
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
