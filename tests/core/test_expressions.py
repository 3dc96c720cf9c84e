import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ssad.core.errors import ConfigError
from ssad.core.expressions import ParameterError, evaluate, parse_expression, resolve_values

VALUES = {"speed": 12.0, "gap": 8.0, "zero": 0.0}


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("3", 3.0),
        (".5e1", 5.0),
        ("speed", 12.0),
        ("$speed", 12.0),
        ("${2 * $speed + gap}", 32.0),
        ("  ${ $gap }  ", 8.0),
        ("1 - 2 - 3", -4.0),
        ("24 / 4 / 3 * 2", 4.0),
        ("1 + 2 * 3", 7.0),
        ("(1 + 2) * 3", 9.0),
        ("-2 * -3", 6.0),
        ("2 - -3", 5.0),
        ("- -speed", 12.0),
        ("7 % 4", 3.0),
        ("-7 % 4", -3.0),  # as in C
        ("pow(speed, 2) / (2 * 6)", 12.0),
        ("sqrt(gap * 2) + abs(-1) + sign(-4)", 4.0),
        ("round(2.5) + round(-2.5) + floor(-0.5) + ceil(0.5)", 0.0),
        ("min(speed, gap, 9) + max(1, 2)", 10.0),
        ("pi", math.pi),
        ("gap > 5 and speed < 20", 1.0),
        ("gap > 5 + speed", 0.0),
        ("not gap > 5 or speed == 12", 1.0),
        ("not not true", 1.0),
        ("1 or 0 and 0", 1.0),
        ("gap != 8 or gap <= 7 or gap >= 9", 0.0),
    ],
)
def test_values(text: str, expected: float) -> None:
    assert evaluate(text, VALUES) == pytest.approx(expected)


@pytest.mark.parametrize(
    ("text", "is_condition"),
    [("gap > 5", True), ("not 1", True), ("true", True), ("gap", False), ("(gap > 5) + 1", False), ("(1 < 2)", True)],
)
def test_conditions_are_told_from_numbers(text: str, is_condition: bool) -> None:
    assert parse_expression(text).is_condition is is_condition


def test_names_in_the_order_of_their_first_use() -> None:
    assert parse_expression("${$b + a * min(b, c)}").names == ("b", "a", "c")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("spede + 1", "unknown name 'spede'; closest: speed"),
        ("1 / zero", "division by zero where zero = 0"),
        ("1 % zero", "division by zero"),
        ("sqrt(-gap)", "not a finite number where gap = 8"),
        ("pow(10, 400)", "not a finite number"),
        ("1e308 * 10", "not a finite number"),
        ("1e999", "too large"),
        ("", "it is empty"),
        ("1 +", "it ends too early"),
        ("1 2", "unexpected '2'"),
        ("1 < 2 < 3", "do not chain"),
        ("(1", "')' is missing at the end"),
        ("min(1 2)", "')' is missing before '2'"),
        ("sqrt(1, 2)", "sqrt takes 1 argument, not 2"),
        ("eval(1)", "unknown function 'eval'"),
        ("speed.real", "unexpected '.'"),
        ("__import__('os')", "unexpected '''"),
        ("gap[0]", "unexpected '['"),
        ("2 ** 3", "unexpected '*'"),
        ("and 1", "unexpected 'and'"),
        ("(" * 60 + "1" + ")" * 60, "nested deeper"),
        ("1 + " * 400 + "1", "at most 1000 characters"),
    ],
)
def test_errors_quote_the_expression(text: str, message: str) -> None:
    with pytest.raises(ConfigError) as error:
        evaluate(text, VALUES)
    assert message in str(error.value)


def test_long_sums_are_evaluated() -> None:
    assert evaluate("+".join(["1"] * 500), {}) == 500.0
    assert evaluate("(" * 45 + "1" + ")" * 45 + "-1" * 400, {}) == -399.0


def test_parameters_of_one_another_in_any_order() -> None:
    values = resolve_values({"a": "b + c", "b": "2 * c", "c": 3, "ego": "ego_speed / 2"}, {"ego_speed": 10.0})
    assert values == {"a": 9.0, "b": 6.0, "c": 3.0, "ego": 5.0}


def test_a_circle_names_its_parameters() -> None:
    with pytest.raises(ParameterError, match=r"in a circle: b -> c -> b") as error:
        resolve_values({"a": "b", "b": "c + 1", "c": "b * 2"}, {})
    assert error.value.name == "b"
    # a known value of the same name does not hide the circle
    with pytest.raises(ParameterError, match=r"a -> a"):
        resolve_values({"a": "a + 1"}, {"a": 1.0})


def test_an_error_names_the_parameter_that_has_it() -> None:
    with pytest.raises(ParameterError, match="division by zero") as error:
        resolve_values({"a": "b", "b": "1 / c", "c": 0.0}, {})
    assert error.value.name == "b"


NUMBERS = st.floats(0.1, 100.0).map(lambda value: repr(round(value, 3)))
EXPRESSIONS = st.recursive(
    NUMBERS,
    lambda inner: st.one_of(
        st.tuples(inner, st.sampled_from("+-*/"), inner).map(lambda parts: f"({' '.join(parts)})"),
        inner.map(lambda text: f"-{text}"),
        st.tuples(inner, st.sampled_from("+-*/"), inner, st.sampled_from("+-*/"), inner).map(" ".join),
        inner.map(lambda text: f"abs({text})"),
    ),
    max_leaves=8,
)


@given(EXPRESSIONS)
def test_arithmetic_is_that_of_python(text: str) -> None:
    try:
        expected = float(eval(text, {"abs": abs}))
    except ZeroDivisionError:
        with pytest.raises(ConfigError, match="division by zero"):
            evaluate(text, {})
        return
    assert evaluate(text, {}) == expected
