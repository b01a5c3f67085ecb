"""The input of a wrist plan, and the hash of everything that the plan depends on."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np

from pgdm.errors import ConfigError, amount
from pgdm.motion.reference import ObjectReference
from pgdm.sim.scene import Scene

VERSION = 1
"""Version of the planner; the library's plans from another version are recomputed."""

_LIFTED_M = 0.02  # rise of the motion at which the hand bears the full weight
_LONGEST = 250  # poses; the solver's time grows with the cube of their number
_OF_FILES = re.compile("path|nbuffer").search  # model fields that depend on file paths


@dataclass(frozen=True)
class WristProblem:
    """Motion, start state and hand that a wrist plan is computed for."""

    scene: Scene
    reference: ObjectReference
    qpos: np.ndarray  # (nq,) m, rad: the start state
    qvel: np.ndarray  # (nv,) m/s, rad/s
    fingers: np.ndarray  # (nu,) m, rad: constant actuator targets; the base's entries are unused
    substeps: int
    """Physics steps per control step."""
    hold_steps: int = 0
    """Control steps for which the hand waits at its start while the fingers close. In as many steps
    after that, tracking errors cost nothing, so that the hand can catch up."""
    bears_load: bool = False
    """Whether the hand carries the object's weight once the motion lifts the object. Gravity
    compensation does not cover that weight, only the hand's."""

    def check(self) -> None:
        """Check that the motion is longer than hold and catch-up, and not too long to plan.

        Raises:
            ConfigError: the motion is too short or too long.
        """
        poses = len(self.reference)
        if 2 * self.hold_steps >= poses - 1:
            raise ConfigError(
                f"action.hold_steps is {self.hold_steps}: to hold and catch up takes twice that, "
                f"and the motion has {amount(poses - 1, 'step')}; use at most {(poses - 2) // 2}"
            )
        if poses > _LONGEST:
            raise ConfigError(
                f"the motion has {poses} poses, and a wrist plan takes at most {_LONGEST}; use "
                "action.wrist_path=feasible"
            )

    def target_steps(self) -> np.ndarray:
        """Return for each step (T,) the motion's step that the hand should follow, 0 in a hold."""
        step = np.arange(len(self.reference))
        return np.where(step <= self.hold_steps, 0, step)

    def load_n(self) -> np.ndarray:
        """Return the load at each step, (T,) N: m g clip((z_k - z_0) / 2 cm, 0, 1).

        z_k is the height of the target that the hand should follow at step k. The load is zero
        without ``bears_load``, and for an object that is attached to something.
        """
        scene, height = self.scene, self.reference.pos.numpy()[self.target_steps(), 2]
        if not (self.bears_load and scene.lies_free):
            return np.zeros(len(height))
        # The tracked body may be only one part of the object: take the mass of all parts.
        root = scene.model.body_rootid[scene.index.object_body]
        weight = scene.model.body_subtreemass[root] * -scene.model.opt.gravity[2]
        return weight * ((height - height[0]) / _LIFTED_M).clip(0.0, 1.0)

    def key(self) -> str:
        """Return a SHA-256 over all that a plan depends on, including the compiled model."""
        return self._key

    @cached_property  # hashing is slow: the model may have tens of megabytes
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
    """Return the numbers of a MuJoCo structure as bytes, except those that depend on file paths."""
    names = (name for name in sorted(dir(struct)) if name[0] != "_" and not _OF_FILES(name))
    values = ((name, getattr(struct, name)) for name in names)
    return b"".join(
        name.encode() + np.ascontiguousarray(value).tobytes()
        for name, value in values
        if isinstance(value, (int, float, np.ndarray))
    )
