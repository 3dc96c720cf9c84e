"""Published statistics of human driving: complete, sourced, and consistent."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.metrics.human_driving import certainty_of, correlations, published, spread, statistics


def test_every_value_has_a_number_a_source_and_a_certainty() -> None:
    for statistic in statistics():
        assert statistic.values, statistic
        assert statistic.source
        assert statistic.address
        assert statistic.place
        assert statistic.certainty in {"read", "cited", "memory"}
        assert statistic.low is None or statistic.high is None or statistic.low < statistic.high
        assert statistic.sd is None or statistic.sd > 0.0


def test_numbers_are_in_the_units_that_they_name() -> None:
    ordinary = {"s": (0.0, 40.0), "m": (0.0, 10.0), "m/s^2": (0.2, 9.0), "veh/h": (1000.0, 2500.0), "m/s": (0.5, 10.0)}
    for statistic in statistics():
        if statistic.unit in ordinary:
            low, high = ordinary[statistic.unit]
            assert all(low <= value <= high for value in statistic.values), statistic


def test_a_spread_is_that_between_all_sources() -> None:
    assert spread("standstill gap") == (1.52, 3.66)
    assert spread("critical gap") == (4.1, 7.1)


def test_the_certainty_of_a_quantity_is_its_weakest() -> None:
    assert certainty_of("standstill gap") == "read"
    assert certainty_of("time gap") == "cited"
    assert certainty_of("lateral position in the lane") == "memory"


def test_correlations_are_those_of_a_distribution() -> None:
    assert len(correlations()) == 2
    for correlation in correlations():
        matrix = correlation.matrix
        assert np.array_equal(matrix, matrix.T)
        assert (np.diag(matrix) == 1.0).all()
        assert np.linalg.eigvalsh(matrix).min() > 0.1
        assert correlation.between("time gap", "standstill gap") > 0.1
        assert correlation.between("time gap", "desired speed") < -0.1


def test_a_quantity_without_a_source_is_named_with_those_that_have_one() -> None:
    with pytest.raises(ConfigError, match="no published value of 'patience'; there are: acceleration"):
        published("patience")
