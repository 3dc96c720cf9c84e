"""Scenarios as plain data: strict reading that locates every error, and compact writing."""

from __future__ import annotations

import dataclasses
import json
import math
import re
from collections.abc import Iterator, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.safeio import Document, Location, format_location
from ssad.core.types import (
    MOST_ERRORS,
    Actor,
    AgentKind,
    Arrival,
    Body,
    DeclaredParameter,
    EpisodeLimits,
    FollowingGap,
    Impact,
    LateralPhase,
    Phase,
    PhaseTrigger,
    Pose,
    Scenario,
    SignalPlan,
    TrafficPlan,
)
from ssad.scenarios.dynamic.catalogue import CUSTOM, scenario_type
from ssad.scenarios.dynamic.parameters import insert_expressions, parameter_problems, resolve_data
from ssad.scenarios.dynamic.phases import phase_problems
from ssad.world.models import model, model_with_body

if TYPE_CHECKING:
    from pydantic import TypeAdapter, ValidationError

_DATA = (
    Scenario,
    Pose,
    Body,
    Actor,
    Phase,
    LateralPhase,
    Arrival,
    FollowingGap,
    PhaseTrigger,
    SignalPlan,
    TrafficPlan,
    EpisodeLimits,
    DeclaredParameter,
    Impact,
)
_DERIVED = ("declared", "expressions")  # fields of a scenario that stand elsewhere in its file
_NAME = re.compile(r"^[A-Za-z0-9][A-Za-z0-9_.:@+=\-]*(/[A-Za-z0-9_][A-Za-z0-9_.:@+=\-]*)*$")
# Generous bounds: they keep a typing error from starting a run of hours.
MAX_SPEED = 60.0
_MAX_TRAFFIC = 62  # agents besides the ego: a world keeps contacts as one bit an agent
_BODY_LIMITS = {
    "length": (0.1, 30.0, "m"),
    "width": (0.1, 5.0, "m"),
    "height": (0.1, 6.0, "m"),
    "wheelbase": (0.1, 25.0, "m"),
    "max_accel": (0.1, 30.0, "m/s^2"),
    "max_brake": (0.1, 30.0, "m/s^2"),
    "max_speed": (0.1, 100.0, "m/s"),
    "brake_build_up": (0.0, 5.0, "s"),
}
_FRICTION = 0.05, 1.5
_MAX_COORDINATE = 1.0e5
_MAX_STEPS = 100_000
_UNKNOWN_KEY = ("unexpected_keyword_argument", "extra_forbidden")


@cache
def _adapter() -> TypeAdapter[Scenario]:
    from pydantic import ConfigDict, TypeAdapter

    for dataclass_type in _DATA:
        # pydantic reads this attribute of a plain dataclass; set here so that ssad.core.types needs no pydantic
        setattr(dataclass_type, "__pydantic_config__", ConfigDict(extra="forbid", allow_inf_nan=False))  # noqa: B010
    return TypeAdapter(Scenario)


def name_part(text: str) -> str:
    """Return a text, such as the name of a file, as a part of a name: what no name may hold becomes "_"."""
    part = re.sub(r"[^A-Za-z0-9_.:@+\-]", "_", text)
    return part if part[:1].isalnum() else f"0{part}"


def scenario_from(data: Any, document: Document | None = None, place: Location = ()) -> Scenario:
    """Validate plain data and return the scenario.

    Args:
        data: The data as YAML or JSON gives it.
        document: The document that contains the data, for messages.
        place: Location of the data in the document.

    Returns:
        The scenario.

    Raises:
        ConfigError: A value is missing, unknown or out of range; the message names file, line, key and valid values.
    """
    from pydantic import ValidationError

    source_document = document or Document("scenario", data)
    if not isinstance(data, Mapping):
        raise source_document.error(place, f"a scenario is a mapping of keys, not {_abbreviated(data)}")
    for key in _DERIVED:
        if key in data:
            raise source_document.error((*place, key), f"unknown key; known: {', '.join(_fields_at(()))}")
    try:
        data = _with_poses(resolve_data(data, source_document, place), source_document, place)
        # JSON mode is the strict one that still takes lists for tuples and words for literals
        text = json.dumps(data, default=str)
        scenario = _adapter().validate_json(text, strict=True)
    except ValidationError as error:
        location, message = _explain(error)
        raise source_document.error((*place, *location), message) from None
    except (ValueError, TypeError) as error:
        raise source_document.error(place, f"not plain data: {error}") from None
    for location, message in problems(scenario):
        expression = scenario.expressions.get(format_location(location))
        suffix = f" (the value of '{expression}')" if expression else ""
        raise source_document.error((*place, *location), message + suffix)
    return scenario


