"""Scenarios as plain data: strict reading with the place of every mistake, and short writing."""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Iterator, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.safeio import Document, Location, dotted
from ssad.core.types import Actor, Condition, Limits, Phase, Pose, Scenario, SignalPlan, TrafficPlan
from ssad.scenarios.dynamic.catalog import CUSTOM, scenario_type
from ssad.world.models import model

if TYPE_CHECKING:
    from pydantic import TypeAdapter, ValidationError

_DATA = (Scenario, Pose, Actor, Phase, Condition, SignalPlan, TrafficPlan, Limits)
_NAME = re.compile(r"^[A-Za-z0-9][A-Za-z0-9_.:@+\-]*(/[A-Za-z0-9][A-Za-z0-9_.:@+\-]*)*$")
# Bounds that no scenario needs to leave; they keep a slip of the pen from running for hours.
MAX_SPEED = 60.0
_MAX_COORDINATE = 1.0e5
_MAX_STEPS = 100_000
_UNKNOWN_KEY = ("unexpected_keyword_argument", "extra_forbidden")


@cache
def _adapter() -> TypeAdapter[Scenario]:
    from pydantic import ConfigDict, TypeAdapter

    for kind in _DATA:
        # pydantic reads this attribute of a plain dataclass; set here so that ssad.core.types needs no pydantic
        setattr(kind, "__pydantic_config__", ConfigDict(extra="forbid", allow_inf_nan=False))  # noqa: B010
    return TypeAdapter(Scenario)


def scenario_from(data: Any, document: Document | None = None, place: Location = ()) -> Scenario:
    """A checked scenario from plain data.

    Args:
        data: The data as YAML or JSON gives it.
        document: The document that it stands in, for messages.
        place: Where in the document it stands.

    Returns:
        The scenario.

    Raises:
        ConfigError: Something is missing, unknown or out of range; names file, line, key and what is allowed.
    """
    from pydantic import ValidationError

    where = document or Document("scenario", data)
    if not isinstance(data, Mapping):
        raise where.error(place, f"a scenario is a mapping of keys, not {_shown(data)}")
    try:
        # JSON mode is the strict one that still takes lists for tuples and words for literals
        text = json.dumps(data, default=str)
        scenario = _adapter().validate_json(text, strict=True)
    except ValidationError as error:
        location, message = _explain(error)
        raise where.error((*place, *location), message) from None
    except (ValueError, TypeError) as error:
        raise where.error(place, f"not plain data: {error}") from None
    for location, message in problems(scenario):
        raise where.error((*place, *location), message)
    return scenario


def check(scenario: Scenario) -> None:
    """Checks the values of a scenario.

    Args:
        scenario: The scenario.

    Raises:
        ConfigError: It is not valid; names the scenario and the key.
    """
    for location, message in problems(scenario):
        raise ConfigError(f"scenario {scenario.name}: {dotted(location)}: {message}")


def _explain(error: ValidationError) -> tuple[tuple[str | int, ...], str]:
    errors = error.errors(include_url=False)
    # a misspelt key also leaves another one missing: the misspelling is the one to show
    first = min(errors, key=lambda e: e["type"] not in _UNKNOWN_KEY)
    location = tuple(first["loc"])
    kind = first["type"]
    if kind in _UNKNOWN_KEY:
        fields = _fields_at(location[:-1])
        return location, f"unknown key; known: {', '.join(fields)}"
    if kind in ("missing", "missing_argument"):
        return location[:-1], f"key '{location[-1]}' is missing"
    if kind == "literal_error":
        return location, f"{_shown(first['input'])} is not one of {first['ctx']['expected']}"
    message = first["msg"].replace("Input should be", "should be")
    return location, f"{message}, not {_shown(first['input'])}"


