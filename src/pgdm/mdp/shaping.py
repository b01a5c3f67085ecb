"""Shaping: what training may add to a task's reward and discount; evaluations never use it.

The paper's reward is flat far from the target: exp(-50 e) is 0.05 at e = 6 cm, and the lift bonus
does not depend on e. It says nothing about how to hold the object either: a pinch that fails
later earns as much as a firm grasp. With the object error e [m] and the displacement d_f [m] of
each of F fingertips, in the object's frame, since the start, shaping replaces reward and discount
factor gamma by

    reward + kernel_weight exp(-kernel_scale e) + grasp_weight mean_f exp(-grasp_scale d_f)

and gamma exp(-(e / soft_end_m)^2), the same for all tasks. With ``beyond_plan``, e in this discount
is only what exceeds the wrist plan's error at that step, so that holding the object stays
worthwhile where the base cannot follow the motion.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from pgdm.errors import check_above_zero, check_at_least
from pgdm.mdp.context import StepContext
from pgdm.mdp.recipe import Recipe, RewardTerm
from pgdm.mdp.rewards import kept_grasp

SLOPE = "slope"
"""Recorded name of the wide tracking term."""
GRASP = "grasp"
"""Recorded name of the grasp term, which pays for keeping the fingertips where the pre-grasp has
them."""


@dataclass(frozen=True)
class ShapingCfg:
    """Settings of the shaping."""

    name: str
    """Name of these settings in reports."""
    kernel_weight: float
    """Weight of the wide tracking term; 0: none."""
    kernel_scale: float
    """Decay rate of that term, 1/m."""
    grasp_weight: float
    """Weight of the grasp term; 0: none."""
    grasp_scale: float
    """Decay rate of that term, 1/m."""
    soft_end_m: float | None
    """Scale of the extra discount, m; None: none."""
    beyond_plan: bool
    """Whether that discount counts only the error beyond that of the wrist plan, if there is a
    plan."""

    def described(self) -> str:
        """Return the shaping as a phrase, empty if it adds nothing."""
        parts = []
        if self.kernel_weight:
            width_m = 1 / self.kernel_scale
            parts.append(
                f"{self.kernel_weight:g} exp(-e/{width_m:.3g} m) is added to the reward "
                "(e: the object's error)"
            )
        if self.grasp_weight:
            width_m = 1 / self.grasp_scale
            parts.append(
                f"{self.grasp_weight:g} exp(-d/{width_m:.3g} m), averaged over the fingertips, is "
                "added to the reward (d: how far each has moved on the object since the pre-grasp)"
            )
        if self.soft_end_m is not None:
            parts.append(
                f"future rewards are scaled by exp(-(e/{self.soft_end_m:g} m)^2) "
                "(e: the object's error"
                f"{', less that of the wrist plan' if self.beyond_plan else ''})"
            )
        return ", and ".join(parts)

    def validate(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: at the first invalid one.
        """
        check_at_least("shaping.kernel_weight", self.kernel_weight, 0)
        check_above_zero("shaping.kernel_scale", self.kernel_scale)
        check_at_least("shaping.grasp_weight", self.grasp_weight, 0)
        check_above_zero("shaping.grasp_scale", self.grasp_scale)
        if self.soft_end_m is not None:
            check_above_zero("shaping.soft_end_m", self.soft_end_m)


def shaped(recipe: Recipe, cfg: ShapingCfg, plan_error_m: Tensor | None = None) -> Recipe:
    """Return the recipe with the shaping's reward terms and discount.

    Args:
        recipe: of the method.
        cfg: settings.
        plan_error_m: error of the wrist plan after each step, (T-1,) m, if there is a plan.
    """

    def slope(c: StepContext) -> Tensor:
        return torch.exp(-cfg.kernel_scale * c.object_error)

    added = (
        RewardTerm(SLOPE, cfg.kernel_weight, slope, shaping=True),
        RewardTerm(GRASP, cfg.grasp_weight, partial(kept_grasp, scale=cfg.grasp_scale), True),
    )
    if added := tuple(term for term in added if term.weight):
        recipe = replace(recipe, rewards=(*recipe.rewards, *added))
    if cfg.soft_end_m is not None:
        reach = cfg.soft_end_m

        def discount(c: StepContext) -> Tensor:
            error = c.object_error
            if cfg.beyond_plan and plan_error_m is not None:
                error = (error - plan_error_m.to(c.t.device)[c.t - 1]).clamp(min=0.0)
            return torch.exp(-(error / reach).square())

        recipe = replace(recipe, discount=discount)
    return recipe
