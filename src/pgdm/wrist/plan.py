"""Commands of the wrist with which the hand alone follows an exemplar, optimised on the simulator.

The base's servos are soft and underdamped: a path sent to them unmodified is tracked late and
overshoots by centimetres. Here the commands of all control steps are found together:
Gauss-Newton on the simulated hand, each step a quadratic program within the control ranges and a
trust region.
"""

from __future__ import annotations

import copy
import hashlib
import re
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import torch
from scipy.spatial.transform import Rotation

from pgdm.errors import ConfigError, SceneError
from pgdm.motion.reference import ObjectReference
from pgdm.sim.batch import SimBatch
from pgdm.sim.scene import Scene, hand_alone
from pgdm.wrist.path import feasible_path
from pgdm.wrist.quadratic import Limits, Model

VERSION = 1
"""Of the planner; plans in the library that another version stored are computed anew."""
NEAR_M = 0.01
"""Error within which a step counts as followed, as in the benchmark's success."""

_SLIDES, _JOINTS = 3, 6  # the base: slides, then hinges

# Scales chosen so that these errors cost the same: a grasp point 1 cm off, a palm turned by 1.1
# rad, a joint 3 mm or 0.01 rad inside its margin (PER_LIMIT).
_PER_M, _PER_RAD = 100.0, 0.9
_MARGIN = np.repeat((0.005, 0.03), _SLIDES)  # m and rad that joints keep from their limits
# Commands that change little from step to step, and lie near the path, are worth a little.
_CHANGE, _NEAR_PATH = np.repeat((2.0, 0.6), _SLIDES), 0.2
_STEP, _STEP_PER_S = 1e-4, 1e-3  # of finite differences, m and rad
# Of what a step was to gain: below the first the trust region shrinks, above the second it grows.
_POOR, _GOOD = 0.3, 0.75
_ENOUGH = 0.01  # a stage ends with a step that lowers the cost by less than this share
_LEAST_TRUST = 1e-3  # or with a trust region below this, m and rad
_LIFTED_M = 0.02
_TINY = 1e-9
_FROZEN = 1e3  # armature with which a finger keeps its place, kg m^2
_LONGEST = 250  # poses: the quadratic program's time grows with the third power
_OF_FILES = re.compile("path|nbuffer").search  # fields that depend on where files lie
_SMOOTH = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_LIMIT


@dataclass(frozen=True)
class Stage:
    """A number of Gauss-Newton steps."""

    rounds: int
    trust: float
    """How far a command may move at first, m and rad."""


SMOOTH_STAGE, REAL_STAGE = Stage(15, 0.3), Stage(8, 0.03)
"""First without limits and contacts, whose discontinuities mislead the search; then with them."""

Progress = Callable[[int, int], None]
"""Told rounds done and rounds at most."""


@dataclass(frozen=True)
class WristProblem:
    """What the wrist is to do."""

    scene: Scene
    reference: ObjectReference
    qpos: np.ndarray  # (nq,) m, rad: the start
    qvel: np.ndarray  # (nv,) m/s, rad/s
    fingers: np.ndarray  # (nu,) m, rad: targets that all joints but the base's are held at
    substeps: int
    """Physics steps per control step."""
    hold_steps: int = 0
    """Control steps for which the hand stays at its start, so that the fingers can close; as many
    follow in which it may go where it likes, to catch up."""
    carries: bool = False
    """Whether the hand is loaded with the object's weight from when the exemplar lifts it: gravity
    compensation covers the hand only."""

    def check(self) -> None:
        """Check that the motion leaves time to follow it, and can be planned in reasonable time.

        Raises:
            ConfigError: if not.
        """
        poses = len(self.reference)
        if 2 * self.hold_steps >= poses - 1:
            raise ConfigError(
                f"action.hold_steps is {self.hold_steps}: to hold and catch up takes twice that, "
                f"and the motion has {poses - 1} steps; use at most {(poses - 2) // 2}"
            )
        if poses > _LONGEST:
            raise ConfigError(
                f"the motion has {poses} poses, and a wrist is planned for at most {_LONGEST}; use "
                "action.wrist_path=feasible"
            )

    def steps_behind(self) -> np.ndarray:
        """Return which step of the exemplar the hand is to be at, (T,): 0 while it holds."""
        step = np.arange(len(self.reference))
        return np.where(step <= self.hold_steps, 0, step)

    def load_n(self) -> np.ndarray:
        """Return the object's weight at each step (T,) N, ramped up over its first 2 cm of rise."""
        scene, height = self.scene, self.reference.pos.numpy()[self.steps_behind(), 2]
        if not (self.carries and scene.lies_free):
            return np.zeros(len(height))
        # The tracked body may be a part of the object.
        root = scene.model.body_rootid[scene.index.object_body]
        weight = scene.model.body_subtreemass[root] * -scene.model.opt.gravity[2]
        return weight * ((height - height[0]) / _LIFTED_M).clip(0.0, 1.0)

    def key(self) -> str:
        """Return a SHA-256 over all that a plan depends on, the whole compiled model with it."""
        return self._key

    @cached_property  # the model may have tens of megabytes
    def _key(self) -> str:
        scene = self.scene
        numbers = (
            *(VERSION, self.substeps, self.hold_steps, scene.hand.num_wrist_joints),
            *(scene.index.num_compensated, scene.object_prefixes),
        )
        digest = hashlib.sha256(f"{mujoco.__version__} {numbers}".encode())
        reference = self.reference.pos.numpy(), self.reference.quat.numpy()
        start = self.qpos, self.qvel, self.fingers
        for struct in (scene.model, scene.model.opt):
            digest.update(_content(struct))
        for array in (*reference, *start, self.load_n()):
            digest.update(np.ascontiguousarray(array).tobytes())
        return digest.hexdigest()


