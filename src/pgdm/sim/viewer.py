"""A window on a scene: MuJoCo's own viewer, for looking at motions."""

from __future__ import annotations

import os
import sys
import time

import mujoco
import numpy as np
from mujoco import viewer

from pgdm.errors import RenderError
from pgdm.sim.render import VIDEO_FPS


def show_motion(model: mujoco.MjModel, qpos: np.ndarray) -> None:
    """Replay joint positions in a window, again and again until it is closed.

    Args:
        model: the compiled scene.
        qpos: joint positions (T, nq) at the control steps.

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
            for row in qpos:
                if not window.is_running():
                    break
                data.qpos[:] = row
                mujoco.mj_forward(model, data)
                window.sync()
                time.sleep(1 / VIDEO_FPS)


def _has_screen() -> bool:
    return any(os.environ.get(name) for name in ("DISPLAY", "WAYLAND_DISPLAY"))
