"""Intervals: known values, coverage on a seeded simulation, edge cases."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssad.metrics.uncertainty import (
    Estimate,
    cluster_estimate,
    mean_estimate,
    mean_of_estimates,
    paired_difference,
    wilson,
)


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    # statsmodels proportion_confint(method="wilson"), also in Newcombe (1998) for 81 of 263 and 15 of 148
    [
        (0, 10, 0.0, 0.27753),
        (5, 10, 0.23659, 0.76341),
        (10, 10, 0.72247, 1.0),
        (81, 263, 0.2553, 0.3662),
        (15, 148, 0.0624, 0.1605),
    ],
)
def test_wilson_known_values(successes, n, low, high):
    e = wilson(successes, n)
    assert e.mean == successes / n
    assert e.low == pytest.approx(low, abs=5e-5)
    assert e.high == pytest.approx(high, abs=5e-5)


@given(st.integers(1, 200), st.data())
def test_wilson_limits_solve_the_score_equation(n, data):
    successes = data.draw(st.integers(0, n))
    e = wilson(successes, n)
    assert 0.0 <= e.low <= e.mean <= e.high <= 1.0
    for limit in (e.low, e.high):
        if 0.0 < limit < 1.0:
            z = (e.mean - limit) / math.sqrt(limit * (1 - limit) / n)
            assert abs(z) == pytest.approx(1.959964, abs=1e-4)


def test_wilson_with_unknown_outcomes_holds_whatever_they_were():
    e = wilson(3, 12, failed=2)
    assert e.mean == 3 / 12
    assert e.low == wilson(3, 12).low
    assert e.high == wilson(5, 12).high
    assert (e.n, e.failed) == (12, 2)


def test_wilson_of_nothing_and_of_nonsense():
    assert math.isnan(wilson(0, 0).mean)
    with pytest.raises(ValueError, match="11 successes"):
        wilson(11, 10)
    with pytest.raises(ValueError, match="2 failed"):
        wilson(9, 10, failed=2)


def test_mean_edge_cases():
    empty = mean_estimate([], failed=3)
    assert math.isnan(empty.mean)
    assert (empty.n, empty.failed) == (0, 3)
    one = mean_estimate([2.5])
    assert one.mean == 2.5
    assert math.isnan(one.low)
    assert math.isnan(one.high)
    same = mean_estimate([2.0, 2.0, 2.0])
    assert (same.low, same.high, same.method) == (2.0, 2.0, "constant")
    assert mean_estimate([1.0, math.nan, 3.0]).n == 2


def test_mean_interval_does_not_depend_on_the_order():
    values = np.random.Generator(np.random.Philox(1)).normal(size=30)
    assert mean_estimate(values) == mean_estimate(values[::-1])


def test_mean_interval_moves_and_scales_with_the_data():
    values = np.random.Generator(np.random.Philox(2)).exponential(size=30)
    base, other = mean_estimate(values), mean_estimate(3.0 * values + 7.0)
    assert other.low == pytest.approx(3.0 * base.low + 7.0)
    assert other.high == pytest.approx(3.0 * base.high + 7.0)


def test_bootstrap_coverage():
    # 95 % nominal; 300 samples of 40 skewed values; the binomial standard error is 1.3 %
    rng = np.random.Generator(np.random.Philox(3))
    inside = 0
    for _ in range(300):
        e = mean_estimate(rng.exponential(size=40))
        inside += e.low <= 1.0 <= e.high
    assert 0.89 <= inside / 300 <= 0.98


def test_bootstrap_is_about_as_wide_as_the_normal_interval():
    values = np.random.Generator(np.random.Philox(4)).normal(size=200)
    e = mean_estimate(values)
    normal = 2 * 1.96 * values.std(ddof=1) / math.sqrt(200)
    assert e.high - e.low == pytest.approx(normal, rel=0.1)


def test_paired_difference_is_tighter_than_unpaired():
    rng = np.random.Generator(np.random.Philox(6))
    hard = rng.normal(size=50) * 10
    a = {str(i): float(v) for i, v in enumerate(hard + rng.normal(size=50) + 1)}
    b = {str(i): float(v) for i, v in enumerate(hard)}
    e = paired_difference(a, b)
    assert e.n == 50
    assert e.low < 1.0 < e.high
    assert e.high - e.low < 1.0 < mean_estimate(list(b.values())).high - mean_estimate(list(b.values())).low


def test_paired_difference_uses_shared_scenarios_only():
    e = paired_difference({"a": 1.0, "b": 2.0, "c": None, "d": 5.0}, {"a": 0.5, "b": 1.0, "c": 1.0, "e": 2.0})
    assert e.mean == pytest.approx(0.75)
    assert (e.n, e.failed) == (2, 3)
    assert paired_difference({"a": 1.0}, {"a": math.nan}).n == 0


def test_clusters_widen_the_interval_of_repeated_values():
    values = np.random.Generator(np.random.Philox(7)).normal(size=10)
    repeated = np.repeat(values, 8)
    clusters = np.repeat(np.arange(10), 8).tolist()
    wide, narrow = cluster_estimate(repeated, clusters), mean_estimate(repeated)
    assert wide.mean == pytest.approx(narrow.mean)
    assert wide.n == 80
    assert wide.high - wide.low > 2 * (narrow.high - narrow.low)
    assert math.isnan(cluster_estimate([1.0, 2.0], ["a", "a"]).low)
    assert math.isnan(cluster_estimate([], []).mean)


def test_mean_of_estimates():
    e = mean_of_estimates([Estimate(1.0, 0.7, 1.4, 10), Estimate(3.0, 2.6, 3.3, 20, 1)])
    assert e.mean == 2.0
    assert e.low == pytest.approx(2.0 - 0.25)
    assert e.high == pytest.approx(2.0 + 0.25)
    assert (e.n, e.failed) == (30, 1)
    nan = math.nan
    assert mean_of_estimates([Estimate(nan, nan, nan, 0, 4), Estimate(1.0, 0.5, 1.5, 3)]).mean == 1.0
    assert math.isnan(mean_of_estimates([]).mean)
