"""The reach as a path through a few waypoints, in numbers that a planner can search.

Only the hand's own kinematics and servos are known here: where its slides lead, which finger
opposes the others, how far a servo hangs behind. Of the object nothing but its centre of mass.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import mujoco
import numpy as np

from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene

ABOVE_M = 0.3
"""How far above its pre-grasp the hand comes to first (SPEC 2)."""
STANDOFF_M = 0.08
"""How far from its pre-grasp the hand stands while the thumb closes, before the search."""
_OPEN_SHARE = 0.6  # how far the other fingers are open there, before the search (1: straight)
_THUMB_SHARE = 0.3
# Shares of the plan's time: above, down to the standoff, to the pre-grasp, thumb, other fingers.
_DURATIONS = np.array([0.25, 0.25, 0.2, 0.12, 0.18])
_ABOVE_STD, _STANDOFF_STD = (0.05, 0.2), (0.04, 0.15)  # m, rad
_SHARE_STD, _DURATION_STD = 0.3, 0.3


@dataclass(frozen=True)
class Layout:
    """Where in a candidate's vector each of its parts lies."""

    above: slice  # slides m, then hinges rad, relative to the goal
    standoff: slice  # likewise
    openness: slice  # (F,) of each finger at the standoff; 1 is straight
    durations: slice  # (5,) logarithms
    ends: slice  # (nu,) what the last target adds to the goal, m and rad
    size: int


