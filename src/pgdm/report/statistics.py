"""Statistics over few runs of many tasks, as Agarwal et al. define them.

"Deep Reinforcement Learning at the Edge of the Statistical Precipice", NeurIPS 2021: interquartile
mean, stratified bootstrap, performance profile (section 4.2), probability of improvement (4.3).
Scores are given as one array a task, with one number a run; tasks may differ in their runs.
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
    """A number and its confidence interval; NaN bounds where no task has two runs."""

    value: float
    low: float
    high: float


def interquartile_mean(values: Array) -> Array:
    """Return the mean of the middle half along the last axis; a quarter is cut off each end."""
    size = values.shape[-1]
    cut = size // 4
    return np.sort(values, axis=-1)[..., cut : size - cut].mean(axis=-1)


def resampled(scores: Scores, rng: np.random.Generator, draws: int = DRAWS) -> list[Array]:
    """Return ``draws`` stratified bootstrap samples: each task's runs drawn anew from its own.

    Returns:
        One array a task, (draws, runs of the task).
    """
    return [task[rng.integers(len(task), size=(draws, len(task)))] for task in scores]


def iqm(scores: Scores, seed: int = 0) -> Estimate:
    """Return the interquartile mean over all runs of all tasks."""
    drawn = np.concatenate(resampled(scores, np.random.default_rng(seed)), axis=-1)
    value = float(interquartile_mean(np.concatenate(list(scores))))
    return _estimate(value, interquartile_mean(drawn), scores)


def mean(scores: Scores, seed: int = 0) -> Estimate:
    """Return the mean over tasks of each task's mean over its runs, as the paper averages."""
    drawn = resampled(scores, np.random.default_rng(seed))
    value = float(np.mean([task.mean() for task in scores]))
    return _estimate(value, np.mean([task.mean(axis=-1) for task in drawn], axis=0), scores)


def profile(scores: Scores, thresholds: Array, seed: int = 0) -> list[Estimate]:
    """Return for each threshold the share of runs that score above it; all tasks weigh the same."""
    drawn = resampled(scores, np.random.default_rng(seed))

    def share(tasks: Scores, threshold: float) -> Array:
        return np.mean([(task > threshold).mean(axis=-1) for task in tasks], axis=0)

    return [_estimate(float(share(scores, t)), share(drawn, t), scores) for t in thresholds]


def improvement(x: Scores, y: Scores, seed: int = 0) -> Estimate:
    """Return the probability that a run of ``x`` beats one of ``y`` on a task drawn at random.

    Ties count half. Both have the same tasks in the same order.
    """
    rng = np.random.default_rng(seed)
    drawn = zip(resampled(x, rng), resampled(y, rng), strict=True)
    value = float(np.mean([_beats(a, b) for a, b in zip(x, y, strict=True)]))
    return _estimate(value, np.mean([_beats(a, b) for a, b in drawn], axis=0), [*x, *y])


def _beats(a: Array, b: Array) -> Array:
    """Return the share of pairs in which ``a`` is larger, over the last axis of each."""
    left, right = a[..., :, None], b[..., None, :]
    return ((left > right) + 0.5 * (left == right)).mean(axis=(-2, -1))


def _estimate(value: float, drawn: Array, scores: Scores) -> Estimate:
    if max(len(task) for task in scores) < 2:
        return Estimate(value, np.nan, np.nan)  # drawing one of one says nothing about chance
    low, high = np.quantile(drawn, [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Estimate(value, float(low), float(high))
