from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from pgdm.report.statistics import improvement, interquartile_mean, iqm, mean, profile, resampled


def tasks(*rows: list[float]) -> list[np.ndarray]:
    return [np.array(row) for row in rows]


@pytest.mark.parametrize(
    ("values", "expected"),
    [
        # The two examples of Wikipedia's "Interquartile mean".
        ([5, 8, 4, 38, 8, 6, 9, 7, 7, 3, 1, 6], 6.5),
        ([1, 3, 5, 7, 9, 11, 13, 15, 17], 9.0),
        ([0.0, 0.2, 0.4, 1.0], 0.3),
        ([0.7], 0.7),
        ([0.2, 0.4, 0.9], 0.5),  # a quarter of three is less than one: nothing is cut
    ],
)
def test_interquartile_mean_by_hand(values: list[float], expected: float) -> None:
    assert interquartile_mean(np.array(values)) == pytest.approx(expected)


def test_interquartile_mean_is_scipys_trimmed_mean() -> None:
    rng = np.random.default_rng(0)
    for size in range(1, 40):
        values = rng.random((3, size))
        trimmed = stats.trim_mean(values, 0.25, axis=-1)
        np.testing.assert_allclose(interquartile_mean(values), trimmed)


def test_iqm_is_over_all_runs_of_all_tasks() -> None:
    assert iqm(tasks([0.0, 0.2], [0.4, 1.0])).value == pytest.approx(0.3)


def test_each_task_is_resampled_from_its_own_runs() -> None:
    drawn = resampled(tasks([1, 2], [10, 20, 30]), np.random.default_rng(0), draws=500)
    assert [sample.shape for sample in drawn] == [(500, 2), (500, 3)]
    assert [set(sample.ravel()) for sample in drawn] == [{1, 2}, {10, 20, 30}]


def test_interval_by_hand() -> None:
    # Two runs drawn from {0, 1}: mean 0, 1/2, 1 with chance 1/4, 1/2, 1/4.
    assert iqm(tasks([0.0, 1.0])) == (0.5, 0.0, 1.0)
    # A second task that never changes moves all by half: the average of tasks.
    assert mean(tasks([0.0, 1.0], [1.0, 1.0])) == (0.75, 0.5, 1.0)


def test_interval_is_near_scipys() -> None:
    values = np.random.default_rng(1).normal(0.6, 0.1, 40)
    theirs = stats.bootstrap(
        (values,), interquartile_mean, method="percentile", rng=np.random.default_rng(2)
    ).confidence_interval
    ours = iqm([values])
    assert ours.low == pytest.approx(theirs.low, abs=0.006)
    assert ours.high == pytest.approx(theirs.high, abs=0.006)


def test_same_seed_same_interval() -> None:
    scores = [np.random.default_rng(0).random(30)]
    assert iqm(scores, seed=3) == iqm(scores, seed=3)
    assert iqm(scores, seed=3) != iqm(scores, seed=4)


def test_one_run_a_task_has_no_interval() -> None:
    value, low, high = iqm(tasks([0.2], [0.4]))
    assert value == pytest.approx(0.3)
    assert np.isnan([low, high]).all()


def test_profile_by_hand() -> None:
    # First task: 3 runs, second: 1 run; both weigh the same; "above" excludes equal.
    scores = tasks([0.2, 0.5, 0.9], [0.5])
    shares = [e.value for e in profile(scores, np.array([0.0, 0.2, 0.5, 0.9]))]
    assert shares == pytest.approx([1.0, (2 / 3 + 1) / 2, (1 / 3 + 0) / 2, 0.0])


def test_improvement_by_hand() -> None:
    # Pairs (1 > 0), (1 > 2 is false), (3 > 0), (3 > 2): 3 of 4.
    assert improvement(tasks([1, 3]), tasks([0, 2])).value == 0.75
    # Ties are halves, and the tasks' shares are averaged: (1/2 + 1) / 2.
    assert improvement(tasks([1.0], [5.0]), tasks([1.0], [2.0])).value == 0.75
    same = tasks([0.1, 0.4, 0.4])
    assert improvement(same, same).value == 0.5


def test_improvement_is_mann_whitneys_u() -> None:
    # Wikipedia's tortoises and hares, THHHHHTTTTTH: of 36 pairs a hare is first in 25.
    order = "THHHHHTTTTTH"
    place = {a: [-i for i, animal in enumerate(order) if animal == a] for a in "TH"}
    assert improvement(tasks(place["H"]), tasks(place["T"])).value == pytest.approx(25 / 36)
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 5, 12).astype(float), rng.integers(0, 5, 9).astype(float)
    u = stats.mannwhitneyu(x, y).statistic
    assert improvement([x], [y]).value == pytest.approx(u / (12 * 9))
