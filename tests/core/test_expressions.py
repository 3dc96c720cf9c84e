"""Expressions: the grammar of OpenSCENARIO, and what is refused."""

from __future__ import annotations

import math

import pytest

from ssad.core.errors import ConfigError
from ssad.core.expressions import evaluate, number_or_text, text_of

VALUES = {"v": "50", "_gap": 2.5, "braking": "false", "name": "Target"}


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("$v / 3.6", 50 / 3.6),
        ("-15 + 3.14 + 23 + 2.1E-7", 11.1400002100),
        ("2 + 3 * 4 - 1", 13),
        ("(2 + 3) * 4", 20),
        ("3/2", 1.5),
        ("2 - 3 - 4", -5),
        ("-7 % 3", -1),
        ("- -$_gap", 2.5),
        ("${v} * 2", 100),
        ("pow(2, 10)", 1024),
        ("sqrt(abs(-16))", 4),
        ("round(2.5) + round(-2.5)", 0),
        ("floor(-1.5) + ceil(1.2)", 0),
        ("sign(-3) + sign(0) + sign(9)", 0),
        ("max(1, $v) - min($v, 1)", 49),
        ("cos(pi)", -1),
        ("not $braking and true or false", True),
        ("$v >= 50", True),
        ("$v == 51", False),
        ("$name", "Target"),
    ],
)
def test_expressions_have_the_value_of_the_grammar(expression: str, value: object) -> None:
    result = evaluate(expression, VALUES)
    assert type(result) is bool if isinstance(value, bool) else True
    assert result == (pytest.approx(value) if isinstance(value, float) else value)


@pytest.mark.parametrize(
    ("expression", "message"),
    [
        ("$w + 1", "there is no parameter 'w'"),
        ("v + 1", "'v' is no function or constant"),
        ("1 / ($v - 50)", "division by zero"),
        ("1 % 0", "division by zero"),
        ("sqrt(-1)", "no real value"),
        ("pow(10, 400)", "no real value"),
        ("1e308 * 10", "not finite"),
        ("1 +", "ends too early"),
        ("(1", "')' is missing"),
        ("1 2", "'2' is not expected"),
        ("pow(2)", "takes 2 arguments, not 1"),
        ("$name * 2", "'Target' is not a number"),
        ("true + 1", "'true' is not a number"),
        ("not 1", "neither true nor false"),
        ("__import__('os')", "is not understood"),
        ("1 @ 2", "'@ 2' is not understood"),
        ("(" * 5000, "an expression of 5000 characters"),
        ("(" * 500, "too many nested"),
    ],
)
def test_broken_expressions_are_refused_by_name(expression: str, message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        evaluate(expression, VALUES)
    assert message in str(refused.value)


def test_whole_numbers_do_not_grow_without_limit() -> None:
    value: float | int | bool | str = 10**6
    for _ in range(5):
        value = evaluate("$x * $x", {"x": value})
    assert isinstance(value, float)
    assert value == pytest.approx(1e192)


def test_values_are_written_as_they_are_read() -> None:
    for text in ("true", "7", "-2.5", "Target"):
        assert text_of(number_or_text(text)) == text
    assert text_of(3.0) == "3"
    assert number_or_text("nan") == "nan"
    assert math.isclose(float(text_of(1 / 3)), 1 / 3)
