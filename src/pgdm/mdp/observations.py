"""Observation layouts: pure functions of the state and the step."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from pgdm import rotations
from pgdm.errors import check_name
from pgdm.mdp.context import on_object
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
    targets; ``relative``: ``released``, and the object relative to its targets and the hand."""


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


RELATIVE_AHEAD = 0, 1, 5
"""Steps ahead of the targets whose distance from the object ``relative`` has."""
NEAR_M = 0.03
"""Scale of the saturating part of ``relative``; the tracking reward exp(-50 e) is 0.22 there."""


def relative(index: SceneIndex, reference: ObjectReference) -> Observe:
    """Return the layout ``relative``: the object relative to its targets and hand, then `released`.

    From world-frame poses alone a network hardly sees a centimetre: it is a small difference of two
    inputs that vary by decimetres. The additional entries, before those of ``released``:

    offsets d_k from the object's centre of mass to its targets at steps t, t+1 and t+5, 3 each |
    tanh(d_0 / 3 cm) (3) | rotation to the target at t (3) | with the hand's first point and its
    body as frame: the object's position (3), orientation (4) and linear velocity (3), both
    relative to the point | fingertips, relative to the object's centre of mass, in the
    object's frame (3 each). A rotation is twice its quaternion's vector part; quaternions have a
    scalar part of 0 or more. m, rad, m/s.
    """
    rest = released(index, reference)
    last = len(reference) - 1

    def observe(s: SimState, t: Tensor) -> Tensor:
        ahead = [(t + k).clamp(max=last) for k in RELATIVE_AHEAD]
        offsets = [reference.pos[at] - s.object_pos for at in ahead]
        from_object = rotations.conjugate(s.object_quat)
        turn = _positive(rotations.multiply(reference.quat[t], from_object))
        to_hand = rotations.conjugate(s.point_quat[:, 0])
        velocity = (s.object_vel - s.point_vel[:, 0])[:, :3]
        parts = (
            *offsets,
            torch.tanh(offsets[0] / NEAR_M),
            2.0 * turn[:, 1:],
            rotations.rotate(to_hand, s.object_pos - s.point_pos[:, 0]),
            _positive(rotations.multiply(to_hand, s.object_quat)),
            rotations.rotate(to_hand, velocity),
            on_object(s, index).flatten(1),
        )
        return torch.cat((torch.cat(parts, -1).float(), rest(s, t)), -1)

    return observe


def _positive(quat: Tensor) -> Tensor:
    """Return quaternions (n, 4) of the same rotations with a scalar part of 0 or more."""
    return torch.where(quat[:, :1] < 0, -quat, quat)


LAYOUTS: dict[str, Callable[[SceneIndex, ObjectReference], Observe]] = {
    "released": released,
    "paper": paper,
    "relative": relative,
}


def layout(cfg: ObsCfg, index: SceneIndex, reference: ObjectReference) -> Observe:
    """Return the configured layout.

    Raises:
        UnknownNameError: if there is no such layout.
    """
    check_name("observation layout", cfg.layout, LAYOUTS)
    return LAYOUTS[cfg.layout](index, reference)
