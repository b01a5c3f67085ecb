"""A Gaussian over grasp vectors whose mean depends linearly on an object's code, and its fit.

With some 40 pre-grasps the exact answer of ridge regression, its penalty chosen on objects that
were held out, predicts better than networks trained by gradient descent
(``benchmark/predictor_networks.py``). The spread is that of its errors on held-out objects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch

from pgdm.errors import ConfigError
from pgdm.pregrasp.predict.encoding import object_code
from pgdm.pregrasp.predict.grasp_vector import JOINTS, POSITION, ROTATION, GraspFrame, rotation_of
from pgdm.seeding import torch_stream
from pgdm.sim.scene import Scene

PENALTIES = (0.3, 1.0, 3.0, 10.0, 30.0)
"""Ridge penalties to choose from, with codes scaled to a total variance of 1."""
SPREAD = 0.7
"""Share of the held-out errors' spread that samples have: candidates are few, and the outer ones
are rarely the best (best of 8 within 36 mm, with the whole spread 38 mm)."""
LEAST_OBJECTS = 2
_LEAST_VARIANCE = 0.5
"""Of codes; 32 objects have 3.4, ten 0.9. Below it they are one shape, whose small differences (how
it was put down) would be taken for what tells objects apart."""

Progress = Callable[[int, int], None]
"""Told how many steps of how many are done."""


@dataclass(frozen=True)
class Example:
    """One pre-grasp of one object."""

    task: str
    object: str
    """Library name of the tracked object."""
    code: np.ndarray = field(repr=False)
    """Of the object, (B,)."""
    vector: np.ndarray = field(repr=False)
    """Of the hand, (9+J,), its position that of the palm's origin."""
    fingertips: np.ndarray = field(repr=False)
    """(F, 3) m, from the object's centre of mass."""


@dataclass(frozen=True)
class Predictor:
    """What was learned for one hand."""

    hand: str
    anchor_m: np.ndarray = field(repr=False)  # (3,) in the palm's frame
    code_mean: np.ndarray = field(repr=False)  # (B,)
    slope: np.ndarray = field(repr=False)  # (B, D)
    mean: np.ndarray = field(repr=False)  # (D,)
    factor: np.ndarray = field(repr=False)  # (n, D), spread = factor^T factor
    penalty: float
    tasks: tuple[str, ...]
    """Whose pre-grasps it saw."""
    objects: tuple[str, ...]
    """Whose shapes it saw."""
    left_out: tuple[str, ...]
    """Objects that it was not to see."""
    error_m: float
    """Mean distance of the fingertips from the stored ones', on objects held out in turn. The
    penalty was chosen by the same figure, which flatters it a little."""
    mean_hand_error_m: float
    """The same of the mean vector of the other objects, which knows nothing of the shape."""

    def expected(self, code: np.ndarray) -> np.ndarray:
        """Return the mean vector (D,) for an object's code (B,)."""
        return self.mean + (code - self.code_mean) @ self.slope

    def sample(self, code: np.ndarray, count: int, seed: int = 0) -> np.ndarray:
        """Return vectors (count, D): the mean one, then random ones; the same for a seed."""
        noise = torch.randn(
            (count, len(self.factor)), generator=torch_stream(seed, "predict"), dtype=torch.float64
        ).numpy()
        noise[0] = 0.0
        return self.expected(code) + noise @ self.factor


def example(scene: Scene, qpos: np.ndarray) -> Example | None:
    """Return a pre-grasp qpos (nq,) as an example, or None if the object does not lie free.

    A door's pose is no choice of a hand's, and its centre is not where it is held.
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
    progress: Progress | None = None,
    penalties: Sequence[float] = PENALTIES,
) -> Predictor:
    """Fit a predictor.

    Args:
        examples: of one hand.
        frame: of that hand, in any scene.
        left_out: objects that were left out of the examples, to be remembered.
        progress: told about penalties tried.
        penalties: to choose from; infinity is the mean vector, whatever the object.

    Raises:
        ConfigError: there are examples of too few objects.
    """
    objects = sorted({e.object for e in examples})
    if len(objects) < LEAST_OBJECTS:
        raise ConfigError(
            f"{len(examples)} pre-grasps of {len(objects)} objects with hand "
            f"'{frame.scene.hand.name}': at least {LEAST_OBJECTS} objects are needed to predict "
            "for another"
        )
    anchor = np.mean([frame.fingertips_in_palm(e.vector[JOINTS]).mean(0) for e in examples], axis=0)
    frame = GraspFrame(frame.scene, anchor)
    codes = np.stack([e.code for e in examples])
    vectors = np.stack([anchored(e.vector, anchor) for e in examples])
    found: dict[float, tuple[float, np.ndarray]] = {}  # penalty -> mean error, errors (n, D)
    tried = list(dict.fromkeys((*penalties, np.inf)))
    for i, penalty in enumerate(tried):
        predicted = np.empty_like(vectors)
        for held, rest in folds(examples):
            predicted[held] = _Ridge(codes[rest], vectors[rest], penalty).at(codes[held])
        away = [off(frame, v, e) for v, e in zip(predicted, examples, strict=True)]
        found[penalty] = float(np.mean(away)), vectors - predicted
        if progress is not None:
            progress(i + 1, len(tried))
    best = min(penalties, key=lambda penalty: found[penalty][0])
    error, errors = found[best]
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
        error_m=error,
        mean_hand_error_m=found[np.inf][0],
    )


def anchored(vector: np.ndarray, anchor: np.ndarray) -> np.ndarray:
    """Return a palm's vector (9+J,) with its position that of a point (3,) m in its frame."""
    moved = vector.copy()
    moved[POSITION] += rotation_of(vector[ROTATION]) @ anchor
    return moved


def folds(examples: Sequence[Example]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield for each object which examples are of it, and which are not, (n,) bool each."""
    names = np.array([e.object for e in examples])
    for name in sorted(set(names.tolist())):
        yield names == name, names != name


def off(frame: GraspFrame, vector: np.ndarray, example: Example) -> float:
    """Return the mean distance of the fingertips of a vector from an example's, m."""
    away = frame.fingertips_of(vector) - example.fingertips
    return float(np.linalg.norm(away, axis=1).mean())


class _Ridge:
    """Linear least squares with a penalty on the slope; infinite, it is the mean.

    Args:
        codes: (n, B).
        vectors: (n, D).
        penalty: with codes scaled to a total variance of 1.
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
        """Return the vectors (m, D) at codes (m, B)."""
        return self.mean + (codes - self.code_mean) @ self.slope
