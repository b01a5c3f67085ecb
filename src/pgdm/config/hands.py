"""The hand that the stored start states of a task's motion belong to."""

from __future__ import annotations

from pgdm.config.compose import compose
from pgdm.config.schema import ExperimentCfg
from pgdm.library import Library
from pgdm.sim.scene import HandCfg


def own_hand(cfg: ExperimentCfg, library: Library) -> HandCfg:
    """Return the hand of the motion's stored start states, whichever hand the experiment uses.

    Raises:
        UnknownNameError: if the library lacks the motion, or there are no settings for its hand.
    """
    name = library.entry(cfg.task.motion).hand
    return cfg.hand if cfg.hand.name == name else compose([f"hand={name}"]).hand
