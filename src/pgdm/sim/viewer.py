"""A window on a scene: MuJoCo's own viewer, for looking at motions."""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Sequence

import mujoco
import numpy as np
from mujoco import viewer

from pgdm.errors import RenderError
from pgdm.sim.marks import add_marks
from pgdm.sim.render import VIDEO_FPS


def show_motion(
    model: mujoco.MjModel, qpos: np.ndarray, marks: Sequence[np.ndarray] | None = None
) -> None:
    """Replay joint positions in a window, again and again until it is closed.

    Args:
        model: the compiled scene.
        qpos: joint positions (T, nq) at the control steps.
        marks: points (n, 3) m to show as small spheres at each of them.

    Raises:
        RenderError: if there is no screen.
    """
    if sys.platform.startswith("linux") and not _has_screen():
        raise RenderError("there is no screen here to open a window on; use --video FILE")
    data = mujoco.MjData(model)
    try:
        window = viewer.launch_passive(model, data, show_left_ui=False)
    except RuntimeError as error:
        raise RenderError(f"the window does not open ({error}); use --video FILE") from error
    with window:
        while window.is_running():
            for t, row in enumerate(qpos):
                if not window.is_running():
                    break
                data.qpos[:] = row
                mujoco.mj_forward(model, data)
                if marks is not None:
                    window.user_scn.ngeom = 0
                    add_marks(window.user_scn, marks[t])
                window.sync()
                time.sleep(1 / VIDEO_FPS)


def _has_screen() -> bool:
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