def _content(struct: Any) -> bytes:
    """Return all numbers of one of MuJoCo's structures, but not where its files lie."""
    names = (name for name in sorted(dir(struct)) if name[0] != "_" and not _OF_FILES(name))
    values = ((name, getattr(struct, name)) for name in names)
    return b"".join(
        name.encode() + np.ascontiguousarray(value).tobytes()
        for name, value in values
        if isinstance(value, (int, float, np.ndarray))
    )


@dataclass(frozen=True)
class WristPlan:
    """Commands, and what the hand alone does with them."""

    commands: np.ndarray
    """Targets of the base joints at control steps 0..T-2, (T-1, 6) m, rad."""
    qpos: np.ndarray
    """The scene at steps 0..T-1, (T, nq); objects stay where they are at the start."""
    error_m: np.ndarray
    """Distance of the grasp point from its target after each step, (T-1,) m."""
    frames: int = 0
    """Control steps that were simulated to find it."""
    seconds: float = 0.0
    """Time that took, s."""

    def sha256(self) -> str:
        """Return a hash of the commands."""
        return hashlib.sha256(self.commands.tobytes()).hexdigest()

    def described(self) -> str:
        """Return in a sentence how near the hand alone comes."""
        return (
            f"the hand alone is {1e3 * self.error_m.mean():.1f} mm off the exemplar on average, "
            f"{1e3 * self.error_m.max():.0f} mm at most, within 1 cm in {self.bound:.0%} of the "
            "steps"
        )

    @property
    def bound(self) -> float:
        """Share of the steps at which the grasp point is within 1 cm (0..1).

        What a grasp that never slips would reach. Policies may do better: they correct.
        """
        return float((self.error_m < NEAR_M).mean())


def plan_wrist(
    problem: WristProblem, num_threads: int = 0, progress: Progress | None = None
) -> WristPlan:
    """Find commands with which the hand alone follows the exemplar.

    Args:
        problem: what the wrist is to do.
        num_threads: of the simulations; 0 takes one per core.
        progress: told how far the search is.

    Raises:
        ConfigError: if the motion is too short for the hold, or too long to plan.
        SceneError: if the simulation of the hand diverges.
    """
    problem.check()
    began, search = time.monotonic(), _Search(problem, num_threads, progress)
    commands = search.path[1:].copy()
    for stage, real in ((SMOOTH_STAGE, False), (REAL_STAGE, True)):
        commands = search.improve(commands, stage, real)
    seconds = time.monotonic() - began
    return replace(simulate(problem, commands), frames=search.frames, seconds=seconds)


def simulate(problem: WristProblem, commands: np.ndarray) -> WristPlan:
    """Return what the hand alone does with commands (T-1, 6)."""
    hand = _Hand(problem, hand_alone(problem.scene))
    way = hand.rollout(commands)
    errors = np.linalg.norm(way.points - problem.reference.pos.numpy()[1:], axis=1)
    qpos, fingers_end = way.qpos.copy(), problem.scene.model.nu
    qpos[:, fingers_end:] = problem.qpos[fingers_end:]  # they fell: nothing holds them
    return WristPlan(commands, qpos, errors)


@dataclass(frozen=True)
class _Way:
    """Where the hand goes in K control steps."""

    qpos: np.ndarray  # (K+1, nq)
    qvel: np.ndarray  # (K+1, nv)
    points: np.ndarray  # (K, 3) m, world frame: the grasp point
    turns: Rotation  # K, of the palm


