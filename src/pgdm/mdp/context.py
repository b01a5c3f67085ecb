"""What the terms of an MDP are computed from, once per control step."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from pgdm import rotations
from pgdm.sim.batch import SimState


@dataclass(frozen=True)
class StepContext:
    """State of n simulations after a step, beside the targets of that step."""

    state: SimState
    t: Tensor  # (n,) int64, steps since reset
    last_t: int  # T-1, index of the motion's last pose
    target_pos: Tensor  # (n, 3) m, where the object's centre of mass should be
    target_quat: Tensor  # (n, 4) wxyz
    start_height: Tensor  # (n,) m, height of the object's centre of mass at reset

    @cached_property
    def object_error(self) -> Tensor:
        """Distance of the object's centre of mass from its target, (n,) m."""
        return torch.linalg.vector_norm(self.target_pos - self.state.object_pos, dim=-1)

    @cached_property
    def object_angle(self) -> Tensor:
        """Angle between the object and its target, (n,) rad in [0, pi]."""
        return rotations.angle(self.state.object_quat, self.target_quat)
