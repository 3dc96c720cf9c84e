"""Scenarios from the folders of SafeBench, FREA and the CARLA leaderboard 1.0.

SafeBench and FREA: `scenario_type/*.json` lists episodes (scenario id, route id); routes are in
`route/scenario_XX_routes/scenario_XX_route_YY.xml`, triggers and actors in
`route/scenarios/scenario_XX.json`. Leaderboard: XML files of routes beside JSON files of triggers; every
trigger on a route gives a scenario, a route without triggers a free drive in natural traffic, also one with the
positions of leaderboard 2.0. In a whole checkout of
SafeBench or FREA the two folders lie deeper (`config/scenario_type`, `scenario_data/route`) and are searched. CARLA's
frame (x forward, y right, yaw clockwise in degrees) is converted here and nowhere else. The town is optional: a
trigger is matched with the straight lines between key points first, then with the route through the town if it is
imported. CARLA's weather is not carried over.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ssad.core.errors import ConfigError, FormatError, SSADError
from ssad.core.import_report import ImportReport
from ssad.core.safeio import format_location, read_json, read_xml
from ssad.core.types import EpisodeLimits, Pose, Scenario, SignalPlan
from ssad.core.wording import counted
from ssad.scenarios.dynamic.catalogue import FREE_DRIVE, PRECRASH, scenario_type
from ssad.scenarios.dynamic.schema import name_part, problems
from ssad.world.roads import load_town
from ssad.world.roads.router import route_along

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

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
_PARAMETERS: dict[int, tuple[str, ...]] = {
    1: ("walker_speed", "trigger_distance", "start_distance"),
    2: ("speed", "trigger_distance", "exit_distance"),
    3: ("distance", "gap", "leader_speed", "neighbour_speed", "brake_after", "brake_speed", "trigger_distance"),
    4: ("distance", "gap", "speed", "trigger_distance"),
    **dict.fromkeys((5, 6, 7, 8), ("speed", "trigger_distance")),
}
"""What the numbers of an entry mean in SafeBench's lists `human` and `random`, by scenario id."""
# A red light outside the conflict would outlast SafeBench's 30 s: there the ego has green.
_SIGNALS: dict[str, SignalPlan] = {
    **dict.fromkeys(
        ("StraightObstacle", "TurningObstacle", "LaneChanging", "VehiclePassing"), SignalPlan(ego="green", others="red")
    ),
    "RightTurn": replace(scenario_type("RightTurn").signals, elsewhere="green"),
}
_NEAR = 2.0  # m between a trigger and the route
_FAR = 1e9  # m; the square of a longer way may be beyond a float
_ALIGNED = math.radians(10.0)
_SIDES = ("front", "left", "right")  # the order in which the leaderboard reads other actors


@dataclass(frozen=True)
class _Entry:
    """One episode of a list: scenario id, route id, and explicit parameters."""

    number: int
    route: int
    parameters: Mapping[str, float]


@dataclass(frozen=True)
class _Event:
    """One trigger of a JSON file."""

    type: str
    town: str
    trigger: Pose
    placements: tuple[Pose, ...]


@dataclass(frozen=True)
class _ImportedRoute:
    """One route of an XML file."""

    ident: str
    town: str
    points: tuple[Pose, ...]
    has_weather: bool = False


def import_routes(folder: Path, *, report: ImportReport | None = None) -> tuple[Scenario, ...]:
    """Import all scenarios of a folder, in its order; of several lists the longest one without parameters.

    Args:
        folder: A SafeBench, FREA or leaderboard folder, a checkout of the first two, or one list in `scenario_type`,
            such as SafeBench's human.json or random.json, whose entries have parameters of their own.
        report: Filled with what came in, what is not carried over, and what is doubtful: broken entries of a list,
            which are skipped; None: the first broken entry raises.

    Raises:
        FormatError: An entry is broken (the message names it and its place), or no entry is left.
    """
    folder = Path(folder)
    if folder.is_file() and folder.parent.name == "scenario_type":
        return _scenarios_of_list(_routes_of(folder.parent), _read_list(folder, report), folder, report)
    if not folder.is_dir():
        raise FormatError(f"{folder}: no such folder")
    lists = sorted(path for list_folder in _scenario_types(folder) for path in list_folder.glob("*.json"))
    if lists:
        entries_by_list: dict[Path, tuple[list[_Entry], ImportReport]] = {}
        for path in lists:
            list_report = ImportReport(str(path))
            entries_by_list[path] = _read_list(path, None if report is None else list_report), list_report
        preferred_list = max(lists, key=lambda path: _list_priority(entries_by_list[path][0]))
        entries, list_report = entries_by_list[preferred_list]
        if report is not None:
            report.extend(list_report)
            for path in lists:
                if path != preferred_list:
                    report.omit(f"other lists than {preferred_list.name}; give a list by its path", path.name)
        return _scenarios_of_list(_routes_of(preferred_list.parent), entries, preferred_list, report)
    return _leaderboard(folder, ImportReport(str(folder)) if report is None else report)


