"""A reach plan, and how far from its pre-grasp it ends."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from pgdm.errors import SceneError
from pgdm.library import Start
from pgdm.pregrasp.reach.rollout import Ends, Rollouts, check_plan
from pgdm.pregrasp.sources import reset_pose
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene

BASE_TOLERANCE_M, JOINT_TOLERANCE_RAD = 0.01, 0.1
OBJECT_TOLERANCE_M = 0.005
TURN_TOLERANCE_RAD = 0.1
"""Tolerance of the object's rotation. The search tries to stay below it, but a plan that exceeds it
may still count as reached."""
DEPTH_TOLERANCE_M = 0.001
"""Tolerance of penetration: fingers that only rest on something sink in by less, since MuJoCo's
contacts are soft."""


@dataclass(frozen=True)
class ReachPlan:
    """A reach plan and where it ends.

    The target is the pre-grasp as given. The errors of the joints are measured against a copy of it
    that is clipped to the hand's ranges.
    """

    actions: np.ndarray = field(repr=False)
    """(K, nu) in [-1, 1]."""
    state: Start = field(repr=False)
    """State in which the plan ends in simulation; its ``actions`` are the plan's."""
    base_error_m: float
    """Largest error of a slide of the base."""
    base_error_rad: float
    """Largest error of a hinge of the base."""
    finger_error_rad: float
    """Largest error of a joint after the base."""
    object_moved_m: float
    """Distance of the object's centre of mass from where it would be without the hand."""
    object_turned_rad: float
    """Angle between the object's orientation and the one it would have without the hand."""
    depth_m: float
    """Deepest penetration between the hand and anything else at the end of the plan."""
    target_depth_m: float
    """Deepest penetration between the hand and anything else at the target."""
    beyond_m: float
    """Largest distance by which a slide of the target exceeds its range."""
    beyond_rad: float
    """Largest angle by which any other joint of the target exceeds its range."""
    rounds: int = 0
    """Rounds of the search; 0 if the plan comes from elsewhere."""
    seconds: float = 0.0
    """Duration of the search, s."""

    @property
    def reached(self) -> bool:
        """Whether the hand reaches the target without moving the object or penetrating anything.

        Each of these holds within its tolerance; penetration may be as deep as at the target.
        """
        return not self.failures

    @property
    def failures(self) -> list[str]:
        """The errors that exceed their tolerances, in words, each with its value."""
        depth = max(self.target_depth_m, DEPTH_TOLERANCE_M)
        rows = (
            ("base", 1e3 * self.base_error_m, 1e3 * BASE_TOLERANCE_M, "mm off"),
            ("base", self.base_error_rad, JOINT_TOLERANCE_RAD, "rad off"),
            ("fingers", self.finger_error_rad, JOINT_TOLERANCE_RAD, "rad off"),
            ("object", 1e3 * self.object_moved_m, 1e3 * OBJECT_TOLERANCE_M, "mm moved"),
            ("hand", 1e3 * self.depth_m, 1e3 * depth, "mm inside something"),
        )
        return [f"{what} {off:.3g} {unit}" for what, off, most, unit in rows if not off <= most]

    def metrics(self) -> dict[str, Any]:
        """Return the plan's metrics as plain JSON; without ``seconds``, so that equal plans give
        equal files."""
        names = (
            *("base_error_m", "base_error_rad", "finger_error_rad", "object_moved_m"),
            *("object_turned_rad", "depth_m", "target_depth_m", "beyond_m", "beyond_rad", "rounds"),
        )
        values = {name: getattr(self, name) for name in names}
        return {"reached": self.reached, "steps": len(self.actions), **values}


