"""Expressions over named values: the grammar of OpenSCENARIO XML 1.1 and later, with its extensions in use.

SSAD's scenario files use the same grammar, in which names also stand alone: `2 * speed + 5` is `${2 * $speed + 5}`.

    expression := or ; or := and ("or" and)* ; and := comparison ("and" comparison)*
    comparison := sum (("<" | "<=" | ">" | ">=" | "==" | "!=") sum)?
    sum := product (("+" | "-") product)* ; product := unary (("*" | "/" | "%") unary)*
    unary := ("-" | "+" | "not") unary | number | "true" | "false" | constant | "$" name | function "(" ... ")"
             | "(" expression ")"

Numbers are real: 3 / 2 is 1.5. The remainder has the sign of the dividend, as in C. Comparisons, trigonometric
functions (rad) and pi are extensions that esmini and others read too.

Source: ASAM OpenSCENARIO XML 1.3, section on parameters, expressions.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from typing import Final

from ssad.core.errors import ConfigError

Value = float | int | bool | str
Lookup = Callable[[str], Value]

MAX_LENGTH: Final = 4_000
MAX_DEPTH: Final = 100
MAX_WHOLE: Final = 2**53
_TOKEN = re.compile(
    r"\s*(?:(?P<number>(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?)|\$\{?\s*(?P<name>[^\W\d][\w.]*)\}?|(?P<word>[A-Za-z_]\w*)"
    r"|(?P<sign><=|>=|==|!=|[-+*/%(),<>]))"
)
_CONSTANTS: Final[Mapping[str, Value]] = {"true": True, "false": False, "pi": math.pi}


def _round(value: float) -> float:
    return math.copysign(math.floor(abs(value) + 0.5), value)


def _sign(value: float) -> float:
    return 0.0 if value == 0.0 else math.copysign(1.0, value)


_FUNCTIONS: Final[Mapping[str, tuple[int, Callable[..., float]]]] = {
    "pow": (2, math.pow),
    "sqrt": (1, math.sqrt),
    "sign": (1, _sign),
    "round": (1, _round),
    "floor": (1, math.floor),
    "ceil": (1, math.ceil),
    "abs": (1, abs),
    "max": (2, max),
    "min": (2, min),
    "sin": (1, math.sin),
    "cos": (1, math.cos),
    "tan": (1, math.tan),
    "asin": (1, math.asin),
    "acos": (1, math.acos),
    "atan": (1, math.atan),
    "atan2": (2, math.atan2),
    "exp": (1, math.exp),
    "log": (1, math.log),
}
RESERVED: Final = frozenset({"and", "or", "not", "true", "false", "pi"})
"""Words that no parameter can have as its name."""
_COMPARISONS: Final[Mapping[str, Callable[[float, float], bool]]] = {
    "<": lambda a, b: a < b,
    "<=": lambda a, b: a <= b,
    ">": lambda a, b: a > b,
    ">=": lambda a, b: a >= b,
}


def evaluate(expression: str, values: Mapping[str, Value] | Lookup, *, bare_names: bool = False) -> Value:
    """Evaluate an expression.

    Args:
        expression: The text, without the `${` and `}` around it.
        values: Value of each name, or a function that returns it and raises KeyError for an unknown name. A text that
            is a number or a truth value counts as one.
        bare_names: Whether a name may stand without `$`.

    Returns:
        The value: a number, a truth value, or a text if the expression is a single name of a text.

    Raises:
        ConfigError: It is no expression, has an unknown name, or has no finite value; the message quotes it.
    """
    if len(expression) > MAX_LENGTH:
        raise ConfigError(f"an expression of {len(expression)} characters; at most {MAX_LENGTH} are read")
    parser = _Parser(expression, values if callable(values) else values.__getitem__, bare_names)
    try:
        value = parser.parse()
    except ZeroDivisionError:
        raise parser.error("division by zero") from None
    except (ValueError, OverflowError):
        raise parser.error("it has no real value") from None
    except RecursionError:
        raise parser.error("too many nested brackets") from None
    if isinstance(value, float) and not math.isfinite(value):
        raise parser.error("its value is not finite")
    return value


def number_or_text(text: str) -> Value:
    """Return the number or truth value that a text states, else the text."""
    stripped = text.strip()
    if stripped in ("true", "false"):
        return stripped == "true"
    try:
        return int(stripped)
    except ValueError:
        pass
    try:
        value = float(stripped)
    except ValueError:
        return text
    return value if math.isfinite(value) else text


def text_of(value: Value) -> str:
    """Return a value as OpenSCENARIO writes it."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, float):
        return repr(int(value)) if value.is_integer() and abs(value) < 1e15 else repr(value)
    return str(value)


