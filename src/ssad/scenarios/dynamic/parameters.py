"""Parameters of scenarios: those of their class, those that they declare, and the expressions that use them."""

from __future__ import annotations

import dataclasses
import itertools
import math
import re
import types
import typing
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from typing import Any, Final

from ssad.core.errors import ConfigError
from ssad.core.expressions import RESERVED, ParameterError, number_of, resolve_values, text_of
from ssad.core.safeio import Document, Location, format_location
from ssad.core.types import DeclaredParameter, Scenario
from ssad.scenarios.dynamic.catalogue import CUSTOM, scenario_type
from ssad.scenarios.dynamic.knowledge._kind import Parameter

TARGET_SPEED: Final = "target_speed"
"""Name of the ego's target speed among the parameters; it is a key of the scenario, not one of its parameters."""
MAX_GRID: Final = 100_000
"""Most values of a grid, and most points of a sweep."""
_NAME: Final = re.compile(r"[A-Za-z_][A-Za-z0-9_]*")
_NUMBERS: Final = (float, int)
_NUMBER: Final = re.compile(r"\s*[-+]?[\d.]+(?:[eE][-+]?\d+)?\s*")
"""A number as text, which is refused: quotes around it are a slip."""
_NO_NUMBERS: Final = ("seed", "declared", "expressions")  # fields of a scenario in which no expression stands
_STEP: Final = re.compile(r"\[(\d+)\]|([^.\[\]]+)")
_TOLERANCE: Final = 1e-9  # of a whole number, relative; and of the steps of a grid


# ---------------------------------------------------------------- values


def parameter_values(scenario: Scenario) -> dict[str, float]:
    """Return the value of every parameter of a scenario: of its class, of the ego's start, and declared.

    Args:
        scenario: The scenario.

    Raises:
        ParameterError: An expression of a parameter is wrong, or a parameter depends on itself.
    """
    box = scenario_type(scenario.type).box
    entries: dict[str, float | str] = {name: parameter.default for name, parameter in box.items()}
    entries |= scenario.parameters
    for location, text in scenario.expressions.items():
        if location.startswith("parameters."):
            entries[location.removeprefix("parameters.")] = text
    entries |= {name: declaration.value for name, declaration in scenario.declared.items()}
    known_values = {} if TARGET_SPEED in scenario.expressions else {TARGET_SPEED: scenario.target_speed}
    return resolve_values(entries, known_values)


def scenario_parameters(scenario: Scenario) -> dict[str, Parameter]:
    """Return the parameters of a scenario: those of its class, those of the ego's start, and those that it declares.

    A declaration of a parameter of the class replaces its range and its spread. A declared parameter without a range
    may have any value, and no search varies it.

    Args:
        scenario: The scenario.

    Returns:
        Parameter name -> range, value in the scenario, unit and spread.
    """
    box = dict(scenario_type(scenario.type).box)
    values = parameter_values(scenario) if scenario.declared else {}
    for name, declaration in scenario.declared.items():
        base = box.get(name)
        low, high = declaration.range or (base.limits if base else (-math.inf, math.inf))
        spread = declaration.spread if declaration.spread is not None else base.spread if base else 0.0
        box[name] = Parameter(
            name,
            low,
            high,
            default=min(max(values[name], low), high),
            unit=declaration.unit or (base.unit if base else ""),
            doc=declaration.doc or (base.doc if base else f"parameter {name}"),
            spread=min(spread, high - low),
        )
    return box


def is_derived(scenario: Scenario, name: str) -> bool:
    """Return whether a parameter, or the target speed, follows from other parameters by an expression."""
    if name in scenario.declared:
        return isinstance(scenario.declared[name].value, str)
    return (name if name == TARGET_SPEED else f"parameters.{name}") in scenario.expressions