def free_drive(name: str, town: str, points: tuple[Pose, ...], *, source: str) -> Scenario:
    """Return the scenario of a route without scenarios: a free drive in natural traffic.

    Its limit of time is the leaderboard's, 0.8 s for each metre between the points and 5 s, and at least a minute.

    Args:
        name: Name of the scenario.
        town: Name of the town.
        points: Key points of the route.
        source: Origin of the route.
    """
    distance = sum(math.hypot(end.x - start.x, end.y - start.y) for start, end in pairwise(points))
    max_time = float(max(math.ceil(0.8 * distance + 5.0), 60))
    limits = EpisodeLimits(max_steps=round(10.0 * max_time), max_time=max_time)
    return Scenario(name, FREE_DRIVE, town, points, limits=limits, group=FREE_DRIVE, source=source)


def _list_priority(entries: Sequence[_Entry]) -> tuple[bool, int]:
    """Return a sort key of lists: lists without parameters first, then longer ones."""
    return bool(entries) and not any(entry.parameters for entry in entries), len(entries)


def _scenario_types(folder: Path) -> list[Path]:
    """Return the folder of lists: in the folder itself, else the nearest below it (a checkout)."""
    direct = folder / "scenario_type"
    if direct.is_dir():
        return [direct]
    nested = [path for path in folder.rglob("scenario_type") if path.is_dir() and any(path.glob("*.json"))]
    return sorted(nested, key=lambda path: (len(path.parts), path))[:1]


def _routes_of(lists: Path) -> Path:
    """Return the folder of routes of a folder of lists: beside it, else the nearest beside one of its parents.

    Raises:
        FormatError: There is no such folder.
    """
    for parent in (lists.parent, lists.parent.parent):
        route_folders = [path for path in (parent / "route", *parent.glob("*/route")) if (path / "scenarios").is_dir()]
        if route_folders:
            return route_folders[0]
    raise FormatError(
        f"{lists.parent}: no folder route with a folder scenarios in it, here or in scenario_data beside it"
    )


# ---------------------------------------------------------------- SafeBench, FREA


def _read_list(path: Path, report: ImportReport | None) -> list[_Entry]:
    """Read the entries of a list in the order of data_id; entries of other scenarios are skipped."""
    entries = read_json(path)
    if not isinstance(entries, list):
        raise FormatError(f"{path}: expected a list of episodes")
    if not entries:
        raise FormatError(f"{path}: the list of episodes is empty")
    numbered_entries: list[tuple[int, _Entry]] = []
    for index, entry in enumerate(entries):
        if not isinstance(entry, dict):
            raise FormatError(f"{path}: entry {index}: expected an object with scenario_id and route_id")
        identifiers = []
        for key in ("data_id", "scenario_id", "route_id"):
            value = entry.get(key)
            if not isinstance(value, int) or isinstance(value, bool) or value < 0:
                raise FormatError(f"{path}: entry {index}: {key} should be a whole number, not {value!r}")
            identifiers.append(value)
        try:
            numbered_entries.append(
                (identifiers[0], _Entry(identifiers[1], identifiers[2], _values(entry, identifiers[1])))
            )
        except FormatError as error:
            if report is None:
                raise FormatError(f"{path}: entry {index}: {error}") from None
            report.doubt(f"an entry is left out: {error}", f"{path.name}, entry {index}")
    numbered_entries.sort(key=lambda row: row[0])
    return [row[1] for row in numbered_entries]


def _values(entry: Mapping[str, Any], number: int) -> dict[str, float]:
    """Return the parameters of an entry by name. FormatError if the scenario or a parameter is not valid."""
    if number not in _TYPES:
        raise FormatError(f"unknown scenario_id {number}; known: 1 to {max(_TYPES)}")
    raw_values = entry.get("parameters")
    if raw_values is None:
        return {}
    names = _PARAMETERS.get(number, ())
    if entry.get("scenario_folder") not in ("human", "random") or not names:
        raise FormatError("parameters are read in lists human and random only; set them to null")
    if (
        not isinstance(raw_values, list)
        or len(raw_values) != len(names)
        or not all(isinstance(raw_value, int | float) and not isinstance(raw_value, bool) for raw_value in raw_values)
    ):
        raise FormatError(f"parameters should be the numbers {', '.join(names)}, not {raw_values!r}")
    values = {name: float(raw_value) for name, raw_value in zip(names, raw_values, strict=True)}
    try:
        scenario_type(_TYPES[number]).values(values)
    except ConfigError as error:
        raise FormatError(str(error)) from None
    return values


