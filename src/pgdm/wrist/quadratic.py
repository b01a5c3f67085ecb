"""Local model of the wrist search's cost: a quadratic, plus one-sided costs at joint limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from qpsolvers import solve_qp

from pgdm.wrist.path import BASE_JOINTS

PER_LIMIT = np.repeat((300.0, 90.0), 3)
"""Residual per excess over a joint limit, 1/m for slides, 1/rad for hinges: about 1 at 3 mm or
0.01 rad."""
_TINY, _SAME = 1e-9, 1e-6  # _SAME: m and rad, changes closer than this are equal
_LIMIT_ROUNDS = 6


@dataclass(frozen=True)
class Limits:
    """Ranges that the base's joint positions should stay in."""

    low: np.ndarray  # (6,) m, rad
    high: np.ndarray  # (6,) m, rad

    def nearest(self, joints: np.ndarray) -> np.ndarray:
        """Return joint positions (K, 6) clipped to the ranges."""
        return joints.clip(self.low, self.high)

    def beyond(self, joints: np.ndarray) -> np.ndarray:
        """Return the residuals L (q - clip(q)), (K, 6), of joint positions q, (K, 6)."""
        return PER_LIMIT * (joints - self.nearest(joints))


class Model:
    """The cost of a change d (K * 6,) of the commands:

        |r + J d|^2 + |L (q + B d - clip(q + B d))|^2

    L is ``PER_LIMIT``, and clip(q) is q clipped to ``limits``.

    Args:
        jacobian: Jacobian of the residuals, J (R, K * 6).
        residuals: residuals at the commands, r (R,).
        joints_by: Jacobian of the joint positions with respect to the commands, B (K * 6, K * 6).
        joints: joint positions at the commands, q (K, 6) m, rad.
        limits: ranges that the joints should stay in.
    """

    def __init__(
        self,
        jacobian: np.ndarray,
        residuals: np.ndarray,
        joints_by: np.ndarray,
        joints: np.ndarray,
        limits: Limits,
    ) -> None:
        self._hessian = 2 * jacobian.T @ jacobian + _TINY * np.eye(jacobian.shape[1])
        self._gradient = 2 * jacobian.T @ residuals
        self._joints_by, self._joints, self._limits = joints_by, joints, limits
        self._weights = np.tile(PER_LIMIT, len(joints))

    def least(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return the change (K, 6) of the commands, between bounds (K, 6), that costs least.

        Each round minimises a quadratic 1/2 d'Hd + g'd with low <= d <= high. It includes the limit
        term only for joints that the previous round's change takes beyond a limit. The search ends
        when the change stays the same, when the solver fails, or after six rounds. The best change
        of all rounds is returned, or no change if none lowers the cost.
        """
        low, high = low.ravel(), np.maximum(high, low + _TINY).ravel()
        best = step = np.zeros_like(low)
        for _ in range(_LIMIT_ROUNDS):
            joints = self._after(step)
            limit = self._limits.nearest(joints)
            rows = self._weights[:, None] * self._joints_by
            off = (self._weights * (self._joints - limit).ravel())[at := (joints != limit).ravel()]
            hessian = self._hessian + 2 * rows[at].T @ rows[at]
            gradient = self._gradient + 2 * rows[at].T @ off
            found = solve_qp(hessian, gradient, lb=low, ub=high, solver="daqp")
            if found is None or np.allclose(found, step, atol=_SAME):
                break
            step = found
            best = max(best, step, key=self.gain)
        return best.reshape(-1, BASE_JOINTS)

    def gain(self, step: np.ndarray) -> float:
        """Return the decrease of the cost that the model predicts for a change (K * 6,)."""
        smooth = self._gradient @ step + 0.5 * step @ self._hessian @ step
        before, after = (
            (self._limits.beyond(joints) ** 2).sum() for joints in (self._joints, self._after(step))
        )
        return float(before - after - smooth)

    def _after(self, step: np.ndarray) -> np.ndarray:
        return self._joints + (self._joints_by @ step).reshape(-1, BASE_JOINTS)