def with_parameters(scenario: Scenario, values: Mapping[str, float]) -> Scenario:
    """Return a scenario with other values of its parameters, and all that depends on them evaluated anew.

    Args:
        scenario: The scenario.
        values: Parameter name, or `target_speed` -> number. The others keep their values, or follow by their
            expressions.

    Raises:
        ConfigError: There is no such parameter, an expression has no value, or a value has no room in its key.
    """
    box = scenario_type(scenario.type).box
    declared, expressions, parameters = dict(scenario.declared), dict(scenario.expressions), dict(scenario.parameters)
    target_speed = scenario.target_speed
    for name, value in values.items():
        number = float(value)
        if name in declared:
            declared[name] = dataclasses.replace(declared[name], value=number)
        elif name not in box and name != TARGET_SPEED:
            known_names = ", ".join([*declared, *box, TARGET_SPEED])
            raise ConfigError(f"scenario {scenario.name}: no such parameter '{name}'; it has: {known_names}")
        if name == TARGET_SPEED:
            target_speed = number
            expressions.pop(TARGET_SPEED, None)
        elif name in box:
            parameters[name] = number
            expressions.pop(f"parameters.{name}", None)
    scenario = dataclasses.replace(
        scenario, declared=declared, expressions=expressions, parameters=parameters, target_speed=target_speed
    )
    return evaluated(scenario) if declared or expressions else scenario


def evaluated(scenario: Scenario) -> Scenario:
    """Return a scenario whose keys have the values of its expressions.

    Raises:
        ConfigError: An expression has no value; names the scenario and the key.
    """
    try:
        values = parameter_values(scenario)
    except ParameterError as error:
        raise ConfigError(f"scenario {scenario.name}: parameters.{error.name}: {error}") from None
    box = scenario_type(scenario.type).box
    parameters = {name: values[name] for name in scenario.declared if name in box}
    scenario = dataclasses.replace(scenario, parameters={**scenario.parameters, **parameters})
    known_values = _names_of(scenario, values)
    for location, text in scenario.expressions.items():
        try:
            scenario = _with_value(scenario, _steps(location), _value_at(_steps(location), text, known_values))
        except ConfigError as error:
            raise ConfigError(f"scenario {scenario.name}: {location}: {error}") from None
        except (AttributeError, LookupError, TypeError):
            raise ConfigError(
                f"scenario {scenario.name}: {location}: its expression '{text}' belongs to a key that is not there"
            ) from None
    return scenario


def _names_of(scenario: Scenario, values: Mapping[str, float]) -> dict[str, float]:
    """Return the values of all names that an expression of a key may use."""
    if TARGET_SPEED in scenario.expressions:
        return dict(values)
    return {TARGET_SPEED: scenario.target_speed, **values}


def violated_constraint(scenario: Scenario) -> tuple[int, str] | None:
    """Return the first constraint that a scenario violates: its index, and a message; None: it keeps all.

    Raises:
        ParameterError: An expression of a parameter is wrong, or a parameter depends on itself.
    """
    if not scenario.constraints:
        return None
    values = _names_of(scenario, parameter_values(scenario))
    for index, constraint in enumerate(scenario.constraints):
        used_values: dict[str, float] = {}

        def lookup(name: str, used_values: dict[str, float] = used_values) -> float:
            used_values[name] = values[name]
            return values[name]

        try:
            holds = number_of(constraint, lookup, values)
        except ConfigError as error:
            return index, str(error)
        if not holds:
            listed = ", ".join(f"{name} = {text_of(value)}" for name, value in used_values.items())
            return index, f"'{constraint}' does not hold where {listed}"
    return None


# ---------------------------------------------------------------- grids


