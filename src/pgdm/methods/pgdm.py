"""PGDM: the object reward alone, from a pre-grasp (paper, Sec. III)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from pgdm.errors import check_above_zero
from pgdm.mdp import rewards, terminations
from pgdm.mdp.metrics import MetricsCfg
from pgdm.mdp.recipe import EndTerm, Recipe, RewardTerm
from pgdm.mdp.rewards import RewardCfg
from pgdm.mdp.terminations import TerminationCfg


@dataclass(frozen=True)
class MethodCfg:
    """Settings that every method has: its name, and PGDM's terms, on which it builds."""

    name: str
    """Key of ``pgdm.methods.METHODS``, or ``my_package.module:attribute``."""
    reward: RewardCfg
    """Object reward."""
    termination: TerminationCfg
    """Early termination."""
    success_threshold_m: float
    """Largest distance from the target at which a step counts as a success, m."""

    def validate(self) -> None:
        """Check the numbers, then call ``validate`` of each section that defines it.

        Raises:
            ConfigError: at the first invalid one.
        """
        check_above_zero("method.reward.tracking_scale", self.reward.tracking_scale)
        limit = self.termination.max_object_error_m
        check_above_zero("method.termination.max_object_error_m", limit)
        check_above_zero("method.success_threshold_m", self.success_threshold_m)
        for section in vars(self).values():
            if hasattr(section, "validate"):
                section.validate()


def recipe(cfg: MethodCfg) -> Recipe:
    """Return PGDM's terms: tracking and lift bonus; object lost and motion ended."""
    r = cfg.reward
    track = partial(rewards.tracking, scale=r.tracking_scale, orientation_scale=r.orientation_scale)
    lift = partial(rewards.lift, height_m=r.lift_height_m)
    lost = partial(terminations.object_lost, max_error_m=cfg.termination.max_object_error_m)
    return Recipe(
        rewards=(
            RewardTerm("tracking", r.tracking_weight, track),
            RewardTerm("lift", r.lift_weight, lift),
        ),
        ends=(
            EndTerm("object_lost", lost),
            EndTerm("motion_ended", terminations.motion_ended),
        ),
        metrics=MetricsCfg(cfg.success_threshold_m, r.lift_height_m),
    )
