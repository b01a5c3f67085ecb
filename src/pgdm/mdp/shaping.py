"""Shaping: what training may add to a task's reward and discount; evaluations never use it.

The paper's reward is flat far from the target: exp(-50 e) is 0.05 at e = 6 cm, and the lift bonus
does not depend on e. With the object error e [m], shaping replaces reward and
discount factor gamma by

    reward + kernel_weight exp(-kernel_scale e)    and    gamma exp(-(e / soft_end_m)^2)

the same for all tasks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pgdm.errors import check_above_zero, check_at_least
from pgdm.mdp.context import StepContext
from pgdm.mdp.recipe import Recipe, RewardTerm

SLOPE = "slope"
"""Recorded name of the added reward term, a tracking term wider than the paper's."""


@dataclass(frozen=True)
class ShapingCfg:
    """Settings of the shaping."""

    name: str
    """Name of these settings in reports."""
    kernel_weight: float
    """Weight of the wide tracking term; 0: none."""
    kernel_scale: float
    """Decay rate of that term, 1/m."""
    soft_end_m: float | None
    """Scale of the extra discount, m; None: none."""

    def described(self) -> str:
        """Return the shaping as a phrase, empty if it adds nothing."""
        parts = []
        if self.kernel_weight:
            width_m = 1 / self.kernel_scale
            parts.append(f"{self.kernel_weight:g} exp(-e/{width_m:.3g} m) is added to the reward")
        if self.soft_end_m is not None:
            parts.append(f"future rewards are scaled by exp(-(e/{self.soft_end_m:g} m)^2)")
        what = " and ".join(parts)
        return f"with the object error e, {what}" if parts else ""

    def validate(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: at the first invalid one.
        """
        check_at_least("shaping.kernel_weight", self.kernel_weight, 0)
        check_above_zero("shaping.kernel_scale", self.kernel_scale)
        if self.soft_end_m is not None:
            check_above_zero("shaping.soft_end_m", self.soft_end_m)


def shaped(recipe: Recipe, cfg: ShapingCfg) -> Recipe:
    """Return the recipe with the shaping's reward term and discount."""
    if cfg.kernel_weight:
        scale = cfg.kernel_scale

        def slope(c: StepContext) -> Tensor:
            return torch.exp(-scale * c.object_error)

        term = RewardTerm(SLOPE, cfg.kernel_weight, slope, shaping=True)
        recipe = replace(recipe, rewards=(*recipe.rewards, term))
    if cfg.soft_end_m is not None:
        reach = cfg.soft_end_m

        def discount(c: StepContext) -> Tensor:
            return torch.exp(-(c.object_error / reach).square())

        recipe = replace(recipe, discount=discount)
    return recipe
