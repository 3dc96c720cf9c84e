"""Arithmetic expressions of scenario files: `2 * speed + 5`, or `${2 * $speed + 5}` as in OpenSCENARIO.

Grammar, from loose to tight: `or`, `and`, `not`, comparisons (== != < <= > >=), + and -, * / and %, a sign; then
numbers, names (`speed` or `$speed`), `true`, `false`, `pi`, calls and parentheses. Functions: abs, ceil, floor, max,
min, pow, round, sign, sqrt. Comparisons and logic give 1 or 0. Nothing else can be written, so that an expression of a
file by others is safe to evaluate.

Source: ASAM OpenSCENARIO XML 1.3, section "Expressions". `%` has the sign of the dividend, and `round` moves halves
away from zero, as in C.
"""

from __future__ import annotations

import difflib
import math
import operator
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, TypeAlias

from ssad.core.errors import ConfigError

MAX_LENGTH: Final = 1000
MAX_DEPTH: Final = 50
NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
"""Names that parameters may have."""

_TOKEN: Final = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)|(?P<name>\$?[A-Za-z_][A-Za-z0-9_]*)"
    r"|(?P<sign>==|!=|<=|>=|[-+*/%()<>,]))"
)
_COMPARISONS: Final[dict[str, Callable[[float, float], bool]]] = {
    "==": operator.eq,
    "!=": operator.ne,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
}
_CONSTANTS: Final = {"true": 1.0, "false": 0.0, "pi": math.pi}
RESERVED: Final = ("and", "or", "not", "true", "false")
"""Words of the grammar that no parameter may have as its name."""


def _remainder(left: float, right: float) -> float:
    if right == 0.0:
        raise ZeroDivisionError
    return math.fmod(left, right)


_OPERATIONS: Final[dict[str, Callable[[float, float], float]]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "%": _remainder,
}


def _round(value: float) -> float:
    return math.copysign(math.floor(abs(value) + 0.5), value)


def _sign(value: float) -> float:
    return float((value > 0.0) - (value < 0.0))


FUNCTIONS: Final[dict[str, tuple[Callable[..., float], int, int]]] = {
    "abs": (abs, 1, 1),
    "ceil": (lambda value: float(math.ceil(value)), 1, 1),
    "floor": (lambda value: float(math.floor(value)), 1, 1),
    "max": (max, 2, 100),
    "min": (min, 2, 100),
    "pow": (math.pow, 2, 2),
    "round": (_round, 1, 1),
    "sign": (_sign, 1, 1),
    "sqrt": (math.sqrt, 1, 1),
}
"""Function name -> function, fewest and most arguments."""

_Node: TypeAlias = "Callable[[Mapping[str, float]], float]"


class _SyntaxError(Exception):
    """Problem of the text of an expression, in words."""


@dataclass(frozen=True)
class Expression:
    """A parsed expression.

    Attributes:
        text: The text as written.
        names: Names that it uses, in the order of their first use, without `$`.
        is_condition: Whether its value is a truth value: that of a comparison, of logic, or `true` and `false`.
    """

    text: str
    names: tuple[str, ...]
    is_condition: bool
    _node: _Node

    def value(self, values: Mapping[str, float]) -> float:
        """Return the value of the expression.

        Args:
            values: Name -> number of all names that it may use.

        Returns:
            A finite number; 1 or 0 for a condition.

        Raises:
            ConfigError: A name is unknown, a division by zero, or a result that is no finite number.
        """
        for name in self.names:
            if name not in values and name not in _CONSTANTS:
                raise ConfigError(f"'{self.text}': unknown name '{name}'; {_suggestion(name, values)}")
        try:
            value = float(self._node(values))
        except ZeroDivisionError:
            raise ConfigError(f"'{self.text}': division by zero{_numbers(self.names, values)}") from None
        except (ValueError, OverflowError):
            value = math.nan
        if not math.isfinite(value):
            raise ConfigError(f"'{self.text}': the result is not a finite number{_numbers(self.names, values)}")
        return value


def _suggestion(name: str, values: Mapping[str, float]) -> str:
    if not values:
        return "no parameters are declared"
    matches = difflib.get_close_matches(name, sorted(values), n=3, cutoff=0.0)
    return f"closest: {', '.join(matches)}"


