"""Where an episode starts: the pre-grasp as stored, in its several forms, or the reset pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pgdm.errors import ConfigError
from pgdm.library import Motion
from pgdm.sim.scene import Scene

SOURCES = ("planned", "mined", "learned", "none")


@dataclass(frozen=True)
class PregraspCfg:
    """Which start state to use (SPEC 1 and 2)."""

    source: str
    """``planned``: state after the reach planner moved the hand to its pre-grasp; ``mined``: the
    pre-grasp as found, kinematic; ``learned``: as a mesh-conditioned model predicted it; ``none``:
    the hand's reset pose, all joints zero."""
    fallback: str | None
    """Source to take where this one is not stored for a task, or None: then it is an error. The
    asset library that the program fetches has no plans, only mined pre-grasps."""


@dataclass(frozen=True)
class StartState:
    """State in which every episode of a task begins."""

    source: str  # where it came from, which may be the fallback
    qpos: np.ndarray  # (nq,) m, rad
    qvel: np.ndarray  # (nv,) m/s, rad/s


def start_state(cfg: PregraspCfg, motion: Motion, scene: Scene) -> StartState:
    """Return the start state of a task.

    With ``none`` the object stands where the mined pre-grasp has it (SPEC 3).

    Raises:
        ConfigError: if the source is unknown, is not stored for this task, or does not fit the
            scene's joints.
    """
    if cfg.source not in SOURCES:
        raise ConfigError(f"pregrasp.source '{cfg.source}' is unknown; valid: {', '.join(SOURCES)}")
    stored = cfg.source in motion.starts or cfg.source == "none"
    source = cfg.source if stored or cfg.fallback is None else cfg.fallback
    wanted = "mined" if source == "none" else source
    if wanted not in motion.starts:
        raise ConfigError(
            f"task '{scene.task.id}' has no stored start '{wanted}' in source '{motion.source}'; "
            f"it has: {', '.join(sorted(motion.starts))} (pregrasp=...). Stored plans come with a "
            f"TCDM checkout: pgdm assets import PATH"
        )
    start, model = motion.starts[wanted], scene.model
    qpos, qvel = np.array(start.qpos), np.array(start.qvel)
    if source == "none":
        # Only the objects' joints, last in qpos, are taken: the hand may be another than the
        # stored start's.
        objects = qpos[len(qpos) - (model.nq - model.nu) :]
        qpos = np.concatenate((np.zeros(model.nu), objects))
        qvel = np.zeros(model.nv)
    if qpos.shape != (model.nq,) or qvel.shape != (model.nv,):
        raise ConfigError(
            f"start '{wanted}' of motion '{motion.id}' has {qpos.size} positions and {qvel.size} "
            f"velocities, the scene of '{scene.task.id}' with hand '{scene.hand.name}' has "
            f"{model.nq} and {model.nv}; pregrasp=none starts any hand from its reset pose"
        )
    return StartState(source, qpos, qvel)
