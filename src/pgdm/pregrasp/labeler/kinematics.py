"""Kinematics of the labeler: joint positions that follow a dragged wrist or fingertip."""

from __future__ import annotations

import mujoco
import numpy as np

from pgdm.pregrasp.hand_geometry import base_joints
from pgdm.pregrasp.labeler import joint_names as names
from pgdm.sim.scene import Scene

TIP_TOLERANCE_M = 1e-4
"""A fingertip has reached its target if it is closer than this."""
_ITERATIONS = 40
_STEP_M = 0.02  # longest step of a fingertip towards its target: the Jacobian is only local
_DAMPING_M = 0.004  # lambda of the damped least squares in `Kinematics.reach_tip`
_BEYOND_WEIGHT = 1e6  # cost of exceeding a limit by 1 rad, relative to a change by 1 rad
_PULL = 0.1  # share of the way to ``rest`` that a step goes, in the null space of the Jacobian


class Kinematics:
    """Forward and inverse kinematics of a scene's hand, within the joints' limits.

    Args:
        scene: a scene; its hand's n joints are first in qpos. The base has three slides, then three
            X-Y-Z hinges, all on one body.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene, self._model = scene, scene.model
        self.data = mujoco.MjData(scene.model)
        self.fingers = names.fingers(scene)
        self.low, self.high = scene.model.jnt_range[: scene.index.num_joints].T.copy()
        self._n, self._couplings = scene.index.num_joints, scene.index.couplings
        self._base = int(scene.model.jnt_bodyid[0])
        self._wrist = int(scene.index.point_bodies[0])
        self._jacobian = np.zeros((3, scene.model.nv))

    def forward(self, qpos: np.ndarray) -> mujoco.MjData:
        """Return the scene's kinematics at qpos (nq,); the next call overwrites the result."""
        self.data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self.data)
        mujoco.mj_comPos(self._model, self.data)
        return self.data

    def wrist_pose(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the wrist's position (3,) m and the mount's orientation (4,) wxyz, world frame."""
        data = self.forward(qpos)
        return data.xpos[self._wrist].copy(), data.xquat[self._base].copy()

    def tip(self, qpos: np.ndarray, finger: int) -> np.ndarray:
        """Return a fingertip's position (3,) m, world frame."""
        return self.forward(qpos).xpos[self.fingers[finger].tip_body].copy()

    def place_wrist(self, qpos: np.ndarray, pos: np.ndarray, quat: np.ndarray) -> np.ndarray:
        """Return joints (n,) that bring the wrist to a pose, clipped to the joints' limits.

        The inverse of :meth:`wrist_pose`. Several triples of hinge angles give the orientation:
        those within the limits are preferred, then those nearest to the last pose.

        Args:
            qpos: the last pose (nq,).
            pos: position of the wrist, (3,) m, world frame.
            quat: orientation of the mount body, (4,) wxyz, world frame.
        """
        data, flat = self.forward(qpos), np.empty(9)
        base = data.xmat[self._base].reshape(3, 3)
        arm = base.T @ (data.xpos[self._wrist] - data.xpos[self._base])  # base to wrist
        mujoco.mju_quat2Mat(flat, np.asarray(quat, float) / np.linalg.norm(quat))
        rotation = flat.reshape(3, 3)
        slides, hinges = base_joints(self._scene, np.asarray(pos) - rotation @ arm, rotation)
        joints = qpos[: self._n].copy()
        joints[:3] = slides
        joints[3:6] = self._nearest(hinges, qpos[3:6])
        return joints.clip(self.low, self.high)

    def _nearest(self, hinges: np.ndarray, near: np.ndarray) -> np.ndarray:
        """Return the triple of ``hinges`` (2, 3) rad, plus full turns, that is nearest to ``near``.

        Triples within the limits have priority.
        """
        low, high = self.low[3:6], self.high[3:6]
        found = []
        for angles in hinges:
            turns = angles + 2 * np.pi * np.arange(-2, 3)[:, None]  # (turns, 3)
            beyond = np.abs(turns - turns.clip(low, high))
            costs = _BEYOND_WEIGHT * beyond + np.abs(turns - near)
            best = costs.argmin(axis=0)
            each = np.arange(3)
            found.append((float(costs[best, each].sum()), turns[best, each]))
        return min(found, key=lambda one: one[0])[1]

    def reach_tip(
        self, qpos: np.ndarray, finger: int, target: np.ndarray, rest: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Return joints (n,) that bring a fingertip as near to a target as its finger can.

        Damped least squares with the fingertip's Jacobian J and its damped pseudo-inverse J#, for a
        step e towards the target and a pull p towards ``rest`` in J's null space:

            dq = J# e + (I - J# J) p        J# = J^T (J J^T + lambda^2 I)^-1

        Joints that are at a limit and would exceed it are left out of a step.

        Args:
            qpos: the last pose (nq,).
            finger: index of the finger; only its joints move.
            target: target of the fingertip, (3,) m, world frame.
            rest: joints (n,) that the finger should stay near.

        Returns:
            The joints, and the fingertip's distance from the target, m.
        """
        one = self.fingers[finger]
        ids = np.setdiff1d(one.joints, self._couplings.followers)
        low, high = self.low[ids], self.high[ids]
        qpos = qpos.copy()
        best, least = qpos[: self._n].copy(), np.inf
        for _ in range(_ITERATIONS):
            error = target - self.tip(qpos, finger)
            distance = float(np.linalg.norm(error))
            if distance < least:
                best, least = qpos[: self._n].copy(), distance
            if distance < TIP_TOLERANCE_M:
                break
            step = error * min(1.0, _STEP_M / distance)
            mujoco.mj_jacBody(self._model, self.data, self._jacobian, None, one.tip_body)
            jacobian = self._couplings.folded(self._jacobian, qpos)
            change = _damped(jacobian[:, ids], step, rest[ids] - qpos[ids])
            stuck = ((qpos[ids] <= low) & (change < 0)) | ((qpos[ids] >= high) & (change > 0))
            if stuck.any():
                free = ~stuck
                change[stuck] = 0.0
                pull = (rest[ids] - qpos[ids])[free]
                change[free] = _damped(jacobian[:, ids[free]], step, pull)
            qpos[ids] = (qpos[ids] + change).clip(low, high)
            self._couplings.apply(qpos)
        return best, least


def _damped(jacobian: np.ndarray, step: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """Return the change (J,) of J joints for a step (3,) m, with a pull (J,) in the null space."""
    square = jacobian @ jacobian.T + _DAMPING_M**2 * np.eye(3)
    inverse = jacobian.T @ np.linalg.inv(square)
    back = _PULL * pull
    return inverse @ step + back - inverse @ (jacobian @ back)
