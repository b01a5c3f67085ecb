"""PGDM: the object reward alone, from a pre-grasp (P III-B, SPEC 1 and 2)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from pgdm.errors import ConfigError
from pgdm.mdp import rewards, terminations
from pgdm.mdp.metrics import MetricsCfg
from pgdm.mdp.recipe import EndTerm, Recipe, RewardTerm
from pgdm.mdp.rewards import RewardCfg
from pgdm.mdp.terminations import TerminationCfg


@dataclass(frozen=True)
class MethodCfg:
    """What every method has: its name, and the numbers of PGDM's terms, on which it builds."""

    name: str
    """Which method; a row of ``pgdm.methods.METHODS``, or ``my_package.module:attribute``."""
    reward: RewardCfg
    """Object reward."""
    termination: TerminationCfg
    """Early ends."""
    success_threshold_m: float
    """Distance at which a step counts as a success in the metrics, m."""

    def validate(self) -> None:
        """Check the numbers.

        Raises:
            ConfigError: at the first one that cannot be right.
        """
        check_above_zero("method.reward.tracking_scale", self.reward.tracking_scale)
        limit = self.termination.max_object_error_m
        check_above_zero("method.termination.max_object_error_m", limit)
        check_above_zero("method.success_threshold_m", self.success_threshold_m)


def check_above_zero(key: str, value: float) -> None:
    """Check a number of the settings.

    Raises:
        ConfigError: if it is 0 or less.
    """
    if value <= 0:
        raise ConfigError(f"{key} is {value}; it must be above 0")


def recipe(cfg: MethodCfg) -> Recipe:
    """Return PGDM's terms: tracking, lift bonus, object lost, motion ended."""
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
