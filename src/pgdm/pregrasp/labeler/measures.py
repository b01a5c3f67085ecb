"""Metrics of a pose, computed fast enough to be shown while the pose changes."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from pgdm.pregrasp.labeler import joint_names as names
from pgdm.pregrasp.labeler.kinematics import Kinematics
from pgdm.sim.contact import FREE_M, FingertipDistance
from pgdm.sim.scene import Scene

BEYOND = 0.01
"""How far (m or rad) a joint may exceed its actuator's range without counting as outside: some
ranges are rounded."""


@dataclass(frozen=True)
class Touch:
    """A part of the hand that penetrates something."""

    part: str
    """Name of a finger, ``palm``, or ``forearm`` (everything before the wrist joints)."""
    body: str
    """Name of the object that it penetrates, or ``the floor``."""
    depth_m: float


@dataclass(frozen=True)
class Metrics:
    """Contacts and distances of a pose."""

    touches: tuple[Touch, ...]
    """The deepest penetration of each part into each object, deepest first; only above 0.1 mm."""
    links: frozenset[int]
    """Ids of the hand's bodies that penetrate something by more than 0.1 mm."""
    tip_distances_m: np.ndarray
    """Distance between the surfaces of each finger's last link and of the object, (F,); negative if
    the link penetrates the object."""
    beyond: tuple[str, ...]
    """Joints whose position is outside their actuator's range."""

    @property
    def free(self) -> bool:
        """Whether the hand touches nothing but itself (no penetration above 0.1 mm)."""
        return not self.touches

    @property
    def depth_m(self) -> float:
        """Deepest penetration; 0 if none exceeds 0.1 mm."""
        return self.touches[0].depth_m if self.touches else 0.0

    @property
    def reason(self) -> str:
        """What the hand penetrates, in words; empty if nothing."""
        parts = [f"{t.part} is {1e3 * t.depth_m:.1f} mm inside {t.body}" for t in self.touches]
        return "; ".join(parts)


class Meter:
    """Measures poses of one scene.

    Args:
        scene: a scene; the hand's n joints are first in qpos.
        kinematics: kinematics of the same scene.
    """

    def __init__(self, scene: Scene, kinematics: Kinematics) -> None:
        model = scene.model
        self._model, self._index, self._kinematics = model, scene.index, kinematics
        self._names = [joint.full for joint in names.joints(scene)]
        roots = model.body_rootid[model.jnt_bodyid[: scene.index.num_joints]]
        self._of_hand = np.isin(model.body_rootid, roots)[model.geom_bodyid]
        self._part = _parts(model, scene.hand.num_base_joints, kinematics.fingers)
        self._distance = FingertipDistance(scene)

    def measure(self, qpos: np.ndarray) -> Metrics:
        """Return the metrics of qpos (nq,)."""
        data = self._kinematics.forward(qpos)
        mujoco.mj_collision(self._model, data)
        deepest: dict[tuple[str, str], float] = {}
        links = set()
        inside = data.contact.dist < -FREE_M
        for (one, two), dist in zip(
            data.contact.geom[inside], data.contact.dist[inside], strict=True
        ):
            if self._of_hand[one] == self._of_hand[two]:
                continue
            mine, other = (one, two) if self._of_hand[one] else (two, one)
            link = int(self._model.geom_bodyid[mine])
            links.add(link)
            key = self._part[link], self._name(int(self._model.geom_bodyid[other]))
            deepest[key] = max(deepest.get(key, 0.0), -float(dist))
        touches = [Touch(part, body, depth) for (part, body), depth in deepest.items()]
        touches.sort(key=lambda touch: -touch.depth_m)
        distances = self._distance(data)
        return Metrics(tuple(touches), frozenset(links), distances, self._beyond(qpos))

    def _beyond(self, qpos: np.ndarray) -> tuple[str, ...]:
        low, high = self._index.joint_low, self._index.joint_high
        values = qpos[: len(low)]
        outside = np.flatnonzero((values < low - BEYOND) | (values > high + BEYOND))
        return tuple(self._names[i] for i in outside)

    def _name(self, body: int) -> str:
        """Return the name to show for a body: that of its object, or ``the floor``."""
        name = self._model.body(body).name or "the floor"
        return "the floor" if name == "world" else name.partition("/")[0]


def _parts(model: mujoco.MjModel, num_base: int, fingers: list[names.Finger]) -> list[str]:
    """Return for each body the name of the part of the hand that the body belongs to."""
    wrist = list(range(num_base, min(finger.joints[0] for finger in fingers)))
    part = [names.FOREARM if wrist else names.PALM] * model.nbody
    base = {int(model.jnt_bodyid[joint]): names.PALM for joint in wrist}
    base |= {int(model.jnt_bodyid[finger.joints[0]]): finger.name for finger in fingers}
    for body in range(1, model.nbody):
        inherited = part[model.body_parentid[body]]
        part[body] = base.get(body, inherited)
    return part
