"""Differential inverse kinematics of a scene's hand (mink).

Each step solves a quadratic program for a change dq of the joints, within their limits:

    min  sum_p w_p^2 |x_p + J_p dq - x*_p|^2 + w_R^2 |theta|^2 + w_h^2 |q_f + dq_f - mean_f|^2

plus damping. Here x_p are the hand's tracked points, J_p their Jacobians and x*_p their targets,
theta is the palm's rotation error after the step, and q_f are the finger joints, which the last
term pulls weakly towards the hand's mean pre-grasp, mean_f.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, field, replace
from functools import cached_property

import mink
import mujoco
import numpy as np
from mink.exceptions import NoSolutionFound

from pgdm.pregrasp.hand_geometry import posed
from pgdm.pregrasp.retarget.targets import HandShape, Targets
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene

REACHED_M = 0.02
"""A fingertip counts as out of reach if it is farther from its target than this."""
AT_LIMIT = 1e-3
"""A joint counts as at a limit if it is closer to the limit than this, m or rad."""
CLEARANCE_M = 0.001
"""Distance that obstacle avoidance keeps between the hand and everything else."""

_SOLVER = "daqp"
_STEPS, _SETTLED = 200, 1e-5  # most steps; fewer once all joints change by less, m or rad
_DAMPING = 1e-6
_MEAN_WEIGHT = 0.006  # per rad; small, since it should only fix joints that the points leave free
_FAR_M = 0.02  # obstacles farther from the hand than this are ignored
_LARGEST_STEP = 0.15  # of a joint in one step, m or rad: the Jacobian is only local
_DEPTH_COST = 20.0  # cost of penetration relative to that of fingertip errors


@dataclass(frozen=True)
class IkResult:
    """A pose found by inverse kinematics, with its errors."""

    qpos: np.ndarray = field(repr=False)
    """Whole scene (nq,): the hand's joints, then those of the objects, unchanged."""
    fingertip_errors_m: np.ndarray
    """Distance of each fingertip from its target (F,)."""
    palm_error_rad: float
    """Angle between the palm's orientation and its target."""
    points_error_m: float
    """Mean distance of the hand's points from their targets, weighted by ``targets.weights``."""
    depth_m: float
    """Deepest penetration between the hand and anything else."""
    at_limit: tuple[str, ...]
    """Names of the joints that are at a limit."""
    slides_at_limit: tuple[str, ...]
    """Those of ``at_limit`` that are slides of the base."""
    targets: Targets = field(repr=False)
    """The targets that the errors refer to."""

    @property
    def unreached(self) -> np.ndarray:
        """Indices of the fingertips that are out of reach."""
        return np.flatnonzero(self.fingertip_errors_m > REACHED_M)

    @property
    def cost(self) -> float:
        """Weighted sum of errors and penetration, m; the result of least cost is chosen."""
        worst = float(self.fingertip_errors_m.max())
        return self.points_error_m + 0.2 * worst + _DEPTH_COST * self.depth_m


class _Points(mink.Task):
    """IK task: brings the hand's points to their targets, each with its own weight."""

    def __init__(self, scene: Scene, targets: Targets) -> None:
        super().__init__(np.repeat(targets.weights, 3), lm_damping=1e-4)
        self._geoms, self._targets = scene.index.point_geoms, targets.points

    def compute_error(self, configuration: mink.Configuration) -> np.ndarray:
        """Return the errors of the points (3 P,) m."""
        return (configuration.data.geom_xpos[self._geoms] - self._targets).ravel()

    def compute_jacobian(self, configuration: mink.Configuration) -> np.ndarray:
        """Return the Jacobian of the errors (3 P, nv)."""
        model, data = configuration.model, configuration.data
        jacobian = np.empty((len(self._geoms), 3, model.nv))
        for row, geom in zip(jacobian, self._geoms, strict=True):
            mujoco.mj_jacGeom(model, data, row, None, geom)
        return jacobian.reshape(-1, model.nv)


class _Coupled(mink.Task):
    """IK constraint: keeps coupled joints at the positions that their leaders determine."""

    def __init__(self, scene: Scene) -> None:
        self._couplings = scene.index.couplings
        super().__init__(np.ones(len(self._couplings.rows)))

    def compute_error(self, configuration: mink.Configuration) -> np.ndarray:
        """Return the deviations of the coupled joints from their determined positions (C,) rad."""
        q, couplings = configuration.q, self._couplings
        return q[couplings.followers] - couplings.of(q[couplings.leaders])

    def compute_jacobian(self, configuration: mink.Configuration) -> np.ndarray:
        """Return the Jacobian of the errors (C, nv)."""
        couplings, rows = self._couplings, np.arange(len(self._couplings.rows))
        jacobian = np.zeros((len(rows), configuration.model.nv))
        jacobian[rows, couplings.followers] = 1.0
        jacobian[rows, couplings.leaders] = -couplings.slopes(configuration.q)
        return jacobian


