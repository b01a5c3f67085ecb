"""Compiling models, with a massless tracked body's centre of mass as in MuJoCo up to 3.3."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np

from pgdm.errors import CorruptAssetError


def compile_tracked(spec: mujoco.MjSpec, body: str) -> mujoco.MjModel:
    """Compile a model so that a massless tracked body has its centre of mass at its origin.

    This applies if the file gives no inertial frame. MuJoCo up to 3.3 puts the centre of mass at
    the origin; 4.0 copies the body's pose in its parent into ``body_ipos`` and ``body_iquat``. The
    spec is changed rather than the compiled model, because the compiler computes bounding boxes
    of the body's geoms in the inertial frame.

    Args:
        spec: the model; a massless ``body`` gets an explicit inertial frame.
        body: name of the body that the task tracks, which may be missing. Other bodies remain as
            MuJoCo compiles them.

    Raises:
        ValueError: MuJoCo cannot compile the model.
    """
    model = spec.compile()
    tracked = spec.body(body)
    if tracked is None or tracked.explicitinertial or model.body(body).mass[0] > 0:
        return model
    tracked.explicitinertial = True
    tracked.mass, tracked.inertia = 0.0, np.zeros(3)
    tracked.ipos, tracked.iquat = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0])
    return spec.compile()


def counts(path: Path, label: str) -> tuple[int, int]:
    """Return nq and nu of a model, compiled with :func:`compiled`."""
    model = compiled(path, label)
    return model.nq, model.nu


def compiled(
    path: Path, label: str, edit: Callable[[mujoco.MjSpec], object] | None = None
) -> mujoco.MjModel:
    """Compile a library model with :func:`compile_tracked`; the tracked body is ``object``.

    Args:
        path: the model's MJCF file.
        label: the model's name in messages.
        edit: changes the spec before it is compiled.

    Raises:
        CorruptAssetError: MuJoCo cannot compile the model; the message has MuJoCo's reason.
    """
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        if edit is not None:
            edit(spec)
        return compile_tracked(spec, "object")
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())[:300]
        raise CorruptAssetError(f"{label}: MuJoCo cannot compile it ({reason})") from error