def _with_poses(data: dict[str, Any], document: Document, place: Location) -> dict[str, Any]:
    """Return data in which actors with an impact have a pose, which their episode replaces."""
    actors = data.get("actors")
    if not isinstance(actors, list) or not any(isinstance(a, Mapping) and a.get("impact") for a in actors):
        return data
    placed_actors = list(actors)
    for index, actor in enumerate(actors):
        if isinstance(actor, Mapping) and actor.get("impact"):
            for key in ("pose", "path"):
                if key in actor:
                    message = f"an actor with an impact has no {key}, which follows from it"
                    raise document.error((*place, "actors", index, key), message)
            placed_actors[index] = {**actor, "pose": {"x": 0.0, "y": 0.0}}
    return {**data, "actors": placed_actors}


def check(scenario: Scenario) -> None:
    """Validate a scenario.

    Args:
        scenario: The scenario.

    Raises:
        ConfigError: It is not valid; names the scenario and the key.
    """
    for location, message in problems(scenario):
        raise ConfigError(f"scenario {scenario.name}: {format_location(location)}: {message}")


def _explain(error: ValidationError) -> tuple[tuple[str | int, ...], str]:
    errors = error.errors(include_url=False)
    # a misspelt key also makes another key missing: report the misspelling
    first_error = min(errors, key=lambda e: e["type"] not in _UNKNOWN_KEY)
    location = tuple(first_error["loc"])
    if location and location[0] == "declared":
        location = ("parameters", *location[1:])
    error_type = first_error["type"]
    if error_type in _UNKNOWN_KEY:
        fields = _fields_at(location[:-1])
        return location, f"unknown key; known: {', '.join(fields)}"
    if error_type in ("missing", "missing_argument"):
        return location[:-1], f"key '{location[-1]}' is missing"
    if error_type == "literal_error":
        return location, f"{_abbreviated(first_error['input'])} is not one of {first_error['ctx']['expected']}"
    message = first_error["msg"].replace("Input should be", "should be")
    return location, f"{message}, not {_abbreviated(first_error['input'])}"


def _fields_at(location: Location) -> list[str]:
    """Return the field names of the dataclass at a location of a scenario."""
    dataclass_type: type = Scenario
    type_of_key: dict[str, type] = {
        "route": Pose,
        "placements": Pose,
        "trigger": Pose,
        "pose": Pose,
        "actors": Actor,
        "phases": Phase,
        "lateral": LateralPhase,
        "arrival": Arrival,
        "gap": FollowingGap,
        "when": PhaseTrigger,
        "signals": SignalPlan,
        "traffic": TrafficPlan,
        "limits": EpisodeLimits,
        "parameters": DeclaredParameter,
        "impact": Impact,
        "body": Body,
        "ego_body": Body,
    }
    for part in location:
        dataclass_type = type_of_key.get(str(part), dataclass_type) if isinstance(part, str) else dataclass_type
    names = [dataclass_field.name for dataclass_field in dataclasses.fields(dataclass_type)]
    return [name for name in names if dataclass_type is not Scenario or name not in _DERIVED]


def _abbreviated(value: Any) -> str:
    text = json.dumps(value, default=str)
    return text if len(text) <= 60 else text[:57] + "..."


def problems(scenario: Scenario) -> Iterator[tuple[tuple[str | int, ...], str]]:
    """Yield the problems of the values of a scenario.

    Args:
        scenario: The scenario.

    Yields:
        Location of the value among the scenario's keys, and a message.
    """
    if not _NAME.match(scenario.name):
        yield ("name",), f"'{scenario.name}' is not a name; use letters, digits, and -_.:@+=/ between them"
    if not scenario.town:
        yield ("town",), "name the town (ssad list towns)"
    if len(scenario.route) < 2:
        yield ("route",), "a route needs at least two key points"
    yield from _poses(scenario)
    if not 0.0 < scenario.target_speed <= MAX_SPEED:
        yield ("target_speed",), f"{scenario.target_speed:g} is outside 0 to {MAX_SPEED:g} m/s"
    if scenario.seed < 0:
        yield ("seed",), "must not be negative"
    yield from _ego(scenario)
    yield from _plans(scenario)
    if scenario.type == CUSTOM:
        yield from _actors(scenario)
    elif scenario.actors:
        yield ("actors",), f"only type {CUSTOM} takes actors; {scenario.type} makes its own"
    try:
        scenario_type(scenario.type)
    except ConfigError as error:
        yield ("type",), str(error)
        return
    yield from parameter_problems(scenario)


