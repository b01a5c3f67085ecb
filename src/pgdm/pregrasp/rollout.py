"""Plans carried out in the simulation, many side by side."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgdm.errors import ConfigError
from pgdm.sim.batch import SimBatch
from pgdm.sim.scene import Scene, SceneIndex


@dataclass(frozen=True)
class Ends:
    """Where N plans end."""

    qpos: np.ndarray  # (N, nq) m, rad
    qvel: np.ndarray  # (N, nv) m/s, rad/s
    moved_m: np.ndarray  # (N,) distance of the object's COM from where the reference has it
    turned_rad: np.ndarray  # (N,) angle between its orientation and the reference's
    peak_m: np.ndarray  # (N,) largest such distance on the way
    diverged: np.ndarray  # (N,) bool


@dataclass(frozen=True)
class ObjectTrack:
    """Where the object is after each of K control steps."""

    pos: np.ndarray  # (K, 3) m, of its centre of mass
    quat: np.ndarray  # (K, 4) wxyz


@dataclass(frozen=True)
class Played:
    """One plan, step by step."""

    qpos: np.ndarray  # (K+1, nq) m, rad
    qvel: np.ndarray  # (K+1, nv) m/s, rad/s


def to_targets(index: SceneIndex, actions: np.ndarray) -> np.ndarray:
    """Return actuator targets (..., nu), m and rad, of normalised actions."""
    middle, half = (
        0.5 * (index.ctrl_high + index.ctrl_low),
        0.5 * (index.ctrl_high - index.ctrl_low),
    )
    return middle + np.clip(actions, -1.0, 1.0) * half


def to_actions(index: SceneIndex, targets: np.ndarray) -> np.ndarray:
    """Return the actions in [-1, 1] whose targets (..., nu) are these, or the nearest ones."""
    middle, half = (
        0.5 * (index.ctrl_high + index.ctrl_low),
        0.5 * (index.ctrl_high - index.ctrl_low),
    )
    return ((targets - middle) / half).clip(-1.0, 1.0)


def reset_pose(scene: Scene, qpos: np.ndarray) -> np.ndarray:
    """Return qpos (nq,) with all joints of the hand at zero, from where a reach begins."""
    home = np.array(qpos, float)
    home[: scene.model.nu] = 0.0
    return home


def play(scene: Scene, plan_actions: np.ndarray, start_qpos: np.ndarray, substeps: int) -> Played:
    """Carry out a plan in the simulation.

    Args:
        scene: of the task.
        plan_actions: (K, nu) in [-1, 1].
        start_qpos: whole scene (nq,), see :func:`reset_pose`.
        substeps: physics steps per control step.

    Raises:
        ConfigError: if the plan is made for another hand.
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
        ConfigError: if it does not.
    """
    if plan_actions.ndim != 2 or plan_actions.shape[1] != scene.model.nu:
        raise ConfigError(
            f"the plan has actions of shape {plan_actions.shape}, but hand '{scene.hand.name}' has "
            f"{scene.model.nu} actuators: it was made for another hand"
        )


class Rollouts:
    """Carries out N plans at a time, all from one start.

    Args:
        scene: of the task.
        start_qpos: whole scene (nq,).
        num_plans: N.
        substeps: physics steps per control step.
        num_threads: 0 takes one per core; results do not depend on it.
    """

    def __init__(
        self, scene: Scene, start_qpos: np.ndarray, num_plans: int, substeps: int, num_threads: int
    ) -> None:
        self._scene, self._start = scene, start_qpos
        self._sim = SimBatch(scene, num_plans, num_threads, substeps)
        self._all = np.arange(num_plans)
        self._substeps = substeps

    @property
    def control_dt_s(self) -> float:
        """Time of one control step, s."""
        return self._sim.control_dt_s

    def undisturbed(self, steps: int) -> ObjectTrack:
        """Return the object's way while the hand stays in its reset pose."""
        sim = SimBatch(self._scene, 1, 1, self._substeps)
        sim.reset(np.array([0]), self._start, np.zeros(self._scene.model.nv))
        targets = np.zeros(self._scene.model.nu)
        targets = targets.clip(self._scene.index.ctrl_low, self._scene.index.ctrl_high)[None]
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
        """Return where servos come to rest near joints, and what they need beyond it, (nu,) each.

        They are held at the joints for a second. What they lack by more than ``nearest`` they
        cannot help, such as joints that a tendon couples: the aim moves there, by ``farthest`` at
        most. For another second their targets follow what is still lacking, as an integrator would.

        Args:
            joints: where the hand shall be, (nu,) m and rad.
            nearest: error that leaves the aim where it is, (nu,).
            farthest: largest shift of the aim, (nu,).
            gain: share of the error that a step adds to the targets.
        """
        index, nu = self._scene.index, len(joints)
        sim, steps = SimBatch(self._scene, 1, 1, self._substeps), round(1 / self.control_dt_s)
        sim.reset(np.array([0]), self._start, np.zeros(self._scene.model.nv))
        aim, extra = joints.copy(), np.zeros(nu)
        for k in range(2 * steps):
            if sim.step((aim + extra)[None]).any():
                return joints.copy(), np.zeros(nu)
            rest = sim.read().qpos[0, :nu].numpy()
            if k == steps:
                off = rest - joints
                aim += np.where(np.abs(off) > nearest, off.clip(-farthest, farthest), 0.0)
            if k >= steps:
                # What a servo cannot be told would have to be unlearnt later.
                extra += gain * (aim - rest)
                extra = extra.clip(index.ctrl_low - aim, index.ctrl_high - aim)
        return aim, extra

    def run(self, actions: np.ndarray, reference: ObjectTrack) -> Ends:
        """Return where plans (N, K, nu) end, the object compared with a reference."""
        sim, n = self._sim, len(self._all)
        sim.reset(self._all, self._start, np.zeros(self._scene.model.nv))
        targets = to_targets(self._scene.index, actions)
        diverged, peak = np.zeros(n, bool), np.zeros(n)
        for k in range(targets.shape[1]):
            diverged |= sim.step(targets[:, k])
            state = sim.read()
            moved = np.linalg.norm(state.object_pos.numpy() - reference.pos[k], axis=1)
            peak = np.maximum(peak, moved)
        qpos, qvel = state.qpos.numpy(), state.qvel.numpy()
        diverged |= ~np.isfinite(qpos).all(1) | ~np.isfinite(peak)
        cosine = np.abs(state.object_quat.numpy() @ reference.quat[-1]).clip(0.0, 1.0)
        return Ends(qpos, qvel, moved, 2 * np.arccos(cosine), peak, diverged)
