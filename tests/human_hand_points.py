"""A plausible, invented human right hand."""

from __future__ import annotations

import numpy as np


def flat_hand() -> np.ndarray:
    """Return MANO's 16 joints (16, 3) m: palm down, fingers straight along y, thumb at -x."""
    points = [np.zeros(3)]
    for x in (-0.025, 0.0, 0.04, 0.02):  # index, middle, little, ring
        points += [np.array([x, y, 0.0]) for y in (0.09, 0.13, 0.155)]
    points += [np.array([-0.02, 0.02, -0.01]), np.array([-0.05, 0.05, -0.02])]
    points.append(np.array([-0.07, 0.07, -0.03]))
    return np.array(points)