def _ego(scenario: Scenario) -> Iterator[tuple[tuple[str | int, ...], str]]:
    try:
        ego = model(scenario.ego_model)
    except ConfigError as error:
        yield ("ego_model",), str(error)
    else:
        if ego.kind in (AgentKind.WALKER, AgentKind.PROP):
            yield ("ego_model",), f"{scenario.ego_model} is no vehicle, which the ego must be"
    yield from _body(scenario.ego_body, ("ego_body",))
    low, high = _FRICTION
    if not low <= scenario.friction <= high:
        yield ("friction",), f"{scenario.friction:g} is outside {low:g} to {high:g}"


def _body(body: Body, place: Location) -> Iterator[tuple[tuple[str | int, ...], str]]:
    for key, (low, high, unit) in _BODY_LIMITS.items():
        value = getattr(body, key)
        if value is not None and not low <= value <= high:
            yield (*place, key), f"{value:g} is outside {low:g} to {high:g} {unit}"


def _poses(scenario: Scenario) -> Iterator[tuple[tuple[str | int, ...], str]]:
    for key in ("route", "placements"):
        for index, pose in enumerate(getattr(scenario, key)):
            if not _finite(pose):
                yield (key, index), f"beyond {_MAX_COORDINATE:g} m or not a number"
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
    if not 0.0 <= traffic.errors <= MOST_ERRORS:
        yield ("traffic", "errors"), f"{traffic.errors:g} is outside 0 to {MOST_ERRORS:g} an hour"
    if traffic.errors > 0.0 and traffic.drivers == "uniform":
        yield ("traffic", "errors"), "only drivers of the population make errors; add drivers: population"
    for key, count in (("walkers", traffic.walkers), ("cyclists", traffic.cyclists)):
        if not 0 <= count <= 40:
            yield ("traffic", key), f"{count} is outside 0 to 40"
    if traffic.walkers + traffic.cyclists > 0 and traffic.maximum + traffic.walkers + traffic.cyclists > _MAX_TRAFFIC:
        yield ("traffic", "maximum"), f"vehicles, walkers and cyclists are more than {_MAX_TRAFFIC}; lower one of them"
    if not traffic.wake_distance >= 0.0:
        yield ("traffic", "wake_distance"), "must not be negative"
    if traffic.draw is not None and traffic.draw < 0:
        yield ("traffic", "draw"), "must not be negative"


def _actors(scenario: Scenario) -> Iterator[tuple[tuple[str | int, ...], str]]:
    max_speeds: dict[int, float] = {}
    for actor_index, actor in enumerate(scenario.actors):
        location = ("actors", actor_index)
        try:
            max_speed = model_with_body(model(actor.model), actor.body).max_speed
        except ConfigError as error:
            yield (*location, "model"), str(error)
            continue
        yield from _body(actor.body, (*location, "body"))
        if actor.body.max_speed is not None and model(actor.model).max_speed == 0.0:
            yield (*location, "body", "max_speed"), f"a {actor.model} does not move"
        if not _finite(actor.pose):
            yield (*location, "pose"), f"beyond {_MAX_COORDINATE:g} m or not a number"
        if len(actor.path) == 1:
            yield (*location, "path"), "a path needs at least two points"
        yield from _trajectory(actor, location)
        yield from _policy(actor, location, max_speed)
        yield from _impact(actor, location)
        max_speeds[actor_index] = max_speed
    yield from phase_problems(scenario.actors, max_speeds)


def _impact(actor: Actor, place: Location) -> Iterator[tuple[tuple[str | int, ...], str]]:
    impact = actor.impact
    if impact is None:
        return
    location = (*place, "impact")
    if actor.trajectory:
        yield location, "an actor with a trajectory has no impact"
    if not 0.0 < impact.distance <= _MAX_COORDINATE:
        yield (*location, "distance"), f"{impact.distance:g} is outside 0 to {_MAX_COORDINATE:g} m"
    if not -2.0 <= impact.location <= 3.0:
        yield (*location, "location"), f"{impact.location:g} is outside -2 to 3 widths of the ego"
    if impact.overlap is not None:
        if not 0.0 <= impact.overlap <= 1.0:
            yield (*location, "overlap"), f"{impact.overlap:g} is outside 0 to 1"
        if impact.location != Impact.location:
            yield (*location, "location"), "give either the location or the overlap"
    if impact.ego_speed is not None and not 0.0 < impact.ego_speed <= MAX_SPEED:
        yield (*location, "ego_speed"), f"{impact.ego_speed:g} is outside 0 to {MAX_SPEED:g} m/s"
    if abs(impact.heading) > 2.0 * math.pi:
        yield (*location, "heading"), f"{impact.heading:g} is more than a full turn; angles are in radians"


