"""What the terms of an MDP are computed from, once per control step."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

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