def _scenarios_of_list(
    routes: Path, entries: Sequence[_Entry], listing: Path, report: ImportReport | None
) -> tuple[Scenario, ...]:
    """Build the scenarios of a list; repetitions of a route get seeds 0, 1, ..."""
    if not entries:
        reason = next(iter(report.doubts), "") if report else ""
        raise FormatError(f"{listing}: no entry of it can be read{f'; the first: {reason}' if reason else ''}")
    suite = "frea" if all(entry.number == NATURAL_ID for entry in entries) else "safebench"
    title = {"frea": "FREA", "safebench": "SafeBench"}[suite]
    # Only routes that occur several times get a repetition number in their names.
    repetition_counts = Counter((entry.number, entry.route) for entry in entries)
    built_counts: Counter[tuple[int, int]] = Counter()
    scenario_cache: dict[tuple[int, int], Scenario | None] = {}
    events_by_number: dict[int, list[_Event]] = {}
    scenarios = []
    for entry in entries:
        route_key = number, route_id = entry.number, entry.route
        if route_key not in scenario_cache:
            try:
                if number not in events_by_number:
                    events_by_number[number] = _read_events(routes / "scenarios" / f"scenario_{number:02d}.json")
                path = routes / f"scenario_{number:02d}_routes" / f"scenario_{number:02d}_route_{route_id:02d}.xml"
                if not path.is_file():
                    raise FormatError(f"{path}: no such route file; {listing.name} asks for it")
                scenario_cache[route_key] = _scenario(path, _TYPES[number], events_by_number[number])
            except FormatError as error:
                if report is None:
                    raise
                report.doubt(f"a route is left out: {error}")
                scenario_cache[route_key] = None
        base, repetition = scenario_cache[route_key], built_counts[route_key]
        if base is None:
            continue
        built_counts[route_key] += 1
        if number == NATURAL_ID:
            name, group = f"{suite}/{base.town}_{route_id:02d}", base.town
        else:
            name, group = f"{suite}/{base.type}/{route_id:02d}", base.type
        if repetition_counts[route_key] > 1:
            name += f"/{repetition:02d}"
        source = f"{title} scenario {number} route {route_id:02d}"
        parameters = {**base.parameters, **entry.parameters}
        scenarios.append(replace(base, name=name, group=group, seed=repetition, source=source, parameters=parameters))
    if not scenarios:
        reasons = report.doubts if report else ()
        reason = next((reason for reason in reasons if reason.startswith("a route")), "")
        raise FormatError(f"{listing}: none of its routes can be read; the first: {reason}")
    if report is not None:
        report.contents.append(f"{title}: {len(scenarios)} of {len(entries)} entries of {listing.name}")
    return tuple(scenarios)


def _scenario(path: Path, kind: str, events: Sequence[_Event]) -> Scenario:
    """Return the scenario of one route file with the first trigger along it."""
    routes = _read_roads(path)
    if len(routes) != 1:
        raise FormatError(f"{path}: expected one route, found {len(routes)}")
    route = routes[0]
    # Key points are sparse: a trigger in a bend can be far from the straight line between two of them.
    triggers = _triggers(route, events) or _triggers(_with_lane_points(route), events)
    if not triggers and kind != "NaturalJunction":
        raise FormatError(f"{path}: no trigger of {kind} in {route.town} lies on the route (2 m, 10 degrees)")
    event = events[triggers[0][1]] if triggers else None
    scenario = Scenario(
        name="imported",
        type=kind,
        town=route.town,
        route=route.points,
        trigger=event.trigger if event else None,
        placements=event.placements if event and kind in _PLACED else (),
        signals=_SIGNALS.get(kind, SignalPlan()),
    )
    if kind in _PLACED and not scenario.placements:
        raise FormatError(f"{path}: its trigger names no other actor, which {kind} needs")
    return _check_scenario(scenario, path)


def _triggers(route: _ImportedRoute, events: Sequence[_Event]) -> list[tuple[float, int]]:
    """Return the position of each trigger along a route, and its number, in order."""
    positions = (
        (_position_along(route, event.trigger), index) for index, event in enumerate(events) if event.town == route.town
    )
    return sorted((position, index) for position, index in positions if position is not None)


