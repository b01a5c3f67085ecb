"""GRAFF*: PGDM's terms plus a reward for fingertips at the expert's contacts (paper, App. D).

Adds a reward: lambda times the mean of exp(-eta d) over the expert's fingers in contact, with
d = |c - f|^2 or |c - f| for a fingertip at f and the expert's contact point c on the object, in m.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

from pgdm.errors import check_above_zero, check_name
from pgdm.mdp import rewards
from pgdm.mdp.context import FORMS
from pgdm.mdp.measures import HAND_MEASURES
from pgdm.mdp.recipe import Recipe, RewardTerm
from pgdm.methods import pgdm
from pgdm.methods.pgdm import MethodCfg


@dataclass(frozen=True)
class ContactCfg:
    """How fingertips at the expert's contact points are rewarded."""

    form: str
    """d: ``squared``, |c - f|^2 (published appendix); ``norm``, |c - f| (an earlier version of the
    paper)."""
    weight: float
    """lambda, weight of the term."""
    scale: float
    """eta, decay rate of the term with d, 1/m^2 or 1/m."""

    def validate(self) -> None:
        """Check names and numbers.

        Raises:
            ConfigError: at the first invalid one.
        """
        check_name("method.contact.form value", self.form, FORMS)
        check_above_zero("method.contact.scale", self.scale)


@dataclass(frozen=True)
class GraffCfg(MethodCfg):
    """Settings of PGDM and of contact."""

    contact: ContactCfg
    """Contact of the fingertips."""


def add_contact(base: Recipe, cfg: ContactCfg) -> Recipe:
    """Return the recipe with the contact reward."""
    near = partial(rewards.fingertip_contact, form=cfg.form, scale=cfg.scale)
    term = RewardTerm("contact", cfg.weight, near)
    return replace(base, rewards=(*base.rewards, term)).comparing(HAND_MEASURES)


def recipe(cfg: GraffCfg) -> Recipe:
    """Return PGDM's terms and the contact reward."""
    return add_contact(pgdm.recipe(cfg), cfg.contact)