def _numbers(used_names: Sequence[str], values: Mapping[str, float]) -> str:
    """Return the values behind an error, in words; empty: the expression uses no names."""
    listed = ", ".join(f"{name} = {values[name]:g}" for name in used_names if name in values)
    return f" where {listed}" if listed else ""


@lru_cache(maxsize=4096)
def parse_expression(text: str) -> Expression:
    """Parse an expression.

    Args:
        text: The expression, with or without `${` and `}` around it.

    Returns:
        The expression.

    Raises:
        ConfigError: It is not one; the message quotes the text and says where it goes wrong.
    """
    if len(text) > MAX_LENGTH:
        raise ConfigError(f"'{text[:40]}...': an expression has at most {MAX_LENGTH} characters, not {len(text)}")
    body = text.strip()
    if body.startswith("${") and body.endswith("}"):
        body = body[2:-1]
    try:
        parser = _Parser(body)
        node, is_condition = parser.parse()
    except _SyntaxError as error:
        raise ConfigError(f"'{text}' is not an expression: {error}") from None
    return Expression(text, tuple(dict.fromkeys(parser.names)), is_condition, node)


def evaluate(text: str, values: Mapping[str, float]) -> float:
    """Return the value of the text of an expression; see `parse_expression` and `Expression.value`."""
    return parse_expression(text).value(values)


class ParameterError(ConfigError):
    """Error in the expression of a parameter.

    Attributes:
        name: The parameter.
    """

    def __init__(self, message: str, name: str) -> None:
        super().__init__(message)
        self.name = name


def resolve_values(entries: Mapping[str, float | str], known_values: Mapping[str, float]) -> dict[str, float]:
    """Return the values of parameters that may depend on one another, in any order.

    Args:
        entries: Parameter name -> number or expression of other parameters.
        known_values: Further names that the expressions may use.

    Returns:
        Parameter name -> number, in the order of `entries`.

    Raises:
        ParameterError: An expression is wrong, or a parameter depends on itself.
    """
    values = dict(known_values) | {name: float(entry) for name, entry in entries.items() if not isinstance(entry, str)}
    # Names of parameters that are not evaluated yet must not reach the known values of the same name.
    for name, entry in entries.items():
        if isinstance(entry, str):
            values.pop(name, None)
    chain: list[str] = []

    def resolve(name: str) -> None:
        entry = entries.get(name)
        if name in values or not isinstance(entry, str):
            return
        if name in chain:
            circle = [*chain[chain.index(name) :], name]
            raise ParameterError(f"parameters depend on one another in a circle: {' -> '.join(circle)}", name)
        chain.append(name)
        try:
            expression = parse_expression(entry)
            for used_name in expression.names:
                resolve(used_name)
            values[name] = expression.value(values)
        except ParameterError:
            raise
        except ConfigError as error:
            raise ParameterError(str(error), name) from None
        finally:
            chain.pop()

    for name in entries:
        resolve(name)
    return {name: values[name] for name in entries}