def _with_lane_points(road: _ImportedRoute) -> _ImportedRoute:
    """Return the route with a point each metre along the lanes of its town; unchanged without such a town or route.

    Source: SafeBench (Xu et al. 2022) interpolates a route to a point each metre and matches triggers to these.
    """
    try:
        route = route_along(load_town(road.town), road.points)
    except SSADError:  # a town that is not imported, or a route that leaves its lanes
        return road
    points = tuple(Pose(*map(float, point)) for point in np.column_stack([route.xy, route.yaw]))
    return replace(road, points=points)


def _check_scenario(scenario: Scenario, path: Path) -> Scenario:
    for location, message in problems(scenario):
        raise FormatError(f"{path}: {format_location(location)}: {message}")
    return scenario


def _position_along(route: _ImportedRoute, trigger: Pose) -> float | None:
    """Return the position of a trigger along the key points, in key points; None beyond 2 m or 10 degrees from them."""
    for index, (start, end) in enumerate(pairwise(route.points)):
        dx, dy = end.x - start.x, end.y - start.y
        length = math.hypot(dx, dy)
        if 1e-6 < length < _FAR:
            t = ((trigger.x - start.x) * dx + (trigger.y - start.y) * dy) / length**2
            t = min(max(t, 0.0), 1.0)
            is_near = math.hypot(start.x + t * dx - trigger.x, start.y + t * dy - trigger.y) <= _NEAR
            turn = math.remainder(math.atan2(dy, dx) - trigger.yaw, 2.0 * math.pi)
            if is_near and abs(turn) <= _ALIGNED:
                return index + t
    return None


# ---------------------------------------------------------------- leaderboard 1.0


def _leaderboard(folder: Path, report: ImportReport) -> tuple[Scenario, ...]:
    """Return a scenario for each trigger on a route, and a free drive for each route without triggers."""
    routes = sorted(folder.rglob("*.xml"))
    tables = sorted(folder.rglob("*.json"))
    if not routes:
        raise FormatError(f"{folder}: no scenario_type/*.json and no route files (*.xml) in it")
    events = [trigger_event for path in tables for trigger_event in _read_events(path, report)]
    scenarios: list[Scenario] = []
    matched: set[int] = set()
    route_count = 0
    for path in routes:
        for route in _read_roads(path):
            triggers = _triggers(route, events)
            route_count += 1
            matched.update(index for _, index in triggers)
            if route.has_weather:
                report.omit("weather of a route", f"{path.name}, route {route.ident}")
            name = f"leaderboard/{name_part(path.stem)}_{route.ident}"
            source = f"leaderboard route {route.ident} of {path.name}"
            if not triggers:
                scenarios.append(
                    _check_scenario(free_drive(f"{name}/{FREE_DRIVE}", route.town, route.points, source=source), path)
                )
                if events:
                    report.note(
                        "routes on which no trigger lies (2 m, 10 degrees) become free drives",
                        f"{path.name}, route {route.ident}",
                    )
            count: Counter[str] = Counter()
            for _, event_index in triggers:
                event = events[event_index]
                if event.type in _PLACED and not event.placements:
                    report.omit(
                        f"triggers of {event.type} without the other actors that it needs",
                        f"{path.name}, route {route.ident}",
                    )
                    continue
                scenario = Scenario(
                    name=f"{name}/{event.type}_{count[event.type]:02d}",
                    type=event.type,
                    town=route.town,
                    route=route.points,
                    trigger=event.trigger,
                    placements=event.placements if event.type in _PLACED else (),
                    group=event.type,
                    source=source,
                )
                count[event.type] += 1
                scenarios.append(_check_scenario(scenario, path))
    if not scenarios:
        raise FormatError(f"{folder}: its triggers name no other actors, which their types need")
    if unmatched := len(events) - len(matched):
        report.omit("triggers that lie on no route", count=unmatched)
    report.contents.append(f"leaderboard 1.0: {counted(len(scenarios), 'scenario')} of {counted(route_count, 'route')}")
    return tuple(scenarios)


# ---------------------------------------------------------------- files


def _read_roads(path: Path) -> list[_ImportedRoute]:
    root = read_xml(path)
    imported_routes: list[_ImportedRoute] = []
    for element in root.iter("route"):
        route_id, town = element.get("id", ""), element.get("town")
        if not town:
            raise FormatError(f"{path}: route {route_id or '?'} names no town")
        location = f"{path}: route {route_id or '?'}"
        if element.find("scenarios/scenario") is not None:
            raise FormatError(f"{location}: has scenarios of leaderboard 2.0; import the file: ssad import leaderboard")
        places = element.findall("waypoints/position") or list(element.iter("waypoint"))
        if len(places) < 2:
            raise FormatError(f"{location}: needs at least two waypoints, has {len(places)}")
        points = _with_headings(places, location)
        has_weather = next(element.iter("weather"), None) is not None
        imported_routes.append(_ImportedRoute(route_id or str(len(imported_routes)), town, points, has_weather))
    if not imported_routes:
        raise FormatError(f"{path}: no <route> in it")
    return imported_routes