class Goal:
    """The pre-grasp at which a reach should end.

    Args:
        scene: scene of the task; the hand's n joints are first in qpos.
        target_qpos: whole scene (nq,) with the hand at its pre-grasp.

    Raises:
        SceneError: the target does not fit the scene.
    """

    def __init__(self, scene: Scene, target_qpos: np.ndarray) -> None:
        model, index = scene.model, scene.index
        target = np.asarray(target_qpos, float)
        if target.shape != (model.nq,) or not np.isfinite(target).all():
            raise SceneError(
                f"a target of shape {target.shape} does not fit: the scene of task "
                f"'{scene.task.id}' with hand '{scene.hand.name}' needs {model.nq} finite positions"
            )
        self.qpos, self._n, self._base = target, index.num_joints, index.num_base_joints
        low = np.maximum(model.jnt_range[: self._n, 0], index.joint_low)
        high = np.minimum(model.jnt_range[: self._n, 1], index.joint_high)
        self.joints = target[: self._n].clip(low, high)
        """Joint positions of the hand (n,), clipped to the ranges of joints and servos."""
        self.tolerance = np.full(self._n, JOINT_TOLERANCE_RAD)
        """Largest error allowed, (n,) m and rad."""
        self.tolerance[: min(3, self._base)] = BASE_TOLERANCE_M
        self._contact = HandContact(scene)
        self._depth = self._contact.depth(target)

    def shares(self, ends: Ends) -> np.ndarray:
        """Return errors divided by their tolerances, (N, 5).

        These are the largest errors of slides, hinges and joints after the base, then the object's
        displacement and rotation.
        """
        error = np.abs(ends.qpos[:, : self._n] - self.joints) / self.tolerance
        groups = [group.max(1, initial=0.0) for group in self._groups(error)]
        objects = ends.moved_m / OBJECT_TOLERANCE_M, ends.turned_rad / TURN_TOLERANCE_RAD
        return np.stack((*groups, *objects), axis=1)

    def plan(self, actions: np.ndarray, ends: Ends, row: int) -> ReachPlan:
        """Return the plan with actions (K, nu), whose final state is row ``row`` of ``ends``."""
        qpos, qvel = ends.qpos[row].copy(), ends.qvel[row].copy()
        errors = self._groups(np.abs(qpos[: self._n] - self.joints))
        beyond = self._groups(np.abs(self.qpos[: self._n] - self.joints))
        slides, hinges, fingers = (float(group.max(initial=0.0)) for group in errors)
        actions = actions.copy()
        return ReachPlan(
            actions=actions,
            state=Start(qpos, qvel, actions),
            base_error_m=slides,
            base_error_rad=hinges,
            finger_error_rad=fingers,
            object_moved_m=float(ends.moved_m[row]),
            object_turned_rad=float(ends.turned_rad[row]),
            depth_m=self._contact.depth(qpos),
            target_depth_m=self._depth,
            beyond_m=float(beyond[0].max(initial=0.0)),
            beyond_rad=float(np.concatenate(beyond[1:]).max(initial=0.0)),
        )

    def _groups(self, joints: np.ndarray) -> list[np.ndarray]:
        """Split joint values (..., n) into those of slides, hinges and joints after the base."""
        slides = min(3, self._base)
        return np.split(joints, [slides, self._base], axis=-1)


def measure(
    scene: Scene, plan_actions: np.ndarray, target_qpos: np.ndarray, substeps: int
) -> ReachPlan:
    """Play a given plan, such as a published one, and measure it like the planner's own plans.

    Args:
        scene: scene of the task.
        plan_actions: (K, nu) in [-1, 1].
        target_qpos: whole scene (nq,) with the hand at its pre-grasp.
        substeps: physics steps per control step.

    Raises:
        ConfigError: the plan is for another hand.
        SceneError: the target does not fit the scene.
    """
    check_plan(scene, plan_actions)
    goal = Goal(scene, target_qpos)
    rollouts = Rollouts(scene, reset_pose(scene, goal.qpos), 1, substeps, 1)
    ends = rollouts.run(plan_actions[None], rollouts.undisturbed(len(plan_actions)))
    return goal.plan(plan_actions, ends, 0)
