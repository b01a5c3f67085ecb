"""Rows of poses, as a recording would have them."""

from __future__ import annotations

import numpy as np

UNTURNED = [1.0, 0.0, 0.0, 0.0]


def line(speed: float, steps: int = 30, ease: int = 10) -> np.ndarray:
    """Return rows (T, 7) that go along x, from rest to a speed in m/s and back."""
    ramp = np.clip(np.arange(steps) / ease, 0, 1) * np.clip((steps - np.arange(steps)) / ease, 0, 1)
    x = np.cumsum(0.04 * speed * ramp)
    return np.column_stack(
        (x - x[0], np.zeros(steps), np.full(steps, 0.05), np.tile(UNTURNED, (steps, 1)))
    )
