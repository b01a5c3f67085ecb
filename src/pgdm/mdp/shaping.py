"""Shaping: what training may add to a task's reward and discount; evaluations never use it.

The paper's reward is flat far from the target: exp(-50 e) is 0.05 at e = 6 cm, and the lift bonus
does not depend on e. Neither depends on the object's orientation, although an object that turns in
the hand is soon lost. With the object error e [m] and the angle phi [rad] between the object's
orientation and its target, shaping replaces reward and discount factor gamma by

    reward + kernel_weight exp(-kernel_scale e)    and
    gamma exp(-(e / soft_end_m)^2 - (phi / soft_end_rad)^2)

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
    """Scale of the extra discount by the object error, m; None: none."""
    soft_end_rad: float | None
    """Scale of the extra discount by the object's angle, rad; None: none."""

    def described(self) -> str:
        """Return the shaping as a phrase, empty if it adds nothing."""
        scales = (self.soft_end_m, "e", "m"), (self.soft_end_rad, "phi", "rad")
        factors = [f"by exp(-({x}/{scale:g} {unit})^2)" for scale, x, unit in scales if scale]
        parts = [f"future rewards are scaled {' and '.join(factors)}"] if factors else []
        if self.kernel_weight:
            width_m = 1 / self.kernel_scale
            added = f"{self.kernel_weight:g} exp(-e/{width_m:.3g} m) is added to the reward"
            parts.insert(0, added)
        angle = " and the object's angle phi to its target" if self.soft_end_rad else ""
        return f"with the object error e{angle}, {' and '.join(parts)}" if parts else ""

    def validate(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: at the first invalid one.
        """
        check_at_least("shaping.kernel_weight", self.kernel_weight, 0)
        check_above_zero("shaping.kernel_scale", self.kernel_scale)
        for name in ("soft_end_m", "soft_end_rad"):
            if (scale := getattr(self, name)) is not None:
                check_above_zero(f"shaping.{name}", scale)


def shaped(recipe: Recipe, cfg: ShapingCfg) -> Recipe:
    """Return the recipe with the shaping's reward term and discount."""
    if cfg.kernel_weight:
        scale = cfg.kernel_scale

        def slope(c: StepContext) -> Tensor:
            return torch.exp(-scale * c.object_error)

        term = RewardTerm(SLOPE, cfg.kernel_weight, slope, shaping=True)
        recipe = replace(recipe, rewards=(*recipe.rewards, term))
    if cfg.soft_end_m is not None or cfg.soft_end_rad is not None:

        def discount(c: StepContext) -> Tensor:
            exponent = torch.zeros_like(c.object_error)
            if cfg.soft_end_m is not None:
                exponent = exponent + (c.object_error / cfg.soft_end_m).square()
            if cfg.soft_end_rad is not None:
                exponent = exponent + (c.object_angle / cfg.soft_end_rad).square()
            return torch.exp(-exponent)

        recipe = replace(recipe, discount=discount)
    return recipe
