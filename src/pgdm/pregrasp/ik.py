"""Inverse kinematics: brings a scene's hand to where a human hand's joints are.

Differential inverse kinematics (mink), joint limits as hard bounds, in two ways: straight to the
target, then moved out of whatever it cuts into; and from a distance with the fingers open, with
object and table as obstacles. The better one is taken.
"""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from pgdm.pregrasp.hand_ik import REACHED_M, HandIk, IkResult
from pgdm.pregrasp.keypoints import Keypoints
from pgdm.pregrasp.push_out import pushed_out
from pgdm.pregrasp.targets import Targets
from pgdm.sim.scene import Scene

__all__ = ["REACHED_M", "HandIk", "IkResult", "solve_hand", "solve_targets"]

# How far fingertips open and the palm moves off, to see where the hand comes free.
_OPENINGS_M = tuple((opening, lift) for lift in (0.0, 0.01) for opening in (0.006, 0.015, 0.03))
_FIRST_TRIES = 3  # of the search; more only while they are not good enough
_RETREATS_M = (0.1, 0.06)  # from where the hand comes to the object


def solve_hand(
    scene: Scene | HandIk,
    keypoints: Keypoints,
    object_qpos: np.ndarray,
    *,
    start: np.ndarray | None = None,
    anchor: str | None = None,
    free: bool = True,
    seed: int = 0,
) -> IkResult:
    """Return the scene's hand posed as a human hand is, touching nothing.

    Args:
        scene: of the task, or what :class:`HandIk` made of it, which saves its set-up.
        keypoints: the human hand, world frame.
        object_qpos: joints of all objects (nq - nu,); they stay.
        start: whole scene (nq,) to begin at, such as the last pose while a person drags; by default
            the hand comes from where it can reach the object.
        anchor: see :data:`pgdm.pregrasp.targets.ANCHORS`; by default chosen by the hand's size.
        free: whether the hand must be out of object and table; without it only the targets count.
        seed: of the search that moves it out.

    Raises:
        ConfigError: the hand's points cannot follow a human hand.
    """
    ik = scene if isinstance(scene, HandIk) else HandIk(scene)
    targets = ik.shape.targets(keypoints, anchor)
    return solve_targets(ik, targets, object_qpos, start=start, free=free, seed=seed)


def solve_targets(
    ik: HandIk,
    targets: Targets,
    object_qpos: np.ndarray,
    *,
    start: np.ndarray | None = None,
    free: bool = True,
    seed: int = 0,
) -> IkResult:
    """Return the hand brought to targets of one's own; arguments as :func:`solve_hand`."""
    begin = ik.approach(object_qpos, targets) if start is None else start
    straight = ik.result(ik.track(targets, begin), targets)
    if not free or straight.depth_m == 0.0:
        return straight
    poses = [*_opened(ik, targets, straight.qpos)]
    if start is None:
        poses += _from_afar(ik, targets, begin)
    # The search is what takes time: it starts at the best two and where a hand was before, and
    # elsewhere only while that is not good enough.
    poses = sorted((ik.result(q, targets) for q in poses), key=lambda r: r.cost)
    tries = [(one.qpos, seed) for one in (*poses[:2], straight)]
    tries += [(one.qpos, seed + 1 + i) for i, one in enumerate((*poses[2:5], straight))]
    found: list[IkResult] = []
    for i, (qpos, stream) in enumerate(tries):
        if i >= _FIRST_TRIES and any(r.depth_m == 0 and not len(r.unreached()) for r in found):
            break
        found.append(_freed(ik, qpos, targets, stream))
    return min(found, key=lambda result: result.cost)


def _freed(ik: HandIk, qpos: np.ndarray, targets: Targets, seed: int) -> IkResult:
    """Return a pose moved out of everything, then as near to the targets as obstacles allow."""
    out = pushed_out(ik.contact, ik.scene, ik.shape, qpos, targets, seed)
    result = ik.result(out, targets)
    if result.depth_m > 0.0:
        return result
    nearer = ik.result(ik.track(targets, out, steps=60, avoid=True), targets)
    return min(result, nearer, key=lambda r: r.cost)


def _opened(ik: HandIk, targets: Targets, begin: np.ndarray) -> list[np.ndarray]:
    """Return poses with the fingertips farther apart and the palm farther off, and what becomes of
    the free ones when they close again around what is in the way."""
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
            break  # those that follow are only farther off
        found.append(pose)
    return found


def _from_afar(ik: HandIk, targets: Targets, begin: np.ndarray) -> list[np.ndarray]:
    """Return where the hand gets that comes from a distance, past object and table."""
    model, index = ik.scene.model, ik.scene.index
    data = mujoco.MjData(model)
    data.qpos[:] = begin
    mujoco.mj_kinematics(model, data)
    centre = data.geom_xpos[index.point_geoms].mean(axis=0)
    away = centre - data.xipos[index.object_body]
    away /= max(float(np.linalg.norm(away)), 1e-9)
    found = []
    for distance in _RETREATS_M:
        far = Targets(
            targets.points + distance * away, np.where(np.arange(len(targets.points)) == 0, 1.0, 0),
            targets.palm, 1.0, targets.scale, targets.anchor,
        )  # fmt: skip
        out = ik.track(far, begin, steps=40)
        if ik.contact.depth(out) == 0.0:
            found.append(ik.track(targets, out, steps=80, avoid=True))
    return found
