"""Compiling models to know that they are sound, and how many joints they have."""

from __future__ import annotations

from pathlib import Path

import mujoco

from pgdm.errors import CorruptAssetError


def compiled(path: Path, label: str) -> mujoco.MjModel:
    """Compile a library model.

    Args:
        path: its MJCF file.
        label: what to call it in messages.

    Raises:
        CorruptAssetError: MuJoCo refuses it; its reason is in the message.
    """
    try:
        return mujoco.MjSpec.from_file(str(path)).compile()
    except (ValueError, mujoco.FatalError) as error:
        reason = " ".join(str(error).split())[:300]
        raise CorruptAssetError(f"{label}: MuJoCo cannot compile it ({reason})") from error
