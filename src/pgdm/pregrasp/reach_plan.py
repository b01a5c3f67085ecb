"""What a reach plan is, and how far from its target it ends."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from pgdm.errors import SceneError
from pgdm.library import Start
from pgdm.pregrasp.rollout import Ends, Rollouts, check_plan, reset_pose
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene

BASE_TOLERANCE_M, JOINT_TOLERANCE_RAD = 0.01, 0.1
OBJECT_TOLERANCE_M = 0.005
TURN_TOLERANCE_RAD = 0.1
"""Of the object; what the search aims at, no part of whether a plan has reached its target."""
DEPTH_TOLERANCE_M = 0.001
"""MuJoCo's contacts are soft: fingers that only lean on something sink in by less than this."""


@dataclass(frozen=True)
class ReachPlan:
    """A plan and where it ends.

    Errors count from the target, or from the nearest pose that the hand's ranges allow.
    """

    actions: np.ndarray = field(repr=False)
    """(K, nu) in [-1, 1]."""
    state: Start = field(repr=False)
    """Where the plan really ends: qpos, qvel, actions."""
    base_error_m: float
    """Of the base's slides, the one that is farthest off."""
    base_error_rad: float
    """Of the base's hinges, likewise."""
    finger_error_rad: float
    """Of the joints after the base, likewise."""
    object_moved_m: float
    """How far the object's centre of mass is from where it is if the hand stays away."""
    object_turned_rad: float
    """How far the object is turned against the same."""
    depth_m: float
    """Deepest penetration of the hand and anything else."""
    target_depth_m: float
    """The same in the target itself."""
    beyond_m: float
    """How far the target's slides lie beyond what the hand's ranges allow, the worst one."""
    beyond_rad: float
    """The same of the other joints."""
    rounds: int
    """How long the search took; 0 if there was none."""
    seconds: float

    @property
    def reached(self) -> bool:
        """Whether the hand is there, has moved nothing and cuts into nothing."""
        return not self.failures

    @property
    def failures(self) -> list[str]:
        """What is not as it must be, each with its figure."""
        depth = max(self.target_depth_m, DEPTH_TOLERANCE_M)
        rows = (
            ("base", 1e3 * self.base_error_m, 1e3 * BASE_TOLERANCE_M, "mm off"),
            ("base", self.base_error_rad, JOINT_TOLERANCE_RAD, "rad off"),
            ("fingers", self.finger_error_rad, JOINT_TOLERANCE_RAD, "rad off"),
            ("object", 1e3 * self.object_moved_m, 1e3 * OBJECT_TOLERANCE_M, "mm moved"),
            ("hand", 1e3 * self.depth_m, 1e3 * depth, "mm inside something"),
        )
        return [f"{what} {is_:.3g} {unit}" for what, is_, most, unit in rows if not is_ <= most]


class Goal:
    """A pre-grasp that a hand shall come to.

    Args:
        scene: of the task; its first joints are the hand's.
        target_qpos: whole scene (nq,) with the hand at its pre-grasp.

    Raises:
        SceneError: if the target does not fit the scene.
    """

    def __init__(self, scene: Scene, target_qpos: np.ndarray) -> None:
        model, index = scene.model, scene.index
        target = np.asarray(target_qpos, float)
        if target.shape != (model.nq,) or not np.isfinite(target).all():
            raise SceneError(
                f"a target of shape {target.shape} cannot be reached: the scene of task "
                f"'{scene.task.id}' with hand '{scene.hand.name}' has {model.nq} finite positions"
            )
        self.qpos, self._nu, self._base = target, model.nu, index.num_base_joints
        low = np.maximum(model.jnt_range[: model.nu, 0], index.ctrl_low)
        high = np.minimum(model.jnt_range[: model.nu, 1], index.ctrl_high)
        self.joints = target[: model.nu].clip(low, high)
        """The hand's joints (nu,), within what joints and servos allow."""
        self.tolerance = np.full(model.nu, JOINT_TOLERANCE_RAD)
        """Largest error that is allowed, (nu,) m and rad."""
        self.tolerance[: min(3, self._base)] = BASE_TOLERANCE_M
        self._contact = HandContact(scene)
        self._depth = self._contact.depth(target)

    def shares(self, ends: Ends) -> np.ndarray:
        """Return errors as shares of what is allowed, (N, 5).

        Of slides, hinges and fingers, the worst joint each; then how far the object has moved and
        turned.
        """
        error = np.abs(ends.qpos[:, : self._nu] - self.joints) / self.tolerance
        groups = [group.max(1, initial=0.0) for group in self._groups(error)]
        objects = ends.moved_m / OBJECT_TOLERANCE_M, ends.turned_rad / TURN_TOLERANCE_RAD
        return np.stack((*groups, *objects), axis=1)

    def plan(
        self, actions: np.ndarray, ends: Ends, row: int, rounds: int = 0, seconds: float = 0.0
    ) -> ReachPlan:
        """Return a plan (K, nu) with its figures, which ended as row ``row`` of ``ends``."""
        qpos, qvel = ends.qpos[row].copy(), ends.qvel[row].copy()
        errors = self._groups(np.abs(qpos[: self._nu] - self.joints))
        beyond = self._groups(np.abs(self.qpos[: self._nu] - self.joints))
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
            rounds=rounds,
            seconds=seconds,
        )

    def _groups(self, joints: np.ndarray) -> list[np.ndarray]:
        """Return slides, hinges and the rest of joints (..., nu)."""
        slides = min(3, self._base)
        return np.split(joints, [slides, self._base], axis=-1)


def measure(
    scene: Scene, plan_actions: np.ndarray, target_qpos: np.ndarray, substeps: int
) -> ReachPlan:
    """Carry out a plan that somebody else made, and measure it as our own are measured.

    Args:
        scene: of the task.
        plan_actions: (K, nu) in [-1, 1].
        target_qpos: whole scene (nq,) with the hand at its pre-grasp.
        substeps: physics steps per control step.

    Raises:
        ConfigError: if the plan is made for another hand.
        SceneError: if the target does not fit the scene.
    """
    check_plan(scene, plan_actions)
    goal = Goal(scene, target_qpos)
    rollouts = Rollouts(scene, reset_pose(scene, goal.qpos), 1, substeps, 1)
    ends = rollouts.run(plan_actions[None], rollouts.undisturbed(len(plan_actions)))
    return goal.plan(plan_actions, ends, 0)
