"""Limits: known values, coverage on simulations with fixed seeds, ends."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from benchmarks.interval_coverage import (
    correlation_of,
    counts,
    design,
    detection_coverage,
    mean_coverage,
    natural_sizes,
    route_layout,
    route_result,
    share_coverage,
)
from ssad.metrics.intervals import (
    Clusters,
    bounded_limits,
    mean_limits,
    replicate_limits,
    share_limits,
    t_quantile,
)

NATURAL = natural_sizes()


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


@pytest.mark.parametrize(
    ("routes", "design_effect", "shares"),
    [
        (10, 6.4, (0.18,)),
        (10, 6.4, (0.24,)),
        (15, 6.4, (0.1,)),
        (20, 5.1, (0.1,)),
        (38, 4.0, (0.06,)),
        (38, 4.0, (0.02,)),
        (15, 2.5, (0.5,)),
        (10, 4.0, (0.3, 0.1)),
        (38, 2.5, (0.05, 0.02)),
        (20, 6.4, (0.5, 0.3)),
    ],
)
def test_intervals_hold_on_routes_and_are_not_much_wider_than_necessary(routes, design_effect, shares):
    """Without room for clusters that are more alike than those seen, the first would hold in 92 %."""
    found = route_result(shares, route_layout(routes, NATURAL), design_effect, 4000)
    assert found is not None
    assert found.coverage > 0.93
    assert 0.9 < found.width < 1.5


def test_routes_of_the_simulation_have_the_correlation_that_makes_the_design_effect():
    layout = route_layout(38, NATURAL)
    assert (NATURAL.sum(), len(NATURAL)) == (150, 38)
    assert route_result((0.1,), layout, 6.4, 10) is None, "cases all alike make less"
    random = np.random.Generator(np.random.Philox(2))
    first, second = counts(random, 20_000, (0.3, 0.1), layout, correlation_of(4.0, layout))
    difference = (first - second).sum(axis=1) / 150
    assert difference.mean() == pytest.approx(0.2, abs=0.005)
    assert difference.var() / ((0.4 - 0.2**2) / 150) == pytest.approx(4.0, rel=0.05)


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


# ---------------------------------------------------------------- the formulas, one cluster after the other


def by_hand(sums, size, stratum, assumed=None):
    """Mean, variance, degrees of freedom, skewness, and the part of each cluster, without arrays."""
    strata = sorted(set(stratum))
    cases = {h: sum(n for n, g in zip(size, stratum, strict=True) if g == h) for h in strata}
    total = {h: sum(x for x, g in zip(sums, stratum, strict=True) if g == h) for h in strata}
    count = {h: stratum.count(h) for h in strata}
    mean = sum(total[h] / cases[h] for h in strata) / len(strata)
    merged = min(count.values()) < 2
    parts = []
    for k, (x, n, h) in enumerate(zip(sums, size, stratum, strict=True)):
        weight = n / cases[h] / len(strata)
        part = (x / n - (mean if merged else total[h] / cases[h])) * weight
        if assumed is not None and assumed[k] is not None:
            part = assumed[k] * weight
        parts.append((part, len(size) if merged else count[h]))
    variance = sum(p**2 * m / (m - 1) for p, m in parts)
    most = len(size) - 1 if merged else sum(m - 1 for m in count.values())
    square, fourth = sum(p**2 for p, _ in parts), sum(p**4 for p, _ in parts)
    kurtosis = len(size) * fourth / square**2
    freedom = min(max(2 * len(size) / (kurtosis - 1), 1), most)
    skew = sum(p**3 * m**2 / ((m - 1) * (m - 2)) for p, m in parts) / variance**1.5
    return mean, variance, freedom, skew, [p for p, _ in parts]


def layout_of(size, stratum):
    return Clusters(np.array(size, float), np.array(stratum))


DESIGNS = {
    "one group": ([3, 1, 2, 2, 5, 1, 1, 4, 2, 3, 1, 2], [0] * 12),
    "two groups": ([3, 1, 2, 2, 5, 1, 1, 4, 2, 3, 1, 2], [0] * 5 + [1] * 7),
    "three groups": ([1, 2, 1, 2, 1, 2, 1, 2, 1, 2, 1, 2], [0, 1, 2] * 4),
    "a group of one cluster": ([3, 1, 2, 2, 5, 1, 1, 4, 2, 3, 1, 2], [0] * 4 + [1] * 7 + [2]),
}


@pytest.mark.parametrize("name", DESIGNS)
@pytest.mark.parametrize("seed", range(4))
def test_student_limits_are_those_of_the_formulas(name, seed):
    size, stratum = DESIGNS[name]
    values = np.random.Generator(np.random.Philox(seed)).exponential(size=12) ** (1 + seed)
    sums = values * np.array(size) * (-1.0 if seed % 2 else 1.0)
    mean, variance, freedom, skew, parts = by_hand(sums.tolist(), size, stratum)
    t = stats.t.ppf(0.975, freedom)
    error = math.sqrt(variance)
    tail = skew * (2 * t**2 + 1) / 6 * error
    found = mean_limits(sums, layout_of(size, stratum))
    assert (found.mean, found.method) == (pytest.approx(mean), "t")
    assert found.low == pytest.approx(mean - t * error + min(tail, 0.0) + 0.3 * min(parts))
    assert found.high == pytest.approx(mean + t * error + max(tail, 0.0) + 0.3 * max(parts))


@pytest.mark.parametrize("name", DESIGNS)
@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("cap", [math.inf, 30.0])
def test_bounded_limits_are_those_of_the_formulas(name, seed, cap):
    size, stratum = DESIGNS[name]
    values = np.random.Generator(np.random.Philox(seed)).beta(5.0, 1.0 + seed, size=12)
    # shares vary more than what lies in between, so that the cap does not hide the formula
    values = np.where(np.isfinite(cap), np.round(values - 0.2), values)
    values[0] = 0.5
    sums = values * np.array(size)
    mean, variance, freedom, _, parts = by_hand(sums.tolist(), size, stratum)
    layout = layout_of(size, stratum)
    inverse, greatest = variance / (mean * (1 - mean)), sum(layout.weight**2)
    if math.isfinite(cap):
        active = sum(p**2 for p in parts) ** 2 / sum(p**4 for p in parts)
        inverse = (active * inverse + 0.1 * greatest) / (active + 0.1)
    effective = (stats.norm.ppf(0.975) / stats.t.ppf(0.975, freedom)) ** 2 / inverse
    effective = min(max(effective, 1 / greatest), cap)
    found = bounded_limits(sums, layout, cap=cap)
    low, high = share_limits(mean, effective)
    assert (found.mean, found.low, found.high) == (pytest.approx(mean), pytest.approx(low), pytest.approx(high))
    assert found.method == "beta"


@pytest.mark.parametrize("name", ["two groups", "three groups", "a group of one cluster"])
@pytest.mark.parametrize("end", [0.0, 1.0])
def test_a_group_at_an_end_is_taken_to_vary_by_half_an_event(name, end):
    size, stratum = DESIGNS[name]
    values = np.random.Generator(np.random.Philox(9)).beta(2.0, 2.0, size=12)
    group = np.array(stratum)
    merged = name == "a group of one cluster"
    # a group of one cluster joins the others, so only all groups together can be at an end
    values[group == 0 if not merged else group >= 0] = end
    count = {h: len(size) if merged else stratum.count(h) for h in stratum}
    share = {h: 0.5 / (count[h] + 1) for h in count}
    deviation = {h: math.sqrt(share[h] * (1 - share[h]) * (count[h] - 1) / count[h]) for h in count}
    at_end = [deviation[h] if merged or h == 0 else None for h in stratum]
    sums = values * np.array(size)
    mean, variance, freedom, _, _ = by_hand(sums.tolist(), size, stratum, at_end)
    effective = mean * (1 - mean) / variance * (stats.norm.ppf(0.975) / stats.t.ppf(0.975, freedom)) ** 2
    layout = layout_of(size, stratum)
    effective = max(effective, 1 / sum(layout.weight**2))
    low, high = share_limits(mean, effective)
    found = bounded_limits(sums, layout)
    assert (found.low, found.high) == (pytest.approx(low), pytest.approx(high))


def test_independent_cases_are_counted_and_not_estimated():
    values = np.array([1.0, 0, 0, 1, 0, 0, 0, 0, 1, 0])
    found = bounded_limits(values, design(10, 1), cap=20.0)
    assert (found.low, found.high) == tuple(share_limits(0.3, 10.0))
    # whole clusters are not independent cases, nor is what lies between 0 and 1
    assert bounded_limits(2 * values, design(10, 2), cap=40.0).high != share_limits(0.3, 20.0)[1]
    assert bounded_limits(values, design(10, 1)).high != share_limits(0.3, 10.0)[1]


def test_values_that_do_not_vary():
    inside = bounded_limits(np.full(10, 0.4), design(10, 1))
    assert (inside.mean, math.isnan(inside.low), math.isnan(inside.high)) == (pytest.approx(0.4), True, True)
    capped = bounded_limits(np.full(10, 0.8), design(10, 2), cap=40.0)  # shares of two cases, all alike
    assert (capped.low, capped.high) == tuple(map(pytest.approx, share_limits(0.4, 40.0)))
    # several data sets at once: each for itself
    both = bounded_limits(np.array([np.full(10, 0.4), np.linspace(0, 1, 10)]), design(10, 1))
    assert np.isnan(both.low).tolist() == [True, False]


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e9])
def test_rounding_is_no_spread(scale):
    noise = 1.0 + 1e-15 * np.arange(20)
    assert math.isnan(mean_limits(scale * noise, design(20, 1)).low)
    real = scale * (1.0 + 1e-7 * np.arange(20))
    assert mean_limits(real, design(20, 1)).low < real.mean()


def test_clusters_that_all_differ_are_all_counted():
    values = np.arange(8.0)
    assert not math.isnan(mean_limits(values, design(8, 1)).low)
    assert math.isnan(mean_limits(np.arange(7.0), design(7, 1)).low)
    # two alike: six differ from them
    assert math.isnan(mean_limits(np.array([0.0, 0, 1, 2, 3, 4, 5, 6]), design(8, 1)).low)
    # alike is what agrees to a billionth
    assert math.isnan(mean_limits(np.array([5.0, 5.0 + 1e-10, 1, 2, 3, 4, 6, 7]), design(8, 1)).low)
    assert not math.isnan(mean_limits(np.array([5.0, 5.0 + 1e-7, 1, 2, 3, 4, 6, 7]), design(8, 1)).low)


@pytest.mark.parametrize(
    ("share", "n"), [(0.3, 10.0), (0.25, 6.0), (0.5, 3.0), (0.02, 800.0), (0.98, 800.0), (0.5, 1000.0), (0.123, 57.3)]
)
def test_limits_of_a_share_are_quantiles(share, n):
    """Half-way between Clopper and Pearson's parameters and Jeffreys' from two events on; from one to two between."""
    events, rest = share * n, (1 - share) * n
    a = 0.25 * min(max(min(events, rest) - 1.0, 0.0), 1.0)
    low, high = share_limits(share, n)
    assert stats.beta.cdf(low, events + a, rest + 1 - a) == pytest.approx(0.025)
    assert stats.beta.cdf(high, events + 1 - a, rest + a) == pytest.approx(0.975)


@pytest.mark.parametrize(("share", "n"), [(0.5, 1001.0), (0.3, 5000.0), (0.999, 1e6), (0.01, 1e9)])
def test_limits_of_a_share_of_many_events_are_score_limits(share, n):
    # Wilson (1927): the shares that differ from the one seen by the normal quantile times their own deviation
    for limit in share_limits(share, n):
        assert abs(share - limit) == pytest.approx(1.959963985 * math.sqrt(limit * (1 - limit) / n), rel=1e-6)


def test_the_interval_of_a_score_is_that_of_its_replicates():
    value, variance = 0.3, 0.04**2
    for clusters in (5, 24):
        ours = variance * clusters / (clusters - 1)
        t = stats.t.ppf(0.975, clusters - 1)
        effective = max(value * (1 - value) / ours * (stats.norm.ppf(0.975) / t) ** 2, clusters)
        found = replicate_limits(np.asarray(value), np.asarray(variance), clusters, bounded=True)
        assert found == tuple(map(pytest.approx, share_limits(value, effective)))
        low, high = replicate_limits(np.asarray(value), np.asarray(variance), clusters, bounded=False)
        assert math.log(high / value) == pytest.approx(t * math.sqrt(ours) / value)
        assert math.log(value / low) == pytest.approx(t * math.sqrt(ours) / value)
    # never fewer cases than clusters, and a score that does not vary is taken to be known to a billion cases
    wide = replicate_limits(np.asarray(value), np.asarray(1.0), 24, bounded=True)
    assert wide == tuple(map(pytest.approx, share_limits(value, 24.0)))
    sure = replicate_limits(np.asarray(value), np.asarray(0.0), 24, bounded=True)
    assert sure == tuple(map(pytest.approx, share_limits(value, 1e9)))
    perfect = replicate_limits(np.asarray(1.0), np.asarray(0.0), 24, bounded=True)
    assert perfect == tuple(map(pytest.approx, share_limits(1.0, 24.0)))


def test_weights_of_clusters():
    layout = layout_of([1, 3, 2], [0, 0, 1])
    assert layout.weight.tolist() == [0.125, 0.375, 0.5]
    assert layout.member.tolist() == [[1, 0], [1, 0], [0, 1]]