def grid_values(entry: Any) -> tuple[float, ...]:
    """Return the values of a grid along one parameter.

    Args:
        entry: A list of numbers, or a mapping `{from: 0, to: 1, step: 0.25}` or `{from: 0, to: 1, count: 5}`; `to` is
            a value of the grid if steps lead to it.

    Raises:
        ConfigError: It is neither, is empty, or has a value twice.
    """
    if isinstance(entry, Mapping):
        values = _range_values(entry)
    elif isinstance(entry, Sequence) and not isinstance(entry, str):
        values = [float(value) for value in entry if _is_number(value)]
        if len(values) != len(entry):
            raise ConfigError("a grid has numbers alone")
    else:
        raise ConfigError("a grid is a list of numbers, or {from: 0, to: 1, step: 0.25}, or {from: 0, to: 1, count: 5}")
    if not values:
        raise ConfigError("the grid is empty")
    if len(set(values)) < len(values):
        repeated_value = next(value for value in values if values.count(value) > 1)
        raise ConfigError(f"the grid has {repeated_value:g} twice")
    return tuple(values)


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _range_values(entry: Mapping[str, Any]) -> list[float]:
    keys = set(entry)
    if keys not in ({"from", "to", "step"}, {"from", "to", "count"}):
        raise ConfigError(f"a grid has the keys from, to, and step or count, not: {', '.join(map(str, entry))}")
    for key, value in entry.items():
        if not _is_number(value):
            raise ConfigError(f"{key} of a grid is a number, not {value!r}")
    first, last = float(entry["from"]), float(entry["to"])
    if first > last:
        raise ConfigError(f"the grid from {first:g} to {last:g} is empty")
    if "count" in keys:
        count = entry["count"]
        if not isinstance(count, int) or not 1 <= count <= MAX_GRID or (count == 1 and first != last):
            raise ConfigError(f"count of a grid is a whole number from 2 to {MAX_GRID}, not {count}")
        step = (last - first) / max(count - 1, 1)
    else:
        step = float(entry["step"])
        if step <= 0.0:
            raise ConfigError(f"step of a grid is more than 0, not {step:g}")
        if (last - first) / step >= MAX_GRID:
            raise ConfigError(f"the grid from {first:g} to {last:g} has more than {MAX_GRID} values")
        count = math.floor((last - first) / step + _TOLERANCE) + 1
    # Rounding writes 0.3 where steps of 0.1 add up to 0.30000000000000004.
    return [float(f"{first + index * step:.12g}") for index in range(count)]


@dataclasses.dataclass(frozen=True)
class GridPoint:
    """Scenario at a point of a grid.

    Attributes:
        scenario: The scenario, whose name ends with the values.
        values: Parameter name -> value.
    """

    scenario: Scenario
    values: Mapping[str, float]


class GridError(ConfigError):
    """Error of a grid; `name` is the parameter, empty if it concerns all."""

    def __init__(self, message: str, name: str = "") -> None:
        super().__init__(message)
        self.name = name


def grid_points(
    scenario: Scenario, grids: Mapping[str, Sequence[float] | None], *, zipped: bool = False
) -> tuple[GridPoint, ...]:
    """Return a scenario at the points of a grid that meet its constraints.

    Args:
        scenario: The nominal scenario.
        grids: Parameter name, or `target_speed` -> values (see `grid_values`); None: the grid that the scenario
            declares for the parameter.
        zipped: Whether the first values make the first point, the second ones the second, and so on; else all
            combinations are points, of which the last parameter varies fastest.

    Returns:
        The points in their order.

    Raises:
        GridError: The scenario has no such parameter, a value is out of its range, the grid has too many points, or
            none of them meets the constraints.
    """
    parameters = scenario_parameters(scenario)
    axes: dict[str, Sequence[float]] = {}
    for name, values in grids.items():
        if name not in parameters and name != TARGET_SPEED:
            known_names = ", ".join([*scenario.declared, *(n for n in parameters if n not in scenario.declared)])
            raise GridError(f"scenario {scenario.name} has no such parameter; it has: {known_names}", name)
        declared_grid = scenario.declared[name].grid if name in scenario.declared else ()
        axes[name] = declared_grid if values is None else values
        if not axes[name]:
            raise GridError(f"scenario {scenario.name} declares no grid for it", name)
        for value in axes[name]:
            problem = parameters[name].problem(value) if name in parameters else None
            if problem:
                raise GridError(f"scenario {scenario.name}: {problem}", name)
    lengths = {name: len(values) for name, values in axes.items()}
    if zipped and len(set(lengths.values())) > 1:
        listed = ", ".join(f"{name} {length}" for name, length in lengths.items())
        raise GridError(f"grids that are zipped have equally many values, not: {listed}")
    if not zipped and math.prod(lengths.values()) > MAX_GRID:
        raise GridError(f"{math.prod(lengths.values())} points; a sweep has at most {MAX_GRID}")
    combinations = zip(*axes.values(), strict=True) if zipped else itertools.product(*axes.values())
    points = []
    violation = None
    for combination in combinations:
        point = dict(zip(axes, combination, strict=True))
        suffix = "/".join(f"{name}={text_of(value)}" for name, value in point.items())
        member = dataclasses.replace(with_parameters(scenario, point), name=f"{scenario.name}/{suffix}")
        violation = violated_constraint(member)
        if violation is None:
            points.append(GridPoint(member, point))
    if not points:
        raise GridError(
            f"scenario {scenario.name}: no point meets the constraints; the last: {violation and violation[1]}"
        )
    return tuple(points)


