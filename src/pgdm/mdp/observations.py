"""Observation layouts: pure functions of the state and the step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pgdm.errors import check_name
from pgdm.motion.reference import ObjectReference
from pgdm.sim.batch import SimState
from pgdm.sim.scene import SceneIndex

Observe = Callable[[SimState, Tensor], Tensor]
"""State of n simulations, steps since reset (n,) -> observations (n, D) float32."""


@dataclass(frozen=True)
class ObsCfg:
    """What the policy observes."""

    layout: str
    """``released``: as in the released code; ``paper``: as in the paper, no velocities or later
    targets."""


def released(index: SceneIndex, reference: ObjectReference) -> Observe:
    """Return the released code's layout; D = 322 for Adroit and an object with six joints.

    qpos (nq) | positions of the P points, then of the object's centre of mass, 3 each | their
    quaternions, wxyz, 4 each | qvel (nv) | linear, then angular velocity of each point, then of the
    object, 6 each | targets ahead (21, `ObjectReference.ahead`) | time encoding (8). World frame;
    m, rad, s.
    """
    ahead = torch.cat((reference.ahead(), reference.time_encoding()), -1)

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
    """Return the paper's layout (App. B).

    Hand joints (n) | fingertip positions, 3 each | the object's position (3) and quaternion (4) |
    time encoding (8). World frame; m, rad.
    """
    time = reference.time_encoding()
    tips = torch.from_numpy(index.fingertips)

    def observe(s: SimState, t: Tensor) -> Tensor:
        joints = s.qpos[:, : index.num_joints]
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
    check_name("observation layout", cfg.layout, LAYOUTS)
    return LAYOUTS[cfg.layout](index, reference)
