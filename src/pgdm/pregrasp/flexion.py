"""Which way the fingers close and the palm faces, derived from a hand's kinematics."""

from __future__ import annotations

import mujoco
import numpy as np

from pgdm.pregrasp.hand_geometry import opposing_finger, straight, unit
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene

_SAMPLES = 21  # angles tried from a joint's straight position to each of its limits
# A joint closes the thumb only if it can bring the thumb's tip nearer to the palm by more than
# `_LEAST_M`. A joint closes another finger if the cosine of the angle between the tip's motion and
# the palm's normal is larger than `_BENDS`.
_LEAST_M = 0.01
_BENDS = 0.5


class Flexion:
    """How a scene's hand closes.

    Args:
        scene: a scene; its hand's n joints are first in qpos.
    """

    def __init__(self, scene: Scene) -> None:
        model, index = scene.model, scene.index
        self._model, self._data = model, mujoco.MjData(model)
        self._couplings = index.couplings
        contact = HandContact(scene)
        self.first = contact.first_finger_joint
        """Index of the first finger joint in qpos; finger joints run from here to n."""
        self.finger_of_joint = contact.finger_of_joint
        self.num_fingers = contact.num_fingers
        tips = index.point_geoms[index.fingertips]
        self._tips = {contact.finger_of_geom(int(geom)): int(geom) for geom in tips}
        bases = [self.first + int(np.argmax(self.finger_of_joint == f)) for f in self._tips]
        self._thumb = thumb = opposing_finger(scene, contact)
        self._others = [finger for finger in self._tips if finger != thumb]
        carrier = bases[list(self._tips).index(self._others[0])]
        self._palm = int(model.body_parentid[model.jnt_bodyid[carrier]])
        self._straight = straight(scene)
        data = self._at(self._straight)
        knuckles = data.xanchor[[b for b, f in zip(bases, self._tips, strict=True) if f != thumb]]
        wrist = data.geom_xpos[index.point_geoms[0]]
        centre = 0.5 * (knuckles.mean(0) + wrist)  # of the palm, (3,) m, with straight fingers
        normal = self._normal(knuckles.mean(0), centre)
        self.closed = self._closed(normal, centre)
        """Angle of each finger joint when closed, (J,) rad; NaN for joints that do not bend a
        finger towards the palm, such as those that spread the fingers."""
        data = self._at(self._straight)
        rotation = data.xmat[self._palm].reshape(3, 3)
        self.normal = normal @ rotation
        """Unit vector in which the palm faces (3,), in the frame of the palm's body."""
        self.centre = (centre - data.xpos[self._palm]) @ rotation
        """Middle of the palm (3,) m, in the frame of the palm's body."""

    def palm(self, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the palm's middle (3,) m and normal (3,) at qpos (nq,), world frame."""
        data = self._at(qpos)
        rotation = data.xmat[self._palm].reshape(3, 3)
        return data.xpos[self._palm] + rotation @ self.centre, rotation @ self.normal

    def _at(self, joints: np.ndarray) -> mujoco.MjData:
        self._data.qpos[: len(joints)] = joints
        self._couplings.apply(self._data.qpos)
        mujoco.mj_kinematics(self._model, self._data)
        return self._data

    def _gains(self, joint: int, tip: int, centre: np.ndarray) -> list[float]:
        """Return how much nearer (m) to ``centre`` a joint brings a tip if turned to each limit."""
        gains = []
        for end in self._model.jnt_range[joint]:
            joints, far = self._straight.copy(), []
            for angle in np.linspace(self._straight[joint], end, _SAMPLES):
                joints[joint] = angle
                far.append(float(np.linalg.norm(self._at(joints).geom_xpos[tip] - centre)))
            gains.append(far[0] - min(far))
        return gains

    def _swing(self, joint: int, tip: int) -> np.ndarray:
        """Return the unit direction (3,) in which a tip moves when a joint's angle grows."""
        data = self._at(self._straight)
        return unit(np.cross(data.xaxis[joint], data.geom_xpos[tip] - data.xanchor[joint]))

    def _joints(self, finger: int) -> list[int]:
        return (self.first + np.flatnonzero(self.finger_of_joint == finger)).tolist()

    def _normal(self, knuckles: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Return the direction (3,), world frame, in which all fingers except the thumb bend."""
        swings = []
        for finger in self._others:
            tip = self._tips[finger]
            gains = {joint: self._gains(joint, tip, centre) for joint in self._joints(finger)}
            best = max(gains, key=lambda joint: max(gains[joint]))
            swings.append(self._swing(best, tip) * (1 if gains[best][1] > gains[best][0] else -1))
        tips = self._at(self._straight).geom_xpos[[self._tips[f] for f in self._others]]
        along = unit(tips.mean(0) - knuckles)
        swing = np.mean(swings, axis=0)
        return unit(swing - along * (along @ swing))

    def _closed(self, normal: np.ndarray, centre: np.ndarray) -> np.ndarray:
        """Return for each finger joint (J,) the limit that closes its finger; NaN if none does."""
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