# ---------------------------------------------------------------- plain data


def resolve_data(data: Mapping[str, Any], document: Document, place: Location) -> dict[str, Any]:
    """Return the plain data of a scenario with numbers in the place of expressions, which stand in keys of their own.

    Args:
        data: A scenario as YAML or JSON gives it.
        document: The document that contains the data, for messages.
        place: Location of the data in the document.

    Raises:
        ConfigError: A declaration or an expression is wrong; the message names file, line and key.
    """
    resolved = dict(data)
    given = data.get("parameters")
    parameters = dict(given) if isinstance(given, Mapping) else {}
    declared = {name: entry for name, entry in parameters.items() if isinstance(entry, Mapping)}
    texts: dict[Location, str] = {}
    _collect_texts(data, Scenario, (), texts)
    if not declared and not texts:
        return resolved
    try:
        box = scenario_type(str(data.get("type"))).box
    except ConfigError as error:
        raise document.error((*place, "type"), str(error)) from None
    declarations = {
        name: _declaration_data(entry, document, (*place, "parameters", name)) for name, entry in declared.items()
    }
    entries: dict[str, float | str] = {name: parameter.default for name, parameter in box.items()}
    entries |= {name: entry for name, entry in parameters.items() if isinstance(entry, str) or _is_number(entry)}
    entries |= {name: entry["value"] for name, entry in declarations.items()}
    target_speed = data.get(TARGET_SPEED, Scenario.target_speed)
    try:
        values = resolve_values(entries, {TARGET_SPEED: target_speed} if _is_number(target_speed) else {})
    except ParameterError as error:
        value_key = ("value",) if error.name in declared else ()
        raise document.error((*place, "parameters", error.name, *value_key), str(error)) from None
    class_values = {name: values[name] for name in declared if name in box}
    if given is not None:
        resolved["parameters"] = {name: entry for name, entry in parameters.items() if name not in declared}
        resolved["parameters"] |= class_values
    known_values = {TARGET_SPEED: float(target_speed)} | values if _is_number(target_speed) else values
    for location, text in texts.items():
        try:
            value = _value_at(location, text, known_values)
        except ConfigError as error:
            raise document.error((*place, *location), str(error)) from None
        resolved = _with_item(resolved, location, value)
    resolved["declared"] = declarations
    resolved["expressions"] = {format_location(location): text for location, text in texts.items()}
    return resolved


def _declaration_data(entry: Mapping[str, Any], document: Document, place: Location) -> dict[str, Any]:
    """Return the data of a declaration, with its grid as a list."""
    declaration = dict(entry)
    if problem := _name_problem(str(place[-1])):
        raise document.error(place, problem)
    if not (isinstance(declaration.get("value"), str) or _is_number(declaration.get("value"))):
        if "value" in declaration:
            raise document.error((*place, "value"), f"a number or an expression, not {declaration['value']!r}")
        raise document.error(place, "key 'value' is missing: the value that the parameter has if nothing varies it")
    if "grid" in declaration:
        try:
            declaration["grid"] = list(grid_values(declaration["grid"]))
        except ConfigError as error:
            raise document.error((*place, "grid"), str(error)) from None
    return declaration


