"""Aggregates over shifts: closed forms, missing cells, and trend tests against enumeration and simulation."""

import itertools
import math

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.core.seeding import generator
from ssad.metrics.robustness import (
    area_over_severity,
    corruption_error,
    is_monotone,
    jonckheere_trend,
    mean_corruption_error,
    mean_resilience_rate,
    page_trend,
    resilience_rate,
)

OURS = {"fog": [0.4, 0.3, 0.2], "snow": [0.3, 0.2, 0.1]}
BASE = {"snow": [0.2, 0.1, 0.1], "fog": [0.3, 0.3, 0.3]}


def test_corruption_error_by_hand() -> None:
    found = corruption_error(OURS, BASE)
    assert found == pytest.approx({"fog": 2.1 / 2.1, "snow": 2.4 / 2.6})
    assert mean_corruption_error(OURS, BASE) == pytest.approx((1.0 + 2.4 / 2.6) / 2)
    assert mean_corruption_error(BASE, BASE) == 1.0


def test_resilience_rate_by_hand() -> None:
    assert resilience_rate(OURS, 0.5) == pytest.approx({"fog": 0.6, "snow": 0.4})
    assert mean_resilience_rate(OURS, 0.5) == pytest.approx(0.5)


@pytest.mark.parametrize(
    ("scores", "says"),
    [
        ({}, "no shift"),
        ({"fog": []}, "same severities"),
        ({"fog": [0.1, 0.2], "snow": [0.1]}, "fog: 2, snow: 1"),
        ({"fog": [0.1, math.nan]}, "'fog' has no value at severity 2"),
        ({"fog": [None, 0.1]}, "'fog' has no value at severity 1"),
    ],
)
def test_a_missing_cell_is_an_error(scores: dict[str, list[float]], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        mean_resilience_rate(scores, 0.5)
    with pytest.raises(ConfigError, match=says):
        mean_corruption_error(scores, scores)


def test_shifts_must_be_those_of_the_baseline() -> None:
    with pytest.raises(ConfigError, match="snow"):
        corruption_error({"fog": [0.1]}, {"fog": [0.1], "snow": [0.1]})
    with pytest.raises(ConfigError, match="number of severities"):
        corruption_error({"fog": [0.1]}, {"fog": [0.1, 0.1]})
    with pytest.raises(ConfigError, match="no error"):
        corruption_error({"fog": [0.1]}, {"fog": [1.0]})


@pytest.mark.parametrize("clean", [0.0, -1.0, math.nan, math.inf])
def test_a_rate_needs_a_clean_score(clean: float) -> None:
    with pytest.raises(ConfigError, match="clean"):
        resilience_rate(OURS, clean)


def test_area_over_severity() -> None:
    assert area_over_severity(0.5, [0.5] * 5) == 0.5
    assert area_over_severity(1.0, [0.8, 0.6, 0.4, 0.2, 0.0]) == pytest.approx(0.5)
    assert area_over_severity(1.0, [0.0]) == 0.5
    for bad in ([], [math.nan]):
        with pytest.raises(ConfigError, match="missing"):
            area_over_severity(0.5, bad)


def test_is_monotone() -> None:
    assert is_monotone(0.5, [0.4, 0.4, 0.1])
    assert not is_monotone(0.5, [0.4, 0.41])
    assert is_monotone(0.5, [0.4, 0.41], tolerance=0.02)
    with pytest.raises(ConfigError, match="missing"):
        is_monotone(0.5, [math.nan])


def test_page_equals_the_exact_test() -> None:
    damage = np.array([[0.1, 0.2, 0.3], [0.1, 0.3, 0.2], [0.2, 0.1, 0.3]])
    found = page_trend(damage, generator=generator("page"), permutations=20_000)
    ranks = [[1, 2, 3], [1, 3, 2], [2, 1, 3]]
    assert found.statistic == sum(sum(j * r for j, r in enumerate(row, 1)) for row in ranks)
    single = [sum(j * r for j, r in enumerate(p, 1)) for p in itertools.permutations((1, 2, 3))]
    every = [sum(choice) for choice in itertools.product(single, repeat=3)]
    exact = np.mean([v >= found.statistic for v in every])
    assert found.p_value == pytest.approx(exact, abs=0.01)


def test_jonckheere_equals_the_exact_test() -> None:
    groups = [[1.0, 2.0], [3.0, 2.0], [4.0]]
    found = jonckheere_trend(groups, generator=generator("jonckheere"), permutations=20_000)

    def count(split: list[list[float]]) -> float:
        pairs = [(x, y) for a, b in itertools.combinations(split, 2) for x in a for y in b]
        return sum((x < y) + 0.5 * (x == y) for x, y in pairs)

    assert found.statistic == count(groups)
    values = [v for group in groups for v in group]
    every = [count([list(p[:2]), list(p[2:4]), [p[4]]]) for p in itertools.permutations(values)]
    assert found.p_value == pytest.approx(np.mean([v >= found.statistic for v in every]), abs=0.01)


def test_trends_are_found_and_not_invented() -> None:
    random = generator("trend")
    growing = np.arange(5.0) * 0.5 + random.normal(size=(10, 5))
    assert page_trend(growing, generator=random, permutations=499).p_value <= 0.01
    assert page_trend(growing[:, ::-1], generator=random, permutations=499).p_value > 0.9
    assert jonckheere_trend(list(growing.T), generator=random, permutations=499).p_value <= 0.01
    level = [page_trend(random.normal(size=(6, 4)), generator=random, permutations=99).p_value for _ in range(200)]
    assert 0.01 <= np.mean(np.array(level) <= 0.05) <= 0.1


def test_constant_damage_is_no_trend() -> None:
    assert page_trend(np.ones((4, 5)), generator=generator("flat"), permutations=99).p_value == 1.0
    assert jonckheere_trend([[1.0], [1.0]], generator=generator("flat"), permutations=99).p_value == 1.0


def test_a_trend_needs_all_values() -> None:
    for bad in (np.ones(3), np.ones((2, 1)), np.array([[0.0, math.nan]]), np.ones((0, 3))):
        with pytest.raises(ConfigError, match="missing"):
            page_trend(bad, generator=generator("bad"))
    for groups in ([[1.0]], [[1.0], []], [[1.0], [math.nan]]):
        with pytest.raises(ConfigError, match="missing"):
            jonckheere_trend(groups, generator=generator("bad"))
