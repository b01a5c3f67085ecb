"""Measures: quantities recorded at every step in m or rad, one value per simulation."""

from __future__ import annotations

import torch
from torch import Tensor

from pgdm.mdp.context import StepContext
from pgdm.mdp.recipe import Measure


def fingertip_error(c: StepContext) -> Tensor:
    """Return the distance of a fingertip from the expert's, mean over the fingers, (n,) m."""
    return torch.linalg.vector_norm(c.fingertip_offset, dim=-1).mean(1)


def finger_joint_error(c: StepContext) -> Tensor:
    """Return |q - q_expert|, mean over wrist and finger joints, (n,) rad."""
    return c.joint_offset[:, c.index.num_base_joints :].abs().mean(1)


def contact_distance(c: StepContext) -> Tensor:
    """Return the distance of a fingertip from the expert's contact point on the object, (n,) m.

    Mean over the fingers with which the expert touches the object; NaN at steps without any.
    """
    wanted = c.in_contact
    total = torch.where(wanted, c.contact_distance, 0.0).sum(1)
    return total / wanted.sum(1)  # 0/0 is NaN


HAND_MEASURES = (
    Measure("hand_error_m", fingertip_error),
    Measure("hand_error_rad", finger_joint_error),
    Measure("contact_distance_m", contact_distance),
)
"""How closely the hand follows the expert's."""
