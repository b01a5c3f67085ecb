"""How good a pose is, fast enough to be shown while it changes."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from pgdm.pregrasp.labeler import names
from pgdm.pregrasp.labeler.kinematics import Kinematics
from pgdm.sim.contact import FREE_M, FingertipDistance
from pgdm.sim.scene import Scene

BEYOND = 0.01
"""By how much, m or rad, a joint may leave its actuator's range: some ranges are rounded."""


@dataclass(frozen=True)
class Touch:
    """A part of the hand that cuts into something."""

    part: str
    """Finger, ``palm``, or ``forearm``: what the wrist's joints leave behind."""
    body: str
    """What it cuts into."""
    depth_m: float


@dataclass(frozen=True)
class Figures:
    """Contacts and distances of a pose."""

    touches: tuple[Touch, ...]
    """One for each part and body, deepest first."""
    links: frozenset[int]
    """Bodies of the hand that cut into something."""
    tip_distances_m: np.ndarray
    """From each fingertip's surface to the object's (F,); below 0 inside."""
    beyond: tuple[str, ...]
    """Joints whose position no actuator target asks for."""

    @property
    def free(self) -> bool:
        """Whether the hand touches nothing."""
        return not self.touches

    @property
    def depth_m(self) -> float:
        """Deepest penetration, 0 if there is none."""
        return self.touches[0].depth_m if self.touches else 0.0

    @property
    def reason(self) -> str:
        """Sentence that says what the hand touches, or nothing."""
        parts = [f"{t.part} is {1e3 * t.depth_m:.1f} mm inside {t.body}" for t in self.touches]
        return "; ".join(parts)


class FigureMaker:
    """Measures poses of one scene.

    Args:
        scene: its actuated joints are the hand's, first in qpos.
        kinematics: of the same scene.
    """

    def __init__(self, scene: Scene, kinematics: Kinematics) -> None:
        model = scene.model
        self._model, self._index, self._kinematics = model, scene.index, kinematics
        self._joints = names.joints(scene)
        roots = model.body_rootid[model.jnt_bodyid[: model.nu]]
        self._of_hand = np.isin(model.body_rootid, roots)[model.geom_bodyid]
        self._part = _parts(model, scene.hand.num_base_joints, kinematics.fingers)
        self._distance = FingertipDistance(scene)

    def measure(self, qpos: np.ndarray) -> Figures:
        """Return the figures of qpos (nq,)."""
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
        return Figures(tuple(touches), frozenset(links), distances, self._beyond(qpos))

    def _beyond(self, qpos: np.ndarray) -> tuple[str, ...]:
        low, high = self._index.ctrl_low, self._index.ctrl_high
        values = qpos[: len(low)]
        outside = np.flatnonzero((values < low - BEYOND) | (values > high + BEYOND))
        return tuple(self._joints[i].full for i in outside)

    def _name(self, body: int) -> str:
        """Return what people call a body: an object's many parts have the object's name."""
        name = self._model.body(body).name or "the floor"
        return "the floor" if name == "world" else name.partition("/")[0]


def _parts(model: mujoco.MjModel, num_base: int, fingers: list[names.Finger]) -> list[str]:
    """Return to which part of the hand each body belongs."""
    wrist = [j for j in range(num_base, min(finger.joints[0] for finger in fingers))]
    part = [names.FOREARM if wrist else names.PALM] * model.nbody
    base = {int(model.jnt_bodyid[joint]): names.PALM for joint in wrist}
    base |= {int(model.jnt_bodyid[finger.joints[0]]): finger.name for finger in fingers}
    for body in range(1, model.nbody):
        inherited = part[model.body_parentid[body]]
        part[body] = base.get(body, inherited)
    return part
