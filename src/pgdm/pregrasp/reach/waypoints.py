"""The reach as a path through three waypoints, encoded in a vector that the planner can search.

From the reset pose q_0 the hand goes to q_1 above the object, to q_2 at a standoff from the
pre-grasp, and to q_3, the pre-grasp plus an offset; there the thumb closes first, then the other
fingers. With s(x) = 10 x^3 - 15 x^4 + 6 x^5, x clipped to 0..1, and joint j moving from waypoint
k - 1 to k between the times b_jk and e_jk, the path is

    q_j(t) = q_0j + sum_k s((t - b_jk) / (e_jk - b_jk)) (q_kj - q_{k-1}j)

The actuator targets compensate the lag of a servo with damping d, gain k_p and inertia M:

    u = q + d/k_p qdot + M/k_p qddot

Only the hand's kinematics and servos, and the object's centre of mass, are used; contacts are not.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from pgdm.pregrasp.hand_geometry import mount_rotation, object_to_hand, opposing_finger, unit
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene

ABOVE_M = 0.3
"""Height of the first waypoint above the pre-grasp (paper, App. B)."""
STANDOFF_M = 0.08
"""Distance of the second waypoint from the pre-grasp, in the first round's mean."""
_OPEN_SHARE, _THUMB_SHARE = 0.6, 0.3  # first means of `Layout.openness`: fingers, thumb
# Shares of the plan's time: to q_1, to q_2, base to q_3, thumb to q_3, other fingers to q_3.
_DURATIONS = np.array([0.25, 0.25, 0.2, 0.12, 0.18])
_ABOVE_STD, _STANDOFF_STD = (0.05, 0.2), (0.04, 0.15)  # m, rad
_SHARE_STD, _DURATION_STD = 0.3, 0.3  # of openness and of the durations' logarithms


@dataclass(frozen=True)
class Layout:
    """Slices of a candidate's vector."""

    above: slice  # base joints at waypoint 1, relative to waypoint 3: slides m, then hinges rad
    standoff: slice  # base joints at waypoint 2, likewise
    openness: slice  # (F,) of each finger at waypoints 1 and 2: 0 as in waypoint 3, 1 as in q_0
    durations: slice  # (5,) logarithms of the relative durations, see `_DURATIONS`
    ends: slice  # (n,) offset of the final target (waypoint 3) from the goal, m and rad
    size: int


