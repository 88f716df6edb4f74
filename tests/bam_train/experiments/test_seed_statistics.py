"""Statistics of a few runs against numbers that were computed by hand."""

from __future__ import annotations

import numpy as np
import pytest

from bam_train.evaluation import wilson_interval
from bam_train.experiments.seed_statistics import (
    Interval,
    bands,
    coverage,
    difference,
    estimate,
    improvement,
    interquartile_mean,
    profile,
)


@pytest.mark.parametrize(
    ("values", "mean"),
    [
        ([3.0, 1.0], 2.0),
        ([9.0, 1.0, 2.0], 4.0),
        ([0.0, 1.0, 3.0, 100.0], 2.0),
        ([5.0, 4.0, 3.0, 2.0, 1.0], 3.0),
        ([0.0, 0.0, 1.0, 2.0, 3.0, 4.0, 50.0, 60.0], 2.5),
        ([1.0, 2.0, 3.0, np.inf], 2.5),
        ([1.0, 2.0, np.inf], np.inf),
    ],
)
def test_the_middle_half_counts(values, mean):
    assert interquartile_mean(np.array(values)) == mean


def test_fewer_than_three_seeds_have_no_interval():
    assert estimate([1.0, 2.0]) == Interval(1.5)
    assert improvement(np.array([1.0, 2.0]), np.array([0.0, 0.0]), True) is None
    assert difference(np.array([3.0, 4.0]), np.array([1.0, 1.0]), False) == Interval(2.5)


def test_an_interval_is_that_of_the_bootstrap_made_wider():
    """Of three values all 27 samples are equally likely: 1 in 27 is the least value alone, and more than 2.5 %."""
    found = estimate([0.0, 1.0, 5.0])
    assert (found.value, found.low, found.high) == pytest.approx((2.0, 2.0 - 2.84 * 2.0, 2.0 + 2.84 * 3.0))
    assert estimate([0.0, 1.0, 5.0], within=(0.0, 5.0)) == Interval(2.0, 0.0, 5.0)
    assert estimate([7.0] * 5) == Interval(7.0, 7.0, 7.0)
    assert estimate([1.0, np.inf, np.inf]) == Interval(np.inf)


def test_seeds_that_are_matched_have_the_same_luck():
    luck = np.array([0.0, 10.0, 20.0, 30.0, 40.0])
    matched = difference(luck + 1.0, luck, True)
    assert matched == Interval(1.0, 1.0, 1.0)
    unmatched = difference(luck + 1.0, luck, False)
    assert unmatched.value == 1.0
    assert unmatched.low < -10.0 < 10.0 < unmatched.high


def test_probability_of_improvement():
    values, others = np.array([1.0, 2.0, 3.0]), np.array([1.0, 0.0, 4.0])
    assert improvement(values, others, True) == Interval(0.5, *wilson_interval(1.5, 3))
    # All nine pairs: 1 = 1, 1 > 0, 2 > 1, 2 > 0, 3 > 1, 3 > 0 and three losses
    found = improvement(values, others, False)
    assert found.value == pytest.approx(5.5 / 9)
    assert (found.low, found.high) == pytest.approx(wilson_interval(3 * 5.5 / 9, 3))


def test_bands_and_profiles():
    curves = np.array([[0.0, 1.0], [0.0, 2.0], [0.0, 3.0]])
    middle, low, high = bands(curves)
    assert middle.tolist() == [0.0, 2.0]
    assert (low[0], high[0]) == (0.0, 0.0)
    assert low[1] < 1.0 < 3.0 < high[1]
    assert profile(np.array([0.2, 0.5, 0.9]), np.array([0.0, 0.2, 0.5, 1.0])).tolist() == [1.0, 2 / 3, 1 / 3, 0.0]


@pytest.mark.parametrize("seeds", [3, 5])
def test_intervals_hold_the_truth(seeds):
    """300 draws: a share of 95 % has a standard deviation of 1.3 %."""
    held = coverage(seeds, draws=300, seed=1)
    assert held.keys() == {"normal", "uniform", "skewed", "difference"}
    assert all(0.91 <= share <= 0.99 for share in held.values()), held
