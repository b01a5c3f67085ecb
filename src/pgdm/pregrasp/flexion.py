"""Which way fingers close, and where the palm looks: read from a hand's kinematics."""

from __future__ import annotations

import mujoco
import numpy as np

from pgdm.pregrasp.waypoints import opposing_finger
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene

_STEPS = 21  # of a joint's range that are looked at
_LEAST_M = 0.01  # a thumb's joint that brings its tip no nearer than this only turns it
_BENDS = 0.5  # cosine between a tip's way and the palm's direction: less is no bending


class Flexion:
    """How a scene's hand closes.

    Args:
        scene: its actuated joints are the hand's, first in qpos.
    """

    def __init__(self, scene: Scene) -> None:
        model, index = scene.model, scene.index
        self._model, self._data = model, mujoco.MjData(model)
        contact = HandContact(scene)
        self.first = contact.first_finger_joint
        """Finger joints are those from here to nu."""
        self.finger_of_joint = contact.finger_of_joint
        self.num_fingers = contact.num_fingers
        tips = index.point_geoms[index.fingertips]
        self._tips = {contact.finger_of_geom(int(geom)): int(geom) for geom in tips}
        bases = [self.first + int(np.argmax(self.finger_of_joint == f)) for f in self._tips]
        self._thumb = thumb = opposing_finger(scene, contact)
        self._others = [finger for finger in self._tips if finger != thumb]
        carrier = bases[list(self._tips).index(self._others[0])]
        self._palm = int(model.body_parentid[model.jnt_bodyid[carrier]])
        self._straight = np.zeros(model.nu).clip(*model.jnt_range[: model.nu].T)
        data = self._at(self._straight)
        knuckles = data.xanchor[[b for b, f in zip(bases, self._tips, strict=True) if f != thumb]]
        wrist = data.geom_xpos[index.point_geoms[0]]
        centre = 0.5 * (knuckles.mean(0) + wrist)  # of the palm, (3,) m, with straight fingers
        normal = self._normal(knuckles.mean(0), centre)
        self.closed = self._closed(normal, centre)
        """Where each finger joint is closed, (J,) rad; NaN for joints that do not close."""
        data = self._at(self._straight)
        turn = data.xmat[self._palm].reshape(3, 3)
        self.normal = normal @ turn
        """Where the palm looks, unit (3,), in the frame of the palm's body."""
        self.centre = (centre - data.xpos[self._palm]) @ turn
        """Middle of the palm (3,) m, in the frame of the palm's body."""

    def palm(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return middle and direction of the palm at qpos (nq,), (3,) each, world frame."""
        self._data.qpos[:] = qpos
        mujoco.mj_kinematics(self._model, self._data)
        turn = self._data.xmat[self._palm].reshape(3, 3)
        return self._data.xpos[self._palm] + turn @ self.centre, turn @ self.normal

    def _at(self, joints: np.ndarray) -> mujoco.MjData:
        self._data.qpos[: len(joints)] = joints
        mujoco.mj_kinematics(self._model, self._data)
        return self._data

    def _gains(self, joint: int, tip: int, centre: np.ndarray) -> list[float]:
        """Return how much nearer to a place each end of a joint's range can bring a tip, m."""
        gains = []
        for end in self._model.jnt_range[joint]:
            joints, far = self._straight.copy(), []
            for angle in np.linspace(self._straight[joint], end, _STEPS):
                joints[joint] = angle
                far.append(float(np.linalg.norm(self._at(joints).geom_xpos[tip] - centre)))
            gains.append(far[0] - min(far))
        return gains

    def _swing(self, joint: int, tip: int) -> np.ndarray:
        """Return the unit direction (3,) in which a tip moves when a joint's angle grows."""
        data = self._at(self._straight)
        swing = np.cross(data.xaxis[joint], data.geom_xpos[tip] - data.xanchor[joint])
        return swing / max(float(np.linalg.norm(swing)), 1e-9)

    def _joints(self, finger: int) -> list[int]:
        return (self.first + np.flatnonzero(self.finger_of_joint == finger)).tolist()

    def _normal(self, knuckles: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Return the direction (3,) in which the fingers that are no thumb bend."""
        swings = []
        for finger in self._others:
            tip = self._tips[finger]
            gains = {joint: self._gains(joint, tip, centre) for joint in self._joints(finger)}
            best = max(gains, key=lambda joint: max(gains[joint]))
            swings.append(self._swing(best, tip) * (1 if gains[best][1] > gains[best][0] else -1))
        tips = self._at(self._straight).geom_xpos[[self._tips[f] for f in self._others]]
        along = tips.mean(0) - knuckles
        along /= np.linalg.norm(along)
        swing = np.mean(swings, axis=0)
        swing -= along * (along @ swing)
        return swing / np.linalg.norm(swing)

    def _closed(self, normal: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Return to which end of its range each finger joint bends its finger."""
        closed = np.full(len(self.finger_of_joint), np.nan)
        for finger, tip in self._tips.items():
            for joint in self._joints(finger):
                towards = float(self._swing(joint, tip) @ normal)
                if finger == self._thumb:
                    gains = self._gains(joint, tip, centre)
                    towards = float(np.sign(gains[1] - gains[0])) * (max(gains) > _LEAST_M)
                if abs(towards) > _BENDS:
                    closed[joint - self.first] = self._model.jnt_range[joint, int(towards > 0)]
        return closed
