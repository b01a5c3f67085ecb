"""Moving a hand out of what it penetrates by a small change of its joints."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from pgdm.cem import CemCfg, CrossEntropy
from pgdm.errors import CorruptAssetError

CLEARANCE_M = 0.0005
"""Distance that is kept, the contact margin of the benchmark's models."""

_SPREAD = (0.01, 0.05)
"""First spread of the search: m of the sliding joints, rad of the turning ones."""
_CEM, _ROUNDS = CemCfg(64, 8, added=0.02), 40
_DEPTH_WEIGHT = 1e3
"""Cost of a metre of penetration, against squared spreads of movement."""
_OBJECT_HEIGHT_M = 0.2


def moved_out(table: Path, hand: Path, thing: Path, qpos: np.ndarray) -> np.ndarray:
    """Return joint positions near ``qpos`` at which the hand touches nothing.

    A cross-entropy search over the hand's joints: the parts of a thin wall push to both sides, so
    that following the contacts' normals goes astray. Same input, same result.

    Args:
        table: MJCF of the scene.
        hand: MJCF of the hand.
        thing: MJCF of the object.
        qpos: hand joints, then the object's (nq,); the object stays where it is.

    Raises:
        CorruptAssetError: no such position was found.
    """
    model, joints = _scene(table, hand, thing)
    data = mujoco.MjData(model)
    low, high = model.jnt_range[:joints].T
    slides = model.jnt_type[:joints] == mujoco.mjtJoint.mjJNT_SLIDE
    scale = np.where(slides, *_SPREAD)
    start = qpos[:joints].clip(low, high)
    data.qpos[:] = qpos
    stream = np.random.Generator(np.random.PCG64(0))
    search = CrossEntropy(np.zeros(joints), np.ones(joints), _CEM, stream)
    best, best_cost = start, np.inf
    for _ in range(_ROUNDS):
        moves = search.ask()
        costs = np.empty(len(moves))
        for i, move in enumerate(moves):
            data.qpos[:joints] = (start + scale * move).clip(low, high)
            depth = _penetration(model, data)
            costs[i] = _DEPTH_WEIGHT * depth + float(move @ move) / joints
            if depth == 0.0 and costs[i] < best_cost:
                best, best_cost = data.qpos[:joints].copy(), costs[i]
        search.tell(moves, costs)
    if not np.isfinite(best_cost):
        raise CorruptAssetError(f"{thing.parent.name}: the hand cannot be moved out of the object")
    return np.concatenate((best, qpos[joints:]))


def _scene(table: Path, hand: Path, thing: Path) -> tuple[mujoco.MjModel, int]:
    spec = mujoco.MjSpec.from_file(str(table))
    for prefix, path in (("hand/", hand), ("thing/", thing)):
        part = mujoco.MjSpec.from_file(str(path))
        spec.attach(part, prefix=prefix, frame=spec.worldbody.add_frame())
    spec.body("thing/object").pos = (0.0, 0.0, _OBJECT_HEIGHT_M)
    model = spec.compile()
    return model, sum(model.joint(i).name.startswith("hand/") for i in range(model.njnt))


def _penetration(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Return by how much the hand's contacts with other things are too close in all, m."""
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_collision(model, data)
    total = 0.0
    for contact in data.contact:
        first, second = (
            model.body(model.geom_bodyid[g]).name.startswith("hand/")
            for g in (contact.geom1, contact.geom2)
        )
        if first != second and contact.dist < CLEARANCE_M:
            total += CLEARANCE_M - float(contact.dist)
    return total
