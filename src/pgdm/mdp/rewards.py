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


def hand_imitation(c: StepContext, space: str, form: str, scale: float) -> Tensor:
    """Return exp(-scale d), (n,) in (0, 1], d the hand's distance from the expert's.

    ``space`` and ``form`` are those of `StepContext.hand_error`.
    """
    return torch.exp(-scale * c.hand_error(space, form))


def fingertip_contact(c: StepContext, form: str, scale: float) -> Tensor:
    """Return the mean of exp(-scale d) over the fingers in contact, (n,) in [0, 1].

    d is a fingertip's distance from the expert's contact point, |d| or |d|^2. Where the expert
    touches nothing, nothing is asked, and the term is 0: which steps these are depends on the
    time alone, so the order of policies whose episodes are equally long is that of any other
    constant, and what is logged is of contact only.
    """
    d = c.contact_distance
    value = torch.exp(-scale * (d.square() if form == "squared" else d))
    asked = c.in_contact
    return torch.where(asked, value, 0.0).sum(1) / asked.sum(1).clamp(min=1)
