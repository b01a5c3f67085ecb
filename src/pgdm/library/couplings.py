"""Joints that follow another joint by an equality constraint, like `<mimic>` in URDF."""

from __future__ import annotations

import mujoco
import numpy as np


class Couplings:
    """The C coupled joints among the first joints of a model.

    The position of a follower depends on its leader's: q_f = a_0 + a_1 q_l + ... + a_4 q_l^4.

    Args:
        model: its first joints are slides and hinges, with all positions 0 in ``qpos0``.
        num_joints: number n of these joints; couplings whose follower comes later are ignored.
    """

    def __init__(self, model: mujoco.MjModel, num_joints: int) -> None:
        kinds, first, second = model.eq_type, model.eq_obj1id, model.eq_obj2id
        coupled = (kinds == mujoco.mjtEq.mjEQ_JOINT) & (second >= 0) & (first < num_joints)
        self.rows = np.flatnonzero(coupled)
        """Ids of the equality constraints (C,)."""
        self.followers = first[self.rows].copy()
        """Joint ids of the followers (C,)."""
        self.leaders = second[self.rows].copy()
        """Joint ids of their leaders (C,)."""
        self._coefficients = model.eq_data[self.rows, :5].T.copy()  # (5, C)

    def apply(self, joints: np.ndarray) -> np.ndarray:
        """Set the followers in joint positions (..., n or nq) from their leaders, in place."""
        if len(self.rows):
            joints[..., self.followers] = self.of(joints[..., self.leaders])
        return joints

    def of(self, leaders: np.ndarray) -> np.ndarray:
        """Return the followers' positions (..., C), given their leaders' (..., C)."""
        result = np.zeros_like(leaders)
        for coefficient in self._coefficients[::-1]:  # Horner's scheme
            result = result * leaders + coefficient
        return result

    def slopes(self, joints: np.ndarray) -> np.ndarray:
        """Return dq_f / dq_l of each follower (C,) at joint positions (n or nq,)."""
        leaders, result = joints[self.leaders], np.zeros(len(self.rows))
        for power in range(4, 0, -1):
            result = result * leaders + power * self._coefficients[power]
        return result

    def folded(self, jacobian: np.ndarray, joints: np.ndarray) -> np.ndarray:
        """Return a copy of a Jacobian (k, n or nv) in which leaders also move their followers."""
        result = jacobian.copy()
        for follower, leader, slope in zip(
            self.followers, self.leaders, self.slopes(joints), strict=True
        ):
            result[:, leader] += slope * jacobian[:, follower]
        return result