class Waypoints:
    """Turns the planner's candidate vectors into actuator targets.

    Args:
        scene: scene of the task; the hand's n joints are first in qpos.
        goal: joints (n,) of the pre-grasp, within the hand's ranges.
        qpos: whole scene (nq,) with the hand at its pre-grasp.
        steps: control steps of the plan, K.
        hold: control steps at the end in which the final targets are held.
        dt_s: duration of a control step, s.
    """

    def __init__(
        self, scene: Scene, goal: np.ndarray, qpos: np.ndarray, steps: int, hold: int, dt_s: float
    ) -> None:
        model, index = scene.model, scene.index
        self._goal, self._n = goal, index.num_joints
        self._low, self._high = index.joint_low, index.joint_high
        self._moving, self._steps, self._dt = steps - hold, steps, dt_s
        contact = HandContact(scene)
        self._base = index.num_base_joints
        self._fingers = slice(contact.first_finger_joint, self._n)
        self._finger_of_joint, self._num_fingers = contact.finger_of_joint, contact.num_fingers
        self._thumb = opposing_finger(scene, contact)
        kp = np.full(self._n, np.inf)  # coupled joints have no servo
        kp[index.driven] = model.actuator_gainprm[index.actuators, 0]
        self._lag = model.dof_damping[: self._n] / kp  # s
        self._inertia = model.dof_M0[: self._n] / kp  # s2
        self._home = index.reset.clip(self._low, self._high)
        mount = mount_rotation(scene)
        # Unit vectors (3,) in the slides' coordinates: up, and from the object to the hand.
        self._up = np.array([0.0, 0.0, 1.0]) @ mount
        self._away = unit(object_to_hand(scene, qpos)) @ mount
        self.layout = self._make_layout()

    def _make_layout(self) -> Layout:
        sizes = [self._base, self._base, self._num_fingers, len(_DURATIONS), self._n]
        ends = np.cumsum([0, *sizes]).tolist()
        parts = [slice(a, b) for a, b in itertools.pairwise(ends)]
        return Layout(*parts, size=ends[-1])

    def prior(self, end_std: tuple[float, float, float]) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation of the first candidates, (D,) each.

        Args:
            end_std: standard deviations of the final targets' offsets: slides m, hinges rad, joints
                after the base rad.
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
        """Joints (n,) with the hand :data:`ABOVE_M` above its pre-grasp, clipped to its ranges."""
        joints = self._goal.copy()
        joints[:3] += ABOVE_M * self._up
        return joints.clip(self._low, self._high)

    def targets(self, candidates: np.ndarray) -> np.ndarray:
        """Return the target joint positions (N, K, n), m and rad, of candidates (N, D)."""
        n, shares = len(candidates), np.exp(candidates[:, self.layout.durations])
        ends = np.cumsum(shares, 1) / shares.sum(1, keepdims=True) * self._moving  # (N, 5) steps
        begins = np.concatenate((np.zeros((n, 1)), ends[:, :-1]), 1)
        knots = self._knots(candidates)
        # The middle of each control step, plus one more at each end for the derivatives.
        t = np.arange(self._steps + 2)[:, None] - 0.5
        path = np.repeat(knots[0][:, None], len(t), 1)
        last = np.full(self._n, 2)  # index in durations of each joint's move to the last waypoint
        last[self._fingers] = np.where(self._finger_of_joint == self._thumb, 3, 4)
        for k, stage in ((1, 0), (2, 1), (3, last)):
            begin = np.broadcast_to(begins[:, stage].reshape(n, -1), (n, self._n))[:, None]
            end = np.broadcast_to(ends[:, stage].reshape(n, -1), (n, self._n))[:, None]
            share = ((t - begin) / (end - begin)).clip(0.0, 1.0)
            path += _smooth(share) * (knots[k] - knots[k - 1])[:, None]
        speed = (path[:, 2:] - path[:, :-2]) / (2 * self._dt)
        push = (path[:, 2:] - 2 * path[:, 1:-1] + path[:, :-2]) / self._dt**2
        targets = path[:, 1:-1] + self._lag * speed + self._inertia * push
        return targets.clip(self._low, self._high)

    def _knots(self, candidates: np.ndarray) -> list[np.ndarray]:
        """Return the reset pose and the three waypoints, (N, n) each, of candidates (N, D)."""
        layout, base, fingers = self.layout, self._base, self._fingers
        goal = self._goal + candidates[:, layout.ends]
        above, standoff = goal.copy(), goal.copy()
        above[:, :base] += candidates[:, layout.above]
        standoff[:, :base] += candidates[:, layout.standoff]
        openness = candidates[:, layout.openness].clip(0.0, 1.0)[:, self._finger_of_joint]
        standoff[:, fingers] += openness * (self._home[fingers] - goal[:, fingers])
        above[:, fingers] = standoff[:, fingers]
        waypoints = [row.clip(self._low, self._high) for row in (above, standoff, goal)]
        return [np.repeat(self._home[None], len(candidates), 0), *waypoints]


def _per_joint(base: int, slides: float, hinges: float) -> np.ndarray:
    return np.where(np.arange(base) < 3, slides, hinges)


def _smooth(share: np.ndarray) -> np.ndarray:
    """Return 10 x^3 - 15 x^4 + 6 x^5, with zero velocity and acceleration at x = 0 and 1."""
    return share**3 * (10 - 15 * share + 6 * share**2)
