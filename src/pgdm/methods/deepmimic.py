"""DeepMimic: PGDM's terms plus imitation of an expert's hand (paper, App. D).

Adds lambda_3 exp(-eta d) to the reward and terminates at d > gamma_h, with the hand error
d = |h - h_expert|^2 or |h - h_expert|, h being the hand's fingertip positions or joints.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

from pgdm.errors import check_above_zero, check_at_least, check_name
from pgdm.mdp import rewards, terminations
from pgdm.mdp.context import FORMS, SPACES
from pgdm.mdp.measures import HAND_MEASURES
from pgdm.mdp.recipe import EndTerm, Recipe, RewardTerm
from pgdm.methods import pgdm
from pgdm.methods.pgdm import MethodCfg


@dataclass(frozen=True)
class ImitationCfg:
    """How the hand error is rewarded, and when it terminates an episode."""

    space: str
    """h: ``fingertips`` (positions, m) or ``joints`` (all joints of the hand, m and rad)."""
    form: str
    """d: ``squared``, |h - h_expert|^2 (published appendix); ``norm``, its root (an earlier version
    of the paper)."""
    weight: float
    """lambda_3, weight of the term."""
    scale: float
    """eta, decay rate of the term with d."""
    max_hand_error: float | None
    """gamma_h, d beyond which an episode terminates; None: never."""
    grace_steps: int
    """Control steps after reset during which d does not terminate an episode."""

    def validate(self) -> None:
        """Check names and numbers.

        Raises:
            ConfigError: at the first invalid one.
        """
        check_name("method.imitation.space value", self.space, SPACES)
        check_name("method.imitation.form value", self.form, FORMS)
        check_above_zero("method.imitation.scale", self.scale)
        if self.max_hand_error is not None:
            check_above_zero("method.imitation.max_hand_error", self.max_hand_error)
        check_at_least("method.imitation.grace_steps", self.grace_steps, 0)


@dataclass(frozen=True)
class DeepMimicCfg(MethodCfg):
    """Settings of PGDM and of imitation."""

    imitation: ImitationCfg
    """Imitation of the hand."""


def add_imitation(base: Recipe, cfg: ImitationCfg) -> Recipe:
    """Return the recipe with the imitation reward and, if there is a limit, its termination."""
    close = partial(rewards.hand_imitation, space=cfg.space, form=cfg.form, scale=cfg.scale)
    ends = base.ends
    if cfg.max_hand_error is not None:
        lost = partial(
            terminations.hand_lost,
            space=cfg.space,
            form=cfg.form,
            max_error=cfg.max_hand_error,
            grace_steps=cfg.grace_steps,
        )
        ends = (*ends, EndTerm("hand_lost", lost))
    term = RewardTerm("imitation", cfg.weight, close)
    return replace(base, rewards=(*base.rewards, term), ends=ends).comparing(HAND_MEASURES)


def recipe(cfg: DeepMimicCfg) -> Recipe:
    """Return PGDM's terms and the imitation terms."""
    return add_imitation(pgdm.recipe(cfg), cfg.imitation)
