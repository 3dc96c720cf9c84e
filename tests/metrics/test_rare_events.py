"""Limits of the mean of rare events: those of a Poisson mean where all values are equal, scaled with the values."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
from scipy.special import gammaincc

from ssad.metrics.rare_events import repeated_estimate, weighted_estimate, weighted_limits

MANY = 1e9  # episodes: so many that the events are rare


@pytest.mark.parametrize("events", [1, 4, 30])
def test_equal_values_have_the_mid_p_limits_of_a_poisson_mean(events: int) -> None:
    low, high = (float(limit) * MANY for limit in weighted_limits(events, events, 1.0, MANY))

    def below(mean: float) -> float:
        """Chance of fewer events than these, and half of that of as many."""
        return float(0.5 * gammaincc(events, mean) + 0.5 * gammaincc(events + 1, mean))

    assert below(low) == pytest.approx(0.975, abs=1e-6)
    assert below(high) == pytest.approx(0.025, abs=1e-6)
    weighted = weighted_limits(3.0 * events, 9.0 * events, 3.0, MANY)
    assert np.array(weighted) * MANY == pytest.approx([3.0 * low, 3.0 * high], rel=1e-6)


def test_without_an_event_the_lower_limit_is_zero_and_the_upper_is_that_of_one_event_more() -> None:
    low, high = weighted_limits(0.0, 0.0, 1.0, MANY)
    assert low == 0.0
    # half of the chance is at zero events, the other half that of the first event: exp(-mean) / 2 = 0.025
    assert float(high) * MANY == pytest.approx(-np.log(0.05), rel=1e-3)


def test_an_estimate_counts_events_and_how_many_equal_ones_they_are_worth() -> None:
    found = weighted_estimate(np.array([0.0] * 96 + [2.0, 2.0, 1.0, 1.0]), "drawn", max_weight=5.0, work=7.0)
    assert (found.probability, found.episodes, found.events) == (pytest.approx(0.06), 100, 4)
    assert found.effective == pytest.approx(36.0 / 10.0)
    assert 0.0 < found.low < 0.06 < found.high < 1.0


@pytest.mark.parametrize("value", [0.0, 0.25])
def test_one_repeat_has_a_mean_and_no_limits(value: float) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        estimate = repeated_estimate([value], "splitting", episodes=20, events=5, work=1.0)
    assert estimate.probability == value
    assert np.isnan([estimate.low, estimate.high, estimate.effective]).all()