class _Hand:
    """The hand without objects to touch, one simulation of it."""

    def __init__(self, problem: WristProblem, scene: Scene) -> None:
        self._problem, hand = problem, scene.hand
        self.palm = int(scene.model.jnt_bodyid[hand.num_base_joints + hand.num_wrist_joints - 1])
        self.sim = SimBatch(scene, 1, 1, problem.substeps)
        self._restart()
        pos, turn = self._palm(self.sim)
        self._load = problem.load_n()
        self.start_turn = turn[0]
        self._grasp = turn[0].inv().apply(problem.reference.pos.numpy()[0] - pos[0])

    def rollout(self, commands: np.ndarray) -> _Way:
        """Return where commands (K, 6) take the hand."""
        self._restart()
        states, poses = [self.sim.read()], []
        ctrl = self._problem.fingers[None].copy()
        for k, command in enumerate(commands):
            ctrl[0, :_JOINTS] = command
            self.carry(self.sim, np.array([k + 1]))
            if self.sim.step(ctrl).any():
                task = self._problem.scene.task.id
                raise SceneError(f"task '{task}': the simulation of the hand alone diverged")
            states.append(self.sim.read())
            poses.append(self.grasp_point(self.sim))
        return _Way(
            np.concatenate([state.qpos.numpy() for state in states]),
            np.concatenate([state.qvel.numpy() for state in states]),
            np.concatenate([points for points, _ in poses]),
            Rotation.concatenate([turn for _, turn in poses]),
        )

    def grasp_point(self, sim: SimBatch) -> tuple[np.ndarray, Rotation]:
        """Return the point (N, 3) that is the object's centre at the start, and the palm's turn."""
        pos, turn = self._palm(sim)
        return pos + turn.apply(self._grasp), turn

    def carry(self, sim: SimBatch, steps: np.ndarray) -> None:
        """Load simulations with the weight that they carry at steps (N,) of the motion."""
        if self._load.any():
            force = np.zeros((len(steps), 3))
            force[:, 2] = -self._load[steps]
            sim.push(self.palm, force, self.grasp_point(sim)[0])

    def _palm(self, sim: SimBatch) -> tuple[np.ndarray, Rotation]:
        pos, quat = sim.body_pose(self.palm)
        return pos, Rotation.from_quat(quat, scalar_first=True)

    def _restart(self) -> None:
        self.sim.reset(np.array([0]), self._problem.qpos, self._problem.qvel)


