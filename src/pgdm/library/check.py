"""Compiling models to know that they are sound, and how many joints they have."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import mujoco

from pgdm.errors import CorruptAssetError


def compiled(
    path: Path, label: str, edit: Callable[[mujoco.MjSpec], object] | None = None
) -> mujoco.MjModel:
    """Compile a library model.

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
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())[:300]
        raise CorruptAssetError(f"{label}: MuJoCo cannot compile it ({reason})") from error
