"""Freeing a hand from penetration by searching for a small change of its joint positions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from pgdm.cem import CemCfg, CrossEntropy
from pgdm.errors import CorruptAssetError
from pgdm.library.couplings import Couplings

CLEARANCE_M = 0.0005
"""Clearance kept from object and table, m: the contact margin of the benchmark's models."""

_ROUNDS, _ELITES, _ADDED = 40, 8, 0.02
_OBJECT_HEIGHT_M = 0.2  # height of the object's body at joint positions of zero, as in the tasks


@dataclass(frozen=True)
class FreeingCfg:
    """Settings of :func:`free_by_search`: step sizes, cost weights, effort."""

    slide_m: float
    """Standard deviation of slide joints in the first round of samples."""
    hinge_rad: float
    """Standard deviation of hinge joints in the first round of samples."""
    depth_weight: float
    """Cost per metre of penetration."""
    move_weight: float = 1.0
    """Cost of moving every joint by its standard deviation in the first round."""
    population: int = 64
    """Samples per round."""
    patience: int = _ROUNDS
    """Once a pose is free: number of rounds without improvement after which the search stops."""
    negligible_m: float = 0.0
    """Penetration up to this counts as none."""


LIBRARY_START = FreeingCfg(slide_m=0.01, hinge_rad=0.05, depth_weight=1e3)
"""Settings for start states that the library stores."""


def free_by_search(
    model: mujoco.MjModel,
    qpos: np.ndarray,
    num_joints: int,
    depth: Callable[[np.ndarray], float],
    cfg: FreeingCfg,
    away: Callable[[np.ndarray], float] = lambda qpos: 0.0,
    seed: int = 0,
) -> tuple[np.ndarray, bool]:
    """Return the state of least penetration near ``qpos``, and whether its depth is negligible.

    A cross-entropy search finds offsets z of the hand's joint positions h, in units of the first
    round's standard deviations s; coupled joints then follow their leaders:

        h(z) = clip(h_0 + s z)        cost(z) = away + depth_weight * depth + move_weight * |z|^2/n

    The cost guides the search; the result is the sampled state of least ``depth``, with ties broken
    by cost. Following contact normals instead would fail, because the convex parts of a thin wall
    push in opposite directions. Equal arguments give an equal result.

    Args:
        model: scene whose first joints are the hand's.
        qpos: joint positions of the scene (nq,); objects stay where they are.
        num_joints: number of the hand's joints, n.
        depth: returns the penetration, m, at joint positions (nq,).
        cfg: settings of the search.
        away: returns a further cost of joint positions (nq,), such as the distance of fingertips
            from their targets.
        seed: seed of the samples.
    """
    low, high = model.jnt_range[:num_joints].T
    is_slide = model.jnt_type[:num_joints] == mujoco.mjtJoint.mjJNT_SLIDE
    scale = np.where(is_slide, cfg.slide_m, cfg.hinge_rad)
    start, state = qpos[:num_joints].clip(low, high), qpos.copy()
    couplings = Couplings(model, num_joints)
    stream = np.random.Generator(np.random.PCG64(seed))
    cem = CemCfg(cfg.population, _ELITES, added=_ADDED)
    search = CrossEntropy(np.zeros(num_joints), np.ones(num_joints), cem, stream)
    best, best_rank, waited = state, (np.inf, np.inf), 0
    for _ in range(_ROUNDS):
        moves = search.ask()
        costs = np.empty(len(moves))
        waited += best_rank[0] <= cfg.negligible_m
        for i, move in enumerate(moves):
            state[:num_joints] = (start + scale * move).clip(low, high)
            couplings.apply(state)
            inside = depth(state)
            moved = cfg.move_weight * float(move @ move) / num_joints
            costs[i] = away(state) + cfg.depth_weight * inside + moved
            rank = max(inside, cfg.negligible_m), costs[i]
            if rank < best_rank:
                best, best_rank, waited = state.copy(), rank, 0
        if waited >= cfg.patience:
            break
        search.tell(moves, costs)
    return best, best_rank[0] <= cfg.negligible_m


def moved_out(table: Path, hand: Path, thing: Path, qpos: np.ndarray) -> np.ndarray:
    """Return joint positions (nq,) near ``qpos`` at which the hand keeps clear of table and object.

    The hand may touch itself.

    Args:
        table: MJCF of the scene.
        hand: MJCF of the hand.
        thing: MJCF of the object.
        qpos: hand joints, then the object's (nq,); the object stays where it is.

    Raises:
        CorruptAssetError: no such joint positions were found.
    """
    model = _scene(table, hand, thing)
    data = mujoco.MjData(model)
    names = [model.body(body).name for body in model.geom_bodyid]
    of_hand = np.array([name.startswith("hand/") for name in names])
    joints = sum(model.joint(i).name.startswith("hand/") for i in range(model.njnt))

    def depth(state: np.ndarray) -> float:
        """Return the missing clearance, m, summed over the hand's contacts with other bodies."""
        data.qpos[:] = state
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_collision(model, data)
        first, second = of_hand[data.contact.geom].T
        total = 0.0  # summed in contact order: stored starts depend on the sum's last bit
        for dist in data.contact.dist[first != second].tolist():
            total += max(CLEARANCE_M - dist, 0.0)
        return total

    found, is_free = free_by_search(model, qpos, joints, depth, LIBRARY_START)
    if not is_free:
        raise CorruptAssetError(
            f"{thing.parent.name}: the hand cannot be freed from object and table"
        )
    return found


def _scene(table: Path, hand: Path, thing: Path) -> mujoco.MjModel:
    spec = mujoco.MjSpec.from_file(str(table))
    for prefix, path in (("hand/", hand), ("object/", thing)):
        part = mujoco.MjSpec.from_file(str(path))
        spec.attach(part, prefix=prefix, frame=spec.worldbody.add_frame())
    spec.body("object/object").pos = (0.0, 0.0, _OBJECT_HEIGHT_M)
    return spec.compile()
