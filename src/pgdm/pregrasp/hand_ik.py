"""A scene's hand on its way to targets: differential inverse kinematics (mink), step by step."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import mink
import mujoco
import numpy as np
from mink.exceptions import NoSolutionFound

from pgdm.pregrasp.targets import HandShape, Targets
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene

REACHED_M = 0.02
"""A fingertip farther from its target than this counts as unreachable."""
AT_LIMIT = 1e-3
"""A joint nearer to a limit than this counts as at it, m or rad."""
CLEARANCE_M = 0.001
"""Distance that avoidance keeps between hand and object."""

_SOLVER = "daqp"
_STEPS, _SETTLED = 200, 1e-5  # of the solver, and largest joint step at which it has converged
_DAMPING = 1e-6
_HABIT_WEIGHT = 0.006  # per rad, beside points' 1 per m: five points do not fix 24 joints
_FAR_M = 0.02  # from where on an obstacle is seen
_LARGEST_STEP = 0.15  # of a joint at once, m or rad: beyond it the linear model says nothing
_DEPTH_COST = 20.0  # m of fingertip error that a metre of penetration counts as


@dataclass(frozen=True)
class IkResult:
    """A hand brought to its targets."""

    qpos: np.ndarray = field(repr=False)
    """Whole scene (nq,): the hand's joints, then the objects' as they were."""
    fingertip_errors_m: np.ndarray
    """Of each fingertip (F,) from its target."""
    palm_error_rad: float
    """Angle between the palm and the one that was wanted."""
    points_error_m: float
    """Mean distance of the hand's points from their targets, by the targets' weights."""
    depth_m: float
    """Deepest penetration of the hand and anything else."""
    at_limit: tuple[str, ...]
    """Joints at one of their limits."""
    targets: Targets = field(repr=False)
    """What was to be reached."""

    def unreached(self, limit_m: float = REACHED_M) -> np.ndarray:
        """Return the fingertips (numbers) that are farther away than a limit."""
        return np.flatnonzero(self.fingertip_errors_m > limit_m)

    @property
    def cost(self) -> float:
        """Error of the points plus penetration, m; for choosing between results."""
        worst = float(self.fingertip_errors_m.max())
        return self.points_error_m + 0.2 * worst + _DEPTH_COST * self.depth_m


class _Points(mink.Task):
    """The hand's points at their targets, each with a weight of its own."""

    def __init__(self, scene: Scene, targets: Targets) -> None:
        super().__init__(np.repeat(targets.weights, 3), lm_damping=1e-4)
        self._geoms, self._targets = scene.index.point_geoms, targets.points

    def compute_error(self, configuration: mink.Configuration) -> np.ndarray:
        """Return the points' errors (3 P,) m."""
        return (configuration.data.geom_xpos[self._geoms] - self._targets).ravel()

    def compute_jacobian(self, configuration: mink.Configuration) -> np.ndarray:
        """Return their derivatives (3 P, nv)."""
        model, data = configuration.model, configuration.data
        jacobian = np.empty((len(self._geoms), 3, model.nv))
        for row, geom in zip(jacobian, self._geoms, strict=True):
            mujoco.mj_jacGeom(model, data, row, None, geom)
        return jacobian.reshape(-1, model.nv)


