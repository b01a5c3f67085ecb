"""DeepMimic: PGDM's terms, and the hand follows an expert's (P App. Baselines, SPEC 3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

from pgdm.errors import ConfigError, UnknownNameError
from pgdm.mdp import rewards, terminations
from pgdm.mdp.context import FORMS, SPACES
from pgdm.mdp.measures import HAND_MEASURES
from pgdm.mdp.recipe import EndTerm, Recipe, RewardTerm
from pgdm.methods import pgdm
from pgdm.methods.pgdm import MethodCfg, check_above_zero


@dataclass(frozen=True)
class ImitationCfg:
    """How the hand's distance from the expert's is paid for, and when it ends an episode."""

    space: str
    """What is compared: ``fingertips``, positions, m; ``joints``, all of the hand's, m and rad."""
    form: str
    """``squared``: |h - hhat|^2 (published appendix); ``norm``: |h - hhat| (earlier text)."""
    weight: float
    """lambda_3, weight of the term."""
    scale: float
    """eta, how fast the term falls with the distance in its form."""
    max_hand_error: float | None
    """gamma_h, distance, in its form, beyond which an episode ends; None: it never does."""
    grace_steps: int
    """Steps since reset in which that distance is not checked yet."""

    def validate(self) -> None:
        """Check names and numbers.

        Raises:
            ConfigError: at the first one that cannot be right.
        """
        if self.space not in SPACES:
            raise UnknownNameError("method.imitation.space value", self.space, SPACES)
        if self.form not in FORMS:
            raise UnknownNameError("method.imitation.form value", self.form, FORMS)
        check_above_zero("method.imitation.scale", self.scale)
        if self.max_hand_error is not None:
            check_above_zero("method.imitation.max_hand_error", self.max_hand_error)
        if self.grace_steps < 0:
            raise ConfigError(
                f"method.imitation.grace_steps is {self.grace_steps}; it must be at least 0"
            )


@dataclass(frozen=True)
class DeepMimicCfg(MethodCfg):
    """PGDM's settings and those of imitation."""

    imitation: ImitationCfg
    """The hand's part."""

    def validate(self) -> None:
        """Check the numbers; see ``MethodCfg``."""
        super().validate()
        self.imitation.validate()


def add_imitation(base: Recipe, cfg: ImitationCfg) -> Recipe:
    """Return a recipe with the imitation reward and, if there is a limit, its end."""
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
    """Return PGDM's terms and those of imitation."""
    return add_imitation(pgdm.recipe(cfg), cfg.imitation)
