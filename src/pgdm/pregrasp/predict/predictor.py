"""A Gaussian over grasp vectors whose mean is linear in an object's code, and its fit.

Given an object's code c, the grasp vector is

    v ~ N(m + (c - c_0) W, S)

with c_0 and m the means of the examples' codes and vectors. With the rows of X and Y the examples'
codes and vectors minus these means, W is the ridge regression

    W = X^T (X X^T + penalty var(X) I)^-1 Y

The penalty is the one with the least fingertip error on objects held out in turn, and S is 0.7^2
times the second moment of the errors on these objects. With some 40 pre-grasps this predicts better
than networks trained by gradient descent (``benchmark/predictor_networks.py``).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from pgdm.errors import ConfigError
from pgdm.library.progress import StepProgress, silent
from pgdm.pregrasp.predict.encoding import object_code
from pgdm.pregrasp.predict.grasp_vector import JOINTS, POSITION, ROTATION, GraspFrame, rotation_of
from pgdm.seeding import torch_stream
from pgdm.sim.scene import Scene

PENALTIES = (0.3, 1.0, 3.0, 10.0, 30.0)
"""Ridge penalties to choose from, relative to the total variance of the codes."""
SPREAD = 0.7
"""Standard deviation of the samples relative to that of the held-out errors: with few candidates,
the outer ones are rarely the best (best of 8 within 36 mm, with the full spread 38 mm)."""
LEAST_OBJECTS = 2
_LEAST_VARIANCE = 0.5
"""Lower bound of the codes' total variance; that of 32 objects is 3.4, of ten 0.9. Below it all
objects have one shape, and small differences, such as how it was put down, must not count."""


@dataclass(frozen=True)
class Example:
    """One pre-grasp of one object."""

    task: str
    object: str
    """Library name of the tracked object."""
    code: np.ndarray = field(repr=False)
    """Code of the object (B,)."""
    vector: np.ndarray = field(repr=False)
    """Grasp vector (9+J,) with the palm's origin as its anchor."""
    fingertips: np.ndarray = field(repr=False)
    """(F, 3) m, relative to the object's centre of mass."""


