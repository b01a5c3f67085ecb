"""Quality of a pre-grasp: is it free of contact, near the object, facing it, able to lift it?"""

from __future__ import annotations

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from pgdm import seeding
from pgdm.errors import ConfigError
from pgdm.library import Start
from pgdm.pregrasp.flexion import Flexion
from pgdm.pregrasp.hand_geometry import mount_rotation, posed
from pgdm.sim.batch import SimBatch
from pgdm.sim.contact import FREE_M, FingertipDistance, HandContact
from pgdm.sim.scene import Scene

LIFT_M = 0.02
"""How far the object's centre of mass must rise, the same as for the reward's lift bonus."""
RAISE_M = 0.1
"""How far a policy raises the hand, unless a slide reaches its limit before that."""
PRESS_M = 0.03
"""Largest distance that the hand moves in the direction that the palm faces, while it closes."""
_SHIFT_M, _SPREAD_RAD = 0.01, 0.15  # std: hand's shift; joints that bend no finger
_PRESS_STEPS, _CLOSE_STEPS, _LIFT_STEPS, _HOLD_STEPS = 8, 20, 25, 15  # control steps
_FASTEST, _SLOWEST = 4, 16  # control steps in which a finger closes
# Ranges of random factors: one per policy, one per finger and one per joint. Their product is the
# share of full flexion.
_GRIP, _FINGER, _JOINT = (0.3, 1.0), (0.5, 1.0), (0.7, 1.3)


@dataclass(frozen=True)
class Quality:
    """Measurements of a pre-grasp."""

    free: bool
    """Whether the hand touches nothing but itself (at most 0.1 mm of penetration)."""
    depth_m: float
    """Deepest penetration between the hand and anything else."""
    fingertip_distance_m: float
    """Distance between the collision surfaces of each finger's last link and of the object, mean
    over fingers; a link that penetrates the object counts as 0."""
    palm_angle_rad: float
    """Angle between the palm's normal and the direction from the palm's middle to the object's
    centre of mass."""
    lift_rate: float
    """Share of random closing policies that lift and hold the object; NaN if not tested, or if the
    object, such as a door, cannot be lifted."""


class LiftTest:
    """The lift test: random closing policies try to lift the object from a pre-grasp.

    A policy moves the hand a little in the direction that the palm faces, plus a random shift. It
    flexes each finger, at the finger's own random speed, by a random share of the way from its
    pre-grasp to full flexion, and moves joints that bend no finger at random. Then it raises the
    hand by :data:`RAISE_M` and holds it still. It succeeds if the object stays at least
    :data:`LIFT_M` above its start during the hold. Equal arguments give an equal result, whatever
    the number of threads.

    Args:
        scene: scene of the task.
        substeps: physics steps per control step.
        num_policies: N, number of policies.
        seed: seed of the policies.
        num_threads: number of threads of the simulations; 0 takes one per core.
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
        """Digest of the scene, and number of substeps, that the test is valid for."""
        self._sim = SimBatch(scene, num_policies, num_threads, substeps)
        self._all = np.arange(num_policies)
        fingers, n = self._flexion.num_fingers, num_policies
        of_joint, random = self._flexion.finger_of_joint, seeding.numpy_stream(seed, "lift")
        grip = random.uniform(*_GRIP, (n, 1)) * random.uniform(*_FINGER, (n, fingers))
        shares = grip[:, of_joint] * random.uniform(*_JOINT, (n, len(of_joint)))
        self._shares = shares.clip(0.0, 1.0)  # (N, J)
        self._steps = random.uniform(_FASTEST, _SLOWEST, (n, fingers))[:, of_joint]  # (N, J)
        self._mount = mount_rotation(scene)
        self._raise = RAISE_M * self._mount[2]  # (3,) m, of the slides
        self._press = random.uniform(0.0, PRESS_M, (n, 1))
        self._shift = random.normal(0.0, _SHIFT_M, (n, 3))
        self._spread = random.normal(0.0, _SPREAD_RAD, shares.shape)  # (N, J)
        self.possible = _can_rise(scene)
        """Whether the object can be lifted at all."""

    def __call__(self, start: Start) -> float:
        """Return the share of policies that lift the object; NaN if it cannot be lifted."""
        return float(self.lifted(start).mean()) if self.possible else math.nan

    def lifted(self, start: Start) -> np.ndarray:
        """Return which policies lift and hold the object, (N,) bool."""
        sim, index, first = self._sim, self._scene.index, self._flexion.first
        sim.reset(self._all, start.qpos, start.qvel)
        height = float(sim.read().object_pos[0, 2])
        begin = start.qpos[: index.num_joints]
        closed = self._flexion.closed
        shift = self._press * (self._flexion.palm(start.qpos)[1] @ self._mount) + self._shift
        bend = np.where(np.isnan(closed), self._spread, (closed - begin[first:]) * self._shares)
        targets = np.repeat(begin[None], len(self._all), 0)
        failed, held = np.zeros(len(self._all), bool), np.ones(len(self._all), bool)
        for k in range(1, _CLOSE_STEPS + _LIFT_STEPS + _HOLD_STEPS + 1):
            targets[:, first:] = begin[first:] + bend * (k / self._steps).clip(max=1.0)
            up = min(max((k - _CLOSE_STEPS) / _LIFT_STEPS, 0.0), 1.0)
            targets[:, :3] = begin[:3] + min(k / _PRESS_STEPS, 1.0) * shift + up * self._raise
            driven = targets[:, index.driven]
            failed |= sim.step(driven.clip(index.ctrl_low, index.ctrl_high))
            if k > _CLOSE_STEPS + _LIFT_STEPS:
                held &= sim.read().object_pos[:, 2].numpy() >= height + LIFT_M
        return held & ~failed


def quality(scene: Scene, qpos: np.ndarray, substeps: int, lift: LiftTest | None) -> Quality:
    """Measure a pre-grasp.

    Args:
        scene: scene of the task.
        qpos: whole scene (nq,) with the hand at its pre-grasp.
        substeps: physics steps per control step.
        lift: lift test of this scene, which takes about a second; None skips it.

    Raises:
        ConfigError: the lift test is for another scene or number of substeps.
    """
    if lift is not None and lift.made_for != (scene.digest(), substeps):
        raise ConfigError(
            f"the lift test is for another scene or number of substeps than task "
            f"'{scene.task.id}' with hand '{scene.hand.name}' and {substeps} substeps"
        )
    depth = HandContact(scene).depth(qpos)
    centre, normal = Flexion(scene).palm(qpos)
    data = posed(scene, qpos)
    to_object = data.xipos[scene.index.object_body] - centre
    cosine = float(normal @ to_object / max(float(np.linalg.norm(to_object)), 1e-9))
    rate = math.nan if lift is None else lift(Start(qpos, np.zeros(scene.model.nv), None))
    return Quality(
        free=depth <= FREE_M,
        depth_m=depth,
        fingertip_distance_m=float(FingertipDistance(scene)(data).clip(0.0).mean()),
        palm_angle_rad=math.acos(min(1.0, max(-1.0, cosine))),
        lift_rate=rate,
    )


def _can_rise(scene: Scene) -> bool:
    """Return whether the object can move up: whether it or an ancestor has a non-hinge joint."""
    model, body = scene.model, scene.index.object_body
    while body:
        first = model.body_jntadr[body]
        kinds = model.jnt_type[first : first + model.body_jntnum[body]]
        if (kinds != mujoco.mjtJoint.mjJNT_HINGE).any():
            return True
        body = model.body_parentid[body]
    return False
