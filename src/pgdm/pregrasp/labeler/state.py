"""The pose being edited: its joints, undo history and metrics, independent of the page."""

from __future__ import annotations

import numpy as np

from pgdm.errors import ConfigError
from pgdm.pregrasp.labeler import joint_names as names
from pgdm.pregrasp.labeler.kinematics import Kinematics
from pgdm.pregrasp.labeler.measures import Meter, Metrics
from pgdm.sim.scene import Scene

MAX_UNDO = 500
"""Largest number of steps that can be undone."""


class LabelState:
    """A pose of the hand in a scene with fixed objects.

    Every change keeps the joints within their limits. A change is a new step of the undo history,
    unless it continues the gesture of the last step, such as a drag.

    Args:
        scene: scene of the task, with any hand.
        qpos: the first pose (nq,); joints beyond their limits are clipped.
    """

    def __init__(self, scene: Scene, qpos: np.ndarray) -> None:
        self.scene = scene
        self.kinematics = Kinematics(scene)
        self.joints = names.joints(scene)
        self._meter = Meter(scene, self.kinematics)
        self._n = scene.index.num_joints
        self._qpos = np.array(qpos, float)
        self._qpos[: self._n] = self._checked(self._qpos[: self._n])
        self._start = self._qpos[: self._n].copy()
        self._undo: list[np.ndarray] = []  # joints (n,) before each step
        self._redo: list[np.ndarray] = []
        self._gesture: object = None
        self._rest = self._start
        self._measured: Metrics | None = None
        self.version = 0
        """Number of changes so far."""

    @property
    def qpos(self) -> np.ndarray:
        """A copy of the scene's positions (nq,), m and rad."""
        return self._qpos.copy()

    @property
    def metrics(self) -> Metrics:
        """Contacts and distances of the pose."""
        if self._measured is None:
            self._measured = self._meter.measure(self._qpos)
        return self._measured

    def set_joint(self, joint: int, value: float, gesture: object = None) -> None:
        """Set one joint, m or rad.

        Raises:
            ConfigError: the value is NaN or infinite.
        """
        joints = self._joints
        joints[joint] = value
        self.set_joints(joints, gesture)

    def set_joints(self, joints: np.ndarray, gesture: object = None) -> None:
        """Set all joint positions of the hand, (n,) m and rad.

        Raises:
            ConfigError: the number of joints is wrong, or a value is NaN or infinite.
        """
        joints, before = self._checked(joints), self._joints
        continues = self._rested(gesture)
        if np.array_equal(joints, before):
            return
        if not (continues and self._undo):
            self._undo.append(before)
            del self._undo[:-MAX_UNDO]
        self._redo.clear()
        self._move(joints, gesture)

    def place_wrist(self, pos: np.ndarray, quat: np.ndarray, gesture: object = None) -> None:
        """Move the wrist to ``pos`` (3,) m, turn the mount body to ``quat`` (4,); world frame."""
        if not (np.isfinite(pos).all() and np.isfinite(quat).all() and np.linalg.norm(quat) > 0.1):
            raise ConfigError(
                f"the wrist cannot go to {pos}, {quat}: not a finite pose with a nonzero quaternion"
            )
        self.set_joints(self.kinematics.place_wrist(self._qpos, pos, quat), gesture)

    def place_tip(self, finger: int, target: np.ndarray, gesture: object = None) -> float:
        """Bring a fingertip as near as its finger can to a point (3,) m, world frame.

        Returns:
            The fingertip's distance from the point, m.
        """
        if not np.isfinite(target).all():
            raise ConfigError(f"the fingertip cannot go to {target}: not a finite position")
        self._rested(gesture)
        joints, missed = self.kinematics.reach_tip(self._qpos, finger, target, self._rest)
        self.set_joints(joints, gesture)
        return missed

    def undo(self) -> bool:
        """Undo the last step; return whether there was one."""
        return self._restore(self._undo, self._redo)

    def redo(self) -> bool:
        """Redo the last undone step; return whether there was one."""
        return self._restore(self._redo, self._undo)

    def reset(self) -> None:
        """Return to the first pose, as a new step of the undo history."""
        self.set_joints(self._start)

    def _restore(self, steps: list[np.ndarray], opposite: list[np.ndarray]) -> bool:
        if not steps:
            return False
        opposite.append(self._joints)
        self._move(steps.pop(), None)
        return True

    def _rested(self, gesture: object) -> bool:
        """Return whether a gesture continues; if not, the present joints become the rest pose."""
        continues = gesture is not None and gesture == self._gesture
        if not continues:
            self._rest = self._joints
        return continues

    @property
    def _joints(self) -> np.ndarray:
        return self._qpos[: self._n].copy()

    def _move(self, joints: np.ndarray, gesture: object) -> None:
        self._qpos[: self._n], self._gesture = joints, gesture
        self._measured = None
        self.version += 1

    def _checked(self, joints: np.ndarray) -> np.ndarray:
        joints = np.asarray(joints, float)
        if joints.shape != (self._n,):
            raise ConfigError(
                f"a pose with {joints.size} joints does not fit hand '{self.scene.hand.name}', "
                f"which has {self._n}"
            )
        wrong = np.flatnonzero(~np.isfinite(joints))
        if wrong.size:
            joint = self.joints[int(wrong[0])]
            raise ConfigError(
                f"joint '{joint.name}' ({joint.full}) is {joints[wrong[0]]}; it must be finite"
            )
        inside = joints.clip(self.kinematics.low, self.kinematics.high)
        return self.scene.index.couplings.apply(inside)
