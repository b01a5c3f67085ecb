"""Statistics over a few runs of many tasks, as Agarwal et al. define them.

"Deep Reinforcement Learning at the Edge of the Statistical Precipice", NeurIPS 2021: interquartile
mean, stratified bootstrap, performance profile (Sec. 4.2), probability of improvement (Sec. 4.3).
Scores are an array x_m for each task m = 1..M, with a value x_mn for each of its N_m runs.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Scores = Sequence[Array]

DRAWS = 2000
LEVEL = 0.95


class Estimate(NamedTuple):
    """A value and its confidence interval; the bounds are NaN if no task has two runs."""

    value: float
    low: float
    high: float


def interquartile_mean(values: Array) -> Array:
    """Sort along the last axis, of size n, and return the mean without n//4 values at each end."""
    size = values.shape[-1]
    cut = size // 4
    return np.sort(values, axis=-1)[..., cut : size - cut].mean(axis=-1)


def resampled(scores: Scores, rng: np.random.Generator, draws: int = DRAWS) -> list[Array]:
    """Return stratified bootstrap samples: each task's runs are resampled with replacement.

    Returns:
        An array for each task, (draws, N_m).
    """
    return [task[rng.integers(len(task), size=(draws, len(task)))] for task in scores]


def iqm(scores: Scores, seed: int = 0) -> Estimate:
    """Return the interquartile mean over all runs of all tasks."""
    drawn = np.concatenate(resampled(scores, np.random.default_rng(seed)), axis=-1)
    value = float(interquartile_mean(np.concatenate(list(scores))))
    return _estimate(value, interquartile_mean(drawn), scores)


def mean(scores: Scores, seed: int = 0) -> Estimate:
    """Return the paper's average, 1/M sum_m 1/N_m sum_n x_mn."""
    drawn = resampled(scores, np.random.default_rng(seed))
    value = float(np.mean([task.mean() for task in scores]))
    return _estimate(value, np.mean([task.mean(axis=-1) for task in drawn], axis=0), scores)


def profile(scores: Scores, thresholds: Array, seed: int = 0) -> list[Estimate]:
    """Return the share of runs above each threshold t, F(t) = 1/M sum_m 1/N_m sum_n [x_mn > t]."""
    drawn = resampled(scores, np.random.default_rng(seed))

    def share(tasks: Scores, threshold: float) -> Array:
        return np.mean([(task > threshold).mean(axis=-1) for task in tasks], axis=0)

    return [_estimate(float(share(scores, t)), share(drawn, t), scores) for t in thresholds]


def improvement(x: Scores, y: Scores, seed: int = 0) -> Estimate:
    """Return the probability that a run of ``x`` beats a run of ``y`` on a random task.

    1/M sum_m 1/(N_m K_m) sum_n sum_k ([x_mn > y_mk] + [x_mn = y_mk] / 2), where ``x`` and ``y``
    have the same tasks in the same order.
    """
    rng = np.random.default_rng(seed)
    drawn = zip(resampled(x, rng), resampled(y, rng), strict=True)
    value = float(np.mean([_beats(a, b) for a, b in zip(x, y, strict=True)]))
    return _estimate(value, np.mean([_beats(a, b) for a, b in drawn], axis=0), [*x, *y])


def _beats(a: Array, b: Array) -> Array:
    """Return the share of pairs in which ``a`` is larger, ties as halves, over the last axes."""
    left, right = a[..., :, None], b[..., None, :]
    return ((left > right) + 0.5 * (left == right)).mean(axis=(-2, -1))


def _estimate(value: float, drawn: Array, scores: Scores) -> Estimate:
    if max(len(task) for task in scores) < 2:
        return Estimate(value, np.nan, np.nan)  # a single run has no spread to resample
    low, high = np.quantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Estimate(value, float(low), float(high))
