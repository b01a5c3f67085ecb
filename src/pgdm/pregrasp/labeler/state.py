"""The pose that is being made: its joints, its history, its figures. It knows of no page."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgdm.errors import ConfigError
from pgdm.pregrasp.labeler import names
from pgdm.pregrasp.labeler.figures import FigureMaker, Figures
from pgdm.pregrasp.labeler.kinematics import Kinematics
from pgdm.sim.scene import Scene

MAX_UNDO = 500
"""Steps that can be taken back."""


@dataclass
class _Step:
    joints: np.ndarray  # (nu,) before the change
    gesture: object  # changes of one gesture, such as one drag, are one step


class LabelState:
    """A pose of the hand in a scene whose objects stand still.

    Every change keeps the joints within their limits, and is one step of the history, or a part of
    the last one if both belong to the same gesture.

    Args:
        scene: the task's, with any hand.
        qpos: the pose to start with, (nq,); joints beyond their limits are set to them.
    """

    def __init__(self, scene: Scene, qpos: np.ndarray) -> None:
        self.scene = scene
        self.kinematics = Kinematics(scene)
        self.joints = names.joints(scene)
        self._figures = FigureMaker(scene, self.kinematics)
        self._nu = scene.model.nu
        self._qpos = np.array(qpos, float)
        self._qpos[: self._nu] = self._checked(self._qpos[: self._nu])
        self._start = self._qpos[: self._nu].copy()
        self._undo: list[_Step] = []
        self._redo: list[np.ndarray] = []
        self._gesture: object = None
        self._rest = self._start
        self._measured: Figures | None = None
        self.version = 0
        """Grows with every change."""

    @property
    def qpos(self) -> np.ndarray:
        """The whole scene's positions, (nq,) m and rad; a copy."""
        return self._qpos.copy()

    @property
    def figures(self) -> Figures:
        """Contacts and distances of the pose."""
        if self._measured is None:
            self._measured = self._figures.measure(self._qpos)
        return self._measured

    @property
    def can_undo(self) -> bool:
        """Whether there is a step to take back."""
        return bool(self._undo)

    @property
    def can_redo(self) -> bool:
        """Whether a step was taken back."""
        return bool(self._redo)

    def set_joint(self, joint: int, value: float, gesture: object = None) -> None:
        """Set one joint, m or rad.

        Raises:
            ConfigError: the value is NaN or infinite.
        """
        joints = self._qpos[: self._nu].copy()
        joints[joint] = value
        self.set_joints(joints, gesture)

    def set_joints(self, joints: np.ndarray, gesture: object = None) -> None:
        """Set all joints of the hand, (nu,) m and rad.

        Raises:
            ConfigError: their number is wrong, or a value is NaN or infinite.
        """
        joints = self._checked(joints)
        if gesture is None or gesture != self._gesture:
            self._rest = self._qpos[: self._nu].copy()
        if np.array_equal(joints, self._qpos[: self._nu]):
            return
        if gesture is None or gesture != self._gesture or not self._undo:
            self._undo.append(_Step(self._qpos[: self._nu].copy(), gesture))
            del self._undo[:-MAX_UNDO]
        self._gesture = gesture
        self._redo.clear()
        self._move(joints)

    def place_wrist(self, pos: np.ndarray, quat: np.ndarray, gesture: object = None) -> None:
        """Bring the wrist to a position (3,) m and the mount to an orientation (4,) wxyz, world."""
        if not (np.isfinite(pos).all() and np.isfinite(quat).all() and np.linalg.norm(quat) > 0.1):
            raise ConfigError(f"the wrist cannot go to {pos}, {quat}: these are no numbers")
        self.set_joints(self.kinematics.place_wrist(self._qpos, pos, quat), gesture)

    def place_tip(self, finger: int, target: np.ndarray, gesture: object = None) -> float:
        """Bring a fingertip as near to a point (3,) m, world frame, as its finger goes.

        Returns:
            How far it is from there, m.
        """
        if not np.isfinite(target).all():
            raise ConfigError(f"the fingertip cannot go to {target}: these are no numbers")
        if gesture is None or gesture != self._gesture:
            self._rest = self._qpos[: self._nu].copy()
        joints, missed = self.kinematics.reach_tip(self._qpos, finger, target, self._rest)
        rest = self._rest
        self.set_joints(joints, gesture)
        self._rest = rest
        return missed

    def undo(self) -> bool:
        """Take the last step back; return whether there was one."""
        if not self._undo:
            return False
        self._redo.append(self._qpos[: self._nu].copy())
        self._gesture = None
        self._move(self._undo.pop().joints)
        return True

    def redo(self) -> bool:
        """Do again what was taken back; return whether there was something."""
        if not self._redo:
            return False
        self._undo.append(_Step(self._qpos[: self._nu].copy(), None))
        self._gesture = None
        self._move(self._redo.pop())
        return True

    def reset(self) -> None:
        """Go back to the pose of the start; one step of the history."""
        self.set_joints(self._start)

    def _move(self, joints: np.ndarray) -> None:
        self._qpos[: self._nu] = joints
        self._measured = None
        self.version += 1

    def _checked(self, joints: np.ndarray) -> np.ndarray:
        joints = np.asarray(joints, float)
        if joints.shape != (self._nu,):
            raise ConfigError(
                f"a pose with {joints.size} joints does not fit hand '{self.scene.hand.name}', "
                f"which has {self._nu}"
            )
        wrong = np.flatnonzero(~np.isfinite(joints))
        if wrong.size:
            joint = self.joints[int(wrong[0])]
            raise ConfigError(f"joint '{joint.name}' ({joint.full}) is {joints[wrong[0]]}")
        return joints.clip(self.kinematics.low, self.kinematics.high)