def _with_headings(places: Sequence[Element], location: str) -> tuple[Pose, ...]:
    """Return the points of a route; those without a heading, as in leaderboard 2.0, look to the next."""
    points = [
        _pose({"yaw": "0", **place.attrib}, f"{location}: waypoint {index}") for index, place in enumerate(places)
    ]
    for index, place in enumerate(places):
        if "yaw" not in place.attrib:
            start, end = points[index : index + 2] if index + 1 < len(points) else points[-2:]
            points[index] = replace(points[index], yaw=math.atan2(end.y - start.y, end.x - start.x))
    return tuple(points)


def _read_events(path: Path, report: ImportReport | None = None) -> list[_Event]:
    """Read the triggers of a JSON file; without a report, another file format or an unknown scenario is an error."""
    document = read_json(path)
    blocks = document.get("available_scenarios") if isinstance(document, dict) else None
    if not isinstance(blocks, list):
        if report is None:
            raise FormatError(f"{path}: expected an object with the list available_scenarios")
        report.omit("JSON files that hold no triggers", path.name)
        return []
    return [event for block in blocks for event in _block_events(path, block, report)]


def _block_events(path: Path, block: Any, report: ImportReport | None) -> Iterator[_Event]:
    if not isinstance(block, dict):
        raise FormatError(f"{path}: available_scenarios should hold objects that map towns to scenarios")
    for town, scenarios in block.items():
        for scenario in _as_list(scenarios, f"{path}: {town}"):
            if not isinstance(scenario, dict):
                raise FormatError(f"{path}: {town}: expected objects with available_event_configurations")
            scenario_name = str(scenario.get("scenario_name", scenario.get("scenario_type")))
            if scenario_name not in _NAMES:
                if report is None:
                    raise FormatError(f"{path}: {town}: unknown scenario '{scenario_name}'; known: {', '.join(_NAMES)}")
                report.omit(f"triggers of {scenario_name[:40]}, which has no counterpart", f"{path.name}, {town[:40]}")
                continue
            configurations = scenario.get("available_event_configurations")
            for index, event in enumerate(_as_list(configurations, f"{path}: {town}: {scenario_name}")):
                location = f"{path}: {town}: {scenario_name}: event {index}"
                if not isinstance(event, dict):
                    raise FormatError(f"{location}: expected an object with a transform")
                yield _Event(
                    _NAMES[scenario_name],
                    town,
                    _pose(event.get("transform"), f"{location}: transform"),
                    _other_actors(event, location),
                )


def _other_actors(event: Mapping[str, Any], location: str) -> tuple[Pose, ...]:
    actors_by_side = event.get("other_actors") or {}
    if not isinstance(actors_by_side, dict):
        raise FormatError(f"{location}: other_actors should map front, left, right to lists")
    return tuple(
        _pose(actor, f"{location}: other_actors: {side} {index}")
        for side in _SIDES
        for index, actor in enumerate(_as_list(actors_by_side.get(side, []), f"{location}: other_actors: {side}"))
    )


def _as_list(value: Any, location: str) -> list[Any]:
    if not isinstance(value, list):
        raise FormatError(f"{location}: expected a list")
    return value


def _pose(data: Any, location: str) -> Pose:
    """CARLA's x, y, yaw (numbers or text, yaw in degrees) as a pose of ours."""
    if not isinstance(data, Mapping):
        raise FormatError(f"{location}: expected x, y and yaw")
    coordinates = []
    for key in ("x", "y", "yaw"):
        try:
            value = float(data[key])
        except KeyError:
            raise FormatError(f"{location}: '{key}' is missing") from None
        except (TypeError, ValueError):
            raise FormatError(f"{location}: {key} is {data[key]!r}, not a number") from None
        if not math.isfinite(value):
            raise FormatError(f"{location}: {key} is {data[key]!r}, not a finite number")
        coordinates.append(value)
    x, y, yaw = coordinates
    # 0.0 - y instead of -y avoids negative zeros in saved scenarios.
    return Pose(x, 0.0 - y, 0.0 - math.radians(math.remainder(yaw, 360.0)))