def _trajectory(actor: Actor, place: Location) -> Iterator[tuple[tuple[str | int, ...], str]]:
    rows = actor.trajectory
    if not rows:
        return
    trajectory_location = (*place, "trajectory")
    if len(rows) < 2:
        yield trajectory_location, "a trajectory needs at least two rows: time, x, y, yaw"
    if actor.phases or actor.path:
        yield trajectory_location, "an actor with a trajectory has neither phases nor a path"
    if (
        max(
            abs(coordinate - expected)
            for coordinate, expected in zip(rows[0][1:], dataclasses.astuple(actor.pose), strict=True)
        )
        > 0.01
    ):
        yield (*place, "pose"), "differs from the first row of the trajectory"
    values = np.array(rows, np.float64)
    times = values[:, 0]
    # NaN fails both comparisons
    for row_index in np.flatnonzero(~(np.abs(values[:, 1:]) <= _MAX_COORDINATE).all(1)).tolist():
        yield (*trajectory_location, row_index), f"beyond {_MAX_COORDINATE:g} m or not a number"
    for row_index in np.flatnonzero(~((times > np.append(-1.0e6, times[:-1])) & (times < 1.0e6))).tolist():
        yield (*trajectory_location, row_index, 0), "times must increase from row to row"


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


def scenario_data(scenario: Scenario, *, defaults: bool = False) -> dict[str, Any]:
    """Return the plain data of a scenario.

    Args:
        scenario: The scenario.
        defaults: Whether fields that have their defaults are written out, as far as scenarios have always had them:
            seeds of cells depend on these data, and a new field must not change those of scenarios without it.

    Returns:
        Data for YAML or JSON; `scenario_from` restores the scenario.
    """
    data: dict[str, Any] = _plain(dataclasses.replace(scenario, declared={}, expressions={}), defaults)
    for actor, actor_data in zip(scenario.actors, data.get("actors", ()), strict=True):
        if actor.impact is not None:
            del actor_data["pose"]
            actor_data.pop("path", None)
    insert_expressions(data, scenario)
    return data


_FIRST_FIELDS: dict[type, str] = {
    Scenario: "name type town route trigger placements parameters actors signals traffic limits target_speed seed "
    "group source",
    Actor: "name model pose phases path trajectory policy target_speed",
    Phase: "speed when",
    PhaseTrigger: "kind value actor",
    Pose: "x y yaw",
    SignalPlan: "ego others until",
    TrafficPlan: "intensity minimum maximum wake_distance draw",
    EpisodeLimits: "max_steps max_time max_distance contact",
}
"""Fields that are written out with `defaults`."""
_AS_THEY_ARE = (float, int, str, bool, type(None))


def _plain(value: Any, defaults: bool) -> Any:
    if isinstance(value, tuple):  # fast path: scenarios with trajectories consist mostly of rows of numbers
        return [element if type(element) in _AS_THEY_ARE else _plain(element, defaults) for element in value]
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        mapping = {}
        written_fields = _FIRST_FIELDS.get(type(value), "").split() if defaults else ()
        for dataclass_field in dataclasses.fields(value):
            field_value = getattr(value, dataclass_field.name)
            if dataclass_field.name not in written_fields and _is_default(dataclass_field, field_value):
                continue
            mapping[dataclass_field.name] = _plain(field_value, defaults)
        return mapping
    if isinstance(value, Mapping):
        return {str(key): _plain(element, defaults) for key, element in value.items()}
    if isinstance(value, float):
        return float(value)  # a numpy scalar would not be written as a plain number
    return value


def _is_default(dataclass_field: dataclasses.Field[Any], value: Any) -> bool:
    if dataclass_field.default is not dataclasses.MISSING:
        return bool(value == dataclass_field.default)
    return dataclass_field.default_factory is not dataclasses.MISSING and value == dataclass_field.default_factory()