class ParameterError(ConfigError):
    """Error of the expression of a parameter.

    Attributes:
        name: The parameter.
    """

    def __init__(self, message: str, name: str) -> None:
        super().__init__(message)
        self.name = name


def resolve_values(entries: Mapping[str, float | str], known_values: Mapping[str, float]) -> dict[str, float]:
    """Return the values of parameters that may depend on one another, in any order.

    Args:
        entries: Parameter name -> number, or expression (see `number_of`) of other parameters.
        known_values: Values of further names, for those that are not among the entries.

    Returns:
        Parameter name -> number, in the order of the entries.

    Raises:
        ParameterError: An expression is wrong, or a parameter depends on itself.
    """
    values: dict[str, float] = {}
    chain: list[str] = []

    def resolve(name: str) -> float:
        if name not in entries:
            return known_values[name]
        if name in chain:
            circle = " -> ".join([*chain[chain.index(name) :], name])
            raise ParameterError(f"parameters depend on one another in a circle: {circle}", name)
        if name not in values:
            chain.append(name)
            entry = entries[name]
            try:
                names = {*entries, *known_values}
                values[name] = number_of(entry, resolve, names) if isinstance(entry, str) else float(entry)
            except ParameterError:
                raise
            except ConfigError as error:
                raise ParameterError(str(error), name) from None
            chain.pop()
        return values[name]

    for name in entries:
        resolve(name)
    return {name: values[name] for name in entries}


def number_of(text: str, values: Mapping[str, float] | Lookup, names: Iterable[str] = ()) -> float:
    """Return the number that an expression of a scenario file states.

    Args:
        text: The expression, with or without `${` and `}` around it; names may stand without `$`.
        values: Value of each name, as for `evaluate`.
        names: Names that are suggested for an unknown one; empty: those of a mapping of values.

    Raises:
        ConfigError: As for `evaluate`, or the value is no number. The message has the values of its names.
    """
    body = text.strip()
    if body.startswith("${") and body.endswith("}") and "}" not in body[2:-1]:
        body = body[2:-1]
    lookup = values if callable(values) else values.__getitem__
    used_values: dict[str, Value] = {}

    def recording_lookup(name: str) -> Value:
        try:
            used_values[name] = lookup(name)
        except KeyError:
            known_names = sorted({*names} or (set() if callable(values) else {*values}))
            suggestions = ", ".join(get_close_matches(name, known_names, n=3, cutoff=0.0))
            hint = f"; closest: {suggestions}" if suggestions else ", and none is declared"
            raise ConfigError(f"expression '{text.strip()[:80]}': there is no parameter '{name}'{hint}") from None
        return used_values[name]

    try:
        value = evaluate(body, recording_lookup, bare_names=True)
    except ParameterError:
        raise
    except ConfigError as error:
        listed = ", ".join(f"{name} = {text_of(value)}" for name, value in used_values.items())
        raise ConfigError(f"{error}{f', where {listed}' if listed else ''}") from None
    if isinstance(value, str):
        raise ConfigError(f"expression '{text.strip()[:80]}': '{value[:40]}' is not a number")
    return float(value)


