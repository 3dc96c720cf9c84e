"""CaseSample sizes: the power of SSAD's own intervals in simulations, measured flip rates, known formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.interval_coverage import counts, route_layout
from ssad.metrics import CaseValue, paired_difference
from ssad.metrics.intervals import MIN_ROUTES, Clusters, bounded_limits, difference_limits
from ssad.metrics.sample_size import (
    CaseSample,
    FlipRate,
    detectable_difference,
    flip_rate,
    necessary_clusters,
    power,
    unpaired_power,
)


def sample(clusters: float, size: float) -> CaseSample:
    return CaseSample(float(clusters), float(size), float(size))


def share_detected(shares: tuple[float, float], layout: Clusters, correlation: float, draws: int) -> float:
    """How often the interval of the difference of two shares leaves out 0."""
    random = np.random.Generator(np.random.Philox(7))
    events = counts(random, draws, shares, layout, max(correlation, 1e-9))
    low, _ = difference_limits(*(bounded_limits(sums, layout, cap=2.0 * layout.size.sum()) for sums in events))
    return float((low > 0.0).mean())


@pytest.mark.parametrize(
    ("difference", "flips", "size", "correlation"),
    [
        (0.1, 0.2, 1, 0.0),
        (0.1, 0.4, 4, 0.3),
        (0.1, 0.3, 10, 0.1),
        (0.2, 0.4, 10, 0.5),
        (0.05, 0.2, 10, 0.1),
        (0.2, 0.5, 4, 0.3),
    ],
)
@pytest.mark.parametrize("target", [0.6, 0.8])
def test_the_interval_leaves_out_0_as_often_as_planned(
    difference: float, flips: float, size: int, correlation: float, target: float
) -> None:
    clusters = necessary_clusters(
        lambda one: power(difference, flips, one, correlation), sample(10, size), target=target
    )
    assert clusters is not None
    layout = Clusters(np.full(clusters, float(size)), np.zeros(clusters, np.intp))
    shares = (0.5 * (flips + difference), 0.5 * (flips - difference))
    detected = share_detected(shares, layout, correlation, 1500)
    assert detected == pytest.approx(target, abs=0.08)


def test_paired_difference_detects_the_difference_as_often_as_planned() -> None:
    clusters = necessary_clusters(lambda one: power(0.2, 0.4, one, 0.3), sample(10, 4), target=0.8)
    assert clusters is not None
    layout = Clusters(np.full(clusters, 4.0), np.zeros(clusters, np.intp))
    only_first, only_second = counts(np.random.Generator(np.random.Philox(11)), 150, (0.3, 0.1), layout, 0.3)
    detected = 0
    for first_sums, second_sums in zip(only_first, only_second, strict=True):
        first, second = {}, {}
        for k, (a, b) in enumerate(zip(first_sums, second_sums, strict=True)):
            for case in range(4):
                key = f"{k} {case}"
                first[key] = CaseValue(float(case < a), f"{k}", key)
                second[key] = CaseValue(float(a <= case < a + b), f"{k}", key)
        detected += paired_difference(first, second, kind="share", min_clusters=MIN_ROUTES).low > 0.0
    assert detected / 150 == pytest.approx(0.8, abs=0.12)


@pytest.mark.parametrize("flips", [0.1, 0.12, 0.15])
@pytest.mark.parametrize(("size", "correlation"), [(1, 0.0), (4, 0.3), (10, 0.1)])
def test_flips_that_nearly_all_go_one_way_are_planned_with_care(flips: float, size: int, correlation: float) -> None:
    clusters = necessary_clusters(lambda one: power(0.1, flips, one, correlation), sample(10, size), target=0.8)
    assert clusters is not None
    layout = Clusters(np.full(clusters, float(size)), np.zeros(clusters, np.intp))
    assert share_detected((0.5 * (flips + 0.1), 0.5 * (flips - 0.1)), layout, correlation, 1000) > 0.75


def test_unequal_routes_are_planned_by_the_size_of_a_typical_one() -> None:
    natural = np.array([1.0] * 8 + [2.0] * 8 + [6.0] * 8 + [10.0] * 6)
    layout = route_layout(len(natural), natural)
    sizes = CaseSample.of([str(route) for route, size in enumerate(natural) for _ in range(int(size))])
    assert (sizes.clusters, sizes.cases) == (30, natural.sum())
    assert sizes.typical_size == pytest.approx((natural**2).sum() / natural.sum())
    planned = power(0.2, 0.5, sizes, 0.3)
    assert share_detected((0.35, 0.15), layout, 0.3, 1500) == pytest.approx(planned, abs=0.08)
    assert 0.3 < planned < 0.9, "a power of 0 or 1 would show nothing"


def test_many_independent_pairs_are_those_of_the_formula() -> None:
    # Connor (1987), without the difference of the variances: (z + z)^2 (flips - difference^2) / difference^2
    found = necessary_clusters(lambda one: power(0.03, 0.3, one, 0.0), sample(10, 1), target=0.8)
    assert found == pytest.approx((1.959964 + 0.841621) ** 2 * (0.3 - 0.03**2) / 0.03**2, rel=0.02)
    alike = necessary_clusters(lambda one: power(0.03, 0.3, one, 0.4), sample(10, 6), target=0.8)
    assert alike is not None
    assert alike * 6 == pytest.approx(found * (1 + 5 * 0.4), rel=0.02)


def test_unpaired_cases_are_those_of_two_shares() -> None:
    found = necessary_clusters(lambda one: unpaired_power(0.1, 0.25, one, 0.0), sample(10, 1), target=0.8)
    assert found == pytest.approx((1.959964 + 0.841621) ** 2 * (0.3 * 0.7 + 0.2 * 0.8) / 0.1**2, rel=0.02)
    # a rate cannot be below 0
    assert unpaired_power(0.2, 0.02, sample(100, 1), 0.0) == unpaired_power(0.2, 0.1, sample(100, 1), 0.0)


def test_fewer_clusters_than_an_interval_needs_detect_nothing() -> None:
    assert necessary_clusters(lambda _: 1.0, sample(3, 1), target=0.8) == MIN_ROUTES
    assert necessary_clusters(lambda _: 0.0, sample(3, 1), target=0.8) is None
    assert detectable_difference(0.1, sample(MIN_ROUTES - 1, 100), 0.0, target=0.8) is None
    assert detectable_difference(0.1, sample(MIN_ROUTES, 100), 0.0, target=0.8) is not None


def test_the_detectable_difference_is_the_least() -> None:
    cases = sample(40, 4)
    found = detectable_difference(0.2, cases, 0.2, target=0.8)
    assert found is not None
    assert power(found, max(0.2, found), cases, 0.2) >= 0.8
    assert power(found - 0.01, 0.2, cases, 0.2) < 0.8
    alike = detectable_difference(0.2, cases, 1.0, target=0.8)
    assert alike is not None
    assert alike > found


def outcomes(values: list[int], size: int, *, failed: int = -1) -> dict[str, CaseValue]:
    return {
        str(k): CaseValue(math.nan if k == failed else float(v), f"c{k // size}", f"case {k}", failed=k == failed)
        for k, v in enumerate(values)
    }


def test_a_flip_rate_counts_the_cases_whose_outcome_differs() -> None:
    first, second = [1, 1, 0, 0, 0, 0, 1, 0], [0, 0, 1, 0, 0, 0, 1, 0]
    found = flip_rate(outcomes(first, 2), outcomes(second, 2))
    assert found is not None
    assert (found.flips, found.rate, found.difference) == (3, 3 / 8, 1 / 8)
    assert found.mean_rate == pytest.approx(5 / 16)
    assert (found.sample.clusters, found.sample.mean_size, found.sample.typical_size) == (4, 2, 2)
    # sums of the clusters less their mean: 2 - 1/4, -1 - 1/4, -1/4, -1/4
    by_hand = sum(x**2 for x in (1.75, -1.25, -0.25, -0.25)) * 4 / 3 / (8 * (3 / 8 - 1 / 64))
    assert found.design_effect == pytest.approx(by_hand)
    assert found.correlation == pytest.approx(min(by_hand - 1, 1.0))


def test_failed_cases_and_copies_count_in_no_flip_rate() -> None:
    first, second = outcomes([1, 0, 0, 1], 1, failed=0), outcomes([0, 0, 0, 0], 1)
    found = flip_rate(first, second)
    assert found is not None
    assert (found.flips, found.sample.cases) == (1, 3)
    copies = [{key: CaseValue(v.value, v.cluster, "same") for key, v in part.items()} for part in (first, second)]
    copied = flip_rate({"1": copies[0]["1"], "2": copies[0]["2"]}, copies[1])
    assert copied is not None
    assert copied.sample.cases == 1
    assert flip_rate(first, {}) is None


def test_the_design_effect_of_simulated_pairs_is_found() -> None:
    layout = Clusters(np.full(3000, 5.0), np.zeros(3000, np.intp))
    random = np.random.Generator(np.random.Philox(3))
    only_first, only_second = (sums[0].astype(int) for sums in counts(random, 1, (0.2, 0.1), layout, 0.4))
    pairs = [
        (1.0, 0.0) if k < a else (0.0, 1.0) if k < a + b else (0.0, 0.0)
        for a, b in zip(only_first, only_second, strict=True)
        for k in range(5)
    ]
    found = flip_rate(outcomes([int(pair[0]) for pair in pairs], 5), outcomes([int(pair[1]) for pair in pairs], 5))
    assert isinstance(found, FlipRate)
    assert found.rate == pytest.approx(0.3, abs=0.02)
    assert found.design_effect == pytest.approx(1 + 4 * 0.4, rel=0.06)
    assert found.correlation == pytest.approx(0.4, abs=0.03)


def test_a_flip_rate_without_flips_has_no_design_effect() -> None:
    found = flip_rate(outcomes([1, 0, 1, 0], 2), outcomes([1, 0, 1, 0], 2))
    assert found is not None
    assert found.flips == 0
    assert math.isnan(found.design_effect)
    assert math.isnan(found.correlation)