class _Search:
    """Gauss-Newton over the commands of all steps."""

    def __init__(self, problem: WristProblem, num_threads: int, progress: Progress | None) -> None:
        scene, self._problem = problem.scene, problem
        self._progress, self._rounds, self.frames = progress, 0, 0
        model, index = scene.model, scene.index
        ranges = np.where(model.jnt_limited[:, None], model.jnt_range, (-np.inf, np.inf))[:_JOINTS]
        margin = np.minimum(_MARGIN, np.ptp(ranges, axis=1) / 4)
        self._low, self._high = index.ctrl_low[:_JOINTS], index.ctrl_high[:_JOINTS]
        self._limits = Limits(ranges[:, 0] + margin, ranges[:, 1] - margin)
        within = replace(
            index,
            ctrl_low=np.maximum(self._low, self._limits.low),
            ctrl_high=np.minimum(self._high, self._limits.high),
        )
        self.path = feasible_path(within, problem.reference, torch.from_numpy(problem.qpos)).numpy()
        # Joints dynamically coupled to the base: its own, and those that rotate the palm.
        self._n = scene.hand.num_base_joints + scene.hand.num_wrist_joints
        alone = hand_alone(scene)
        model = copy.deepcopy(alone.model)
        model.opt.disableflags |= _SMOOTH
        # Without limits the fingers would swing past them, so they are frozen.
        model.dof_armature[self._n : model.nu] = _FROZEN
        smooth = replace(alone, model=model)
        self._hands = {True: _Hand(problem, alone), False: _Hand(problem, smooth)}
        self._steps = SimBatch(smooth, len(self.path) - 1, num_threads, problem.substeps)
        base = Rotation.from_euler("XYZ", self.path[:, _SLIDES:])
        mount = Rotation.from_quat(index.mount_quat, scalar_first=True)
        carried = mount * base
        base0 = mount * Rotation.from_euler("XYZ", problem.qpos[_SLIDES:_JOINTS])
        turns = carried * (base0.inv() * self._hands[True].start_turn)
        hold, step = problem.hold_steps, np.arange(len(self.path))
        held = problem.steps_behind()[1:]
        self._targets, self._turns = problem.reference.pos.numpy()[held], turns[held.tolist()]
        self._followed = ((step <= hold) | (step > 2 * hold))[1:, None]

    def improve(self, commands: np.ndarray, stage: Stage, real: bool) -> np.ndarray:
        """Return better commands (K, 6), by at most as many steps as a stage has."""
        hand, trust = self._hands[real], stage.trust
        commands = commands.clip(self._low, self._high)
        way = self._rollout(hand, commands)
        cost, model = self._cost(commands, way), self._linearise(commands, way)
        end = self._rounds + stage.rounds
        while self._rounds < end and trust > _LEAST_TRUST:
            self._rounds += 1
            if self._progress is not None:
                self._progress(self._rounds, SMOOTH_STAGE.rounds + REAL_STAGE.rounds)
            step = model.least(
                np.maximum(self._low - commands, -trust), np.minimum(self._high - commands, trust)
            )
            tried = (commands + step).clip(self._low, self._high)
            try:
                tried_way = self._rollout(hand, tried)
            except SceneError:  # it diverged: too far
                trust /= 4
                continue
            gained = cost - (tried_cost := self._cost(tried, tried_way))
            share = gained / max(model.gain(step.ravel()), _TINY)  # of what the model promised
            if share < _POOR:
                trust = min(trust, float(np.abs(step).max())) / 4
            elif share > _GOOD:
                trust *= 2
            if gained > 0:
                finished = gained < _ENOUGH * cost
                commands, way, cost = tried, tried_way, tried_cost
                if finished:
                    break
                model = self._linearise(commands, way)
        self._rounds = end
        return commands

    def _rollout(self, hand: _Hand, commands: np.ndarray) -> _Way:
        self.frames += len(commands)
        return hand.rollout(commands)

    def _cost(self, commands: np.ndarray, way: _Way) -> float:
        beyond = self._limits.beyond(way.qpos[1:, :_JOINTS])
        parts = self._off(way.points, way.turns), *self._unsteady(commands), beyond
        return sum(float((part**2).sum()) for part in parts)

    def _off(self, points: np.ndarray, turns: Rotation) -> np.ndarray:
        """Return residuals (K, 6): of the grasp point's position, then of the palm's turn."""
        turned = (self._turns.inv() * turns).as_rotvec()
        off = np.concatenate((_PER_M * (points - self._targets), _PER_RAD * turned), 1)
        return off * self._followed

    def _unsteady(self, commands: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return residuals (K, 6) each: change of the commands, and their distance to the path."""
        change = np.diff(np.concatenate((self.path[:1], commands)), axis=0)
        return _CHANGE * change, _NEAR_PATH * _CHANGE * (commands - self.path[1:])

    def _linearise(self, commands: np.ndarray, way: _Way) -> Model:
        """Return the cost around commands, by finite differences of every step, side by side.

        The smooth model serves for both stages: kinks would only make it wrong farther away.
        """
        steps, n = len(commands), self._n
        ctrl = np.repeat(self._problem.fingers[None], steps, 0)
        ctrl[:, :_JOINTS] = commands

        qpos, qvel = way.qpos[:-1].copy(), way.qvel[:-1].copy()

        def after() -> np.ndarray:
            self.frames += steps
            self._steps.reset(np.arange(steps), qpos, qvel)
            self._hands[True].carry(self._steps, np.arange(1, steps + 1))
            if self._steps.step(ctrl).any():
                raise SceneError("the simulation of the hand alone diverged")
            state = self._steps.read()
            off = self._off(*self._hands[True].grasp_point(self._steps))
            return np.concatenate((state.qpos[:, :n], state.qvel[:, :n], off), 1)

        here, slopes = after(), []
        # Away from the upper end of the control range, where a command beyond it changes nothing.
        inward = np.where(commands + _STEP > self._high, -_STEP, _STEP)
        for array, by in (
            (qpos, np.full((steps, n), _STEP)),
            (qvel, np.full((steps, n), _STEP_PER_S)),
            (ctrl, inward),
        ):
            for column in range(by.shape[1]):
                before = array[:, column].copy()
                array[:, column] += by[:, column]
                slopes.append((after() - here) / by[:, column, None])
                array[:, column] = before
        slopes = np.stack(slopes, 2)  # (K, 2n+6, 2n+6)
        size = steps * _JOINTS
        off_by, joints_by = np.zeros((2, steps, _JOINTS, size))
        state_by = np.zeros((2 * n, size))
        for k, slope in enumerate(slopes):
            chained = slope[:, : 2 * n] @ state_by
            chained[:, k * _JOINTS : (k + 1) * _JOINTS] += slope[:, 2 * n :]
            state_by, off_by[k], joints_by[k] = (
                chained[: 2 * n],
                chained[2 * n :],
                chained[:_JOINTS],
            )
        change = np.tile(_CHANGE, steps)[:, None] * (np.eye(size) - np.eye(size, k=-_JOINTS))
        near = np.diag(np.tile(_NEAR_PATH * _CHANGE, steps))
        residuals = self._off(way.points, way.turns), *self._unsteady(commands)
        return Model(
            np.concatenate((off_by.reshape(size, size), change, near)),
            np.concatenate([part.ravel() for part in residuals]),
            joints_by.reshape(size, size),
            way.qpos[1:, :_JOINTS],
            self._limits,
        )