class _Parser:
    """Recursive descent over the tokens of one expression, which evaluates as it goes."""

    def __init__(self, expression: str, lookup: Lookup, bare_names: bool) -> None:
        self.expression, self.lookup, self.bare_names = expression, lookup, bare_names
        self.tokens: list[tuple[str, str]] = []
        self.index = self.depth = 0
        position = 0
        text = expression.rstrip()
        while position < len(text):
            match = _TOKEN.match(text, position)
            if match is None or match.lastgroup is None:
                raise self.error(f"'{text[position:].strip()[:20]}' is not understood")
            self.tokens.append((match.lastgroup, match[match.lastgroup]))
            position = match.end()

    def error(self, problem: str) -> ConfigError:
        """Return an error that quotes the expression."""
        return ConfigError(f"expression '{self.expression.strip()[:80]}': {problem}")

    def parse(self) -> Value:
        """Return the value of all tokens."""
        value = self.disjunction()
        if self.index < len(self.tokens):
            raise self.error(f"'{self.tokens[self.index][1]}' is not expected there")
        return value

    def take(self, *texts: str) -> str | None:
        """Consume and return the next token if it is one of these signs or words."""
        if self.index < len(self.tokens):
            group, text = self.tokens[self.index]
            if group in ("sign", "word") and text in texts:
                self.index += 1
                return text
        return None

    def number(self, value: Value) -> float:
        """Return a value as an operand. ConfigError if it is a text or a truth value."""
        if isinstance(value, (str, bool)):
            raise self.error(f"'{text_of(value)[:40]}' is not a number")
        # Large whole numbers become floats: products of them would otherwise grow without limit.
        return float(value) if abs(value) > MAX_WHOLE else value

    def truth(self, value: Value) -> bool:
        """Return a value as a truth value. ConfigError if it is none."""
        if not isinstance(value, bool):
            raise self.error(f"'{text_of(value)[:40]}' is neither true nor false")
        return value

    def disjunction(self) -> Value:
        """Return the value of conjunctions that `or` joins."""
        value = self.conjunction()
        while self.take("or"):
            other = self.truth(self.conjunction())
            value = self.truth(value) or other
        return value

    def conjunction(self) -> Value:
        """Return the value of comparisons that `and` joins."""
        value = self.comparison()
        while self.take("and"):
            other = self.truth(self.comparison())
            value = self.truth(value) and other
        return value

    def comparison(self) -> Value:
        """Return the value of a sum, or of a comparison of two."""
        value = self.sum()
        operator = self.take("<", "<=", ">", ">=", "==", "!=")
        if operator is None:
            return value
        other = self.sum()
        if operator in _COMPARISONS:
            return _COMPARISONS[operator](self.number(value), self.number(other))
        return (value == other) == (operator == "==")

    def sum(self) -> Value:
        """Return the value of products that + and - join."""
        value = self.product()
        while operator := self.take("+", "-"):
            left, right = self.number(value), self.number(self.product())
            value = left + right if operator == "+" else left - right
        return value

    def product(self) -> Value:
        """Return the value of factors that *, / and % join."""
        value = self.unary()
        while operator := self.take("*", "/", "%"):
            left, right = self.number(value), self.number(self.unary())
            if operator == "*":
                value = left * right
            elif right == 0:
                raise ZeroDivisionError
            else:
                value = left / right if operator == "/" else math.fmod(left, right)
        return value

    def unary(self) -> Value:
        """Return the value of a factor with its signs."""
        self.depth += 1
        if self.depth > MAX_DEPTH:
            raise self.error("too many nested brackets or signs")
        try:
            if operator := self.take("-", "+", "not"):
                value = self.unary()
                if operator == "not":
                    return not self.truth(value)
                return -self.number(value) if operator == "-" else self.number(value)
            return self.primary()
        finally:
            self.depth -= 1

    def primary(self) -> Value:
        """Return the value of a number, a name, a function or a bracket."""
        if self.take("("):
            value = self.disjunction()
            self.expect(")")
            return value
        if self.index >= len(self.tokens):
            raise self.error("it ends too early")
        group, text = self.tokens[self.index]
        self.index += 1
        if group == "number":
            return int(text) if text.isdecimal() else float(text)
        is_call = self.index < len(self.tokens) and self.tokens[self.index] == ("sign", "(")
        is_bare_name = self.bare_names and text not in RESERVED and not is_call
        if group == "name" or (group == "word" and is_bare_name):
            try:
                value = self.lookup(text)
            except KeyError:
                raise self.error(f"there is no parameter '{text}'") from None
            return number_or_text(value) if isinstance(value, str) else value
        if group == "word" and text in _CONSTANTS:
            return _CONSTANTS[text]
        if group == "word" and text in _FUNCTIONS:
            return self.call(text)
        if group == "word" and self.bare_names and text not in RESERVED:
            raise self.error(f"there is no function '{text}'; functions: {', '.join(_FUNCTIONS)}")
        if group == "word" and not self.bare_names:
            function_names = ", ".join(_FUNCTIONS)
            raise self.error(
                f"'{text}' is no function or constant; functions: {function_names}; parameters are written $name"
            )
        raise self.error(f"'{text}' is not expected there")

    def call(self, name: str) -> Value:
        """Return the value of a function of the arguments that follow."""
        count, function = _FUNCTIONS[name]
        self.expect("(")
        arguments = [self.number(self.disjunction())]
        while self.take(","):
            arguments.append(self.number(self.disjunction()))
        self.expect(")")
        if len(arguments) != count and not (name in ("max", "min") and len(arguments) > 1):
            raise self.error(f"{name} takes {count} arguments, not {len(arguments)}")
        return function(*arguments)

    def expect(self, text: str) -> None:
        """Consume a sign. ConfigError if another token comes."""
        if not self.take(text):
            raise self.error(f"'{text}' is missing")
