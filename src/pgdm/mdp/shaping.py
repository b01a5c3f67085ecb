"""What a training may add to a task's own reward and ends; evaluations never see it.

The paper's reward is flat far from the target: exp(-50 e) is 0.05 at 6 cm, and the lift bonus is
paid at any distance. These additions give the learner a slope to follow, the same for all tasks.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pgdm.errors import ConfigError
from pgdm.mdp.context import StepContext
from pgdm.mdp.recipe import Recipe, RewardTerm

SLOPE = "slope"
"""Name of the added reward term."""


@dataclass(frozen=True)
class ShapingCfg:
    """What is added."""

    name: str
    """Name of the settings, as reports show it."""
    kernel_weight: float
    """Weight of a second tracking term exp(-kernel_scale e); 0: none."""
    kernel_scale: float
    """How fast that term falls with the object's distance e, 1/m."""
    soft_end_m: float | None
    """Distance at which the future is discounted by a further 1/e, m; None: not at all."""

    def described(self) -> str:
        """Return what it does in a sentence, or nothing."""
        parts = []
        if self.kernel_weight:
            width_m = 1 / self.kernel_scale
            parts.append(f"{self.kernel_weight:g} exp(-e/{width_m:.3g} m) is added to the reward")
        if self.soft_end_m is not None:
            parts.append(f"future rewards are scaled by exp(-(e/{self.soft_end_m:g} m)^2)")
        what = " and ".join(parts)
        return f"with the object at distance e from its target, {what}" if parts else ""

    def validate(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: at the first one that cannot be right.
        """
        if (weight := self.kernel_weight) < 0:
            raise ConfigError(f"shaping.kernel_weight is {weight}; it must be at least 0")
        for key in ("kernel_scale", "soft_end_m"):
            value = getattr(self, key)
            if value is not None and value <= 0:
                raise ConfigError(f"shaping.{key} is {value}; it must be above 0")


def shaped(recipe: Recipe, cfg: ShapingCfg) -> Recipe:
    """Return a recipe with the additions."""
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
