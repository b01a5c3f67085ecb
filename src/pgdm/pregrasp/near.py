"""Searches for a pre-grasp if a task has none: hand poses near the object that do not touch it.

A cross-entropy search over the hand's joints, started from several orientations of the base. It
minimises, over poses h within the joints' limits,

    mean_f |d_f - d*|  +  sum_k w_k c_k(h)

with d_f the distance of fingertip f from the object and d* :data:`TIP_DISTANCE_M`. The terms c_k,
weighted by ``_WEIGHTS``:

- depth: amount by which contacts are closer than :data:`CLEARANCE_M`, summed, m
- middle: distance of the object's centre of mass from the point halfway between the thumb's tip
  and the mean of the other tips, m
- across: |u_thumb + u_others|, with u the mean unit vectors from the centre of mass to the tips; 0
  if the thumb opposes the other fingers
- posture: mean squared difference of the finger joints from a given posture, rad^2
- wrist: mean squared angle of base hinges and wrist joints, rad^2
- tendons: angle by which joints exceed the range of a tendon that couples them, rad
- beyond: a further cost, computed by the caller's function
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np

from pgdm import seeding
from pgdm.cem import CemCfg, CrossEntropy
from pgdm.errors import SceneError
from pgdm.library.progress import StepProgress, silent
from pgdm.pregrasp.hand_geometry import mount_rotation, opposing_finger
from pgdm.sim.contact import FingertipDistance, HandContact
from pgdm.sim.scene import Scene

CLEARANCE_M = 0.003
"""Distance that the search tries to keep between the hand and everything else. In returned poses it
may be smaller, but the hand touches nothing but itself."""
TIP_DISTANCE_M = 0.015
"""Desired distance of the fingertips from the object."""

STARTS, ROUNDS = 8, 30
_SPREAD = (0.04, 0.3, 0.2)  # first standard deviations: slides m, base hinges, other joints rad
_CEM = CemCfg(48, 8, added=0.03)
_WRIST_RAD = (0.7, 0.7, 1.3)  # largest starting angle of each base hinge
_WEIGHTS = {
    "depth": 20.0,
    "middle": 0.5,
    "across": 0.03,
    "posture": 0.01,
    "wrist": 0.01,
    "tendons": 0.1,
    "beyond": 5.0,
}


@dataclass(frozen=True)
class NearPose:
    """A pose found by the search."""

    qpos: np.ndarray  # (nq,) whole scene
    cost: float
    tip_distances_m: np.ndarray  # (F,) distance from each finger's last link to the object


Beyond = Callable[[np.ndarray], float]
"""Maps qpos (nq,) to the largest amount by which the base would leave its permitted range if it
followed the motion, m or rad."""


def poses_near(
    scene: Scene,
    qpos: np.ndarray,
    fingers: np.ndarray,
    beyond: Beyond,
    progress: StepProgress = silent,
) -> list[NearPose]:
    """Search for poses of the hand near the object; equal arguments give equal poses.

    Args:
        scene: scene of the task.
        qpos: whole scene (nq,); objects stay where they are.
        fingers: posture (J,) rad that the finger joints should stay near.
        beyond: further cost of a pose.
        progress: called before each start of the search, and at the end.

    Returns:
        Poses in which the hand touches nothing but itself, best first.

    Raises:
        SceneError: no such pose was found.
    """
    search = _Search(scene, np.asarray(qpos, float), fingers, beyond)
    stream = seeding.numpy_stream(0, "near")
    found = []
    for start in range(STARTS):
        progress("pre-grasp search", start, STARTS)
        pose = search.run(stream, first=start == 0)
        if pose is not None:
            found.append(pose)
    progress("pre-grasp search", STARTS, STARTS)
    if not found:
        raise SceneError(
            f"found no pose near the object in which hand '{scene.hand.name}' touches nothing; "
            "move the object elsewhere on the table, or pass a pose with --pregrasp FILE"
        )
    return sorted(found, key=lambda pose: pose.cost)


class _Search:
    """The search in one scene, with the cost of a pose."""

    def __init__(self, scene: Scene, qpos: np.ndarray, fingers: np.ndarray, beyond: Beyond) -> None:
        self._scene, self._qpos, self._beyond = scene, qpos, beyond
        self._contact = HandContact(scene)
        self._model = model = copy.copy(scene.model)
        model.geom_margin[:] = np.maximum(model.geom_margin, CLEARANCE_M)
        self._data = mujoco.MjData(model)
        n, base = scene.index.num_joints, scene.index.num_base_joints
        self._n, self._base = n, base
        self._first = self._contact.first_finger_joint
        self._low, self._high = model.jnt_range[:n].T.copy()
        self._posture = np.zeros(n)
        self._posture[self._first :] = fingers
        self._posture = self._posture.clip(self._low, self._high)
        scene.index.couplings.apply(self._posture)
        self._scale = np.full(n, _SPREAD[2])
        self._scale[:3], self._scale[3:base] = _SPREAD[0], _SPREAD[1]
        self._tips = scene.index.point_geoms[scene.index.fingertips]
        thumb = opposing_finger(scene, self._contact)
        of_tip = [self._contact.finger_of_geom(tip) for tip in self._tips.tolist()]
        self._thumb = np.array(of_tip) == thumb  # (F,)
        self._tendons = _Tendons(model)
        self._distance = FingertipDistance(scene)

    def run(self, stream: np.random.Generator, first: bool) -> NearPose | None:
        """Search from one orientation of the base: hinges at zero if ``first``, else random."""
        start = self._posture.copy()
        limits = np.array(_WRIST_RAD[: self._base - 3])
        start[3 : self._base] = 0.0 if first else stream.uniform(-limits, limits)
        start = self._centred(start.clip(self._low, self._high))
        search = CrossEntropy(np.zeros(self._n), np.ones(self._n), _CEM, stream)
        best, best_cost = None, np.inf
        for _ in range(ROUNDS):
            moves = search.ask()
            joints = (start + self._scale * moves).clip(self._low, self._high)
            self._scene.index.couplings.apply(joints)
            costs = np.array([self._cost(row)[0] for row in joints])
            first_of_round = search.tell(moves, costs)[0]
            if costs[first_of_round] < best_cost:
                best, best_cost = joints[first_of_round].copy(), float(costs[first_of_round])
        if best is None:
            return None
        cost, distances = self._cost(best)
        qpos = np.concatenate((best, self._qpos[self._n :]))
        if self._contact.depth(qpos) > 0.0:
            return None
        return NearPose(qpos, cost, distances)

    def _cost(self, joints: np.ndarray) -> tuple[float, np.ndarray]:
        """Return the cost of a pose, and the fingertips' distances (F,) m."""
        model, data = self._model, self._data
        self._place(joints)
        mujoco.mj_collision(model, data)
        depth = self._contact.too_near(data, CLEARANCE_M)
        distances = self._distance(data)
        com = data.xipos[self._scene.index.object_body]
        tips = data.geom_xpos[self._tips]
        units = tips - com
        units /= np.maximum(np.linalg.norm(units, axis=1, keepdims=True), 1e-6)
        across = np.linalg.norm(units[self._thumb].mean(axis=0) + units[~self._thumb].mean(axis=0))
        fingers = joints[self._first :] - self._posture[self._first :]
        terms = {
            "depth": depth,
            "middle": float(np.linalg.norm(self._middle() - com)),
            "across": float(across),
            "posture": float((fingers**2).mean()),
            "wrist": float((joints[3 : self._first] ** 2).mean()),
            "tendons": self._tendons.beyond_rad(data),
            "beyond": self._beyond(np.concatenate((joints, self._qpos[self._n :]))),
        }
        cost = float(np.abs(distances - TIP_DISTANCE_M).mean())
        return cost + sum(_WEIGHTS[name] * value for name, value in terms.items()), distances

    def _place(self, joints: np.ndarray) -> None:
        self._data.qpos[:] = self._qpos
        self._data.qpos[: self._n] = joints
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_comPos(self._model, self._data)
        mujoco.mj_tendon(self._model, self._data)

    def _middle(self) -> np.ndarray:
        """Return the point halfway between the thumb's tip and the mean of the others, (3,) m."""
        tips = self._data.geom_xpos[self._tips]
        return 0.5 * (tips[self._thumb].mean(axis=0) + tips[~self._thumb].mean(axis=0))

    def _centred(self, joints: np.ndarray) -> np.ndarray:
        """Return joints (n,) with the slides moved so that the fingertips surround the object."""
        self._place(joints)
        shift = self._data.xipos[self._scene.index.object_body] - self._middle()
        moved = joints.copy()
        moved[:3] += mount_rotation(self._scene).T @ shift
        return moved.clip(self._low, self._high)


class _Tendons:
    """How far joints exceed the ranges of limited tendons; servos could not bring them there.

    Args:
        model: a model; only its fixed tendons count (their length is a weighted sum of joint
            angles).
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        fixed = model.wrap_type[model.tendon_adr] == mujoco.mjtWrap.mjWRAP_JOINT
        self._which = np.flatnonzero(fixed & (model.tendon_limited != 0))
        first, count = model.tendon_adr[self._which], model.tendon_num[self._which]
        spans = zip(first.tolist(), (first + count).tolist(), strict=True)
        self._arms = np.array([np.abs(model.wrap_prm[a:b]).max() for a, b in spans])  # m/rad
        self._range = model.tendon_range[self._which]

    def beyond_rad(self, data: mujoco.MjData) -> float:
        """Return the sum over tendons of excess length divided by the tendon's largest arm, rad."""
        length = data.ten_length[self._which]
        over = np.maximum(self._range[:, 0] - length, length - self._range[:, 1]).clip(0.0)
        return float((over / self._arms).sum())
