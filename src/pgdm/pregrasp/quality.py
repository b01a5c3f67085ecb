"""How good a pre-grasp is: free of contact, near, facing the object, and able to lift it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from pgdm import seeding
from pgdm.errors import ConfigError
from pgdm.library import Start
from pgdm.pregrasp.flexion import Flexion
from pgdm.sim.batch import SimBatch
from pgdm.sim.contact import FREE_M, FingertipDistance, HandContact
from pgdm.sim.scene import Scene

LIFT_M = 0.02
"""How far the object's centre of mass must rise: as much as earns the reward's bonus (SPEC 1)."""
CARRY_M = 0.1
"""How far the palm is carried up, or as far as its slides go."""
PRESS_M = 0.03
"""How far a policy moves the palm along its own direction while it closes, at most."""
_SHIFT_M, _SPREAD_RAD = 0.01, 0.15  # deviation of the wrist, and of joints that do not close
_PRESS_STEPS = 8
_CLOSE_STEPS, _LIFT_STEPS, _HOLD_STEPS = 20, 25, 15  # control steps
_FASTEST, _SLOWEST = 4, 16  # steps in which a finger closes
_GRIP, _FINGER, _JOINT = (0.3, 1.0), (0.5, 1.0), (0.7, 1.3)  # shares of the way to full flexion


@dataclass(frozen=True)
class Quality:
    """What can be said of a pre-grasp."""

    free: bool
    """Whether the hand touches nothing."""
    depth_m: float
    """Deepest penetration of the hand and anything else."""
    fingertip_distance_m: float
    """From the collision surface of the fingers' last links to the object's, mean over fingers; a
    link that cuts into it counts as 0."""
    palm_angle_rad: float
    """Between where the palm looks and the way from its middle to the object's centre of mass."""
    lift_rate: float
    """Share of random closing policies that lift the object and hold it; NaN if not tested, or if
    the object cannot be lifted, such as a door."""


class LiftTest:
    """Closes the fingers in many random ways, carries the palm up, and looks at the object.

    A policy presses the palm a little towards where it looks, closes each finger at a speed of its
    own by a random share of the way to full flexion, then raises the wrist. Equal arguments give
    an equal result, whatever the number of threads.

    Args:
        scene: of the task.
        substeps: physics steps per control step.
        num_policies: how many policies are tried.
        seed: of their random numbers.
        num_threads: 0 takes one per core.
    """

    def __init__(
        self,
        scene: Scene,
        substeps: int,
        num_policies: int = 32,
        seed: int = 0,
        num_threads: int = 0,
    ) -> None:
        self._scene, self._flexion = scene, Flexion(scene)
        self.made_for = scene.digest(), substeps
        """Scene and speed that it tests."""
        self._sim = SimBatch(scene, num_policies, num_threads, substeps)
        self._all = np.arange(num_policies)
        fingers, n = self._flexion.num_fingers, num_policies
        of_joint, random = self._flexion.finger_of_joint, seeding.numpy_stream(seed, "lift")
        grip = random.uniform(*_GRIP, (n, 1)) * random.uniform(*_FINGER, (n, fingers))
        shares = grip[:, of_joint] * random.uniform(*_JOINT, (n, len(of_joint)))
        self._shares = shares.clip(0.0, 1.0)  # (N, J)
        self._steps = random.uniform(_FASTEST, _SLOWEST, (n, fingers))[:, of_joint]  # (N, J)
        mount = np.empty(9)
        mujoco.mju_quat2Mat(mount, scene.index.mount_quat)
        self._mount = mount.reshape(3, 3)
        self._carry = CARRY_M * self._mount[2]  # (3,) m, of the slides
        self._press = random.uniform(0.0, PRESS_M, (n, 1))
        self._shift = random.normal(0.0, _SHIFT_M, (n, 3))
        self._spread = random.normal(0.0, _SPREAD_RAD, shares.shape)  # (N, J)
        self.possible = _can_rise(scene)
        """Whether the object can be lifted at all."""

    def __call__(self, start: Start) -> float:
        """Return the share of policies that lift the object and hold it; NaN if none ever could."""
        return float(self.lifted(start).mean()) if self.possible else math.nan

    def lifted(self, start: Start) -> np.ndarray:
        """Return which policies do, (N,) bool."""
        sim, index, first = self._sim, self._scene.index, self._flexion.first
        sim.reset(self._all, start.qpos, start.qvel)
        height = float(sim.read().object_pos[0, 2])
        begin = start.qpos[: index.num_actuators]
        closed = self._flexion.closed
        shift = self._press * (self._flexion.palm(start.qpos)[1] @ self._mount) + self._shift
        way = np.where(np.isnan(closed), self._spread, (closed - begin[first:]) * self._shares)
        targets = np.repeat(begin[None], len(self._all), 0)
        failed, held = np.zeros(len(self._all), bool), np.ones(len(self._all), bool)
        for k in range(1, _CLOSE_STEPS + _LIFT_STEPS + _HOLD_STEPS + 1):
            targets[:, first:] = begin[first:] + way * (k / self._steps).clip(max=1.0)
            up = min(max((k - _CLOSE_STEPS) / _LIFT_STEPS, 0.0), 1.0)
            targets[:, :3] = begin[:3] + min(k / _PRESS_STEPS, 1.0) * shift + up * self._carry
            failed |= sim.step(targets.clip(index.ctrl_low, index.ctrl_high))
            if k > _CLOSE_STEPS + _LIFT_STEPS:
                held &= sim.read().object_pos[:, 2].numpy() >= height + LIFT_M
        return held & ~failed


def quality(scene: Scene, qpos: np.ndarray, substeps: int, lift: LiftTest | None) -> Quality:
    """Measure a pre-grasp.

    Args:
        scene: of the task.
        qpos: whole scene (nq,) with the hand at its pre-grasp.
        substeps: physics steps per control step.
        lift: test of this scene, or None to leave it out, as it takes a second.

    Raises:
        ConfigError: if the test was made for another scene or speed.
    """
    if lift is not None and lift.made_for != (scene.digest(), substeps):
        raise ConfigError(
            f"this lift test was made for another scene or speed than that of task "
            f"'{scene.task.id}' with hand '{scene.hand.name}' and {substeps} substeps"
        )
    depth = HandContact(scene).depth(qpos)
    centre, normal = Flexion(scene).palm(qpos)
    data = mujoco.MjData(scene.model)
    data.qpos[:] = qpos
    mujoco.mj_kinematics(scene.model, data)
    way = data.xipos[scene.index.object_body] - centre
    cosine = float(normal @ way / max(float(np.linalg.norm(way)), 1e-9))
    rate = math.nan if lift is None else lift(Start(qpos, np.zeros(scene.model.nv), None))
    return Quality(
        free=depth <= FREE_M,
        depth_m=depth,
        fingertip_distance_m=float(FingertipDistance(scene)(data).clip(0.0).mean()),
        palm_angle_rad=math.acos(min(1.0, max(-1.0, cosine))),
        lift_rate=rate,
    )


def _can_rise(scene: Scene) -> bool:
    """Return whether the object has joints of its own that lead it upwards."""
    model, body = scene.model, scene.index.object_body
    while body:
        first = model.body_jntadr[body]
        kinds = model.jnt_type[first : first + model.body_jntnum[body]]
        if (kinds != mujoco.mjtJoint.mjJNT_HINGE).any():
            return True
        body = model.body_parentid[body]
    return False
