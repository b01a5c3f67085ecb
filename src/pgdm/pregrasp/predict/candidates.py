"""Candidates for a pre-grasp: sampled, made free of contact, ranked by what they can lift."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from pgdm.errors import ConfigError, SceneError
from pgdm.library import Start
from pgdm.pregrasp.predict.encoding import object_code
from pgdm.pregrasp.predict.grasp_vector import GraspFrame
from pgdm.pregrasp.predict.predictor import Predictor
from pgdm.pregrasp.predict.refine import freed
from pgdm.pregrasp.quality import LiftTest, Quality, quality
from pgdm.sim.scene import Scene

Progress = Callable[[int, int], None]
"""Told how many steps of how many are done."""

OVERSAMPLING = 3
"""Samples for each candidate that is lift-tested."""


@dataclass(frozen=True)
class Candidate:
    """A predicted pre-grasp that touches nothing."""

    qpos: np.ndarray = field(repr=False)
    """Whole scene (nq,)."""
    moved_m: float
    """Mean way of the fingertips from where they were predicted."""
    quality: Quality


def propose(
    predictor: Predictor,
    scene: Scene,
    objects: np.ndarray,
    count: int,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Candidate]:
    """Sample hands for a scene's object and move them out of whatever they cut into.

    Args:
        predictor: of the scene's hand.
        scene: of the task.
        objects: a state (nq,) whose objects lie as they should.
        count: how many candidates.
        seed: of the samples.
        progress: told about samples.

    Returns:
        At most ``count``, most promising first; the hand's quality without its lift rate.

    Raises:
        ConfigError: the predictor is of another hand, or the object hangs on something.
        SceneError: no sample could be made free.
    """
    if predictor.hand != scene.hand.name:
        raise ConfigError(
            f"the predictor is for hand '{predictor.hand}', task '{scene.task.id}' has "
            f"'{scene.hand.name}'"
        )
    if not scene.lies_free:
        raise ConfigError(
            f"the object of task '{scene.task.id}' hangs on something: pre-grasps are predicted "
            "for objects that lie free"
        )
    frame = GraspFrame(scene, predictor.anchor_m)
    if len(predictor.mean) != frame.size:
        raise ConfigError(
            f"the predictor of hand '{predictor.hand}' gives {len(predictor.mean)} numbers, in "
            f"task '{scene.task.id}' it has {frame.size}: train it anew (pgdm pregrasp train)"
        )
    vectors = predictor.sample(object_code(scene, objects), OVERSAMPLING * count, seed)
    return free_ones(frame, vectors, objects, seed, progress)[:count]


def free_ones(
    frame: GraspFrame,
    vectors: Sequence[np.ndarray] | np.ndarray,
    objects: np.ndarray,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[Candidate]:
    """Return vectors as candidates that touch nothing, most promising first.

    Those are that had to be moved least and whose fingertips are near the object: a hand that
    hovers far away touches nothing either.

    Raises:
        SceneError: none could be made free.
    """
    scene, found = frame.scene, []
    for i, vector in enumerate(vectors):
        qpos = freed(scene, frame.qpos(vector, objects), seed)
        if qpos is not None:
            away = frame.fingertips(qpos) - frame.fingertips_of(vector)
            moved = float(np.linalg.norm(away, axis=1).mean())
            found.append(Candidate(qpos, moved, quality(scene, qpos, 0, None)))
        if progress is not None:
            progress(i + 1, len(vectors))
    if not found:
        raise SceneError(
            f"task '{scene.task.id}': none of {len(vectors)} predicted hands could be moved out of "
            "what it cuts into; try more samples, or another seed"
        )
    return sorted(found, key=lambda c: c.moved_m + c.quality.fingertip_distance_m)


def ranked(
    candidates: Sequence[Candidate], lift: LiftTest, progress: Progress | None = None
) -> list[Candidate]:
    """Return candidates with their lift rates, best first; of equal ones the nearest fingertips.

    An object that cannot be lifted leaves only the fingertips to rank by.
    """
    tested = []
    for i, one in enumerate(candidates):
        # One-DoF joints only: as many velocities as positions.
        rate = lift(Start(one.qpos, np.zeros_like(one.qpos), None))
        tested.append(replace(one, quality=replace(one.quality, lift_rate=rate)))
        if progress is not None:
            progress(i + 1, len(candidates))
    return sorted(tested, key=_rank)


def _rank(candidate: Candidate) -> tuple[float, float]:
    rate = candidate.quality.lift_rate
    return (0.0 if math.isnan(rate) else -rate, candidate.quality.fingertip_distance_m)