def _fields_at(location: Location) -> list[str]:
    """Names of the fields of the dataclass at a location of a scenario."""
    kind: type = Scenario
    inner: dict[str, type] = {
        "route": Pose,
        "placements": Pose,
        "trigger": Pose,
        "pose": Pose,
        "actors": Actor,
        "phases": Phase,
        "when": Condition,
        "signals": SignalPlan,
        "traffic": TrafficPlan,
        "limits": Limits,
    }
    for part in location:
        kind = inner.get(str(part), kind) if isinstance(part, str) else kind
    return [f.name for f in dataclasses.fields(kind)]


def _shown(value: Any) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def problems(scenario: Scenario) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """What is wrong with the values of a scenario.

    Args:
        scenario: The scenario.

    Yields:
        Place of the value among the scenario's keys, and a message.
    """
    if not _NAME.match(scenario.name):
        yield ("name",), f"'{scenario.name}' is not a name; use letters, digits, and -_.:@+/ between them"
    if not scenario.town:
        yield ("town",), "name the town (ssad list towns)"
    if len(scenario.route) < 2:
        yield ("route",), "a route needs at least two key points"
    yield from _poses(scenario)
    if not 0.0 < scenario.target_speed <= MAX_SPEED:
        yield ("target_speed",), f"{scenario.target_speed:g} is outside 0 to {MAX_SPEED:g} m/s"
    if scenario.seed < 0:
        yield ("seed",), "must not be negative"
    yield from _plans(scenario)
    if scenario.type == CUSTOM:
        yield from _actors(scenario)
    elif scenario.actors:
        yield ("actors",), f"only type {CUSTOM} takes actors; {scenario.type} makes its own"
    try:
        box = scenario_type(scenario.type).box
    except ConfigError as error:
        yield ("type",), str(error)
        return
    for name, value in scenario.parameters.items():
        if name not in box:
            yield ("parameters", name), f"no such parameter; {scenario.type} has: {', '.join(box)}"
        elif problem := box[name].problem(value):
            yield ("parameters", name), problem


def _poses(scenario: Scenario) -> Iterator[tuple[tuple[str | int, ...], str]]:
    for key in ("route", "placements"):
        for i, pose in enumerate(getattr(scenario, key)):
            if not _finite(pose):
                yield (key, i), f"beyond {_MAX_COORDINATE:g} m or not a number"
    if scenario.trigger is not None and not _finite(scenario.trigger):
        yield ("trigger",), f"beyond {_MAX_COORDINATE:g} m or not a number"


def _finite(pose: Pose) -> bool:
    return all(abs(value) <= _MAX_COORDINATE for value in (pose.x, pose.y, pose.yaw))  # False for NaN


def _plans(scenario: Scenario) -> Iterator[tuple[tuple[str | int, ...], str]]:
    limits = scenario.limits
    if not 1 <= limits.max_steps <= _MAX_STEPS:
        yield ("limits", "max_steps"), f"{limits.max_steps} is outside 1 to {_MAX_STEPS}"
    if not limits.max_time > 0.0:
        yield ("limits", "max_time"), "must be more than 0 s"
    if not limits.max_distance > 0.0:
        yield ("limits", "max_distance"), "must be more than 0 m"
    if not scenario.signals.until >= 0.0:
        yield ("signals", "until"), "must not be negative"
    traffic = scenario.traffic
    if traffic is None:
        return
    if not 0.0 <= traffic.intensity <= 1.0:
        yield ("traffic", "intensity"), f"{traffic.intensity:g} is outside 0 to 1"
    if not 0 <= traffic.minimum <= 64:
        yield ("traffic", "minimum"), f"{traffic.minimum} is outside 0 to 64"
    if not traffic.minimum <= traffic.maximum <= 64:
        yield ("traffic", "maximum"), f"{traffic.maximum} is outside minimum ({traffic.minimum}) to 64"
    if not traffic.wake_distance >= 0.0:
        yield ("traffic", "wake_distance"), "must not be negative"
    if traffic.draw is not None and traffic.draw < 0:
        yield ("traffic", "draw"), "must not be negative"


