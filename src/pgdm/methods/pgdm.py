"""PGDM: the object reward alone, from a pre-grasp (P III-B, SPEC 1 and 2)."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

from pgdm.mdp import rewards, terminations
from pgdm.mdp.metrics import MetricsCfg
from pgdm.mdp.recipe import EndTerm, Recipe, RewardTerm
from pgdm.mdp.rewards import RewardCfg
from pgdm.mdp.terminations import TerminationCfg


@dataclass(frozen=True)
class MethodCfg:
    """A method: its name and the numbers of its terms."""

    name: str
    """Which method; a row of ``pgdm.methods.METHODS``."""
    reward: RewardCfg
    """Object reward."""
    termination: TerminationCfg
    """Early ends."""
    success_threshold_m: float
    """Distance at which a step counts as a success in the metrics, m."""


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
