"""Scenarios from the folders of SafeBench, FREA and the CARLA leaderboard 1.0.

SafeBench and FREA: `scenario_type/*.json` lists episodes (scenario id, route id); routes are in
`route/scenario_XX_routes/scenario_XX_route_YY.xml`, triggers and actors in
`route/scenarios/scenario_XX.json`. Leaderboard: XML files of routes beside JSON files of triggers; every
trigger on a route gives a scenario. CARLA's frame (x forward, y right, yaw clockwise in degrees) becomes
ours here and nowhere else. The town is not needed. Nothing of CARLA's weather is read.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

from ssad.core.errors import FormatError
from ssad.core.safeio import dotted, read_json, read_xml
from ssad.core.types import Pose, Scenario
from ssad.scenarios.dynamic.catalog import PRECRASH
from ssad.scenarios.dynamic.schema import problems

NATURAL_ID = 9
_TYPES: dict[int, str] = {**dict(enumerate(PRECRASH, start=1)), NATURAL_ID: "NaturalJunction"}
_PLACED = frozenset({"RedlightRunning", "UnprotectedLeftTurn", "RightTurn", "CrossingNegotiation"})
_NAMES: dict[str, str] = {
    "DynamicObjectCrossing": "StraightObstacle",
    "VehicleTurningRoute": "TurningObstacle",
    "OtherLeadingVehicle": "LaneChanging",
    "ManeuverOppositeDirection": "VehiclePassing",
    "OppositeVehicleRunningRedLight": "RedlightRunning",
    "SignalizedJunctionLeftTurn": "UnprotectedLeftTurn",
    "SignalizedJunctionRightTurn": "RightTurn",
    "NoSignalJunctionCrossingRoute": "CrossingNegotiation",
    "SignalizedJunctionTurn": "NaturalJunction",
    # the leaderboard's numbers; 1 (loss of control) and 2 (a leading vehicle) have no counterpart here
    "Scenario3": "StraightObstacle",
    "Scenario4": "TurningObstacle",
    "Scenario5": "LaneChanging",
    "Scenario6": "VehiclePassing",
    "Scenario7": "RedlightRunning",
    "Scenario8": "UnprotectedLeftTurn",
    "Scenario9": "RightTurn",
    "Scenario10": "CrossingNegotiation",
}
_NEAR = 2.0  # m between a trigger and the route
_ALIGNED = math.radians(10.0)
_SIDES = ("front", "left", "right")  # the order in which the leaderboard reads other actors


@dataclass(frozen=True)
class _Event:
    """One trigger of a JSON file."""

    type: str
    town: str
    trigger: Pose
    placements: tuple[Pose, ...]


@dataclass(frozen=True)
class _Road:
    """One route of an XML file."""

    ident: str
    town: str
    points: tuple[Pose, ...]


def import_routes(folder: Path) -> tuple[Scenario, ...]:
    """All scenarios of a folder, in its order; of several lists in `scenario_type` the longest is taken.

    Args:
        folder: A SafeBench, FREA or leaderboard folder, or one list in `scenario_type`.

    Raises:
        FormatError: The message says what is broken and where.
    """
    folder = Path(folder)
    if folder.is_file() and folder.parent.name == "scenario_type":
        return _listed(folder.parent.parent, _read_list(folder), folder)
    if not folder.is_dir():
        raise FormatError(f"{folder}: no such folder")
    lists = sorted((folder / "scenario_type").glob("*.json"))
    if lists:
        entries = {path: _read_list(path) for path in lists}
        longest = max(lists, key=lambda path: len(entries[path]))
        return _listed(folder, entries[longest], longest)
    return _leaderboard(folder)


# ---------------------------------------------------------------- SafeBench, FREA


def _read_list(path: Path) -> list[tuple[int, int]]:
    """(scenario id, route id) of each entry, in the order of data_id."""
    data = read_json(path)
    if not isinstance(data, list):
        raise FormatError(f"{path}: expected a list of episodes")
    if not data:
        raise FormatError(f"{path}: the list of episodes is empty")
    rows = []
    for i, entry in enumerate(data):
        if not isinstance(entry, dict):
            raise FormatError(f"{path}: entry {i}: expected an object with scenario_id and route_id")
        ids = []
        for key in ("data_id", "scenario_id", "route_id"):
            value = entry.get(key)
            if not isinstance(value, int) or isinstance(value, bool) or value < 0:
                raise FormatError(f"{path}: entry {i}: {key} should be a whole number, not {value!r}")
            ids.append(value)
        if ids[1] not in _TYPES:
            raise FormatError(f"{path}: entry {i}: unknown scenario_id {ids[1]}; known: 1 to {max(_TYPES)}")
        if entry.get("parameters") is not None:
            raise FormatError(f"{path}: entry {i}: parameters of an entry are not read; set them to null")
        rows.append(ids)
    rows.sort(key=lambda row: row[0])
    return [(row[1], row[2]) for row in rows]


def _listed(folder: Path, entries: Sequence[tuple[int, int]], listing: Path) -> tuple[Scenario, ...]:
    """The scenarios of a list; repetitions of a route get seeds 0, 1, ..."""
    suite = "frea" if all(number == NATURAL_ID for number, _ in entries) else "safebench"
    title = {"frea": "FREA", "safebench": "SafeBench"}[suite]
    total = Counter(entries)
    done: Counter[tuple[int, int]] = Counter()
    cache: dict[tuple[int, int], Scenario] = {}
    events: dict[int, list[_Event]] = {}
    result = []
    for number, route_id in entries:
        key = (number, route_id)
        if key not in cache:
            if number not in events:
                events[number] = _read_events(folder / "route" / "scenarios" / f"scenario_{number:02d}.json")
            name = f"scenario_{number:02d}_route_{route_id:02d}.xml"
            path = folder / "route" / f"scenario_{number:02d}_routes" / name
            if not path.is_file():
                raise FormatError(f"{path}: no such route file; {listing.name} asks for it")
            cache[key] = _scenario(path, _TYPES[number], events[number])
        base, repetition = cache[key], done[key]
        done[key] += 1
        if number == NATURAL_ID:
            name, group = f"{suite}/{base.town}_{route_id:02d}", base.town
        else:
            name, group = f"{suite}/{base.type}/{route_id:02d}", base.type
        if total[key] > 1:
            name += f"/{repetition:02d}"
        source = f"{title} scenario {number} route {route_id:02d}"
        result.append(replace(base, name=name, group=group, seed=repetition, source=source))
    return tuple(result)


def _scenario(path: Path, kind: str, events: Sequence[_Event]) -> Scenario:
    """The scenario of one route file with the first trigger along it."""
    roads = _read_roads(path)
    if len(roads) != 1:
        raise FormatError(f"{path}: expected one route, found {len(roads)}")
    road = roads[0]
    found = sorted(
        (at, i) for i, e in enumerate(events) if e.town == road.town and (at := _along(road, e.trigger)) is not None
    )
    if not found and kind != "NaturalJunction":
        raise FormatError(f"{path}: no trigger of {kind} in {road.town} lies on the route (2 m, 10 degrees)")
    event = events[found[0][1]] if found else None
    scenario = Scenario(
        name="imported",
        type=kind,
        town=road.town,
        route=road.points,
        trigger=event.trigger if event else None,
        placements=event.placements if event and kind in _PLACED else (),
    )
    if kind in _PLACED and not scenario.placements:
        raise FormatError(f"{path}: its trigger names no other actor, which {kind} needs")
    return _checked(scenario, path)


def _checked(scenario: Scenario, path: Path) -> Scenario:
    for location, message in problems(scenario):
        raise FormatError(f"{path}: {dotted(location)}: {message}")
    return scenario


def _along(road: _Road, trigger: Pose) -> float | None:
    """How far along the key points the trigger is, counted in key points; None beyond 2 m or 10 degrees from them."""
    for k, (a, b) in enumerate(pairwise(road.points)):
        dx, dy = b.x - a.x, b.y - a.y
        length = math.hypot(dx, dy)
        if length > 1e-6:
            t = ((trigger.x - a.x) * dx + (trigger.y - a.y) * dy) / length**2
            t = min(max(t, 0.0), 1.0)
            near = math.hypot(a.x + t * dx - trigger.x, a.y + t * dy - trigger.y) <= _NEAR
            turn = math.remainder(math.atan2(dy, dx) - trigger.yaw, 2.0 * math.pi)
            if near and abs(turn) <= _ALIGNED:
                return k + t
    return None


# ---------------------------------------------------------------- leaderboard 1.0


def _leaderboard(folder: Path) -> tuple[Scenario, ...]:
    routes = sorted(folder.rglob("*.xml"))
    tables = sorted(folder.rglob("*.json"))
    if not routes:
        raise FormatError(f"{folder}: no scenario_type/*.json and no route files (*.xml) in it")
    events = [e for path in tables for e in _read_events(path, strict=False)]
    if not events:
        raise FormatError(f"{folder}: no JSON file with available_scenarios; put the scenarios beside the routes")
    result: list[Scenario] = []
    for path in routes:
        for road in _read_roads(path):
            found = sorted(
                (at, i)
                for i, e in enumerate(events)
                if e.town == road.town and (at := _along(road, e.trigger)) is not None
            )
            count: Counter[str] = Counter()
            for _, i in found:
                event = events[i]
                if event.type in _PLACED and not event.placements:
                    continue
                scenario = Scenario(
                    name=f"leaderboard/{path.stem}_{road.ident}/{event.type}_{count[event.type]:02d}",
                    type=event.type,
                    town=road.town,
                    route=road.points,
                    trigger=event.trigger,
                    placements=event.placements if event.type in _PLACED else (),
                    group=event.type,
                    source=f"leaderboard route {road.ident} of {path.name}",
                )
                count[event.type] += 1
                result.append(_checked(scenario, path))
    if not result:
        raise FormatError(f"{folder}: no trigger lies on any route (2 m, 10 degrees)")
    return tuple(result)


# ---------------------------------------------------------------- files


def _read_roads(path: Path) -> list[_Road]:
    root = read_xml(path)
    roads: list[_Road] = []
    for element in root.iter("route"):
        ident, town = element.get("id", ""), element.get("town")
        if not town:
            raise FormatError(f"{path}: route {ident or '?'} names no town")
        where = f"{path}: route {ident or '?'}"
        points = tuple(
            _pose(point.attrib, f"{where}: waypoint {i}") for i, point in enumerate(element.iter("waypoint"))
        )
        if len(points) < 2:
            raise FormatError(f"{where}: needs at least two waypoints, has {len(points)}")
        roads.append(_Road(ident or str(len(roads)), town, points))
    if not roads:
        raise FormatError(f"{path}: no <route> in it")
    return roads


def _read_events(path: Path, *, strict: bool = True) -> list[_Event]:
    """Triggers of a JSON file; strict: a file of another kind, or an unknown scenario in it, is an error."""
    data = read_json(path)
    blocks = data.get("available_scenarios") if isinstance(data, dict) else None
    if not isinstance(blocks, list):
        if strict:
            raise FormatError(f"{path}: expected an object with the list available_scenarios")
        return []
    return [event for block in blocks for event in _block_events(path, block, strict)]


def _block_events(path: Path, block: Any, strict: bool) -> Iterator[_Event]:
    if not isinstance(block, dict):
        raise FormatError(f"{path}: available_scenarios should hold objects that map towns to scenarios")
    for town, scenarios in block.items():
        for scenario in _list(scenarios, f"{path}: {town}"):
            if not isinstance(scenario, dict):
                raise FormatError(f"{path}: {town}: expected objects with available_event_configurations")
            name = str(scenario.get("scenario_name", scenario.get("scenario_type")))
            if name not in _NAMES:
                if strict:
                    raise FormatError(f"{path}: {town}: unknown scenario '{name}'; known: {', '.join(_NAMES)}")
                continue
            configurations = scenario.get("available_event_configurations")
            for i, event in enumerate(_list(configurations, f"{path}: {town}: {name}")):
                where = f"{path}: {town}: {name}: event {i}"
                if not isinstance(event, dict):
                    raise FormatError(f"{where}: expected an object with a transform")
                yield _Event(
                    _NAMES[name],
                    town,
                    _pose(event.get("transform"), f"{where}: transform"),
                    _others(event, where),
                )


def _others(event: Mapping[str, Any], where: str) -> tuple[Pose, ...]:
    groups = event.get("other_actors") or {}
    if not isinstance(groups, dict):
        raise FormatError(f"{where}: other_actors should map front, left, right to lists")
    return tuple(
        _pose(actor, f"{where}: other_actors: {side} {i}")
        for side in _SIDES
        for i, actor in enumerate(_list(groups.get(side, []), f"{where}: other_actors: {side}"))
    )


def _list(value: Any, where: str) -> list[Any]:
    if not isinstance(value, list):
        raise FormatError(f"{where}: expected a list")
    return value


def _pose(data: Any, where: str) -> Pose:
    """CARLA's x, y, yaw (numbers or text, yaw in degrees) as a pose of ours."""
    if not isinstance(data, Mapping):
        raise FormatError(f"{where}: expected x, y and yaw")
    numbers = []
    for key in ("x", "y", "yaw"):
        try:
            value = float(data[key])
        except KeyError:
            raise FormatError(f"{where}: '{key}' is missing") from None
        except (TypeError, ValueError):
            raise FormatError(f"{where}: {key} is {data[key]!r}, not a number") from None
        if not math.isfinite(value):
            raise FormatError(f"{where}: {key} is {data[key]!r}, not a finite number")
        numbers.append(value)
    x, y, yaw = numbers
    return Pose(x, 0.0 - y, 0.0 - math.radians(math.remainder(yaw, 360.0)))
