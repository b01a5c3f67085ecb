r"""Gauss-Newton on the commands of all control steps at once, with finite-difference derivatives.

The base's servos are soft and underdamped: if a path is sent to them unmodified, the hand lags and
overshoots by centimetres. The search therefore minimises over all commands together. Control step
k = 0..K-1 leads to pose k+1 of the motion. During step k, u_k are the targets of the six base
joints. After step k, q_k are the base joint positions, R_k is the palm's orientation, and g_k the
grasp point (a point fixed to the palm, which starts at the motion's first target). p_k is pose k+1
of the feasible path of `pgdm.wrist.path`, and u_{-1} = p_{-1}. The target x_k is the position in
pose k+1 of the motion, and R*_k the palm's orientation in pose k+1 of the feasible path; during a
hold, x_k and R*_k are those of pose 0. The cost is

    sum_k  w_k |100 (g_k - x_k)|^2  +  w_k |0.9 log(R*_k^-1 R_k)|^2      follow the motion
           + |C (u_k - u_{k-1})|^2  +  |0.2 C (u_k - p_k)|^2             smooth, near the path
           + |L (q_k - clip(q_k))|^2                                     keep off the joint limits

in m and rad, with w_k = 0 while the hand catches up after a hold (see `WristProblem.hold_steps`),
else 1; C = diag(2, 2, 2, 0.6, 0.6, 0.6), L = diag(300, 300, 300, 90, 90, 90). clip(q_k) is
q_k clipped to the joint ranges, narrowed by a margin.

Let s be the positions and velocities of the base and wrist joints, and s_{k+1} = f(s_k, u_k) one
control step. F = df/ds and G = df/du are computed by one-sided finite differences. Let u be all
commands, S_k = ds_k/du, and E_k the matrix with E_k u = u_k. The chain rule gives

    S_0 = 0,   S_{k+1} = F_k S_k + G_k E_k

and from S follows the Jacobian of the residuals. `quadratic.Model` then computes the step d subject
to max(low - u, -trust) <= d <= min(high - u, trust), where the control range is low to high. The
trust region grows and shrinks with the ratio of actual to predicted decrease.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace

import mujoco
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from pgdm.errors import SceneError
from pgdm.library.progress import StepProgress
from pgdm.sim.batch import SimBatch
from pgdm.sim.scene import hand_alone
from pgdm.wrist.hand import HandAlone, Rollout
from pgdm.wrist.path import BASE_JOINTS, SLIDES, base_orientation, feasible_path
from pgdm.wrist.problem import WristProblem
from pgdm.wrist.quadratic import Limits, Model

# These cost about the same: the grasp point 1 cm off target, the palm 1.1 rad off target, or a
# joint 3 mm or 0.01 rad inside its margin (`quadratic.PER_LIMIT`).
_PER_M, _PER_RAD = 100.0, 0.9
_MARGIN = np.repeat((0.005, 0.03), SLIDES)  # m and rad: distance of joints from their limits
_CHANGE, _NEAR_PATH = np.repeat((2.0, 0.6), SLIDES), 0.2
# Steps of finite differences: of positions (m and rad) and of velocities (m/s and rad/s).
_STEP, _STEP_PER_S = 1e-4, 1e-3
# The trust region shrinks if the ratio of actual to predicted decrease is below `_POOR_RATIO`, and
# grows if it is above `_GOOD_RATIO`.
_POOR_RATIO, _GOOD_RATIO = 0.3, 0.75
_ENOUGH = 0.01  # a stage ends once a step lowers the cost by less than this share
_LEAST_TRUST = 1e-3  # a stage also ends once the trust region is below this, m and rad
_TINY = 1e-9
_FROZEN = 1e3  # armature that keeps a finger where it is, kg m^2
_SMOOTH = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT


@dataclass(frozen=True)
class Stage:
    """Limits of a series of Gauss-Newton steps."""

    rounds: int
    """Largest number of steps."""
    trust: float
    """Largest change of a command in the first step, m and rad."""


SMOOTH_STAGE, REAL_STAGE = Stage(15, 0.3), Stage(8, 0.03)
"""The first stage simulates without joint limits and contacts, because their discontinuities
mislead the search; the second simulates with them."""


def base_ranges(model: mujoco.MjModel) -> np.ndarray:
    """Return the ranges (6, 2) of the base joints, m and rad; infinite if a joint has no limits."""
    limited = model.jnt_limited[:, None]
    return np.where(limited, model.jnt_range, (-np.inf, np.inf))[:BASE_JOINTS]


class Search:
    """Search for the wrist plan of one problem.

    Args:
        problem: motion, start state and hand.
        num_threads: number of threads of the simulations; 0 takes one per core.
        progress: called before each round.
    """

    def __init__(self, problem: WristProblem, num_threads: int, progress: StepProgress) -> None:
        scene, self._problem = problem.scene, problem
        # `frames`: control steps simulated so far.
        self._progress, self._rounds, self.frames = progress, 0, 0
        model, index = scene.model, scene.index
        ranges = base_ranges(model)
        margin = np.minimum(_MARGIN, np.ptp(ranges, axis=1) / 4)
        self._low, self._high = index.ctrl_low[:BASE_JOINTS], index.ctrl_high[:BASE_JOINTS]
        self._limits = Limits(ranges[:, 0] + margin, ranges[:, 1] - margin)
        within = replace(
            index,
            ctrl_low=np.maximum(self._low, self._limits.low),
            ctrl_high=np.minimum(self._high, self._limits.high),
        )
        self.path = feasible_path(within, problem.reference, torch.from_numpy(problem.qpos)).numpy()
        # Number of base and wrist joints: those that move the palm.
        self._n = scene.hand.num_base_joints + scene.hand.num_wrist_joints
        alone = hand_alone(scene)
        model = copy.deepcopy(alone.model)
        model.opt.disableflags |= _SMOOTH
        # Without joint limits the fingers would swing past them, so a large armature freezes them.
        model.dof_armature[self._n : index.num_joints] = _FROZEN
        smooth = replace(alone, model=model)
        self._real_hand, self._smooth_hand = (HandAlone(problem, s) for s in (alone, smooth))
        self._steps = SimBatch(smooth, len(self.path) - 1, num_threads, problem.substeps)
        mount = Rotation.from_quat(index.mount_quat, scalar_first=True)
        palm = (mount * base_orientation(problem.qpos)).inv() * self._real_hand.start_orientation
        palms = mount * base_orientation(self.path) * palm
        hold, step = problem.hold_steps, np.arange(len(self.path))
        held = problem.target_steps()[1:]
        self._targets, self._palms = problem.reference.pos.numpy()[held], palms[held.tolist()]
        self._followed = ((step <= hold) | (step > 2 * hold))[1:, None]

    def improve(self, commands: np.ndarray, stage: Stage, real: bool) -> np.ndarray:
        """Return commands (K, 6) of lower cost, or the given ones if no step lowers the cost.

        Args:
            commands: commands to start from, (K, 6) m and rad.
            stage: number and size of the steps.
            real: whether joint limits and contacts are simulated.
        """
        hand, trust = self._real_hand if real else self._smooth_hand, stage.trust
        commands = commands.clip(self._low, self._high)
        rollout = self._rollout(hand, commands)
        cost, model = self._cost(commands, rollout), self._linearise(commands, rollout)
        end = self._rounds + stage.rounds
        while self._rounds < end and trust > _LEAST_TRUST:
            self._rounds += 1
            self._progress("wrist plan", self._rounds, SMOOTH_STAGE.rounds + REAL_STAGE.rounds)
            step = model.least(
                np.maximum(self._low - commands, -trust), np.minimum(self._high - commands, trust)
            )
            tried = (commands + step).clip(self._low, self._high)
            try:
                tried_rollout = self._rollout(hand, tried)
            except SceneError:  # the simulation diverged: the step was too large
                trust /= 4
                continue
            gained = cost - (tried_cost := self._cost(tried, tried_rollout))
            ratio = gained / max(model.gain(step.ravel()), _TINY)
            if ratio < _POOR_RATIO:
                trust = min(trust, float(np.abs(step).max())) / 4
            elif ratio > _GOOD_RATIO:
                trust *= 2
            if gained > 0:
                finished = gained < _ENOUGH * cost
                commands, rollout, cost = tried, tried_rollout, tried_cost
                if finished:
                    break
                model = self._linearise(commands, rollout)
        self._rounds = end
        return commands

    def _rollout(self, hand: HandAlone, commands: np.ndarray) -> Rollout:
        self.frames += len(commands)
        return hand.rollout(commands)

    def _cost(self, commands: np.ndarray, rollout: Rollout) -> float:
        beyond = self._limits.beyond(rollout.qpos[1:, :BASE_JOINTS])
        parts = *self._residuals(commands, rollout), beyond
        return sum(float((part**2).sum()) for part in parts)

    def _tracking_residuals(self, points: np.ndarray, orientations: Rotation) -> np.ndarray:
        """Return residuals (K, 6): the grasp point's position, then the palm's orientation."""
        angles = (self._palms.inv() * orientations).as_rotvec()
        errors = np.concatenate((_PER_M * (points - self._targets), _PER_RAD * angles), 1)
        return errors * self._followed

    def _residuals(self, commands: np.ndarray, rollout: Rollout) -> tuple[np.ndarray, ...]:
        """Return three residuals (K, 6): tracking, change of commands, distance to the path."""
        tracking = self._tracking_residuals(rollout.points, rollout.orientations)
        change = np.diff(np.concatenate((self.path[:1], commands)), axis=0)
        return tracking, _CHANGE * change, _NEAR_PATH * _CHANGE * (commands - self.path[1:])

    def _linearise(self, commands: np.ndarray, rollout: Rollout) -> Model:
        """Return the Gauss-Newton model of the cost at ``commands``.

        Both stages use derivatives simulated without contacts and limits: with them, derivatives
        are valid only over very small changes.
        """
        steps, size, n = len(commands), commands.size, 2 * self._n
        tracking_by, joints_by = np.zeros((2, steps, BASE_JOINTS, size))
        state_by = np.zeros((n, size))
        for k, jacobian in enumerate(self._step_jacobians(commands, rollout)):
            chained = jacobian[:, :n] @ state_by
            chained[:, k * BASE_JOINTS : (k + 1) * BASE_JOINTS] += jacobian[:, n:]
            state_by, tracking_by[k], joints_by[k] = chained[:n], chained[n:], chained[:BASE_JOINTS]
        change = np.eye(size) - np.eye(size, k=-BASE_JOINTS)
        change = np.tile(_CHANGE, steps)[:, None] * change
        near = np.diag(np.tile(_NEAR_PATH * _CHANGE, steps))
        return Model(
            np.concatenate((tracking_by.reshape(size, size), change, near)),
            np.concatenate([part.ravel() for part in self._residuals(commands, rollout)]),
            joints_by.reshape(size, size),
            rollout.qpos[1:, :BASE_JOINTS],
            self._limits,
        )

    def _step_jacobians(self, commands: np.ndarray, rollout: Rollout) -> np.ndarray:
        """Return the Jacobians of all steps (K, 2n + 6, 2n + 6), simulated in parallel.

        Rows: positions and velocities of the n base and wrist joints after the step, then the
        tracking residuals; columns: positions and velocities before the step, then the commands.
        """
        steps, n = len(commands), self._n
        ctrl = np.repeat(self._problem.fingers[None], steps, 0)
        ctrl[:, :BASE_JOINTS] = commands
        qpos, qvel = rollout.qpos[:-1].copy(), rollout.qvel[:-1].copy()

        def after() -> np.ndarray:
            self.frames += steps
            self._steps.reset(np.arange(steps), qpos, qvel)
            # `_steps` simulates the smooth scene; `_real_hand` only applies load and commands.
            self._real_hand.step(self._steps, ctrl, np.arange(1, steps + 1))
            state = self._steps.read()
            tracking = self._tracking_residuals(*self._real_hand.grasp_point(self._steps))
            return np.concatenate((state.qpos[:, :n], state.qvel[:, :n], tracking), 1)

        here, columns = after(), []
        # Step downwards at the upper end of the control range: beyond it a command has no effect.
        inward = np.where(commands + _STEP > self._high, -_STEP, _STEP)
        for array, by in (
            (qpos, np.full((steps, n), _STEP)),
            (qvel, np.full((steps, n), _STEP_PER_S)),
            (ctrl, inward),
        ):
            for column in range(by.shape[1]):
                before = array[:, column].copy()
                array[:, column] += by[:, column]
                columns.append((after() - here) / by[:, column, None])
                array[:, column] = before
        return np.stack(columns, 2)
