"""Reward terms before weighting, one value per simulation.

With the term weights, a step's reward is (released code; paper, Sec. III-A)

    lambda_1 exp(-alpha (e + c phi/pi)) + lambda_2 [object and target lifted] + ...

where e is the distance of the object's centre of mass from its target [m] and phi the angle
between object and target [rad].
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pgdm.mdp.context import StepContext


@dataclass(frozen=True)
class RewardCfg:
    """Weights and scales of the object reward.

    The paper writes alpha e + beta phi with alpha = 50, beta = 5 (App. B); in the released code
    phi is divided by pi first, so that c = beta / alpha = 0.1 m.
    """

    tracking_weight: float
    """lambda_1, weight of the tracking term."""
    tracking_scale: float
    """alpha, decay rate of the tracking term with distance, 1/m."""
    orientation_scale: float
    """c, distance that costs as much as an angle of pi, m."""
    lift_weight: float
    """lambda_2, weight of the lift bonus."""
    lift_height_m: float
    """Height above the start at which object and target count as lifted, m."""


def tracking(c: StepContext, scale: float, orientation_scale: float) -> Tensor:
    """Return exp(-scale (e + orientation_scale phi/pi)), (n,) in (0, 1]."""
    return torch.exp(-scale * (c.object_error + orientation_scale / torch.pi * c.object_angle))


def lift(c: StepContext, height_m: float) -> Tensor:
    """Return 1 if object and target are >= ``height_m`` above the object's start, else 0, (n,)."""
    lower = torch.minimum(c.target_pos[:, 2], c.state.object_pos[:, 2])
    return (lower >= c.start_height + height_m).double()


def kept_grasp(c: StepContext, scale: float) -> Tensor:
    """Return the mean of exp(-scale d) over the fingertips, (n,) in (0, 1].

    d [m] is how far a fingertip has moved since the start, in the object's frame (pgdm's own).
    """
    moved = torch.linalg.vector_norm(c.fingertips_on_object - c.pregrasp_fingertips, dim=-1)
    return torch.exp(-scale * moved).mean(1)


def hand_imitation(c: StepContext, space: str, form: str, scale: float) -> Tensor:
    """Return exp(-scale d), (n,) in (0, 1], with the hand error d (DeepMimic; paper, App. D).

    ``space`` and ``form`` choose d, see `StepContext.hand_error`.
    """
    return torch.exp(-scale * c.hand_error(space, form))


def fingertip_contact(c: StepContext, form: str, scale: float) -> Tensor:
    """Return the mean of exp(-scale d) over the expert's fingers in contact, (n,) in [0, 1].

    GRAFF* (paper, App. D): with the distance r [m] of a fingertip from the expert's contact point,
    d = r (``norm``) or r^2 (``squared``). The term is 0 at steps where the expert touches nothing.
    These steps depend on time alone, so any constant would rank policies with equally long episodes
    the same; with 0 the logged term reflects contact only.
    """
    d = c.contact_distance
    value = torch.exp(-scale * (d.square() if form == "squared" else d))
    wanted = c.in_contact
    return torch.where(wanted, value, 0.0).sum(1) / wanted.sum(1).clamp(min=1)