class _Parser:
    """Recursive descent through the grammar; each rule returns a function of the values, and if it is a condition."""

    def __init__(self, text: str) -> None:
        self.tokens = list(_tokens(text))
        self.position = 0
        self.depth = 0
        self.names: list[str] = []

    def parse(self) -> tuple[_Node, bool]:
        rule = self.disjunction()
        if self.position < len(self.tokens):
            raise _SyntaxError(f"unexpected '{self.tokens[self.position]}'")
        return rule

    def next_is(self, *tokens: str) -> str | None:
        """Consume and return the next token if it is one of these."""
        if self.position < len(self.tokens) and self.tokens[self.position] in tokens:
            self.position += 1
            return self.tokens[self.position - 1]
        return None

    def disjunction(self) -> tuple[_Node, bool]:
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise _SyntaxError(f"nested deeper than {MAX_DEPTH} levels")
        node, is_condition = self.conjunction()
        nodes = [node]
        while self.next_is("or"):
            nodes.append(self.conjunction()[0])
        self.depth -= 1
        if len(nodes) == 1:
            return node, is_condition
        return (lambda values: float(any(operand(values) != 0.0 for operand in nodes))), True

    def conjunction(self) -> tuple[_Node, bool]:
        node, is_condition = self.negation()
        nodes = [node]
        while self.next_is("and"):
            nodes.append(self.negation()[0])
        if len(nodes) == 1:
            return node, is_condition
        return (lambda values: float(all(operand(values) != 0.0 for operand in nodes))), True

    def negation(self) -> tuple[_Node, bool]:
        is_negated, is_condition = False, False
        while self.next_is("not"):
            is_negated, is_condition = not is_negated, True
        node, is_comparison = self.comparison()
        if not is_condition:
            return node, is_comparison
        return (lambda values: float((node(values) == 0.0) is is_negated)), True

    def comparison(self) -> tuple[_Node, bool]:
        node, is_condition = self.sum()
        if sign := self.next_is(*_COMPARISONS):
            node, is_condition = _compare(_COMPARISONS[sign], node, self.sum()[0]), True
            if self.position < len(self.tokens) and self.tokens[self.position] in _COMPARISONS:
                raise _SyntaxError("comparisons do not chain; join them with 'and'")
        return node, is_condition

    def sum(self) -> tuple[_Node, bool]:
        return self.chain(self.product, "+", "-")

    def product(self) -> tuple[_Node, bool]:
        return self.chain(self.signed, "*", "/", "%")

    def chain(self, operand: Callable[[], tuple[_Node, bool]], *signs: str) -> tuple[_Node, bool]:
        """Parse operands with operators of equal rank between them, which apply from left to right."""
        first, is_condition = operand()
        steps: list[tuple[Callable[[float, float], float], _Node]] = []
        while sign := self.next_is(*signs):
            steps.append((_OPERATIONS[sign], operand()[0]))

        def result(values: Mapping[str, float]) -> float:
            # A loop and not nested calls: a long sum must not reach Python's limit of recursion.
            total = first(values)
            for operation, node in steps:
                total = operation(total, node(values))
            return total

        return (result, False) if steps else (first, is_condition)

    def signed(self) -> tuple[_Node, bool]:
        is_negative, is_signed = False, False
        while sign := self.next_is("-", "+"):
            is_negative, is_signed = is_negative != (sign == "-"), True
        node, is_condition = self.atom()
        if is_negative:
            return (lambda values: -node(values)), False
        return node, is_condition and not is_signed

    def atom(self) -> tuple[_Node, bool]:
        if self.position >= len(self.tokens):
            raise _SyntaxError("it ends too early" if self.tokens else "it is empty")
        token = self.tokens[self.position]
        self.position += 1
        if token == "(":
            node = self.disjunction()
            self.expect(")")
            return node
        if token[0].isdigit() or token[0] == ".":
            number = float(token)
            if math.isinf(number):
                raise _SyntaxError(f"{token} is too large for a number")
            return (lambda values: number), False
        if token in ("and", "or", "not") or not (token[0] in "$_" or token[0].isalpha()):
            raise _SyntaxError(f"unexpected '{token}'")
        if token in FUNCTIONS and self.next_is("("):
            return self.call(token), False
        name = token.removeprefix("$")
        if self.position < len(self.tokens) and self.tokens[self.position] == "(":
            raise _SyntaxError(f"unknown function '{name}'; known: {', '.join(FUNCTIONS)}")
        self.names.append(name)
        return (lambda values: values[name] if name in values else _CONSTANTS[name]), token in ("true", "false")

    def call(self, name: str) -> _Node:
        function, fewest, most = FUNCTIONS[name]
        arguments = [self.disjunction()[0]]
        while self.next_is(","):
            arguments.append(self.disjunction()[0])
        self.expect(")")
        if not fewest <= len(arguments) <= most:
            raise _SyntaxError(f"{name} takes {fewest} argument{'s' if fewest > 1 else ''}, not {len(arguments)}")
        return lambda values: function(*(argument(values) for argument in arguments))

    def expect(self, token: str) -> None:
        if not self.next_is(token):
            where = f"before '{self.tokens[self.position]}'" if self.position < len(self.tokens) else "at the end"
            raise _SyntaxError(f"'{token}' is missing {where}")


def _tokens(text: str) -> Iterator[str]:
    position = 0
    text = text.rstrip()
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None:
            raise _SyntaxError(f"unexpected '{text[position:].lstrip()[:1]}'")
        yield match.group().strip()
        position = match.end()


def _compare(operation: Callable[[float, float], bool], left: _Node, right: _Node) -> _Node:
    return lambda values: float(operation(left(values), right(values)))
