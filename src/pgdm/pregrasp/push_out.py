"""Moving a posed hand out of what it cuts into, with its fingertips as near to their targets as
can be."""

from __future__ import annotations

import mujoco
import numpy as np

from pgdm.cem import CemCfg, CrossEntropy
from pgdm.pregrasp.targets import HandShape, Targets
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene

_SPREAD = 0.01, 0.08  # of the first samples: m of sliding, rad of turning joints
_CEM, _ROUNDS = CemCfg(64, 8, added=0.02), 40
_DEPTH_COST = 60.0  # m of fingertip error that a metre of summed penetration counts as
_MOVE_COST = 1e-3  # m of fingertip error for moving all joints by their spread
_FAR_M = 0.01  # from here on a fingertip's error counts more than in proportion
_EXACT_M = 1e-9


def pushed_out(
    contact: HandContact,
    scene: Scene,
    shape: HandShape,
    qpos: np.ndarray,
    targets: Targets,
    seed: int = 0,
) -> np.ndarray:
    """Return joint positions (nq,) near ``qpos`` at which the hand cuts into nothing, if found.

    A cross-entropy search over the hand's joints: the parts of a thin wall push to both sides, so
    that following the contacts' normals goes astray. Equal arguments give an equal result. Where
    no free pose is found, the least penetration is returned.

    Args:
        contact: of the scene.
        scene: with hand and objects.
        shape: of the hand.
        qpos: whole scene (nq,); the objects stay.
        targets: what the fingertips should stay near to.
        seed: of the samples.
    """
    if contact.depth(qpos) == 0.0:
        return qpos
    model, nu = scene.model, scene.model.nu
    data = mujoco.MjData(model)
    low, high = model.jnt_range[:nu].T
    scale = np.where(model.jnt_type[:nu] == mujoco.mjtJoint.mjJNT_SLIDE, *_SPREAD)
    tips, start = shape.rows[:, 2], qpos[:nu].clip(low, high)
    geoms, weights = scene.index.point_geoms, targets.weights / targets.weights[tips].max()
    stream = np.random.Generator(np.random.PCG64(seed))

    def cost(hand: np.ndarray, move: np.ndarray) -> tuple[float, float]:
        data.qpos[:nu], data.qpos[nu:] = hand, qpos[nu:]
        depth = float(contact.depths(data.qpos).sum())
        mujoco.mj_kinematics(model, data)
        away = np.linalg.norm(data.geom_xpos[geoms] - targets.points, axis=1)
        # Squared, so that no finger pays for all.
        error = float((weights * away * (1.0 + away / _FAR_M)).sum() / len(tips))
        return depth, error + _DEPTH_COST * depth + _MOVE_COST * float(move @ move) / nu

    search = CrossEntropy(np.zeros(nu), np.ones(nu), _CEM, stream)
    best, best_rank = start, (np.inf, np.inf)
    for _ in range(_ROUNDS):
        moves = search.ask()
        costs = np.empty(len(moves))
        for i, move in enumerate(moves):
            hand = (start + scale * move).clip(low, high)
            depth, costs[i] = cost(hand, move)
            rank = (max(depth, _EXACT_M), costs[i])
            if rank < best_rank:
                best, best_rank = hand, rank
        search.tell(moves, costs)
    return np.concatenate((best, qpos[nu:]))
