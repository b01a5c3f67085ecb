"""Which hand a task's motion was made with."""

from __future__ import annotations

from pgdm.config.schema import ExperimentCfg
from pgdm.config.store import compose
from pgdm.library import Library
from pgdm.sim.scene import HandCfg


def own_hand(cfg: ExperimentCfg, library: Library) -> HandCfg:
    """Return the hand whose joints the motion's stored starts are, whatever hand takes it up.

    Raises:
        UnknownNameError: the library lacks the motion, or there are no settings of the hand.
    """
    name = library.entry(cfg.task.motion).hand
    return cfg.hand if cfg.hand.name == name else compose([f"hand={name}"]).hand