class Waypoints:
    """Turns candidates into actuator targets.

    Args:
        scene: its first joints are the hand's.
        goal: joints (nu,) at which the hand shall end, within the hand's ranges.
        qpos: whole scene (nq,) with the hand at its pre-grasp.
        steps: control steps of the plan, K.
        hold: of them, steps at the end in which the last target stays.
        dt_s: time of a control step.
    """

    def __init__(
        self, scene: Scene, goal: np.ndarray, qpos: np.ndarray, steps: int, hold: int, dt_s: float
    ) -> None:
        model, index = scene.model, scene.index
        self._goal, self._nu = goal, model.nu
        self._low, self._high = index.ctrl_low, index.ctrl_high
        self._moving, self._steps, self._dt = steps - hold, steps, dt_s
        contact = HandContact(scene)
        self._base, self._first_finger = index.num_base_joints, contact.first_finger_joint
        self._finger_of_joint, self._num_fingers = contact.finger_of_joint, contact.num_fingers
        self._thumb = opposing_finger(scene, contact)
        kp = model.actuator_gainprm[: model.nu, 0]
        # A servo with these two ahead of it follows a path instead of hanging behind.
        self._lag = model.dof_damping[: model.nu] / kp  # s
        self._inertia = model.dof_M0[: model.nu] / kp  # s2
        self._home = np.zeros(model.nu).clip(self._low, self._high)
        self._up, self._away = _directions(scene, qpos)
        self.layout = self._make_layout()

    def _make_layout(self) -> Layout:
        sizes = [self._base, self._base, self._num_fingers, len(_DURATIONS), self._nu]
        ends = np.cumsum([0, *sizes]).tolist()
        parts = [slice(a, b) for a, b in itertools.pairwise(ends)]
        return Layout(*parts, size=ends[-1])

    def prior(self, end_std: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation of the first candidates, (D,) each.

        Args:
            end_std: of what the last targets add to slides, m, hinges and fingers, rad.
        """
        layout, base = self.layout, self._base
        mean, std = np.zeros(layout.size), np.zeros(layout.size)
        mean[layout.above][:3] = ABOVE_M * self._up
        mean[layout.standoff][:3] = STANDOFF_M * self._away
        std[layout.above] = _per_joint(base, *_ABOVE_STD)
        std[layout.standoff] = _per_joint(base, *_STANDOFF_STD)
        mean[layout.openness] = _OPEN_SHARE
        mean[layout.openness][self._thumb] = _THUMB_SHARE
        std[layout.openness] = _SHARE_STD
        mean[layout.durations] = np.log(_DURATIONS)
        std[layout.durations] = _DURATION_STD
        slides, hinges, fingers = end_std
        std[layout.ends][:base] = _per_joint(base, slides, hinges)
        std[layout.ends][base:] = fingers
        return mean, std

    @property
    def above(self) -> np.ndarray:
        """Joints (nu,) of the pre-grasp's hand above it, or as far up as its slides go."""
        joints = self._goal.copy()
        joints[:3] += ABOVE_M * self._up
        return joints.clip(self._low, self._high)

    def targets(self, candidates: np.ndarray) -> np.ndarray:
        """Return actuator targets (N, K, nu) of candidates (N, D), m and rad."""
        layout, base, n = self.layout, self._base, len(candidates)
        shares = np.exp(candidates[:, layout.durations])
        ends = np.cumsum(shares, 1) / shares.sum(1, keepdims=True) * self._moving  # (N, 5) steps
        begins = np.concatenate((np.zeros((n, 1)), ends[:, :-1]), 1)
        goal = self._goal + candidates[:, layout.ends]
        above, standoff = goal.copy(), goal.copy()
        above[:, :base] += candidates[:, layout.above]
        standoff[:, :base] += candidates[:, layout.standoff]
        openness = candidates[:, layout.openness].clip(0.0, 1.0)[:, self._finger_of_joint]
        fingers = slice(self._first_finger, self._nu)
        opened = self._home[fingers] - goal[:, fingers]
        standoff[:, fingers] += openness * opened
        above[:, fingers] = standoff[:, fingers]
        knots = [np.repeat(self._home[None], n, 0)]
        knots += [row.clip(self._low, self._high) for row in (above, standoff, goal)]
        t = np.arange(self._steps + 2)[:, None] - 0.5  # of the path, to end where the step ends
        path = np.repeat(knots[0][:, None], len(t), 1)
        joint = np.arange(self._nu)
        of_thumb = np.zeros(self._nu, bool)
        of_thumb[fingers] = self._finger_of_joint == self._thumb
        last = np.where(joint < self._first_finger, 2, np.where(of_thumb, 3, 4))  # (nu,)
        for k, stage in ((1, 0), (2, 1), (3, last)):
            begin = np.broadcast_to(begins[:, stage].reshape(n, -1), (n, self._nu))[:, None]
            end = np.broadcast_to(ends[:, stage].reshape(n, -1), (n, self._nu))[:, None]
            share = ((t - begin) / (end - begin)).clip(0.0, 1.0)
            path += _smooth(share) * (knots[k] - knots[k - 1])[:, None]
        speed = (path[:, 2:] - path[:, :-2]) / (2 * self._dt)
        push = (path[:, 2:] - 2 * path[:, 1:-1] + path[:, :-2]) / self._dt**2
        targets = path[:, 1:-1] + self._lag * speed + self._inertia * push
        return targets.clip(self._low, self._high)


def opposing_finger(scene: Scene, contact: HandContact) -> int:
    """Return the thumb's number: straight, its tip is farthest from the others'."""
    model, index = scene.model, scene.index
    data = mujoco.MjData(model)
    data.qpos[: model.nu] = np.zeros(model.nu).clip(*model.jnt_range[: model.nu].T)
    mujoco.mj_kinematics(model, data)
    tips = index.point_geoms[index.fingertips]
    places = data.geom_xpos[tips]
    middle = (places.sum(0) - places) / max(len(tips) - 1, 1)  # of the others
    return contact.finger_of_geom(int(tips[np.linalg.norm(places - middle, axis=1).argmax()]))


def _directions(scene: Scene, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the slides' unit directions, (3,) each, up and from the object to the hand."""
    model, index = scene.model, scene.index
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(model, data)
    away = data.geom_xpos[index.point_geoms].mean(axis=0) - data.xipos[index.object_body]
    mount = np.empty(9)
    mujoco.mju_quat2Mat(mount, index.mount_quat)
    mount = mount.reshape(3, 3)
    return np.array([0.0, 0.0, 1.0]) @ mount, away / max(float(np.linalg.norm(away)), 1e-9) @ mount


def _per_joint(base: int, slides: float, hinges: float) -> np.ndarray:
    return np.where(np.arange(base) < 3, slides, hinges)


def _smooth(share: np.ndarray) -> np.ndarray:
    """Return the way along a path that begins and ends without speed or acceleration."""
    return share**3 * (10 - 15 * share + 6 * share**2)