def insert_expressions(data: dict[str, Any], scenario: Scenario) -> None:
    """Write declarations and expressions of a scenario into its plain data, where its file has them."""
    for location, text in scenario.expressions.items():
        container: Any = data
        *path, last = _steps(location)
        for step in path:
            container = container.setdefault(step, {}) if isinstance(container, dict) else container[int(step)]
        container[last] = text
    if scenario.declared:
        parameters = data.setdefault("parameters", {})
        for name, declaration in scenario.declared.items():
            parameters[name] = {
                field.name: list(value) if isinstance(value, tuple) else value
                for field in dataclasses.fields(declaration)
                if (value := getattr(declaration, field.name)) != field.default
            }


def _collect_texts(data: Any, hint: Any, location: tuple[str | int, ...], texts: dict[Location, str]) -> None:
    """Collect the texts that stand where a type expects a number, by their locations."""
    if isinstance(data, _NUMBERS):  # fast path: most leaves are numbers
        return
    hint = _without_none(hint)
    if hint in (float, int):
        if isinstance(data, str) and not _NUMBER.fullmatch(data):
            texts[location] = data
    elif _has_fields(hint):
        if isinstance(data, Mapping):
            for key, value in data.items():
                if key in _hints(hint) and not (hint is Scenario and key in _NO_NUMBERS):
                    _collect_texts(value, _hints(hint)[key], (*location, key), texts)
    elif typing.get_origin(hint) is tuple:
        if isinstance(data, list | tuple):
            if all(type(value) in _NUMBERS for value in data):  # fast path: rows of trajectories
                return
            for index, value in enumerate(data):
                _collect_texts(value, _item_hint(hint, index), (*location, index), texts)
    elif typing.get_origin(hint) is not None and isinstance(data, Mapping):
        for key, value in data.items():
            _collect_texts(value, _item_hint(hint, key), (*location, key), texts)


def _item_hint(hint: Any, step: str | int) -> Any:
    """Return the type of an item of a mapping or a tuple."""
    arguments = typing.get_args(hint)
    if isinstance(step, str):
        return arguments[-1]
    return arguments[0] if arguments[-1] is ... else arguments[min(step, len(arguments) - 1)]


def _has_fields(hint: Any) -> bool:
    return dataclasses.is_dataclass(hint)


@cache
def _hints(dataclass_type: Any) -> dict[str, Any]:
    return typing.get_type_hints(dataclass_type)


@cache
def _without_none(hint: Any) -> Any:
    """Return the type of an optional value; None for a union of several."""
    if typing.get_origin(hint) not in (typing.Union, types.UnionType):
        return hint
    members = [member for member in typing.get_args(hint) if member is not type(None)]
    return members[0] if len(members) == 1 else None


def _hint_at(location: Location) -> Any:
    """Return the type at a location of a scenario."""
    hint: Any = Scenario
    for step in location:
        hint = _without_none(hint)
        hint = _hints(hint)[str(step)] if _has_fields(hint) else _item_hint(hint, step)
    return _without_none(hint)


def _value_at(location: Location, text: str, values: Mapping[str, float]) -> float | int:
    """Return the value of an expression as the type that its location takes.

    Raises:
        ConfigError: It has no value, or none that is whole where a whole number belongs.
    """
    value = number_of(text, values)
    if _hint_at(location) is not int:
        return value
    whole = round(value)
    if abs(value - whole) > _TOLERANCE * max(1.0, abs(value)):
        raise ConfigError(f"expression '{text}': {value:g} is not a whole number; use round(), floor() or ceil()")
    return whole


