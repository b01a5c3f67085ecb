"""Candidates for a pre-grasp: sampled, freed from penetration, ranked by their lift rates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pgdm.errors import ConfigError, SceneError
from pgdm.library import Start
from pgdm.library.clearance import CLEARANCE_M, FreeingCfg, free_by_search
from pgdm.library.progress import StepProgress, silent
from pgdm.pregrasp.predict.encoding import object_code
from pgdm.pregrasp.predict.grasp_vector import GraspFrame
from pgdm.pregrasp.predict.predictor import Predictor
from pgdm.pregrasp.quality import LiftTest, Quality, quality
from pgdm.sim.contact import HandContact
from pgdm.sim.scene import Scene

OVERSAMPLING = 3
"""Number of samples drawn for each candidate that is kept for the lift test."""
_FREEING = FreeingCfg(0.01, 0.08, depth_weight=1e3, population=48, patience=6)


@dataclass(frozen=True)
class Candidate:
    """A predicted pre-grasp in which the hand touches nothing but itself."""

    qpos: np.ndarray = field(repr=False)
    """Whole scene (nq,)."""
    moved_m: float
    """Mean distance of the fingertips from their predicted positions."""
    quality: Quality


def propose(
    predictor: Predictor,
    scene: Scene,
    objects: np.ndarray,
    count: int,
    seed: int = 0,
    progress: StepProgress = silent,
) -> list[Candidate]:
    """Sample hand poses for a scene's object and free them from penetration.

    Args:
        predictor: predictor of the scene's hand.
        scene: scene of the task.
        objects: a state (nq,) with the objects in place.
        count: number of candidates to return.
        seed: seed of the samples and of the search that frees them.
        progress: called after each sample.

    Returns:
        At most ``count`` candidates, most promising first, as yet without a lift rate.

    Raises:
        ConfigError: the predictor is for another hand, or for a version of the hand with other
            joints, or the object is attached to something.
        SceneError: no sample could be freed.
    """
    if predictor.hand != scene.hand.name:
        raise ConfigError(
            f"the predictor is for hand '{predictor.hand}', task '{scene.task.id}' has "
            f"'{scene.hand.name}'"
        )
    if not scene.lies_free:
        raise ConfigError(
            f"the object of task '{scene.task.id}' is attached to something: pre-grasps are only "
            "predicted for objects that lie free"
        )
    frame = GraspFrame(scene, predictor.anchor_m)
    if len(predictor.mean) != frame.size:
        raise ConfigError(
            f"predictor of hand '{predictor.hand}' gives {len(predictor.mean)} numbers, but task "
            f"'{scene.task.id}' needs {frame.size}: train it again (pgdm pregrasp train)"
        )
    vectors = predictor.sample(object_code(scene, objects), OVERSAMPLING * count, seed)
    return free_ones(frame, vectors, objects, seed, progress)[:count]


def free_ones(
    frame: GraspFrame,
    vectors: Sequence[np.ndarray] | np.ndarray,
    objects: np.ndarray,
    seed: int = 0,
    progress: StepProgress = silent,
) -> list[Candidate]:
    """Return grasp vectors as candidates that touch nothing, most promising first.

    They are sorted by ``moved_m`` plus ``quality.fingertip_distance_m``. Vectors that cannot be
    freed from penetration are left out.

    Raises:
        SceneError: no vector could be freed.
    """
    scene, found = frame.scene, []
    for i, vector in enumerate(vectors):
        qpos = freed(scene, frame.qpos(vector, objects), seed)
        if qpos is not None:
            away = frame.fingertips(qpos) - frame.fingertips_of(vector)
            moved = float(np.linalg.norm(away, axis=1).mean())
            found.append(Candidate(qpos, moved, quality(scene, qpos, 0, None)))
        progress("samples", i + 1, len(vectors))
    if not found:
        raise SceneError(
            f"task '{scene.task.id}': none of {len(vectors)} predicted hands could be freed from "
            "penetration; try more samples, or another seed"
        )
    return sorted(found, key=lambda c: c.moved_m + c.quality.fingertip_distance_m)


def freed(scene: Scene, qpos: np.ndarray, seed: int = 0) -> np.ndarray | None:
    """Return a state (nq,) near ``qpos`` in which the hand is free; None if no such state is found.

    The hand then keeps a clearance of 0.5 mm from everything but itself. Objects stay, joints
    stay within their limits, and equal arguments give an equal result.
    """
    model, contact, start = scene.model, HandContact(scene), qpos.copy()
    count = scene.index.num_joints
    start[:count] = qpos[:count].clip(*model.jnt_range[:count].T)
    scene.index.couplings.apply(start)

    def overlap(state: np.ndarray) -> float:
        return contact.overlap(state, CLEARANCE_M)

    if overlap(start) == 0.0:
        return start
    found, is_free = free_by_search(model, start, count, overlap, _FREEING, seed=seed)
    return found if is_free else None


def ranked(
    candidates: Sequence[Candidate], lift: LiftTest, progress: StepProgress = silent
) -> list[Candidate]:
    """Return candidates with their lift rates, best first; ties go to the nearer fingertips.

    If the object cannot be lifted, only the fingertips' distance counts.
    """
    tested = []
    for i, one in enumerate(candidates):
        # All joints have one degree of freedom, so that nv = nq.
        rate = lift(Start(one.qpos, np.zeros_like(one.qpos), None))
        tested.append(replace(one, quality=replace(one.quality, lift_rate=rate)))
        progress("lift tests", i + 1, len(candidates))
    return sorted(
        tested,
        key=lambda c: (-np.nan_to_num(c.quality.lift_rate), c.quality.fingertip_distance_m),
    )
