"""The wrist planner's cost around its commands, as a quadratic program with one-sided limits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from qpsolvers import solve_qp

_JOINTS = 6
PER_LIMIT = np.repeat((300.0, 90.0), 3)
"""Residual of a slide, 1/m, and a hinge, 1/rad, beyond its limits: 1 at 3 mm or 0.01 rad."""
_TINY, _SAME = 1e-9, 1e-6
_LIMIT_ROUNDS = 6


@dataclass(frozen=True)
class Limits:
    """What joints keep away from."""

    low: np.ndarray  # (6,) m, rad
    high: np.ndarray

    def nearest(self, joints: np.ndarray) -> np.ndarray:
        """Return joints (K, 6) brought within."""
        return joints.clip(self.low, self.high)

    def beyond(self, joints: np.ndarray) -> np.ndarray:
        """Return residuals (K, 6) of joints (K, 6): 0 within."""
        return PER_LIMIT * (joints - self.nearest(joints))


class Model:
    """The cost around commands: squares of linear residuals, and of joints beyond their limits.

    Args:
        jacobian: of the residuals (R, K * 6).
        residuals: at the commands (R,).
        joints_by: how the joints depend on the commands (K * 6, K * 6).
        joints: at the commands (K, 6).
        limits: that joints keep away from.
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
        self._slope = 2 * jacobian.T @ residuals
        self._joints_by, self._joints, self._limits = joints_by, joints, limits
        self._weights = np.tile(PER_LIMIT, len(joints))

    def least(self, low: np.ndarray, high: np.ndarray) -> np.ndarray:
        """Return the best change of the commands within bounds, (K, 6) each.

        Which joints it takes beyond a limit shows only afterwards: some rounds find it.
        """
        low, high = low.ravel(), np.maximum(high, low + _TINY).ravel()
        best = step = np.zeros_like(low)
        for _ in range(_LIMIT_ROUNDS):
            joints = self._after(step)
            limit = self._limits.nearest(joints)
            rows = self._weights[:, None] * self._joints_by
            off = (self._weights * (self._joints - limit).ravel())[at := (joints != limit).ravel()]
            hessian = self._hessian + 2 * rows[at].T @ rows[at]
            slope = self._slope + 2 * rows[at].T @ off
            found = solve_qp(hessian, slope, lb=low, ub=high, solver="daqp")
            if found is None or np.allclose(found, step, atol=_SAME):
                break
            step = found
            best = max(best, step, key=self.gain)
        return best.reshape(-1, _JOINTS)

    def gain(self, step: np.ndarray) -> float:
        """Return by how much a change (K * 6,) should lower the cost."""
        steady = self._slope @ step + 0.5 * step @ self._hessian @ step
        before, after = (
            (self._limits.beyond(joints) ** 2).sum() for joints in (self._joints, self._after(step))
        )
        return float(before - after - steady)

    def _after(self, step: np.ndarray) -> np.ndarray:
        return self._joints + (self._joints_by @ step).reshape(-1, _JOINTS)
