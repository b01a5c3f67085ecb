"""Observation layouts: pure functions of the state and the step (SPEC 1, Observation)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pgdm.errors import UnknownNameError
from pgdm.motion.reference import ObjectReference
from pgdm.sim.batch import SimState
from pgdm.sim.scene import SceneIndex

Observe = Callable[[SimState, Tensor], Tensor]
"""State of n simulations and steps since reset (n,) -> observations (n, D) float32."""


@dataclass(frozen=True)
class ObsCfg:
    """Which observation the policy gets."""

    layout: str
    """``released``: as the authors' code; ``paper``: as the text, without velocities and goals."""


def released(index: SceneIndex, reference: ObjectReference) -> Observe:
    """Return the released layout, 322 numbers for Adroit with a six-joint object (R).

    qpos | positions of points and object | their quaternions | qvel | linear and angular
    velocity of each point, then of the object | goals 1, 5, 10 steps ahead | time encoding.
    """
    ahead = torch.cat((reference.goals(), reference.time_encoding()), -1)

    def observe(s: SimState, t: Tensor) -> Tensor:
        parts = (
            s.qpos,
            s.point_pos.flatten(1),
            s.object_pos,
            s.point_quat.flatten(1),
            s.object_quat,
            s.qvel,
            s.point_vel.flatten(1),
            s.object_vel,
            ahead[t],
        )
        return torch.cat(parts, -1).float()

    return observe


def paper(index: SceneIndex, reference: ObjectReference) -> Observe:
    """Return the paper's layout (P III-B).

    Robot joints (nu) | fingertip positions | object position and quaternion | time encoding.
    """
    time = reference.time_encoding()
    tips = torch.from_numpy(index.fingertips)

    def observe(s: SimState, t: Tensor) -> Tensor:
        joints = s.qpos[:, : index.num_actuators]
        fingertips = s.point_pos[:, tips].flatten(1)
        return torch.cat((joints, fingertips, s.object_pos, s.object_quat, time[t]), -1).float()

    return observe


LAYOUTS: dict[str, Callable[[SceneIndex, ObjectReference], Observe]] = {
    "released": released,
    "paper": paper,
}


def layout(cfg: ObsCfg, index: SceneIndex, reference: ObjectReference) -> Observe:
    """Return the configured layout.

    Raises:
        UnknownNameError: if there is no such layout.
    """
    if cfg.layout not in LAYOUTS:
        raise UnknownNameError("observation layout", cfg.layout, LAYOUTS)
    return LAYOUTS[cfg.layout](index, reference)
