"""Any combination of the methods: sections of the settings that are null are left out."""

from __future__ import annotations

from dataclasses import dataclass

from pgdm.mdp.recipe import Recipe
from pgdm.methods import pgdm
from pgdm.methods.curriculum import RampCfg, add_curriculum
from pgdm.methods.deepmimic import ImitationCfg, add_imitation
from pgdm.methods.graff import ContactCfg, add_contact
from pgdm.methods.pgdm import MethodCfg


@dataclass(frozen=True)
class FullCfg(MethodCfg):
    """Settings of PGDM and of every addition."""

    imitation: ImitationCfg | None
    """As in DeepMimic, or None."""
    contact: ContactCfg | None
    """As in GRAFF*, or None."""
    curriculum: RampCfg | None
    """As in the task curriculum, or None."""


def recipe(cfg: FullCfg) -> Recipe:
    """Return PGDM's terms and the terms of all sections that are not None."""
    combined = pgdm.recipe(cfg)
    if cfg.imitation is not None:
        combined = add_imitation(combined, cfg.imitation)
    if cfg.contact is not None:
        combined = add_contact(combined, cfg.contact)
    if cfg.curriculum is not None:
        combined = add_curriculum(combined, cfg.curriculum)
    return combined
