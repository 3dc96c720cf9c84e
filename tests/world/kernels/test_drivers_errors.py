"""Errors of drivers: as many as asked for, independent of one another, and what they do."""

from __future__ import annotations

import math

import numpy as np
import pytest
import warp as wp

from ssad.core.types import DriverStyle, Episode
from ssad.world.kernels.drivers import LAPSE, is_lapsed
from ssad.world.world import World
from tests.world.kernels.test_drivers import CALM, road
from tests.world.worlds import NO_PASSING

PERIOD = float(LAPSE)  # s
RATE = 360.0  # errors an hour
DRIVERS, PERIODS = 20, 400


@pytest.fixture(scope="module")
def errors() -> np.ndarray:
    """Errors of each driver in each period, bool [DRIVERS, PERIODS]."""
    middle = [(period + 0.5) * PERIOD for period in range(PERIODS)]
    habits = [wp.vec3(0.0, RATE, float(1000 * number + 7)) for number in range(DRIVERS)]
    return np.array([[is_lapsed(habit, time) for time in middle] for habit in habits])


def test_the_number_of_errors_is_binomial_with_the_rate_that_is_asked_for(errors: np.ndarray) -> None:
    chance = RATE * PERIOD / 3600.0
    expected = RATE * DRIVERS * PERIODS * PERIOD / 3600.0
    assert errors.sum() == pytest.approx(expected, abs=3.5 * math.sqrt(expected * (1.0 - chance)))
    # from driver to driver, too: the index of dispersion has a standard deviation of sqrt(2 / (n - 1))
    counts = errors.sum(axis=1)
    dispersion = counts.var(ddof=1) / (PERIODS * chance * (1.0 - chance))
    assert dispersion == pytest.approx(1.0, abs=3.5 * math.sqrt(2.0 / (DRIVERS - 1)))


def test_errors_do_not_follow_one_another(errors: np.ndarray) -> None:
    deviation = errors - errors.mean()
    correlation = (deviation[:, 1:] * deviation[:, :-1]).mean() / deviation.var()
    assert abs(correlation) < 3.5 / math.sqrt(errors.size)


def test_an_error_lasts_for_its_period(errors: np.ndarray) -> None:
    habit = wp.vec3(0.0, RATE, 7.0)
    for period in range(50):
        shown = {bool(is_lapsed(habit, (period + share) * PERIOD)) for share in (0.01, 0.5, 0.99)}
        assert shown == {bool(errors[0, period])}


def scene(style: DriverStyle) -> Episode:
    return road(style, speed=8.0)


@pytest.mark.parametrize("rate", [0.0, RATE])
def test_drivers_of_the_world_err_at_those_times(errors: np.ndarray, rate: float) -> None:
    world = World([scene(DriverStyle(**{**vars(CALM), "errors": rate, "key": 7}))], NO_PASSING)
    blind = []
    for _ in range(200):
        world.step()
        blind.append(world.work.judgement.numpy()[0, 1, 1] > 0.5)
    expected = np.repeat(errors[0, :10], 20) if rate else np.zeros(200, bool)
    np.testing.assert_array_equal(blind, expected)
