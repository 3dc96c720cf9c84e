"""Limits: known values, coverage on simulations with fixed seeds, ends."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.interval_coverage import design, detection_coverage, mean_coverage, share_coverage
from ssad.metrics.intervals import (
    Clusters,
    bounded_limits,
    mean_limits,
    replicate_limits,
    share_limits,
    t_quantile,
)


def test_student_quantiles():
    # any table of Student's distribution
    found = t_quantile([1, 2, 4, 7, 31, 149])
    np.testing.assert_allclose(found, [12.70620, 4.30265, 2.77645, 2.36462, 2.03951, 1.97601], atol=1e-5)


def test_shares_at_the_ends_are_clopper_and_pearsons():
    # Clopper and Pearson (1934) for 0 and 1 of 10
    low, high = share_limits([0.0, 0.1, 1.0], 10)
    np.testing.assert_allclose(low, [0.0, 0.00253, 0.69150], atol=1e-5)
    np.testing.assert_allclose(high, [0.30850, 0.44502, 1.0], atol=1e-5)


def test_many_events_join_the_score_limits_without_a_step():
    n = np.array([998.0, 1002.0]) * 2
    low, high = share_limits(0.5, n)
    assert low[1] - low[0] == pytest.approx(high[0] - high[1])
    assert 0 < low[1] - low[0] < 1e-4


@pytest.mark.parametrize("n", [5, 8, 12, 20, 32, 80, 150])
def test_exact_coverage_of_shares_of_independent_cases(n):
    # every share, every outcome: nothing is drawn
    k = np.arange(n + 1.0)
    low, high = share_limits(k / n, n)
    p = np.linspace(0.0005, 0.9995, 1999)
    chance = np.array([math.comb(n, int(i)) * p**i * (1 - p) ** (n - i) for i in k])
    held = (chance * ((low[:, None] <= p) & (p <= high[:, None]))).sum(axis=0)
    assert held.min() > 0.93
    middle = held[(p > 0.25) & (p < 0.75)]
    assert middle.mean() < 0.965 or n < 32


@pytest.mark.parametrize(
    ("share", "clusters", "cases", "correlation"),
    [
        (0.05, 32, 10, 0.8),
        (0.05, 32, 10, 0.3),
        (0.3, 5, 10, 0.8),
        (0.5, 5, 10, 0.0),
        (0.01, 8, 4, 0.3),
        (0.8, 8, 4, 0.3),
        (0.5, 150, 3, 1.0),
        (0.95, 150, 3, 0.8),
    ],
)
def test_coverage_of_shares_in_clusters(share, clusters, cases, correlation):
    held = share_coverage(share, design(clusters, cases), correlation, 1500)
    assert held > 0.93
    if clusters > 30 and 0.1 < share < 0.9:
        assert held < 0.975


@pytest.mark.parametrize("shares", [[0.05] * 8, [0.5] * 8, [0.2, 0.8] * 4, [0.1, 1.0] * 4])
@pytest.mark.parametrize(("cases", "correlation"), [(1, 0.0), (10, 0.3), (10, 1.0)])
def test_coverage_of_the_average_of_eight_groups(shares, cases, correlation):
    held = share_coverage(np.repeat(shares, 4), design(4, cases, 8), correlation, 1000)
    assert held > 0.93
    if shares == [0.5] * 8:
        assert held < 0.975


@pytest.mark.parametrize("name", ["RC, 10 % below 1", "RC, 40 % below 1", "OR, 60 % zeros", "TS, normal"])
@pytest.mark.parametrize(
    ("layout", "correlation"), [(design(32, 1), 0.0), (design(32, 10), 0.3), (design(4, 1, 8), 0.0)]
)
def test_coverage_of_means(name, layout, correlation):
    held, given_ = mean_coverage(name, layout, correlation, 1000)
    assert held > 0.93
    assert given_ > 0.9


@pytest.mark.parametrize("scenes", [24, 150])
def test_coverage_of_average_precision(scenes):
    assert detection_coverage(scenes, 0.5, 0.1, 200) > 0.92


def test_clusters_that_are_all_zero_or_all_one_have_width():
    layout = design(4, 10, 8)
    for value in (0.0, 10.0):
        found = bounded_limits(np.full(32, value), layout, cap=640.0)
        assert found.high - found.low > 0.08
    # and so has their average where some groups are all 0 and the others all 1
    found = bounded_limits(np.repeat([0.0, 10.0] * 4, 4), layout, cap=640.0)
    assert found.mean == 0.5
    assert found.high - found.low > 0.15


def test_alike_cases_do_not_narrow_an_interval():
    # ten alike cases a cluster are worth one
    random = np.random.Generator(np.random.Philox(1))
    one = (random.random(20) < 0.4).astype(float)
    alone = bounded_limits(one, design(20, 1), cap=40.0)
    ten = bounded_limits(10 * one, design(20, 10), cap=400.0)
    assert ten.high - ten.low > 0.95 * (alone.high - alone.low)
    values = random.exponential(size=20)
    first, second = mean_limits(values, design(20, 1)), mean_limits(10 * values, design(20, 10))
    assert (first.low, first.high) == (pytest.approx(second.low), pytest.approx(second.high))


def test_a_mean_needs_eight_clusters_that_differ():
    values = np.array([0.0] * 30 + [1.0, 2.0, 0.5, 3.0, 0.25, 1.5, 4.0])
    assert math.isnan(mean_limits(values, design(37, 1)).low)
    values[0] = 2.5
    assert mean_limits(values, design(37, 1)).low < values.mean() < mean_limits(values, design(37, 1)).high
    assert math.isnan(mean_limits(np.full(20, 7.0), design(20, 1)).low)


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_student_limits_move_and_scale_with_the_data(seed):
    values = np.random.Generator(np.random.Philox(seed)).exponential(size=24)
    base, other = mean_limits(values, design(6, 1, 4)), mean_limits(7.0 - 3.0 * values, design(6, 1, 4))
    assert other.high == pytest.approx(7.0 - 3.0 * base.low)
    assert other.low == pytest.approx(7.0 - 3.0 * base.high)


def test_bounded_limits_are_mirrored_with_the_data():
    values = np.random.Generator(np.random.Philox(5)).beta(5, 1, size=24)
    base, other = bounded_limits(values, design(6, 1, 4)), bounded_limits(1.0 - values, design(6, 1, 4))
    assert (other.low, other.high) == (pytest.approx(1.0 - base.high), pytest.approx(1.0 - base.low))


def test_a_group_of_one_cluster_borrows_from_the_others():
    layout = Clusters(np.ones(9), np.array([0] * 8 + [1]))
    found = bounded_limits(np.array([1.0, 0, 0, 1, 0, 1, 0, 0, 1]), layout, cap=18.0)
    assert found.mean == pytest.approx((3 / 8 + 1) / 2)
    assert found.low < 0.5
    assert found.high > 0.85
    # groups of one cluster each are as uncertain as clusters of one group
    values = np.array([1.0, 0, 1, 0, 1, 0, 0, 1])
    apart = bounded_limits(values, Clusters(np.ones(8), np.arange(8)), cap=16.0)
    together = bounded_limits(values, design(8, 1), cap=16.0)
    assert (apart.low, apart.high) == (pytest.approx(together.low), pytest.approx(together.high))


def test_replicates_of_few_clusters_are_widened():
    value, variance = np.asarray(0.4), np.asarray(0.01**2)
    widths = [np.subtract(*replicate_limits(value, variance, c, bounded=True)[::-1]) for c in (5, 24, 1000)]
    assert widths[0] > widths[1] > widths[2]
    assert widths[2] == pytest.approx(2 * 1.96 * 0.01, rel=0.02)
    low, high = replicate_limits(np.asarray(1.2), variance, 1000, bounded=False)
    assert low * high == pytest.approx(1.44)
    assert (low, high) == (pytest.approx(1.2 - 0.0196, abs=3e-4), pytest.approx(1.2 + 0.0196, abs=3e-4))
    assert replicate_limits(np.asarray(0.0), np.asarray(0.0), 24, bounded=True)[1] > 0.1
