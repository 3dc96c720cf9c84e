"""Estimates: copies, clusters, strata, failed cases, what is not measured, paired differences, scores."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ssad.metrics.intervals import Clusters, bounded_limits, mean_limits, replicate_limits
from ssad.metrics.uncertainty import (
    CaseValue,
    estimate,
    paired_difference,
    replicate_estimate,
    sign_flip_test,
)

NAN = math.nan


def cases(values, per_cluster=1, stratum=""):
    """Case values in clusters of `per_cluster`, one after the other."""
    return [
        CaseValue(float(v), f"{stratum}c{k // per_cluster}", f"{stratum}{k}", stratum) for k, v in enumerate(values)
    ]


@st.composite
def samples(draw):
    """Values of some clusters in some strata, some of them failed or not measured."""
    kind = draw(st.sampled_from(["share", "bounded", "mean"]))
    number = st.sampled_from([0.0, 1.0]) if kind == "share" else st.floats(0.0, 1.0)
    rows = draw(
        st.lists(st.tuples(st.integers(0, 9), st.integers(0, 2), number, st.integers(0, 9)), min_size=1, max_size=40)
    )
    return kind, [
        CaseValue(NAN if chance < 2 else value, f"c{cluster}", f"case{k}", f"s{stratum}", failed=chance == 0)
        for k, (cluster, stratum, value, chance) in enumerate(rows)
    ]


@settings(max_examples=200, deadline=None)
@given(samples(), st.data())
def test_copies_and_order_change_nothing(sample, data):
    kind, values = sample
    copies = data.draw(st.lists(st.sampled_from(values), max_size=60))
    mixed = data.draw(st.permutations([*values, *copies]))
    # compared as text, since NaN differs from itself
    assert repr(estimate(mixed, kind)) == repr(estimate(values, kind))


@settings(max_examples=200, deadline=None)
@given(samples())
def test_limits_hold_the_mean_and_stay_in_bounds(sample):
    kind, values = sample
    e = estimate(values, kind, min_value=0.0)
    if math.isnan(e.mean):
        assert e.n == 0
        return
    is_widened = kind != "mean" and e.failed > 0
    if e.clusters == 1 and not is_widened:
        assert (e.method, math.isnan(e.low), math.isnan(e.high)) == ("none", True, True)
        return
    assert 0.0 <= e.low <= e.mean <= e.high
    assert kind == "mean" or e.high <= 1.0
    if e.clusters < 5 and not is_widened:
        assert e.method == "range"


@settings(max_examples=200, deadline=None)
@given(samples(), st.lists(st.sampled_from([0.0, 1.0]), min_size=40, max_size=40))
def test_limits_hold_whatever_the_failed_cases_were(sample, outcomes):
    """The mean of any assumed outcomes lies between the limits."""
    kind, values = sample
    e = estimate(values, kind)
    if kind == "mean" or math.isnan(e.low):
        return
    assumed = [replace(v, value=o, failed=False) if v.failed else v for v, o in zip(values, outcomes, strict=False)]
    assert e.low - 1e-9 <= estimate(assumed, kind).mean <= e.high + 1e-9


def test_fewer_than_five_clusters_give_their_range():
    e = estimate(cases([0, 1, 1, 1, 0, 0, 0, 0], per_cluster=2), "share")
    assert (e.mean, e.low, e.high, e.method, e.n, e.clusters) == (3 / 8, 0.0, 1.0, "range", 8, 4)
    five = estimate(cases([0, 1, 1, 1, 0, 0, 0, 0, 0, 0], per_cluster=2), "share")
    assert (five.method, five.clusters) == ("beta", 5)


def test_the_limits_of_a_share_hold_whatever_the_failed_cases_were():
    values = cases([1, 0, 0, 0, 0, 1, 0, 0])
    lost = [replace(v, value=NAN, failed=True) for v in values[1:3]]
    e = estimate([values[0], *lost, *values[3:]], "share")
    assert (e.mean, e.n, e.failed) == (2 / 6, 6, 2)
    assert e.low == estimate(values, "share").low
    known = [replace(v, value=1.0) if k in (1, 2) else v for k, v in enumerate(values)]
    assert e.high == estimate(known, "share").high


def test_what_is_not_measured_is_left_out():
    e = estimate([*cases([1.0, 3.0]), CaseValue(NAN, "x", "x"), CaseValue(NAN, "y", "y", failed=True)], "mean")
    assert (e.mean, e.n, e.failed, e.clusters) == (2.0, 2, 1, 2)
    nothing = estimate([CaseValue(NAN, "x", "x")], "share")
    assert (nothing.n, nothing.failed, nothing.method) == (0, 0, "none")
    assert math.isnan(nothing.mean)
    assert estimate([], "mean").n == 0


def test_strata_weigh_the_same():
    values = [*cases([1, 1, 1, 1, 1, 1, 1, 1], stratum="a"), *cases([0, 0], stratum="b")]
    e = estimate(values, "share")
    assert e.mean == 0.5
    assert (e.n, e.clusters) == (10, 10)
    assert 0.1 < e.low < 0.5 < e.high < 0.9


def test_the_same_case_in_two_strata_counts_in_both():
    values = [CaseValue(1.0, "c", "same", "a"), CaseValue(1.0, "c", "same", "b"), CaseValue(0.0, "d", "other", "b")]
    assert estimate(values, "share").mean == pytest.approx(0.75)


def test_scale_and_least():
    values = [0.2, 0.4, 0.9, 1.0, 0.7, 0.3, 0.5, 0.8, 0.1, 0.6]
    one, hundred = estimate(cases(values), "bounded"), estimate(cases(np.multiply(100, values)), "bounded", scale=100.0)
    assert (hundred.low, hundred.high) == (pytest.approx(100 * one.low), pytest.approx(100 * one.high))
    skewed = [0.0, 0.01, 0.0, 0.02, 0.03, 9.0, 0.04, 0.05, 0.06, 0.07]
    assert estimate(cases(skewed), "mean").low < 0.0
    assert estimate(cases(skewed), "mean", min_value=0.0).low == 0.0
    mirrored = one.scaled(-2.0, 1.0)
    assert (mirrored.low, mirrored.high) == (pytest.approx(1 - 2 * one.high), pytest.approx(1 - 2 * one.low))
    assert mirrored.mean == pytest.approx(1 - 2 * one.mean)


def test_paired_difference_is_tighter_than_unpaired():
    random = np.random.Generator(np.random.Philox(6))
    hard = random.normal(size=50) * 10
    first = dict(enumerate(cases(hard + random.normal(size=50) + 1)))
    second = dict(enumerate(cases(hard)))
    e = paired_difference(first, second)
    assert (e.n, e.clusters) == (50, 50)
    assert e.low < 1.0 < e.high
    alone = estimate(second.values(), "mean")
    assert e.high - e.low < 1.0 < alone.high - alone.low


def test_paired_difference_follows_the_rules():
    first = {str(k): v for k, v in enumerate(cases(range(20), per_cluster=2))}
    second = {str(k): v for k, v in enumerate(cases([0.5 * k for k in range(20)], per_cluster=2))}
    e = paired_difference(first, second)
    assert (e.n, e.clusters, e.failed) == (20, 10, 0)
    # a copy of both halves is a copy, a copy of one is not
    again = paired_difference(first | {"copy": first["3"]}, second | {"copy": second["3"]})
    assert again == e
    assert paired_difference(first | {"copy": first["3"]}, second | {"copy": replace(second["3"], case="x")}).n == 21
    # cells of one alone, failed, not measured
    lost = replace(second["4"], value=NAN, failed=True)
    other = paired_difference(first | {"only": first["0"]}, second | {"4": lost, "5": replace(lost, failed=False)})
    assert (other.n, other.failed) == (18, 3)


def shares(ones: int, count: int, name: str) -> dict[str, CaseValue]:
    return {str(k): CaseValue(float(k < ones), str(k), f"{name}{k}") for k in range(count)}


def test_a_difference_of_shares_has_an_interval_also_where_no_cell_differs():
    same = paired_difference(shares(6, 40, "a"), shares(6, 40, "b"), kind="share")
    assert (same.mean, same.n, same.failed, same.method) == (0.0, 40, 0, "beta")
    # nothing in 40 cells: exact limit of the cells that only one has, both ways, joined
    limit = 1.0 - 0.025 ** (1 / 40)
    assert (same.low, same.high) == (pytest.approx(-limit), pytest.approx(limit))
    more = paired_difference(shares(16, 40, "a"), shares(6, 40, "b"), kind="share")
    assert more.mean == pytest.approx(0.25)
    assert 0.05 < more.low < 0.2
    assert 0.3 < more.high < 0.45
    turned = paired_difference(shares(6, 40, "b"), shares(16, 40, "a"), kind="share")
    assert (turned.low, turned.high) == (pytest.approx(-more.high), pytest.approx(-more.low))
    few = paired_difference(shares(2, 4, "a"), shares(1, 4, "b"), kind="share")
    assert few.method == "range"


def test_limits_of_a_difference_of_shares_hold():
    random = np.random.Generator(np.random.Philox(9))
    held = 0
    for _ in range(200):
        drawn = random.choice(3, p=[0.15, 0.05, 0.8], size=60)
        first = {str(k): CaseValue(float(v == 0), str(k), f"a{k}") for k, v in enumerate(drawn)}
        second = {str(k): CaseValue(float(v == 1), str(k), f"b{k}") for k, v in enumerate(drawn)}
        e = paired_difference(first, second, kind="share")
        held += e.low <= 0.1 <= e.high
    assert 180 <= held <= 199


def test_sign_flips():
    # five cells that only the first has, none that only the second has: McNemar's exact test
    assert sign_flip_test(shares(11, 40, "a"), shares(6, 40, "b")) == pytest.approx(2 * 0.5**5)
    assert sign_flip_test(shares(6, 40, "a"), shares(6, 40, "b")) == 1.0
    assert math.isnan(sign_flip_test({}, {}))
    values = [1.0, -2.0, 4.0]  # sums of signs: 3, 7, 5, 1 and their negatives
    first = {str(k): CaseValue(v, str(k), f"a{k}") for k, v in enumerate(values)}
    second = {str(k): CaseValue(0.0, str(k), f"b{k}") for k in range(3)}
    assert sign_flip_test(first, second) == pytest.approx(6 / 8)
    # drawn signs agree with the exact ones, and clusters count, not cases
    many, none = shares(30, 40, "a"), shares(12, 40, "b")
    assert sign_flip_test(many, none) == pytest.approx(1 / 20_001, abs=2e-4)
    one = {k: replace(v, cluster="one") for k, v in many.items()}
    assert sign_flip_test(one, none | {}) == 1.0


def test_scores_by_replicates():
    replicates = list(np.random.Generator(np.random.Philox(2)).normal(0.4, 0.02, size=200))
    e = replicate_estimate(0.4, replicates, n=500, clusters=24)
    assert (e.n, e.clusters, e.method) == (500, 24, "beta")
    assert e.high - e.low == pytest.approx(2 * 2.069 * 0.02 * math.sqrt(24 / 23), rel=0.15)
    assert math.isnan(replicate_estimate(0.4, replicates, n=8, clusters=4).low)
    assert math.isnan(replicate_estimate(0.4, [0.4], n=8, clusters=24).low)
    assert math.isnan(replicate_estimate(0.4, [], n=8, clusters=24).low)
    ratio = replicate_estimate(1.1, [v / 0.4 for v in replicates], n=500, clusters=24, bounded=False)
    assert ratio.low < 1.1 < ratio.high
    assert ratio.low * ratio.high == pytest.approx(1.21)
    assert math.isnan(replicate_estimate(1.0, [1.0] * 50, n=500, clusters=24, bounded=False).low)


def test_what_there_is_nothing_of():
    nothing = estimate([CaseValue(NAN, "x", "x"), CaseValue(NAN, "y", "y", failed=True)], "mean")
    assert (nothing.n, nothing.failed, nothing.clusters, nothing.method) == (0, 1, 0, "none")
    assert math.isnan(nothing.low + nothing.high)


def test_of_copies_that_disagree_one_that_ran_counts():
    ran, failed, lost = CaseValue(1.0, "c", "x"), CaseValue(NAN, "c", "x", failed=True), CaseValue(NAN, "c", "x")
    for values in ([ran, failed, lost], [lost, failed, ran], [failed, ran, lost]):
        e = estimate(values, "share")
        assert (e.mean, e.n, e.failed) == (1.0, 1, 0)
    assert estimate([failed, lost], "share").failed == 0
    assert estimate([replace(ran, failed=True), replace(ran, value=0.0)], "mean").mean == 0.0


def test_what_never_ran_has_no_mean_and_one_cluster_has_bounds():
    never = [CaseValue(NAN, "a", str(k), failed=True) for k in range(3)]
    for kind in ("share", "bounded", "mean"):
        e = estimate(never, kind)
        assert (e.n, e.failed, e.method) == (0, 3, "none")
        assert all(math.isnan(number) for number in (e.mean, e.low, e.high))
    half = estimate([CaseValue(1.0, "a", "x"), *never[:1]], "share")
    assert (half.mean, half.low, half.high, half.n, half.method) == (1.0, 0.5, 1.0, 1, "bounds")
    score = estimate([CaseValue(40.0, "a", "x"), *never[:1]], "bounded", scale=100.0)
    assert (score.mean, score.low, score.high) == (40.0, 20.0, 70.0)


def test_a_group_none_of_which_ran_is_in_the_limits_alone():
    values = [*cases([0, 1], stratum="a"), CaseValue(NAN, "x", "x", "b", failed=True)]
    e = estimate(values, "share")
    assert (e.mean, e.low, e.high) == (0.5, 0.0, 1.0)


def test_pairs_of_which_one_failed_widen_a_difference_of_shares():
    first, second = shares(30, 40, "a"), shares(10, 40, "b")
    lost = {key: replace(value, value=NAN, failed=True) if int(key) < 12 else value for key, value in first.items()}
    whole, partial = (paired_difference(one, second, kind="share") for one in (first, lost))
    assert (whole.mean, whole.n, whole.failed) == (0.5, 40, 0)
    assert (partial.n, partial.failed) == (28, 12)
    assert partial.mean == pytest.approx(18 / 28)
    # the twelve may each have been as much better or worse as can be
    assert partial.low < (18 - 12) / 40 < whole.mean < partial.high
    few, none = shares(2, 4, "a"), shares(1, 4, "b")
    few["0"] = replace(few["0"], value=NAN, failed=True)
    e = paired_difference(few, none, kind="share")
    assert e.low <= (1 - 1) / 4 <= e.mean <= (1 + 1) / 4 <= e.high


def test_a_failed_case_widens_shares_and_bounded_values():
    values = [*cases([0.2, 0.4, 0.6, 0.8, 1.0, 0.5]), CaseValue(NAN, "x", "x", failed=True)]
    assert (estimate(values, "bounded").n, estimate(values, "bounded").failed) == (6, 1)
    assert estimate(values, "bounded").mean == pytest.approx(3.5 / 6)
    assert estimate(values, "bounded").low < estimate(values[:-1], "bounded").low
    assert estimate(values, "bounded").high > estimate(values[:-1], "bounded").high
    # one that failed and has a value (a route completion of 0) counts with it
    known = [*values[:-1], CaseValue(0.0, "x", "x", failed=True)]
    assert (estimate(known, "bounded").mean, estimate(known, "bounded").failed) == (pytest.approx(0.5), 1)
    share = [*cases([0, 0, 1]), CaseValue(NAN, "x", "x", failed=True)]
    e = estimate(share, "share")
    assert (e.mean, e.low, e.high, e.method) == (pytest.approx(1 / 3), 0.0, 1.0, "range")


def test_the_limits_are_those_of_the_intervals():
    values = np.random.Generator(np.random.Philox(3)).random(24)
    layout = Clusters(np.full(12, 2.0), np.repeat([0, 1], 6))
    of_pairs = [CaseValue(float(v), f"c{k // 2}", str(k), "ab"[k // 12]) for k, v in enumerate(values)]
    for kind, limits in (("mean", mean_limits), ("bounded", bounded_limits)):
        e, found = estimate(of_pairs, kind), limits(values.reshape(12, 2).sum(axis=1), layout)
        assert (e.mean, e.low, e.high, e.method) == (found.mean, found.low, found.high, found.method)
    ones = [replace(v, value=float(v.value < 0.3)) for v in of_pairs]
    found = bounded_limits((values < 0.3).reshape(12, 2).sum(axis=1).astype(float), layout, cap=48.0)
    assert estimate(ones, "share").low == pytest.approx(found.low)
    assert estimate(ones, "share").high == pytest.approx(found.high)
    # with a scale and a least value
    e = estimate(of_pairs, "mean", scale=4.0)
    assert (e.low, e.high) == (
        pytest.approx(estimate(of_pairs, "mean").low),
        pytest.approx(estimate(of_pairs, "mean").high),
    )
    assert estimate(of_pairs, "mean", scale=4.0, min_value=0.45).low == pytest.approx(0.45)


def test_the_range_is_that_of_the_clusters_means():
    e = estimate(cases([1.0, 3.0, 5.0, 9.0], per_cluster=2), "mean")
    assert (e.mean, e.low, e.high, e.method) == (4.5, 2.0, 7.0, "range")
    one = estimate(cases([1.0, 3.0], per_cluster=2), "mean")
    assert (one.mean, one.method, one.clusters) == (2.0, "none", 1)
    # groups weigh the same, whatever the number of their cases
    groups = [
        CaseValue(v, c, c + str(k), s) for k, (v, c, s) in enumerate([(1, "a", "x"), (2, "b", "x"), (6, "c", "y")])
    ]
    assert estimate(groups, "mean").mean == 3.75
    # five clusters that are too alike for an interval
    flat = estimate(cases([2.0] * 5), "mean")
    assert (flat.low, flat.high, flat.method) == (2.0, 2.0, "range")


@pytest.mark.parametrize(
    ("value", "replicates", "clusters", "bounded", "known"),
    [
        (0.4, [0.3, 0.5], 5, True, True),
        (0.4, [0.3, 0.5], 4, True, False),
        (0.4, [0.3], 5, True, False),
        (0.4, [0.3, NAN], 5, True, False),
        (NAN, [0.3, 0.5], 5, True, False),
        (0.4, [0.4, 0.4], 5, True, True),
        (0.4, [0.4, 0.4], 5, False, False),
        (0.0, [0.3, 0.5], 5, False, False),
        (0.0, [0.0, 0.0], 5, True, True),
        (0.4, [0.3, 0.5], 5, False, True),
    ],
)
def test_which_scores_have_an_interval(value, replicates, clusters, bounded, known):
    e = replicate_estimate(value, replicates, n=7, clusters=clusters, bounded=bounded)
    assert (not math.isnan(e.low), e.n, e.failed, e.clusters) == (known, 7, 0, clusters)
    assert e.method == (("beta" if bounded else "t") if known else "none")
    if known:
        limits = replicate_limits(np.asarray(value), np.asarray(np.var(replicates, ddof=1)), clusters, bounded=bounded)
        assert (e.low, e.high) == limits


def test_pairs_of_cells():
    first = {"a": CaseValue(3.0, "c", "1"), "b": CaseValue(5.0, "d", "2")}
    second = {"b": CaseValue(1.0, "x", "2"), "c": CaseValue(9.0, "c", "3")}
    e = paired_difference(first, second)
    assert (e.mean, e.n, e.failed, e.clusters) == (4.0, 1, 2, 1)
    nothing = paired_difference({"a": first["a"]}, {"c": second["c"]})
    assert (nothing.n, nothing.failed) == (0, 2)


def test_the_margins_of_a_difference_of_shares_are_correlated():
    """Donner and Zou's limits, worked out from the two shares: 12 and 5 of 40 cells differ in one way and the other."""
    first = {str(k): CaseValue(float(k < 12), str(k), f"a{k}") for k in range(40)}
    second = {str(k): CaseValue(float(12 <= k < 17), str(k), f"b{k}") for k in range(40)}
    gained, lost = (estimate(list(cases.values()), "share") for cases in (first, second))
    phi = -math.sqrt(0.3 * 0.125 / (0.7 * 0.875))
    margins = [
        math.sqrt(one * one + other * other - 2.0 * phi * one * other)
        for one, other in ((0.3 - gained.low, lost.high - 0.125), (gained.high - 0.3, 0.125 - lost.low))
    ]
    difference = paired_difference(first, second, kind="share")
    assert difference.low == pytest.approx(0.175 - margins[0])
    assert difference.high == pytest.approx(0.175 + margins[1])


def test_drawn_signs_leave_room_for_the_observed_ones():
    """18 clusters that all have one sign: none of nine draws has it, and the p-value is 1 in 10, not 0."""
    assert sign_flip_test(shares(30, 40, "a"), shares(12, 40, "b"), draws=9) == pytest.approx(1 / 10)
