"""The predictor: a Gaussian over grasp vectors whose mean is linear in the object's code.

Given an object's code c (`encoding`), the grasp vector (`grasp_vector`) is distributed as

    v ~ N(m + (c - c_0) W, S)

where c_0 and m are the means of the examples' codes and vectors. The rows of X and Y are the
examples' codes and vectors, minus these means; W is the ridge regression

    W = X^T (X X^T + penalty var(X) I)^-1 Y

where var(X) is the total variance of the codes, or 0.5 if that is larger.

Each object is held out in turn, and its grasp vectors are predicted from the other objects. The
penalty is the one with the least fingertip error of these predictions, and S is 0.7^2 times the
second moment of the errors of the predicted vectors. With some 40 pre-grasps this predicts
better than networks trained by gradient descent (``benchmark/predictor_networks.py``).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from pgdm.errors import ConfigError, amount
from pgdm.library.progress import StepProgress, silent
from pgdm.pregrasp.predict.encoding import object_code
from pgdm.pregrasp.predict.grasp_vector import JOINTS, POSITION, ROTATION, GraspFrame, rotation_of
from pgdm.seeding import torch_stream
from pgdm.sim.scene import Scene

PENALTIES = (0.3, 1.0, 3.0, 10.0, 30.0)
"""Ridge penalties to choose from, relative to the total variance of the codes."""
SPREAD = 0.7
"""Standard deviation of the samples relative to that of the held-out errors. Less than 1, because
among few candidates those far from the mean are rarely the best: with 0.7 the best of 8 candidates
has a fingertip error of 36 mm, with 1 it has 38 mm."""
LEAST_OBJECTS = 2
_LEAST_VARIANCE = 0.5
"""Lower bound of the codes' total variance in the ridge penalty. The variance is 3.4 for
32 objects and 0.9 for ten. If it is below 0.5, all objects have about the same shape, and small
differences, such as how the objects lie, must have little effect."""


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
    """A fitted predictor of one hand, for codes (B,) and grasp vectors (D,), from n examples."""

    hand: str
    anchor_m: np.ndarray = field(repr=False)  # (3,) in the palm's frame
    code_mean: np.ndarray = field(repr=False)  # (B,)
    slope: np.ndarray = field(repr=False)  # (B, D)
    mean: np.ndarray = field(repr=False)  # (D,)
    factor: np.ndarray = field(repr=False)  # (n, D), covariance = factor^T factor
    penalty: float
    tasks: tuple[str, ...]
    """Tasks whose pre-grasps the predictor was fitted on."""
    objects: tuple[str, ...]
    """Objects that the predictor was fitted on."""
    left_out: tuple[str, ...]
    """Objects that the user left out of the fit."""
    error_m: float
    """Mean distance of the predicted fingertips from the stored ones, on objects held out in turn.
    Slightly optimistic, since the penalty was chosen to minimise it."""
    mean_hand_error_m: float
    """The same error of a predictor that ignores the shape: it predicts the other objects' mean."""

    def expected(self, code: np.ndarray) -> np.ndarray:
        """Return the mean grasp vector (D,) for an object's code (B,)."""
        return self.mean + (code - self.code_mean) @ self.slope

    def sample(self, code: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
        """Return grasp vectors (count, D): the mean, then random samples from ``seed``."""
        noise = torch.randn(
            (count, len(self.factor)), generator=torch_stream(seed, "predict"), dtype=torch.float64
        ).numpy()
        noise[0] = 0.0
        return self.expected(code) + noise @ self.factor


def example(scene: Scene, qpos: np.ndarray) -> Example | None:
    """Return a pre-grasp qpos (nq,) as an example, or None if the object is attached to something.

    A door, for instance, can only be grasped at its handle, far from its centre of mass.
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
        frame: grasp frame of that hand, in any scene.
        left_out: objects that the examples leave out, stored in the predictor.
        progress: called after each penalty tried.
        penalties: penalties to choose from; infinity predicts the mean vector for every object.

    Raises:
        ConfigError: the examples are from too few objects.
    """
    objects = sorted({e.object for e in examples})
    if len(objects) < LEAST_OBJECTS:
        raise ConfigError(
            f"{amount(len(examples), 'pre-grasp')} of {amount(len(objects), 'object')} with hand "
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
    """Return each object's grasp vectors (n, D), predicted from the other objects' examples."""
    predicted = np.empty_like(vectors)
    for held, rest in folds(examples):
        predicted[held] = _Ridge(codes[rest], vectors[rest], penalty).at(codes[held])
    return predicted


def anchored(vector: np.ndarray, anchor: np.ndarray) -> np.ndarray:
    """Return a grasp vector (9+J,) with a new anchor (3,) m instead of the palm's origin."""
    moved = vector.copy()
    moved[POSITION] += rotation_of(vector[ROTATION]) @ anchor
    return moved


def folds(examples: Sequence[Example]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield for each object two masks (n,): the object's examples, and all others."""
    names = np.array([e.object for e in examples])
    for name in sorted(set(names.tolist())):
        yield names == name, names != name


def off(frame: GraspFrame, vector: np.ndarray, example: Example) -> float:
    """Return the mean distance between the fingertips of a grasp vector and an example, m."""
    away = frame.fingertips_of(vector) - example.fingertips
    return float(np.linalg.norm(away, axis=1).mean())


class _Ridge:
    """Ridge regression with an unpenalised offset; an infinite penalty predicts the mean.

    Args:
        codes: codes of the examples' objects (n, B).
        vectors: grasp vectors of the examples (n, D).
        penalty: ridge penalty, relative to the total variance of the codes.
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
        """Return the predicted grasp vectors (m, D) for codes (m, B)."""
        return self.mean + (codes - self.code_mean) @ self.slope
