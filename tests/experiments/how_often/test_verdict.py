"""Rates of collisions in sentences."""

from __future__ import annotations

import pytest

from ssad.experiments.how_often.verdict import _million


@pytest.mark.parametrize(
    ("value", "text"), [(0.0123, "0.012"), (9.94, "9.9"), (10.0, "10"), (10.6, "11"), (12345.4, "12,345")]
)
def test_small_numbers_have_two_digits_and_large_ones_none_behind_the_point(value: float, text: str) -> None:
    assert _million(value) == text