@dataclass(frozen=True)
class Predictor:
    """A fitted predictor of one hand."""

    hand: str
    anchor_m: np.ndarray = field(repr=False)  # (3,) in the palm's frame
    code_mean: np.ndarray = field(repr=False)  # (B,)
    slope: np.ndarray = field(repr=False)  # (B, D)
    mean: np.ndarray = field(repr=False)  # (D,)
    factor: np.ndarray = field(repr=False)  # (n, D), covariance = factor^T factor
    penalty: float
    tasks: tuple[str, ...]
    """Tasks whose pre-grasps it was fitted on."""
    objects: tuple[str, ...]
    """Objects it was fitted on."""
    left_out: tuple[str, ...]
    """Objects that were left out."""
    error_m: float
    """Mean distance of the predicted fingertips from the stored ones, on objects held out in turn.
    Slightly optimistic, since the penalty was chosen by it."""
    mean_hand_error_m: float
    """The same for the mean vector of the other objects, whatever the shape."""

    def expected(self, code: np.ndarray) -> np.ndarray:
        """Return the mean grasp vector (D,) for an object's code (B,)."""
        return self.mean + (code - self.code_mean) @ self.slope

    def sample(self, code: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
        """Return grasp vectors (count, D): the mean, then random ones that depend on the seed."""
        noise = torch.randn(
            (count, len(self.factor)), generator=torch_stream(seed, "predict"), dtype=torch.float64
        ).numpy()
        noise[0] = 0.0
        return self.expected(code) + noise @ self.factor


def example(scene: Scene, qpos: np.ndarray) -> Example | None:
    """Return a pre-grasp qpos (nq,) as an example, or None if the object does not lie free.

    A hand has no choice where to grasp a door, and does not hold it near its centre.
    """
    if not scene.lies_free:
        return None
    frame, code = GraspFrame(scene), object_code(scene, qpos)
    return Example(
        scene.task.id, object_of(scene), code, frame.vector(qpos), frame.fingertips(qpos)
    )


def object_of(scene: Scene) -> str:
    """Return the library name of a scene's tracked object."""
    return scene.task.objects[0]


def fit(
    examples: Sequence[Example],
    frame: GraspFrame,
    left_out: Sequence[str] = (),
    progress: StepProgress = silent,
    penalties: Sequence[float] = PENALTIES,
) -> Predictor:
    """Fit a predictor.

    Args:
        examples: examples of one hand.
        frame: frame of that hand, in any scene.
        left_out: objects left out of the examples, for the record.
        progress: called after each penalty tried.
        penalties: penalties to choose from; infinity gives the mean vector, whatever the object.

    Raises:
        ConfigError: the examples are of too few objects.
    """
    objects = sorted({e.object for e in examples})
    if len(objects) < LEAST_OBJECTS:
        raise ConfigError(
            f"{len(examples)} pre-grasps of {len(objects)} objects with hand "
            f"'{frame.scene.hand.name}': predicting for another object needs at least "
            f"{LEAST_OBJECTS} objects"
        )
    anchor = np.mean([frame.fingertips_in_palm(e.vector[JOINTS]).mean(0) for e in examples], axis=0)
    frame = GraspFrame(frame.scene, anchor)
    codes = np.stack([e.code for e in examples])
    vectors = np.stack([anchored(e.vector, anchor) for e in examples])
    predicted: dict[float, np.ndarray] = {}  # penalty -> vectors (n, D) of held-out objects
    error_m: dict[float, float] = {}
    tried = list(dict.fromkeys((*penalties, np.inf)))
    for i, penalty in enumerate(tried):
        predicted[penalty] = _held_out(examples, codes, vectors, penalty)
        away = [off(frame, v, e) for v, e in zip(predicted[penalty], examples, strict=True)]
        error_m[penalty] = float(np.mean(away))
        progress("held-out fits", i + 1, len(tried))
    best = min(penalties, key=lambda penalty: error_m[penalty])
    errors = vectors - predicted[best]
    ridge = _Ridge(codes, vectors, best)
    return Predictor(
        hand=frame.scene.hand.name,
        anchor_m=anchor,
        code_mean=ridge.code_mean,
        slope=ridge.slope,
        mean=ridge.mean,
        factor=SPREAD * errors / np.sqrt(max(len(examples) - 1, 1)),
        penalty=best,
        tasks=tuple(sorted({e.task for e in examples})),
        objects=tuple(objects),
        left_out=tuple(left_out),
        error_m=error_m[best],
        mean_hand_error_m=error_m[np.inf],
    )


def _held_out(
    examples: Sequence[Example], codes: np.ndarray, vectors: np.ndarray, penalty: float
) -> np.ndarray:
    """Return the grasp vectors (n, D) predicted for each object from those of the others."""
    predicted = np.empty_like(vectors)
    for held, rest in folds(examples):
        predicted[held] = _Ridge(codes[rest], vectors[rest], penalty).at(codes[held])
    return predicted


def anchored(vector: np.ndarray, anchor: np.ndarray) -> np.ndarray:
    """Return a grasp vector (9+J,) of the palm's origin with another anchor (3,) m instead."""
    moved = vector.copy()
    moved[POSITION] += rotation_of(vector[ROTATION]) @ anchor
    return moved


def folds(examples: Sequence[Example]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield masks (n,) for each object: the examples of it, and the others."""
    names = np.array([e.object for e in examples])
    for name in sorted(set(names.tolist())):
        yield names == name, names != name


def off(frame: GraspFrame, vector: np.ndarray, example: Example) -> float:
    """Return the mean distance of a grasp vector's fingertips from an example's, m."""
    away = frame.fingertips_of(vector) - example.fingertips
    return float(np.linalg.norm(away, axis=1).mean())


class _Ridge:
    """Ridge regression with an unpenalised offset; an infinite penalty gives the mean.

    Args:
        codes: (n, B).
        vectors: (n, D).
        penalty: relative to the total variance of the codes.
    """

    def __init__(self, codes: np.ndarray, vectors: np.ndarray, penalty: float) -> None:
        self.code_mean, self.mean = codes.mean(axis=0), vectors.mean(axis=0)
        x, y = codes - self.code_mean, vectors - self.mean
        variance = max(float((x**2).sum()) / len(x), _LEAST_VARIANCE)
        if np.isinf(penalty):
            self.slope = np.zeros((x.shape[1], y.shape[1]))
            return
        gram = x @ x.T + penalty * variance * np.eye(len(x))
        self.slope = x.T @ np.linalg.solve(gram, y)

    def at(self, codes: np.ndarray) -> np.ndarray:
        """Return the grasp vectors (m, D) at codes (m, B)."""
        return self.mean + (codes - self.code_mean) @ self.slope
