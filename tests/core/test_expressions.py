"""Expressions: the grammar of OpenSCENARIO, and what is refused."""

from __future__ import annotations

import math

import pytest

from ssad.core.errors import ConfigError
from ssad.core.expressions import ParameterError, Value, evaluate, number_of, number_or_text, resolve_values, text_of

VALUES: dict[str, Value] = {"v": "50", "_gap": 2.5, "braking": "false", "name": "Target"}


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


NUMBERS = {"speed": 12.0, "gap": 8.0, "zero": 0.0, "max": 3.0}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("speed", 12.0),
        ("${2 * $speed + gap}", 32.0),
        ("  ${ $gap }  ", 8.0),
        ("${gap} + ${speed}", 20.0),
        ("pow(speed, 2) / (2 * 6)", 12.0),
        ("max + max(1, 2)", 5.0),
        ("gap > 5 and speed < 20", 1.0),
        ("not (gap > 5 + speed)", 1.0),
        ("pi", math.pi),
    ],
)
def test_names_of_scenario_files_may_stand_without_dollar(text: str, value: float) -> None:
    assert number_of(text, NUMBERS) == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("sped + 1", "there is no parameter 'sped'; closest: speed"),
        ("1 / (gap - 8)", "division by zero, where gap = 8"),
        ("eval(1)", "there is no function 'eval'"),
        ("speed.real", "'.real' is not understood"),
        ("gap[0]", "is not understood"),
        ("2 ** 3", "'*' is not expected"),
        ("speed speed", "'speed' is not expected"),
        ("and", "'and' is not expected"),
        ("", "ends too early"),
    ],
)
def test_errors_of_scenario_files_name_what_is_wrong(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as refused:
        number_of(text, NUMBERS)
    assert message in str(refused.value)


def test_parameters_of_one_another_in_any_order() -> None:
    values = resolve_values({"a": "b + c", "b": "2 * c", "c": 3, "ego": "ego_speed / 2"}, {"ego_speed": 10.0})
    assert values == {"a": 9.0, "b": 6.0, "c": 3.0, "ego": 5.0}


def test_a_circle_names_its_parameters() -> None:
    with pytest.raises(ParameterError, match=r"in a circle: b -> c -> b") as refused:
        resolve_values({"a": "b", "b": "c + 1", "c": "b * 2"}, {})
    assert refused.value.name == "b"
    # a known value of the same name does not hide the circle
    with pytest.raises(ParameterError, match=r"a -> a"):
        resolve_values({"a": "a + 1"}, {"a": 1.0})


def test_an_error_names_the_parameter_that_has_it() -> None:
    with pytest.raises(ParameterError, match="division by zero, where c = 0") as refused:
        resolve_values({"a": "b", "b": "1 / c", "c": 0.0}, {})
    assert refused.value.name == "b"
