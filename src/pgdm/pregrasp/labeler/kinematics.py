"""From where the wrist or a fingertip is dragged to the hand's joints."""

from __future__ import annotations

import mujoco
import numpy as np
import torch

from pgdm import rotations
from pgdm.pregrasp.labeler import names
from pgdm.sim.scene import Scene

TIP_TOLERANCE_M = 1e-4
"""A fingertip this near to its target has reached it."""
_ITERATIONS = 40
_STEP_M = 0.02  # longest step of a fingertip towards its target: the Jacobian is only local
_DAMPING_M = 0.004  # of the least squares: how far from singular poses it acts
_BEYOND_WEIGHT = 1e6  # of an angle beyond its limits, against its distance from the one before
_PULL = 0.1  # share of the way back to the pose before, where the fingertip leaves a choice


class Kinematics:
    """Forward and inverse kinematics of a scene's hand; keeps its joints within their limits.

    Args:
        scene: its actuated joints are the hand's, first in qpos; base joints are three slides,
            then three hinges, X-Y-Z, on one body.
    """

    def __init__(self, scene: Scene) -> None:
        self._scene, self._model = scene, scene.model
        self.data = mujoco.MjData(scene.model)
        self.fingers = names.fingers(scene)
        self.low, self.high = scene.model.jnt_range[: scene.model.nu].T.copy()
        self._base = int(scene.model.jnt_bodyid[0])
        self._wrist = int(scene.index.point_bodies[0])
        self._jacobian = np.zeros((3, scene.model.nv))

    def forward(self, qpos: np.ndarray) -> mujoco.MjData:
        """Return the scene's kinematics at qpos (nq,); the next call writes over it."""
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
        """Return joints (nu,) that bring the wrist to a pose as near as the base's limits allow.

        The inverse of :meth:`wrist_pose`: in the mount's frame the base's position gives the three
        slides, and its orientation, as intrinsic X-Y-Z Euler angles, the three hinges. Of the
        angles that mean the same orientation those within the limits are taken, then the nearest.

        Args:
            qpos: the pose before, (nq,).
            pos: of the wrist, (3,) m, world frame.
            quat: of the mount's body, (4,) wxyz.
        """
        index = self._scene.index
        wrist, now = self.wrist_pose(qpos)
        arm = np.empty(3)  # from the base's origin to the wrist, in the base's frame
        mujoco.mju_rotVecQuat(arm, wrist - self.data.xpos[self._base], _inverse(now))
        turned = np.empty(3)
        unit = np.asarray(quat, float) / np.linalg.norm(quat)
        mujoco.mju_rotVecQuat(turned, arm, unit)
        to_mount, slides, in_mount = _inverse(index.mount_quat), np.empty(3), np.empty(4)
        mujoco.mju_rotVecQuat(slides, np.asarray(pos, float) - turned - index.mount_pos, to_mount)
        mujoco.mju_mulQuat(in_mount, to_mount, unit)
        joints = qpos[: self._model.nu].copy()
        joints[:3] = slides
        joints[3:6] = self._hinges(in_mount, qpos[3:6])
        return joints.clip(self.low, self.high)

    def _hinges(self, quat: np.ndarray, near: np.ndarray) -> np.ndarray:
        """Return hinge angles (3,) rad of an orientation (4,), as near as possible to others."""
        x, y, z = rotations.to_euler_xyz(torch.from_numpy(quat)).numpy()
        low, high = self.low[3:6], self.high[3:6]
        found = []
        for angles in (np.array([x, y, z]), np.array([x + np.pi, np.pi - y, z + np.pi])):
            turns = angles + 2 * np.pi * np.arange(-2, 3)[:, None]  # (turns, 3), all the same
            beyond = np.abs(turns - turns.clip(low, high))
            costs = _BEYOND_WEIGHT * beyond + np.abs(turns - near)
            best = costs.argmin(axis=0)
            each = np.arange(3)
            found.append((float(costs[best, each].sum()), turns[best, each]))
        return min(found, key=lambda one: one[0])[1]

    def reach_tip(
        self, qpos: np.ndarray, finger: int, target: np.ndarray, rest: np.ndarray
    ) -> tuple[np.ndarray, float]:
        """Return joints (nu,) whose fingertip is as near to a target as its finger goes.

        Damped least squares on the fingertip's Jacobian. A joint at its limit is left out for a
        step that would go beyond; where the fingertip leaves a choice, joints go back to rest.

        Args:
            qpos: the pose before, (nq,).
            finger: which of the fingers; only its own joints move.
            target: of the fingertip, (3,) m, world frame.
            rest: joints (nu,) that the finger keeps to if it can.

        Returns:
            The joints, and how far the fingertip is from the target, m.
        """
        one = self.fingers[finger]
        ids = np.array(one.joints)
        low, high = self.low[ids], self.high[ids]
        qpos = qpos.copy()
        best, least = qpos[: self._model.nu].copy(), np.inf
        for _ in range(_ITERATIONS):
            error = target - self.tip(qpos, finger)
            distance = float(np.linalg.norm(error))
            if distance < least:
                best, least = qpos[: self._model.nu].copy(), distance
            if distance < TIP_TOLERANCE_M:
                break
            step = error * min(1.0, _STEP_M / distance)
            mujoco.mj_jacBody(self._model, self.data, self._jacobian, None, one.tip_body)
            change = _damped(self._jacobian[:, ids], step, rest[ids] - qpos[ids])
            stuck = ((qpos[ids] <= low) & (change < 0)) | ((qpos[ids] >= high) & (change > 0))
            if stuck.any():
                free = ~stuck
                change[stuck] = 0.0
                pull = (rest[ids] - qpos[ids])[free]
                change[free] = _damped(self._jacobian[:, ids[free]], step, pull)
            qpos[ids] = (qpos[ids] + change).clip(low, high)
        return best, least


def _damped(jacobian: np.ndarray, step: np.ndarray, pull: np.ndarray) -> np.ndarray:
    """Return the least change of joints (J,) for a step (3,); a pull (J,) where it is free."""
    square = jacobian @ jacobian.T + _DAMPING_M**2 * np.eye(3)
    inverse = jacobian.T @ np.linalg.inv(square)
    back = _PULL * pull
    return inverse @ step + back - inverse @ (jacobian @ back)


def _inverse(quat: np.ndarray) -> np.ndarray:
    return quat * np.array([1.0, -1.0, -1.0, -1.0])
