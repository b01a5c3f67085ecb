"""Wrist plans: commands of the base with which the hand alone follows a motion."""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass, replace

import numpy as np

from pgdm.library.progress import StepProgress, silent
from pgdm.sim.scene import hand_alone
from pgdm.wrist.hand import HandAlone
from pgdm.wrist.path import BASE_JOINTS, SLIDES
from pgdm.wrist.problem import WristProblem
from pgdm.wrist.search import REAL_STAGE, SMOOTH_STAGE, Search, base_ranges

__all__ = ["WristPlan", "WristProblem", "plan_wrist", "shortcoming", "simulate"]

NEAR_M = 0.01
"""A step counts towards the rigid grasp if its error is at most this; same limit as for success."""
_AT_END = np.repeat((0.01, 0.06), SLIDES)  # m and rad: this near to an end of the range


@dataclass(frozen=True)
class WristPlan:
    """Base commands, and the simulated motion of the hand alone under them."""

    commands: np.ndarray
    """Targets of the base joints at control steps 0..T-2, (T-1, 6) m, rad."""
    qpos: np.ndarray
    """The scene's positions at steps 0..T-1, (T, nq); objects as in the start state."""
    error_m: np.ndarray
    """Distance of the grasp point from its target after each step, (T-1,) m."""
    frames: int = 0
    """Control steps simulated by the search."""
    seconds: float = 0.0
    """Duration of the search, s."""

    def sha256(self) -> str:
        """Return a hash of the commands."""
        return hashlib.sha256(self.commands.tobytes()).hexdigest()

    def described(self) -> str:
        """Return a sentence on how closely the hand alone follows the motion."""
        return (
            f"the hand alone is {1e3 * self.error_m.mean():.1f} mm off the motion on average, "
            f"{1e3 * self.error_m.max():.0f} mm at most, within 1 cm in {self.rigid_grasp:.0%} of "
            "the steps"
        )

    @property
    def rigid_grasp(self) -> float:
        """Share of the steps with the grasp point within 1 cm of its target (0..1).

        Under these commands, a grasp that never slips would have this success. Reports call it
        *rigid grasp*. A policy may exceed this value, since a policy corrects the commands.
        """
        return float((self.error_m <= NEAR_M).mean())


def plan_wrist(
    problem: WristProblem, num_threads: int = 0, progress: StepProgress = silent
) -> WristPlan:
    """Find commands with which the hand alone follows the motion, see `pgdm.wrist.search`.

    Args:
        problem: motion, start state and hand.
        num_threads: number of threads of the simulations; 0 takes one per core. The plan does not
            depend on it.
        progress: called before each round of the search.

    Raises:
        ConfigError: if the motion is too short for ``hold_steps``, or too long to plan.
        SceneError: if the simulation of the hand diverges.
    """
    problem.check()
    began, search = time.monotonic(), Search(problem, num_threads, progress)
    commands = search.path[1:].copy()
    for stage, real in ((SMOOTH_STAGE, False), (REAL_STAGE, True)):
        commands = search.improve(commands, stage, real)
    seconds = time.monotonic() - began
    return replace(simulate(problem, commands), frames=search.frames, seconds=seconds)


def shortcoming(problem: WristProblem, plan: WristPlan) -> str | None:
    """Return a sentence if a plan follows its motion only in part, else None.

    That is, if the hand alone is more than 1 cm off on average after hold and catch-up. The
    sentence names base joints that are commanded to an end of their range in at least half of the
    steps with more than 1 cm of error, and those that start beyond their range.
    """
    late = slice(2 * problem.hold_steps, None)
    if plan.error_m[late].mean() <= NEAR_M:
        return None
    model, index = problem.scene.model, problem.scene.index
    low, high = base_ranges(model).T
    commands = plan.commands[late][plan.error_m[late] > NEAR_M]
    at_low = commands <= np.maximum(low, index.ctrl_low[:BASE_JOINTS]) + _AT_END
    at_high = commands >= np.minimum(high, index.ctrl_high[:BASE_JOINTS]) - _AT_END
    start = problem.qpos[:BASE_JOINTS]
    which = {
        "joints commanded to an end of their range": (at_low | at_high).mean(axis=0) >= 0.5,
        "joints that start beyond their range": np.maximum(low - start, start - high) > _AT_END,
    }
    text = (
        f"the base cannot follow the whole motion of '{problem.scene.task.id}': rigid grasp "
        f"{plan.rigid_grasp:.0%}, the hand alone {1e3 * plan.error_m.mean():.0f} mm off on average"
    )
    for what, joint in which.items():
        if joint.any():
            text += f"; {what}: " + ", ".join(model.joint(i).name for i in np.flatnonzero(joint))
    return text


def simulate(problem: WristProblem, commands: np.ndarray) -> WristPlan:
    """Simulate the hand alone with commands (T-1, 6), and return commands and motion as a plan."""
    rollout = HandAlone(problem, hand_alone(problem.scene)).rollout(commands)
    errors = np.linalg.norm(rollout.points - problem.reference.pos.numpy()[1:], axis=1)
    qpos, fingers_end = rollout.qpos.copy(), problem.scene.index.num_joints
    qpos[:, fingers_end:] = problem.qpos[fingers_end:]  # in simulation the objects fell
    return WristPlan(commands, qpos, errors)