def _actors(scenario: Scenario) -> Iterator[tuple[tuple[str | int, ...], str]]:
    for i, actor in enumerate(scenario.actors):
        place = ("actors", i)
        try:
            fastest = model(actor.model).max_speed
        except ConfigError as error:
            yield (*place, "model"), str(error)
            continue
        if not _finite(actor.pose):
            yield (*place, "pose"), f"beyond {_MAX_COORDINATE:g} m or not a number"
        if len(actor.path) == 1:
            yield (*place, "path"), "a path needs at least two points"
        yield from _trajectory(actor, place)
        yield from _policy(actor, place, fastest)
        for j, phase in enumerate(actor.phases):
            here = (*place, "phases", j)
            if not 0.0 <= phase.speed <= fastest:
                yield (*here, "speed"), f"{phase.speed:g} is outside 0 to {fastest:g} m/s ({actor.model})"
            if not 0 <= phase.when.actor < len(scenario.actors):
                yield (*here, "when", "actor"), f"there are actors 0 to {len(scenario.actors) - 1}"
            if phase.when.value < 0.0:
                yield (*here, "when", "value"), "must not be negative"


def _trajectory(actor: Actor, place: Location) -> Iterator[tuple[tuple[str | int, ...], str]]:
    rows = actor.trajectory
    if not rows:
        return
    here = (*place, "trajectory")
    if len(rows) < 2:
        yield here, "a trajectory needs at least two rows: time, x, y, yaw"
    if actor.phases or actor.path:
        yield here, "an actor with a trajectory has neither phases nor a path"
    if max(abs(a - b) for a, b in zip(rows[0][1:], dataclasses.astuple(actor.pose), strict=True)) > 0.01:
        yield (*place, "pose"), "differs from the first row of the trajectory"
    values = np.array(rows, np.float64)
    time = values[:, 0]
    # false for what is no number
    for j in np.flatnonzero(~(np.abs(values[:, 1:]) <= _MAX_COORDINATE).all(1)).tolist():
        yield (*here, j), f"beyond {_MAX_COORDINATE:g} m or not a number"
    for j in np.flatnonzero(~((time > np.append(-1.0e6, time[:-1])) & (time < 1.0e6))).tolist():
        yield (*here, j, 0), "times must increase from row to row"


def _policy(actor: Actor, place: Location, fastest: float) -> Iterator[tuple[tuple[str | int, ...], str]]:
    if not actor.policy:
        if actor.target_speed != Actor.target_speed:
            yield (*place, "target_speed"), "only an actor with a policy has one; the others have phases"
        return
    if actor.phases or actor.trajectory:
        yield (*place, "policy"), "an actor with a policy has neither phases nor a trajectory"
    if not fastest > 0.0:
        yield (*place, "policy"), f"nobody drives a {actor.model}"
    elif not 0.0 < actor.target_speed <= fastest:
        yield (*place, "target_speed"), f"{actor.target_speed:g} is outside 0 to {fastest:g} m/s ({actor.model})"


def scenario_data(scenario: Scenario) -> dict[str, Any]:
    """Plain data of a scenario.

    Args:
        scenario: The scenario.

    Returns:
        Data for YAML or JSON, defaults left out; `scenario_from` gives the scenario back.
    """
    data: dict[str, Any] = _plain(scenario)
    return data


_AS_THEY_ARE = (float, int, str, bool, type(None))


def _plain(value: Any) -> Any:
    if isinstance(value, tuple):  # nearly all of a scenario with trajectories are rows of numbers
        return [v if type(v) in _AS_THEY_ARE else _plain(v) for v in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        result = {}
        for f in dataclasses.fields(value):
            item = getattr(value, f.name)
            if f.default is not dataclasses.MISSING and item == f.default:
                continue
            if f.default_factory is not dataclasses.MISSING and item == f.default_factory():
                continue
            result[f.name] = _plain(item)
        return result
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, float):
        return float(value)  # a numpy scalar would not be written as a plain number
    return value
