"""What a wrist plan is computed for, and the hash of everything it depends on."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np

from pgdm.errors import ConfigError
from pgdm.motion.reference import ObjectReference
from pgdm.sim.scene import Scene

VERSION = 1
"""Version of the planner; plans in the library that another version stored are computed anew."""

_LIFTED_M = 0.02
_LONGEST = 250  # poses: the quadratic program's time grows with the third power
_OF_FILES = re.compile("path|nbuffer").search  # fields that depend on where files are


@dataclass(frozen=True)
class WristProblem:
    """Motion, start state and hand that a wrist plan is computed for."""

    scene: Scene
    reference: ObjectReference
    qpos: np.ndarray  # (nq,) m, rad: the start state
    qvel: np.ndarray  # (nv,) m/s, rad/s
    fingers: np.ndarray  # (nu,) m, rad: targets at which all driven joints but the base's are held
    substeps: int
    """Physics steps per control step."""
    hold_steps: int = 0
    """Control steps for which the hand stays at its start, so that the fingers can close. It then
    has as many to catch up, in which errors cost nothing."""
    bears_load: bool = False
    """Whether the hand bears the object's weight from when the motion lifts it: gravity
    compensation covers the hand only."""

    def check(self) -> None:
        """Check that the hold leaves time to follow, and that the motion is not too long.

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
                f"the motion has {poses} poses, and a wrist plan takes at most {_LONGEST}; use "
                "action.wrist_path=feasible"
            )

    def target_steps(self) -> np.ndarray:
        """Return the step of the motion at which the hand is to be, (T,): 0 during the hold."""
        step = np.arange(len(self.reference))
        return np.where(step <= self.hold_steps, 0, step)

    def load_n(self) -> np.ndarray:
        """Return the weight borne at each step, (T,) N: m g clip((z_k - z_0) / 2 cm, 0, 1)."""
        scene, height = self.scene, self.reference.pos.numpy()[self.target_steps(), 2]
        if not (self.bears_load and scene.lies_free):
            return np.zeros(len(height))
        # The tracked body may be a part of the object.
        root = scene.model.body_rootid[scene.index.object_body]
        weight = scene.model.body_subtreemass[root] * -scene.model.opt.gravity[2]
        return weight * ((height - height[0]) / _LIFTED_M).clip(0.0, 1.0)

    def key(self) -> str:
        """Return a SHA-256 over all that a plan depends on, the whole compiled model included."""
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
    """Return all numbers of one of MuJoCo's structures, except those that depend on file paths."""
    names = (name for name in sorted(dir(struct)) if name[0] != "_" and not _OF_FILES(name))
    values = ((name, getattr(struct, name)) for name in names)
    return b"".join(
        name.encode() + np.ascontiguousarray(value).tobytes()
        for name, value in values
        if isinstance(value, (int, float, np.ndarray))
    )
