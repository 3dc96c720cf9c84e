"""Aggregates over shifts: closed forms and missing cells."""

import math

import pytest

from ssad.core.errors import ConfigError
from ssad.metrics.robustness import (
    corruption_error,
    mean_resilience_rate,
    resilience_rate,
)

OURS = {"fog": [0.4, 0.3, 0.2], "snow": [0.3, 0.2, 0.1]}
BASE = {"snow": [0.2, 0.1, 0.1], "fog": [0.3, 0.3, 0.3]}


def test_corruption_error_by_hand() -> None:
    found = corruption_error(OURS, BASE)
    assert found == pytest.approx({"fog": 2.1 / 2.1, "snow": 2.4 / 2.6})
    assert corruption_error(BASE, BASE) == {"snow": 1.0, "fog": 1.0}


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
        corruption_error(scores, scores)


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


def test_names_keep_their_scores_and_no_cell_may_miss() -> None:
    three = {"fog": [0.9, 0.1], "snow": [0.5, 0.5], "rain": [0.2, 0.0]}
    assert resilience_rate(three, 0.8) == pytest.approx({"fog": 0.625, "snow": 0.625, "rain": 0.125})
    assert list(resilience_rate(three, 0.8)) == list(three)
    assert mean_resilience_rate(three, 0.8) == pytest.approx((0.625 + 0.625 + 0.125) / 3)
    base = {"rain": [0.0, 0.0], "fog": [0.5, 0.0], "snow": [0.0, 0.0]}
    assert corruption_error(three, base) == pytest.approx({"fog": 1.0 / 1.5, "snow": 0.5, "rain": 0.9})
    with pytest.raises(ConfigError, match=r"scores: shift 'rain' has no value at severity 2; run that cell first"):
        resilience_rate(three | {"rain": [0.2, None]}, 0.8)
    with pytest.raises(ConfigError, match=r"baseline: shift 'fog' has no value at severity 1"):
        corruption_error(three, base | {"fog": [None, 0.0]})
    with pytest.raises(ConfigError, match=r"shift 'snow': the baseline makes no error there"):
        corruption_error(three, base | {"snow": [1.0, 1.0]})
    with pytest.raises(ConfigError, match=r"differ in: rain, sleet; run both"):
        corruption_error(three, {"fog": [0.0, 0.0], "snow": [0.0, 0.0], "sleet": [0.0, 0.0]})