class HandIk:
    """Inverse kinematics of one scene, set up once: a call costs a few milliseconds a step.

    Args:
        scene: with hand, table and objects.
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.shape, self.contact = scene, HandShape(scene), HandContact(scene)
        model = scene.model
        self._limits = mink.ConfigurationLimit(model, gain=1.0)
        self._habit = self._habitual()
        self._frozen = mink.DofFreezingTask(model, list(range(model.nu, model.nv)))

    def track(
        self, targets: Targets, start: np.ndarray, steps: int = _STEPS, avoid: bool = False
    ) -> np.ndarray:
        """Return joint positions (nq,) nearer to the targets, within the joints' limits.

        Args:
            targets: what to reach.
            start: whole scene (nq,) to go on from.
            steps: of the solver, at most.
            avoid: whether object and table are obstacles; what the start cuts into already is left
                no deeper.
        """
        model, nu = self.scene.model, self.scene.model.nu
        low, high = model.jnt_range[:nu].T
        qpos = start.copy()
        qpos[:nu] = qpos[:nu].clip(low, high)
        configuration = mink.Configuration(model, qpos)
        tasks: list[mink.Task] = [_Points(self.scene, targets)]
        if targets.palm_weight > 0:
            tasks.append(self._palm(targets))
        tasks.append(self._habit)
        limits = [self._limits, self._obstacles] if avoid else [self._limits]
        for _ in range(steps):
            try:
                move = mink.solve_ik(
                    configuration, tasks, 1.0, _SOLVER, _DAMPING,
                    limits=limits, constraints=[self._frozen],
                )  # fmt: skip
            except NoSolutionFound:
                break  # wedged in: where it is now is as far as it gets
            largest = float(np.abs(move[:nu]).max())
            if largest > _LARGEST_STEP:
                move *= _LARGEST_STEP / largest
            move[nu:] = 0.0
            configuration.integrate_inplace(move, 1.0)
            if largest < _SETTLED:
                break
        found = configuration.q
        found[:nu] = found[:nu].clip(low, high)
        found[nu:] = start[nu:]
        return found

    def result(self, qpos: np.ndarray, targets: Targets) -> IkResult:
        """Return a pose with its figures."""
        model, shape = self.scene.model, self.shape
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        away = data.geom_xpos[self.scene.index.point_geoms] - targets.points
        errors = np.linalg.norm(away, axis=1)
        palm = data.xmat[shape.palm_body].reshape(3, 3) @ shape.palm_in_body
        cosine = (np.trace(palm.T @ targets.palm) - 1.0) / 2.0
        low, high = model.jnt_range[: model.nu].T
        hand = qpos[: model.nu]
        at_limit = np.flatnonzero((hand < low + AT_LIMIT) | (hand > high - AT_LIMIT))
        return IkResult(
            qpos=qpos,
            fingertip_errors_m=errors[shape.rows[:, 2]],
            points_error_m=float(np.average(errors, weights=targets.weights)),
            palm_error_rad=float(np.arccos(np.clip(cosine, -1.0, 1.0))),
            depth_m=self.contact.depth(qpos),
            at_limit=tuple(model.joint(int(i)).name for i in at_limit),
            targets=targets,
        )

    def approach(self, object_qpos: np.ndarray, targets: Targets) -> np.ndarray:
        """Return whole-scene positions (nq,) with the palm about where it should be, fingers
        straight: a start for :meth:`track`."""
        model, shape = self.scene.model, self.shape
        qpos = np.concatenate((np.zeros(model.nu), object_qpos))
        rough = Targets(
            points=targets.points,
            weights=np.where(np.arange(len(targets.points)) == 0, 1.0, 0.1),
            palm=targets.palm,
            palm_weight=1.0,
            scale=targets.scale,
            anchor=targets.anchor,
        )
        qpos = self.track(rough, qpos, steps=40)
        qpos[shape.first_finger_joint : model.nu] = 0.0
        low, high = model.jnt_range[: model.nu].T
        qpos[: model.nu] = qpos[: model.nu].clip(low, high)
        return qpos

    def _habitual(self) -> mink.PostureTask:
        """Return the pull of the fingers towards the hand's mean pre-grasp."""
        model, first = self.scene.model, self.shape.first_finger_joint
        cost, posture = np.zeros(model.nv), np.zeros(model.nq)
        mean = self.scene.hand.mean_fingers_rad
        if len(mean) == model.nu - first:
            cost[first : model.nu] = _HABIT_WEIGHT
            posture[first : model.nu] = mean
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
        own = np.isin(roots, model.body_rootid[model.jnt_bodyid[: model.nu]])
        pairs = [(np.flatnonzero(solid & own).tolist(), np.flatnonzero(solid & ~own).tolist())]
        return mink.CollisionAvoidanceLimit(
            model, pairs, gain=0.5,
            minimum_distance_from_collisions=CLEARANCE_M, collision_detection_distance=_FAR_M,
        )  # fmt: skip
