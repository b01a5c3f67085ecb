"""Inverse kinematics: poses a scene's hand like a human hand, free of penetration if possible.

Differential inverse kinematics (:class:`pgdm.pregrasp.retarget.hand_ik.HandIk`) is tried in three
ways: directly to the targets; by way of poses with the fingertips farther apart and the palm
farther back; and from a distance with open fingers, avoiding object and table. If the direct result
penetrates something, it and the best of the others are freed from penetration, and the result of
least cost is used.
"""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from pgdm.library.clearance import FreeingCfg, free_by_search
from pgdm.pregrasp.hand_geometry import object_to_hand, unit
from pgdm.pregrasp.retarget.hand_ik import HandIk, IkResult
from pgdm.pregrasp.retarget.keypoints import Keypoints
from pgdm.pregrasp.retarget.targets import Targets
from pgdm.sim.scene import Scene

# Attempts of `_opened`: how far the fingertips spread, and how far the palm backs off.
_OPENINGS_M = tuple((opening, lift) for lift in (0.0, 0.01) for opening in (0.006, 0.015, 0.03))
_FIRST_TRIES = 3  # searches that are always run; more only while no result is good enough
_RETREATS_M = (0.1, 0.06)  # distances from which the hand approaches the object
_FREEING = FreeingCfg(
    slide_m=0.01, hinge_rad=0.08, depth_weight=60.0, move_weight=1e-3, negligible_m=1e-9
)
"""Settings of the search that frees the hand; its cost is in m of mean fingertip error."""
_FAR_M = 0.01  # an error of this size counts twice its value, see `pushed_out`


def solve_hand(
    scene: Scene | HandIk, keypoints: Keypoints, object_qpos: np.ndarray, *, seed: int = 0
) -> IkResult:
    """Return the scene's hand posed like a human hand, touching nothing if possible.

    Args:
        scene: scene of the task, or an existing :class:`HandIk` of it, to save the set-up.
        keypoints: the human hand, world frame.
        object_qpos: joint positions of all objects (nq - n,); they stay.
        seed: seed of the search that frees the hand.

    Raises:
        ConfigError: the hand's points do not have the layout that
            :class:`pgdm.pregrasp.retarget.targets.HandShape` needs.
    """
    ik = scene if isinstance(scene, HandIk) else HandIk(scene)
    targets = ik.shape.targets(keypoints)
    begin = ik.approach(object_qpos, targets)
    straight = ik.result(ik.track(targets, begin), targets)
    if straight.depth_m == 0.0:
        return straight
    poses = [*_opened(ik, targets, straight.qpos), *_from_afar(ik, targets, begin)]
    # The search takes most of the time: it starts from the best two and the direct result
    # (`straight`), and from others only while none of these is good enough.
    poses = sorted((ik.result(q, targets) for q in poses), key=lambda r: r.cost)
    tries = [(one.qpos, seed) for one in (*poses[:2], straight)]
    tries += [(one.qpos, seed + 1 + i) for i, one in enumerate((*poses[2:5], straight))]
    found: list[IkResult] = []
    for i, (qpos, stream) in enumerate(tries):
        if i >= _FIRST_TRIES and any(r.depth_m == 0 and not len(r.unreached) for r in found):
            break
        found.append(_freed(ik, qpos, targets, stream))
    return min(found, key=lambda result: result.cost)


def pushed_out(ik: HandIk, qpos: np.ndarray, targets: Targets, seed: int = 0) -> np.ndarray:
    """Return the scene (nq,) near ``qpos`` with the least penetration, ideally none.

    The cost of leaving the targets is

        sum_p w_p e_p (1 + e_p / 1 cm) / F

    with e_p the error of point p, w_p its weight divided by the largest weight of a fingertip, and
    F the number of fingertips. The cost grows faster than the errors, so that the errors spread
    over the fingers. Equal arguments give an equal result.

    Args:
        ik: inverse kinematics of the scene.
        qpos: whole scene (nq,); objects stay.
        targets: where the hand's points should stay.
        seed: seed of the search.
    """
    if ik.contact.depth(qpos) == 0.0:
        return qpos
    model, geoms, tips = ik.scene.model, ik.scene.index.point_geoms, ik.shape.rows[:, 2]
    data, weights = mujoco.MjData(model), targets.weights / targets.weights[tips].max()

    def away(state: np.ndarray) -> float:
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        error = np.linalg.norm(data.geom_xpos[geoms] - targets.points, axis=1)
        return float((weights * error * (1.0 + error / _FAR_M)).sum() / len(tips))

    def depth(state: np.ndarray) -> float:
        return float(ik.contact.depths(state).sum())

    return free_by_search(model, qpos, ik.scene.index.num_joints, depth, _FREEING, away, seed)[0]


def _freed(ik: HandIk, qpos: np.ndarray, targets: Targets, seed: int) -> IkResult:
    """Free a pose from penetration, then bring it as near to the targets as obstacles allow."""
    out = pushed_out(ik, qpos, targets, seed)
    result = ik.result(out, targets)
    if result.depth_m > 0.0:
        return result
    nearer = ik.result(ik.track(targets, out, steps=60, avoid=True), targets)
    return min(result, nearer, key=lambda r: r.cost)


def _opened(ik: HandIk, targets: Targets, begin: np.ndarray) -> list[np.ndarray]:
    """Return poses with the fingertips farther apart and the palm farther away, up to the first
    that is free; that pose is closed again around the obstacles."""
    tips = targets.points[ik.shape.rows[:, 2]]
    outward = tips - tips.mean(axis=0)
    outward /= np.maximum(np.linalg.norm(outward, axis=1, keepdims=True), 1e-9)
    found = []
    for opening, lift in _OPENINGS_M:
        points = targets.points + lift * targets.palm[:, 2]
        points[ik.shape.rows[:, 1]] += 0.5 * opening * outward
        points[ik.shape.rows[:, 2]] += opening * outward
        pose = ik.track(replace(targets, points=points), begin, steps=60)
        if ik.contact.depth(pose) == 0.0:
            found.append(ik.track(targets, pose, steps=40, avoid=True))
            break  # the next poses would only be farther from the targets
        found.append(pose)
    return found


def _from_afar(ik: HandIk, targets: Targets, begin: np.ndarray) -> list[np.ndarray]:
    """Return poses that the hand reaches from a distance, avoiding object and table."""
    away = unit(object_to_hand(ik.scene, begin))
    found = []
    for distance in _RETREATS_M:
        wrist = np.where(np.arange(len(targets.points)) == 0, 1.0, 0.0)
        points = targets.points + distance * away
        far = replace(targets, points=points, weights=wrist, palm_weight=1.0)
        out = ik.track(far, begin, steps=40)
        if ik.contact.depth(out) == 0.0:
            found.append(ik.track(targets, out, steps=80, avoid=True))
    return found
