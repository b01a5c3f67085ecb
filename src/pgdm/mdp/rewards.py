"""Reward terms before weighting: one value a simulation (SPEC 1, Reward and end)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgdm.mdp.context import StepContext


@dataclass(frozen=True)
class RewardCfg:
    """Weights and scales of the object reward (R; P writes alpha=50, beta=5)."""

    tracking_weight: float
    """lambda_1, weight of the tracking term."""
    tracking_scale: float
    """alpha, how fast the tracking term falls with distance, 1/m."""
    orientation_scale: float
    """Metres that count as much as half a turn: the angle is divided by pi first."""
    lift_weight: float
    """Weight of the lift bonus."""
    lift_height_m: float
    """Height above the start at which object and target count as lifted, m."""


def tracking(c: StepContext, scale: float, orientation_scale: float) -> Tensor:
    """Return exp(-scale (e + orientation_scale angle/pi)), (n,) in (0, 1]."""
    return torch.exp(-scale * (c.object_error + orientation_scale / torch.pi * c.object_angle))


def lift(c: StepContext, height_m: float) -> Tensor:
    """Return 1 where object and target are both ``height_m`` above the start, (n,)."""
    lower = torch.minimum(c.target_pos[:, 2], c.state.object_pos[:, 2])
    return (lower >= c.start_height + height_m).double()
