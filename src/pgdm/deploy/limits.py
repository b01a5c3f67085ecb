"""Joint limits of the Franka Panda, and where a trajectory exceeds them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, make_interp_spline

JOINTS = tuple(f"joint{i}" for i in range(1, 8))
"""Names of the arm's joints, in the model and in playbacks."""

# Joints 1 to 7, from Franka's documentation of the control parameters ("Necessary conditions for
# joint trajectories"). The position limits in the arm's model are the same.
POSITION_RAD = np.array(
    [
        [-2.8973, 2.8973],
        [-1.7628, 1.7628],
        [-2.8973, 2.8973],
        [-3.0718, -0.0698],
        [-2.8973, 2.8973],
        [-0.0175, 3.7525],
        [-2.8973, 2.8973],
    ]
)
VELOCITY = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])  # rad/s
ACCELERATION = np.array([15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0])  # rad/s2
JERK = np.array([7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0])  # rad/s3
TORQUE = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])  # N m
PAYLOAD_KG = 3.0

CONTROL_HZ = 1000.0
"""Rate at which the arm takes commands and limits are checked."""
_UNITS = {"velocity": "rad/s", "acceleration": "rad/s2", "jerk": "rad/s3"}


@dataclass(frozen=True)
class Violation:
    """The worst excess of one joint over one limit."""

    joint: str
    quantity: str
    """``position``, ``velocity``, ``acceleration`` or ``jerk``."""
    time_s: float
    value: float
    limit: float

    @property
    def described(self) -> str:
        """The violation as a sentence."""
        unit = _UNITS.get(self.quantity, "rad")
        return (
            f"{self.joint}: {self.quantity} {self.value:.4g} {unit} at {self.time_s:.3f} s, "
            f"limit {self.limit:.4g} {unit}"
        )


@dataclass(frozen=True)
class Usage:
    """How much of its limits a trajectory of the arm uses."""

    # By quantity, (7,): largest share of the limit; for ``position``, least distance to it, rad.
    share: dict[str, np.ndarray]
    violations: list[Violation]

    @property
    def slower(self) -> float:
        """Largest speed factor, at most 1, within the limits of velocity, acceleration and jerk.

        With the largest shares v, a, j of these limits: min(1, 1/v, a^(-1/2), j^(-1/3)).
        """
        roots = {"velocity": 1, "acceleration": 2, "jerk": 3}
        return min(max(1.0, float(self.share[k].max())) ** (-1 / n) for k, n in roots.items())


def smooth(time_s: np.ndarray, values: np.ndarray) -> BSpline:
    """Return the quintic spline through samples (K, n) at times (K,) that rests at both ends.

    It defines a playback between its samples, for the check of the limits and for playing.
    """
    still = [(1, np.zeros(values.shape[1])), (2, np.zeros(values.shape[1]))]
    return make_interp_spline(time_s, values, k=5, bc_type=(still, still))


def usage(time_s: np.ndarray, joints: np.ndarray) -> Usage:
    """Measure a trajectory of the arm against the limits.

    Args:
        time_s: (K,) increasing, K at least 6.
        joints: (K, 7) rad.
    """
    spline = smooth(time_s, joints)
    fine = np.append(np.arange(time_s[0], time_s[-1], 1 / CONTROL_HZ), time_s[-1])
    found: list[Violation] = []

    def note(quantity: str, excess: np.ndarray, value: np.ndarray, limit: np.ndarray) -> None:
        for joint in np.flatnonzero(excess.max(0) > 0):
            row = int(excess[:, joint].argmax())
            numbers = float(value[row, joint]), float(limit[row, joint])
            found.append(Violation(JOINTS[joint], quantity, float(fine[row]), *numbers))

    at = spline(fine)
    low, high = POSITION_RAD.T
    margin = np.minimum(at - low, high - at)
    note("position", -margin, at, np.where(at - low < high - at, low, high))
    share = {"position": margin.min(0)}
    for order, (quantity, limit) in enumerate(
        (("velocity", VELOCITY), ("acceleration", ACCELERATION), ("jerk", JERK)), 1
    ):
        value = spline.derivative(order)(fine)
        share[quantity] = np.abs(value).max(0) / limit
        note(quantity, np.abs(value) - limit, value, np.broadcast_to(limit, value.shape))
    return Usage(share, found)