def _steps(location: str) -> tuple[str | int, ...]:
    """Return the steps of a location such as `actors[0].phases[1].speed`."""
    return tuple(int(index) if index else key for index, key in _STEP.findall(location))


def _with_value(value: Any, steps: Location, new_value: Any) -> Any:
    """Return a dataclass, tuple or mapping with another value at a location."""
    if not steps:
        return new_value
    step, *rest = steps
    if isinstance(value, tuple):
        index = int(step)
        return (*value[:index], _with_value(value[index], rest, new_value), *value[index + 1 :])
    if isinstance(value, Mapping):
        return {**value, step: _with_value(value.get(str(step)), rest, new_value)}
    return dataclasses.replace(value, **{str(step): _with_value(getattr(value, str(step)), rest, new_value)})


def _with_item(data: Any, steps: Location, new_value: Any) -> Any:
    """Return plain data with another value at a location; the data stay as they are."""
    if not steps:
        return new_value
    step, *rest = steps
    copy: Any = dict(data) if isinstance(data, Mapping) else list(data)
    copy[step] = _with_item(data[step], rest, new_value)
    return copy


# ---------------------------------------------------------------- checks


def parameter_problems(scenario: Scenario) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Yield the problems of the parameters of a scenario: location among its keys, and a message."""
    box = scenario_type(scenario.type).box
    if scenario.declared or scenario.expressions:
        yield from _declared_problems(scenario, box)
    for name, value in scenario.parameters.items():
        if name not in box:
            hint = f"; to declare one, write {name}: {{value: {value:g}}}" if scenario.type == CUSTOM else ""
            yield ("parameters", name), f"no such parameter; {scenario.type} has: {', '.join(box)}{hint}"
        elif problem := box[name].problem(value):
            key = ("value",) if name in scenario.declared else ()
            yield ("parameters", name, *key), problem
    if violation := violated_constraint(scenario):
        yield ("constraints", violation[0]), violation[1]


def _declared_problems(scenario: Scenario, box: Mapping[str, Parameter]) -> Iterator[tuple[tuple[str | int, ...], str]]:
    for name, declaration in scenario.declared.items():
        yield from ((("parameters", name, *key), text) for key, text in _declaration_problems(name, declaration, box))
    try:
        values = parameter_values(scenario)
    except ParameterError as error:
        yield ("parameters", error.name), str(error)
        return
    for name, declaration in scenario.declared.items():
        low, high = declaration.range or (-math.inf, math.inf)
        if not low <= values[name] <= high:
            unit = f" {declaration.unit}" if declaration.unit else ""
            yield ("parameters", name, "value"), f"{values[name]:g} is outside its range, {low:g} to {high:g}{unit}"


def _name_problem(name: str) -> str:
    """Return the problem of the name of a declared parameter; empty: it has none."""
    if not _NAME.fullmatch(name):
        return "the name of a parameter has letters, digits and _, and begins with no digit"
    if name in RESERVED or name == TARGET_SPEED:
        return f"'{name}' has a meaning of its own; choose another name"
    return ""


def _declaration_problems(
    name: str, declaration: DeclaredParameter, box: Mapping[str, Parameter]
) -> Iterator[tuple[tuple[str | int, ...], str]]:
    if problem := _name_problem(name):
        yield (), problem
    low, high = declaration.range or (-math.inf, math.inf)
    if declaration.range is not None:
        if not low < high:
            yield ("range",), f"the range from {low:g} to {high:g} is empty"
        if name in box:
            lowest, highest = box[name].limits
            if low < lowest or high > highest:
                yield ("range",), f"beyond {lowest:g} to {highest:g} {box[name].unit} ({box[name].doc})"
    if declaration.spread is not None and not 0.0 <= declaration.spread < math.inf:
        yield ("spread",), f"{declaration.spread:g} is not valid; give 0 (never drawn) or more"
    for index, value in enumerate(declaration.grid):
        if not low <= value <= high:
            yield ("grid", index), f"{value:g} is outside its range, {low:g} to {high:g}"
