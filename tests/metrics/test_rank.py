"""Rank correlations against scipy's, and their interval over families."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import spearmanr

from ssad.metrics.rank import family_correlation, rank_correlation


def test_it_is_spearmans_with_ties() -> None:
    draws = np.random.default_rng(0)
    for _ in range(5):
        one, other = draws.integers(0, 6, 20), draws.normal(size=20)
        assert rank_correlation(one, other) == pytest.approx(spearmanr(one, other).statistic)
    assert math.isnan(rank_correlation([1, 1, 1], [1, 2, 3]))


def test_severities_of_a_family_do_not_narrow_the_interval() -> None:
    draws = np.random.default_rng(3)
    one = draws.normal(size=8)
    other = one + draws.normal(size=8)
    families = [str(k) for k in range(8)]
    single = family_correlation(one, other, families)
    copies = family_correlation([*one] * 5, [*other] * 5, families * 5)
    assert single.method == copies.method == "bootstrap"
    assert (copies.n, copies.clusters) == (40, 8)
    assert copies.high - copies.low > 0.8 * (single.high - single.low)
    assert single.low < single.mean < single.high
    assert family_correlation(one, other, families) == single


def test_few_families_have_no_interval_and_what_does_not_vary_no_correlation() -> None:
    few = family_correlation([1, 2, 3, 4], [1, 2, 3, 4], ["a", "a", "b", "c"])
    assert few.mean == pytest.approx(1.0)
    assert math.isnan(few.low)
    assert few.method == "none"
    assert math.isnan(family_correlation([1, 2, 3], [0, 0, 0], ["a", "b", "c"]).mean)
    assert family_correlation([1, 2, math.nan, 4], [1, 2, 9, 4], list("abcd")).n == 3


def test_every_family_is_drawn() -> None:
    """Without the family that breaks the order the correlation is 1 in each draw."""
    for outlier in (0, 5):
        first = np.arange(6.0)
        second = first.copy()
        second[outlier] = 10.0 if outlier == 0 else -10.0
        estimate = family_correlation(first, second, list("abcdef"))
        assert estimate.low < 0.5 < estimate.high == pytest.approx(1.0)
