"""GRAFF*: PGDM's terms, and fingertips at the expert's contact points (P App., SPEC 3)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

from pgdm.errors import UnknownNameError
from pgdm.mdp import rewards
from pgdm.mdp.context import FORMS
from pgdm.mdp.measures import HAND_MEASURES
from pgdm.mdp.recipe import Recipe, RewardTerm
from pgdm.methods import pgdm
from pgdm.methods.pgdm import MethodCfg, check_above_zero


@dataclass(frozen=True)
class ContactCfg:
    """How fingertips are paid for being where the expert's fingers touch the object."""

    form: str
    """``squared``: |c - f|^2 (published appendix); ``norm``: |c - f| (earlier text)."""
    weight: float
    """lambda, weight of the term."""
    scale: float
    """eta, how fast the term falls with the distance in its form, 1/m^2 or 1/m."""

    def validate(self) -> None:
        """Check names and numbers.

        Raises:
            ConfigError: at the first one that cannot be right.
        """
        if self.form not in FORMS:
            raise UnknownNameError("method.contact.form value", self.form, FORMS)
        check_above_zero("method.contact.scale", self.scale)


@dataclass(frozen=True)
class GraffCfg(MethodCfg):
    """PGDM's settings and those of contact."""

    contact: ContactCfg
    """The fingertips' part."""

    def validate(self) -> None:
        """Check the numbers; see ``MethodCfg``."""
        super().validate()
        self.contact.validate()


def add_contact(base: Recipe, cfg: ContactCfg) -> Recipe:
    """Return a recipe with the contact reward."""
    near = partial(rewards.fingertip_contact, form=cfg.form, scale=cfg.scale)
    term = RewardTerm("contact", cfg.weight, near)
    return replace(base, rewards=(*base.rewards, term)).comparing(HAND_MEASURES)


def recipe(cfg: GraffCfg) -> Recipe:
    """Return PGDM's terms and that of contact."""
    return add_contact(pgdm.recipe(cfg), cfg.contact)
