"""Compiling models, to know that they are sound, and with centres of mass that can be relied on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

from pgdm.errors import CorruptAssetError


def compile_tracked(spec: mujoco.MjSpec, body: str) -> mujoco.MjModel:
    """Compile a model of which one body's centre of mass is looked at.

    The centre of mass of a massless body is its origin, unless its file gives an inertial frame.
    MuJoCo up to 3.3 has it there; 4.0 copies the body's pose in its parent into ``body_ipos`` and
    ``body_iquat``. The spec is changed rather than the compiled model, because the bounding boxes
    of the body's geoms are compiled in that frame.

    Args:
        spec: the model; a massless ``body`` gets an explicit inertial frame in it.
        body: name of that body. Other bodies stay as MuJoCo compiles them, and so does everything
            if there is no such body.

    Raises:
        ValueError: MuJoCo refuses the model.
    """
    model = spec.compile()
    looked_at = spec.body(body)
    if looked_at is None or looked_at.explicitinertial or model.body(body).mass[0] > 0:
        return model
    looked_at.explicitinertial = True
    looked_at.mass, looked_at.inertia = 0.0, np.zeros(3)
    looked_at.ipos, looked_at.iquat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    return spec.compile()


def compiled(
    path: Path, label: str, edit: Callable[[mujoco.MjSpec], object] | None = None
) -> mujoco.MjModel:
    """Compile a library model; see `compile_tracked` for where an object's centre of mass is.

    Args:
        path: its MJCF file.
        label: what to call it in messages.
        edit: what to change before.

    Raises:
        CorruptAssetError: MuJoCo refuses it; its reason is in the message.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        if edit is not None:
            edit(spec)
        return compile_tracked(spec, "object")
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())[:300]
        raise CorruptAssetError(f"{label}: MuJoCo cannot compile it ({reason})") from error
