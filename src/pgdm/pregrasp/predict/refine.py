"""From predicted hands to hands that touch nothing."""

from __future__ import annotations

import mujoco
import numpy as np

from pgdm.cem import CemCfg, CrossEntropy
from pgdm.library.clearance import CLEARANCE_M
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene

_SPREAD = 0.01, 0.08  # of the first samples: m of sliding, rad of turning joints
_CEM, _ROUNDS = CemCfg(48, 8, added=0.02), 40
_PATIENCE = 6  # rounds without a better free pose
_DEPTH_WEIGHT = 1e3  # cost of a metre of summed penetration, against squared spreads


def freed(scene: Scene, qpos: np.ndarray, seed: int = 0) -> np.ndarray | None:
    """Return a state (nq,) near qpos in which the hand touches nothing, or None if none is found.

    A cross-entropy search over the hand's joints, as :mod:`pgdm.library.clearance` makes it.
    Objects stay where they are; joints keep their limits; equal arguments give an equal result.
    """
    model, nu = scene.model, scene.model.nu
    contact = HandContact(scene)
    low, high = model.jnt_range[:nu].T
    scale = np.where(model.jnt_type[:nu] == mujoco.mjtJoint.mjJNT_SLIDE, *_SPREAD)
    start, trial = qpos[:nu].clip(low, high), qpos.copy()
    trial[:nu] = start
    if contact.overlap(trial, CLEARANCE_M) == 0.0:
        return trial
    stream = np.random.Generator(np.random.PCG64(seed))
    search = CrossEntropy(np.zeros(nu), np.ones(nu), _CEM, stream)
    best, best_cost, waited = None, np.inf, 0
    for _ in range(_ROUNDS):
        moves = search.ask()
        costs = np.empty(len(moves))
        waited += best is not None
        for i, move in enumerate(moves):
            trial[:nu] = (start + scale * move).clip(low, high)
            overlap = contact.overlap(trial, CLEARANCE_M)
            costs[i] = _DEPTH_WEIGHT * overlap + float(move @ move) / nu
            if overlap == 0.0 and costs[i] < best_cost:
                best, best_cost, waited = trial.copy(), costs[i], 0
        if waited >= _PATIENCE:
            break
        search.tell(moves, costs)
    return best
