"""Plays reach plans in simulation, many in parallel."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgdm.errors import ConfigError
from pgdm.sim.batch import SimBatch
from pgdm.sim.scene import Scene, SceneIndex


@dataclass(frozen=True)
class Ends:
    """Final states of N plans.

    The object's displacement and rotation are relative to the pose it has if the hand stays away.
    """

    qpos: np.ndarray  # (N, nq) m, rad
    qvel: np.ndarray  # (N, nv) m/s, rad/s
    moved_m: np.ndarray  # (N,) displacement of the object's centre of mass
    turned_rad: np.ndarray  # (N,) rotation of the object
    peak_m: np.ndarray  # (N,) largest displacement of the object's centre of mass during the plan
    diverged: np.ndarray  # (N,) bool


@dataclass(frozen=True)
class ObjectTrack:
    """Pose of the object after each of K control steps."""

    pos: np.ndarray  # (K, 3) m, position of the object's centre of mass, world frame
    quat: np.ndarray  # (K, 4) wxyz, orientation of the object's body


@dataclass(frozen=True)
class Played:
    """States of one plan, before and after each control step."""

    qpos: np.ndarray  # (K+1, nq) m, rad
    qvel: np.ndarray  # (K+1, nv) m/s, rad/s


def to_targets(index: SceneIndex, actions: np.ndarray) -> np.ndarray:
    """Return the actuator targets (..., nu), m and rad, of actions (..., nu) in [-1, 1]."""
    middle, half = _control_range(index)
    return middle + np.clip(actions, -1.0, 1.0) * half


def to_actions(index: SceneIndex, targets: np.ndarray) -> np.ndarray:
    """Return the actions (..., nu) in [-1, 1] for target joint positions (..., n), clipped."""
    middle, half = _control_range(index)
    return ((targets[..., index.driven] - middle) / half).clip(-1.0, 1.0)


def _control_range(index: SceneIndex) -> tuple[np.ndarray, np.ndarray]:
    low, high = index.ctrl_low, index.ctrl_high
    return 0.5 * (high + low), 0.5 * (high - low)


def play(scene: Scene, plan_actions: np.ndarray, start_qpos: np.ndarray, substeps: int) -> Played:
    """Play a plan in simulation.

    Args:
        scene: scene of the task.
        plan_actions: (K, nu) in [-1, 1].
        start_qpos: start of the plan, whole scene (nq,): see
            :func:`pgdm.pregrasp.sources.reset_pose`.
        substeps: physics steps per control step.

    Raises:
        ConfigError: the plan is for another hand.
    """
    check_plan(scene, plan_actions)
    sim = SimBatch(scene, 1, 1, substeps)
    sim.reset(np.array([0]), start_qpos, np.zeros(scene.model.nv))
    states = [sim.read()]
    for targets in to_targets(scene.index, plan_actions):
        sim.step(targets[None])
        states.append(sim.read())
    return Played(
        np.stack([s.qpos[0].numpy() for s in states]), np.stack([s.qvel[0].numpy() for s in states])
    )


def check_plan(scene: Scene, plan_actions: np.ndarray) -> None:
    """Check that a plan (K, nu) fits the scene's hand.

    Raises:
        ConfigError: the plan is for another hand.
    """
    if plan_actions.ndim != 2 or plan_actions.shape[1] != scene.model.nu:
        raise ConfigError(
            f"the plan has actions of shape {plan_actions.shape}, but hand '{scene.hand.name}' has "
            f"{scene.model.nu} actuators: it is for another hand"
        )


class Rollouts:
    """Plays N plans in parallel, all from the same start.

    Args:
        scene: scene of the task.
        start_qpos: start of the plans, whole scene (nq,).
        num_plans: number of plans, N.
        substeps: physics steps per control step.
        num_threads: number of threads; 0 takes one per core. Results do not depend on it.
    """

    def __init__(
        self, scene: Scene, start_qpos: np.ndarray, num_plans: int, substeps: int, num_threads: int
    ) -> None:
        self._scene, self._start = scene, start_qpos
        self._sim = SimBatch(scene, num_plans, num_threads, substeps)
        self._all = np.arange(num_plans)
        self._substeps, self.control_dt_s = substeps, self._sim.control_dt_s

    def undisturbed(self, steps: int) -> ObjectTrack:
        """Return the object's track over ``steps`` while the hand stays in its reset pose."""
        sim = SimBatch(self._scene, 1, 1, self._substeps)
        sim.reset(np.array([0]), self._start, np.zeros(self._scene.model.nv))
        index = self._scene.index
        targets = index.reset[index.driven].clip(index.ctrl_low, index.ctrl_high)[None]
        pos, quat = [], []
        for _ in range(steps):
            sim.step(targets)
            state = sim.read()
            pos.append(state.object_pos[0].numpy())
            quat.append(state.object_quat[0].numpy())
        return ObjectTrack(np.stack(pos), np.stack(quat))

    def settled(
        self, joints: np.ndarray, nearest: np.ndarray, farthest: np.ndarray, gain: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """Return joint positions near ``joints`` where servos can come to rest, and target offsets.

        First the targets are held at ``joints`` for a second. If an error still exceeds ``nearest``
        then, servos cannot remove it (joints coupled by a tendon are an example), and the aim is
        shifted by this error, at most by ``farthest``. For another second an integrator finds the
        offsets between targets and aim that remove the remaining error:

            extra <- extra + gain (aim - q)

        Args:
            joints: desired joint positions (n,) m and rad.
            nearest: largest error that does not shift the aim, (n,).
            farthest: largest shift of the aim, (n,).
            gain: share of the error that each control step adds to the offsets.

        Returns:
            Aim and offsets, (n,) each; ``joints`` and zeros if the simulation diverges.
        """
        index, n = self._scene.index, len(joints)
        sim, steps = SimBatch(self._scene, 1, 1, self._substeps), round(1 / self.control_dt_s)
        sim.reset(np.array([0]), self._start, np.zeros(self._scene.model.nv))
        aim, extra = joints.copy(), np.zeros(n)
        for k in range(2 * steps):
            if sim.step((aim + extra)[None, index.driven]).any():
                return joints.copy(), np.zeros(n)
            rest = sim.read().qpos[0, :n].numpy()
            if k == steps:
                off = rest - joints
                aim += np.where(np.abs(off) > nearest, off.clip(-farthest, farthest), 0.0)
            if k >= steps:
                # Anti-windup: keep targets within the control range, beyond which they are clipped.
                extra += gain * (aim - rest)
                extra = extra.clip(index.joint_low - aim, index.joint_high - aim)
        return aim, extra

    def run(self, actions: np.ndarray, undisturbed: ObjectTrack) -> Ends:
        """Return the final states of plans with actions (N, K, nu).

        Args:
            actions: (N, K, nu) in [-1, 1].
            undisturbed: the object's track if the hand stays away, for comparison.
        """
        sim, n = self._sim, len(self._all)
        sim.reset(self._all, self._start, np.zeros(self._scene.model.nv))
        targets = to_targets(self._scene.index, actions)
        diverged, peak = np.zeros(n, bool), np.zeros(n)
        for k in range(targets.shape[1]):
            diverged |= sim.step(targets[:, k])
            state = sim.read()
            moved = np.linalg.norm(state.object_pos.numpy() - undisturbed.pos[k], axis=1)
            peak = np.maximum(peak, moved)
        qpos, qvel = state.qpos.numpy(), state.qvel.numpy()
        diverged |= ~np.isfinite(qpos).all(1) | ~np.isfinite(peak)
        cosine = np.abs(state.object_quat.numpy() @ undisturbed.quat[-1]).clip(0.0, 1.0)
        return Ends(qpos, qvel, moved, 2 * np.arccos(cosine), peak, diverged)