class HandIk:
    """Inverse kinematics of the hand in one scene; a step takes a few milliseconds.

    Args:
        scene: scene with hand, table and objects.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.shape, self.contact = scene, HandShape(scene), HandContact(scene)
        model = scene.model
        self._limits = mink.ConfigurationLimit(model, gain=1.0)
        self._mean = self._mean_posture()
        objects = list(range(scene.index.num_joints, model.nv))
        self._constraints: list[mink.Task] = [mink.DofFreezingTask(model, objects)]
        self._couple = scene.index.couplings.apply
        if len(scene.index.couplings.rows):
            self._constraints.append(_Coupled(scene))

    def track(
        self, targets: Targets, start: np.ndarray, steps: int = _STEPS, avoid: bool = False
    ) -> np.ndarray:
        """Return the scene (nq,) with the hand near its targets, within the joints' limits.

        Args:
            targets: targets of the hand's points.
            start: whole scene (nq,) to start from.
            steps: largest number of steps.
            avoid: whether to avoid object and table; existing penetration then gets no deeper.
        """
        model, n = self.scene.model, self.scene.index.num_joints
        low, high = model.jnt_range[:n].T
        qpos = start.copy()
        qpos[:n] = qpos[:n].clip(low, high)
        self._couple(qpos)
        configuration = mink.Configuration(model, qpos)
        tasks: list[mink.Task] = [_Points(self.scene, targets)]
        if targets.palm_weight > 0:
            tasks.append(self._palm(targets))
        tasks.append(self._mean)
        limits = [self._limits, self._obstacles] if avoid else [self._limits]
        for _ in range(steps):
            try:
                move = mink.solve_ik(
                    configuration, tasks, 1.0, _SOLVER, _DAMPING,
                    limits=limits, constraints=self._constraints,
                )  # fmt: skip
            except NoSolutionFound:
                break  # no feasible step: the hand is wedged between obstacles
            largest = float(np.abs(move[:n]).max())
            if largest > _LARGEST_STEP:
                move *= _LARGEST_STEP / largest
            move[n:] = 0.0
            configuration.integrate_inplace(move, 1.0)
            if largest < _SETTLED:
                break
        found = configuration.q
        found[:n] = found[:n].clip(low, high)
        found[n:] = start[n:]
        self._couple(found)
        return found

    def result(self, qpos: np.ndarray, targets: Targets) -> IkResult:
        """Return a pose (nq,) as a result, with its errors."""
        model, shape = self.scene.model, self.shape
        data = posed(self.scene, qpos)
        away = data.geom_xpos[self.scene.index.point_geoms] - targets.points
        errors = np.linalg.norm(away, axis=1)
        palm = data.xmat[shape.palm_body].reshape(3, 3) @ shape.palm_in_body
        cosine = (np.trace(palm.T @ targets.palm) - 1.0) / 2.0
        n = self.scene.index.num_joints
        low, high = model.jnt_range[:n].T
        hand = qpos[:n]
        at_limit = np.flatnonzero((hand < low + AT_LIMIT) | (hand > high - AT_LIMIT))
        names = [model.joint(int(i)).name for i in at_limit]
        is_slide = model.jnt_type[at_limit] == mujoco.mjtJoint.mjJNT_SLIDE
        slides = is_slide & (at_limit < self.scene.index.num_base_joints)
        return IkResult(
            qpos=qpos,
            fingertip_errors_m=errors[shape.rows[:, 2]],
            points_error_m=float(np.average(errors, weights=targets.weights)),
            palm_error_rad=float(np.arccos(np.clip(cosine, -1.0, 1.0))),
            depth_m=self.contact.depth(qpos),
            at_limit=tuple(names),
            slides_at_limit=tuple(itertools.compress(names, slides)),
            targets=targets,
        )

    def approach(self, object_qpos: np.ndarray, targets: Targets) -> np.ndarray:
        """Return a start for :meth:`track`: the scene (nq,) with the palm near its target and
        straight fingers."""
        model, shape, n = self.scene.model, self.shape, self.scene.index.num_joints
        qpos = np.concatenate((np.zeros(n), object_qpos))
        wrist = np.where(np.arange(len(targets.points)) == 0, 1.0, 0.1)
        rough = replace(targets, weights=wrist, palm_weight=1.0)
        qpos = self.track(rough, qpos, steps=40)
        qpos[shape.first_finger_joint : n] = 0.0
        qpos[:n] = qpos[:n].clip(*model.jnt_range[:n].T)
        return self._couple(qpos)

    def _mean_posture(self) -> mink.PostureTask:
        """Return the task that pulls the fingers towards the hand's mean pre-grasp."""
        model, first = self.scene.model, self.shape.first_finger_joint
        n = self.scene.index.num_joints
        cost, posture = np.zeros(model.nv), np.zeros(model.nq)
        mean = self.scene.hand.mean_fingers_rad
        if len(mean) == n - first:
            cost[first:n] = _MEAN_WEIGHT
            posture[first:n] = mean
        task = mink.PostureTask(model, cost)
        task.set_target(posture)
        return task

    def _palm(self, targets: Targets) -> mink.FrameTask:
        body = self.scene.model.body(self.shape.palm_body).name
        task = mink.FrameTask(body, "body", 0.0, targets.palm_weight, lm_damping=1e-4)
        rotation = mink.SO3.from_matrix(targets.palm @ self.shape.palm_in_body.T)
        task.set_target(mink.SE3.from_rotation(rotation))
        return task

    @cached_property
    def _obstacles(self) -> mink.CollisionAvoidanceLimit:
        model = self.scene.model
        solid = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        roots = model.body_rootid[model.geom_bodyid]
        own = np.isin(roots, model.body_rootid[model.jnt_bodyid[: self.scene.index.num_joints]])
        pairs = [(np.flatnonzero(solid & own).tolist(), np.flatnonzero(solid & ~own).tolist())]
        return mink.CollisionAvoidanceLimit(
            model, pairs, gain=0.5,
            minimum_distance_from_collisions=CLEARANCE_M, collision_detection_distance=_FAR_M,
        )  # fmt: skip
