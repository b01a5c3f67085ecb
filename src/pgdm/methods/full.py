"""Any combination of the methods: a section of the settings that is null is left out."""

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
    """PGDM's settings and those of every addition."""

    imitation: ImitationCfg | None
    """DeepMimic's part, or None."""
    contact: ContactCfg | None
    """GRAFF*'s part, or None."""
    curriculum: RampCfg | None
    """The curriculum's part, or None."""

    def validate(self) -> None:
        """Check the numbers; see ``MethodCfg``."""
        super().validate()
        for part in (self.imitation, self.contact, self.curriculum):
            if part is not None:
                part.validate()


def recipe(cfg: FullCfg) -> Recipe:
    """Return PGDM's terms and those of the sections that are there."""
    made = pgdm.recipe(cfg)
    if cfg.imitation is not None:
        made = add_imitation(made, cfg.imitation)
    if cfg.contact is not None:
        made = add_contact(made, cfg.contact)
    if cfg.curriculum is not None:
        made = add_curriculum(made, cfg.curriculum)
    return made
