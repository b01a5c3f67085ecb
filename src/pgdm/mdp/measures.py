"""What is measured of every step beside the reward: one value a simulation, in plain units."""

from __future__ import annotations

import torch
from torch import Tensor

from pgdm.mdp.context import StepContext
from pgdm.mdp.recipe import Measure


def fingertip_error(c: StepContext) -> Tensor:
    """Return the distance of a fingertip from the expert's, mean over the fingers, (n,) m."""
    return torch.linalg.vector_norm(c.fingertip_offset, dim=-1).mean(1)


def finger_joint_error(c: StepContext) -> Tensor:
    """Return the angle between a joint and the expert's, mean over all but the base, (n,) rad."""
    return c.joint_offset[:, c.index.num_base_joints :].abs().mean(1)


def contact_distance(c: StepContext) -> Tensor:
    """Return the distance of a fingertip from the expert's contact point on the object, (n,) m.

    Mean over the fingers in contact; NaN at steps at which the expert touches nothing.
    """
    asked = c.in_contact
    total = torch.where(asked, c.contact_distance, 0.0).sum(1)
    return total / asked.sum(1)  # 0/0 is NaN


HAND_MEASURES = (
    Measure("hand_error_m", fingertip_error),
    Measure("hand_error_rad", finger_joint_error),
    Measure("contact_distance_m", contact_distance),
)
"""What tells whether an expert is followed."""
