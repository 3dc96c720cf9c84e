"""Routes of the CARLA leaderboards: 2.0 (and Bench2Drive) in and out, 1.0 out; `ssad import routes` reads 1.0.

A scenario of a leaderboard is a type, a trigger and numbers; its actors and their behaviour are code of the
leaderboard. `leaderboard_types` plays its types with the same actors. An exported file holds, beside the type, the
scenario itself as a child that the leaderboard ignores, so that it can be read back unchanged. CARLA's left-handed
frame is converted here. Types and format: leaderboard 2.0 (leaderboard.carla.org) and Bench2Drive.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from ssad.core.errors import ConfigError, FormatError, RouteError, SSADError
from ssad.core.import_report import ImportReport
from ssad.core.safeio import MIB, dump_json, make_folder, read_xml, write_atomic
from ssad.core.seeding import generator
from ssad.core.types import Episode, Pose, Scenario
from ssad.core.wording import counted
from ssad.interchange.export import ExportedFiles, episode
from ssad.interchange.leaderboard_site import LIMITS, ScenarioBuilder
from ssad.interchange.leaderboard_types import TYPES, UNPLAYED, add_no_actors
from ssad.interchange.openscenario_document import AttributeReader
from ssad.scenarios.dynamic import CUSTOM, build_episode
from ssad.scenarios.dynamic.catalogue import FREE_DRIVE
from ssad.scenarios.dynamic.importer import free_drive
from ssad.scenarios.dynamic.knowledge._placing import trigger_index
from ssad.scenarios.dynamic.schema import scenario_data, scenario_from
from ssad.world.roads import load_town, route_along, town_names

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element as Node

MAX_BYTES: Final = 64 * MIB
OWN: Final = "ssad"  # child of a scenario element that holds the scenario in our own format
NO_TOWN: Final = "town {} is not imported: its scenarios cannot be built (ssad import map)"
MOVED: Final = 0.01  # m; larger shifts of a point count as edits of the file
ROUND: Final = 1.5  # largest ratio of a route's length to the distance along its points
TYPES_2: Final[Mapping[str, str]] = {
    "StraightObstacle": "DynamicObjectCrossing",
    "LaneChanging": "OtherLeadingVehicle",
    "TurningObstacle": "VehicleTurningRoute",
    "VehiclePassing": "ParkedObstacleTwoWays",
    "RedlightRunning": "OppositeVehicleRunningRedLight",
    "UnprotectedLeftTurn": "SignalizedJunctionLeftTurn",
    "RightTurn": "SignalizedJunctionRightTurn",
    "CrossingNegotiation": "OppositeVehicleTakingPriority",
}
"""Class -> type of leaderboard 2.0, or class of ScenarioRunner, which the leaderboard takes as well."""
ALONE: Final = "FreeRide"
"""Class of ScenarioRunner that stands for scenarios without a counterpart: nobody but the ego."""
TYPES_1: Final[Mapping[str, str]] = {
    "StraightObstacle": "Scenario3",
    "TurningObstacle": "Scenario4",
    "LaneChanging": "Scenario5",
    "VehiclePassing": "Scenario6",
    "RedlightRunning": "Scenario7",
    "UnprotectedLeftTurn": "Scenario8",
    "RightTurn": "Scenario9",
    "CrossingNegotiation": "Scenario10",
}
"""Class -> type of leaderboard 1.0."""


def read_leaderboard(
    path: Path,
    *,
    report: ImportReport | None = None,
    progress: Callable[[int, int], None] = lambda completed, total: None,
) -> tuple[Scenario, ...]:
    """Read the scenarios of a file of routes of leaderboard 2.0.

    A route without scenarios is a free drive in natural traffic, also one with the waypoints of leaderboard 1.0.

    Args:
        path: The file.
        report: Filled with what came in, what is not carried over, and what is doubtful.
        progress: Called after each route with the number of routes that are read, and of all.

    Returns:
        One scenario for each scenario element that can be played here and for each route without one.

    Raises:
        FormatError: The file is broken, or no scenario in it can be played.
    """
    root = read_xml(path, limit=MAX_BYTES)
    if root.tag != "routes":
        raise FormatError(f"{path}: not a file of routes: its root is <{root.tag[:40]}>")
    account = ImportReport(str(path)) if report is None else report
    values, scenarios = AttributeReader(str(path)), list[Scenario]()
    towns = town_names()
    routes = root.findall("route")
    for route_number, route in enumerate(routes):
        progress(route_number, len(routes))
        route_id, town = values.text(route, "id"), values.text(route, "town")
        points = _points(values, route)
        place = f"route {route_id[:40]}"
        if route.find("weathers/weather") is not None:
            account.omit("weather of a route", place)
        elements = route.findall("scenarios/scenario")
        if not elements:
            try:
                scenarios.append(_free_drive(route_id, town, points, path))
            except ConfigError as error:
                raise FormatError(f"{path}: route {route_id[:40]}: {error}") from None
            except SSADError as error:
                _left_out(account, error, town, place)
        for element_index, element in enumerate(elements):
            type_name = values.text(element, "type")
            template = Scenario(
                f"leaderboard/{route_id}/{type_name}_{element_index:02d}",
                CUSTOM,
                town,
                points,
                limits=LIMITS,
                group=type_name,
                source=f"leaderboard route {route_id} of {path.name}",
            )
            stored = element.find(OWN)
            if stored is None and type_name not in TYPES:
                account.omit(f"type {type_name[:40]}: {UNPLAYED.get(type_name, 'it is not known here')}", place)
                continue
            if town not in towns:
                account.omit(NO_TOWN.format(town), place)
                continue
            try:
                scenario = (
                    _scenario_of_item(values, element, template, account)
                    if stored is None
                    else _restored_scenario(values, element, stored, template)
                )
                build_episode(scenario, load_town(town), seed=0)
            except FormatError:
                raise
            except ConfigError as error:
                raise FormatError(f"{path}: route {route_id[:40]}: {error}") from None
            except SSADError as error:
                _left_out(account, error, town, place)
                continue
            scenarios.append(scenario)
    if not scenarios:
        reasons = "; ".join([*account.omissions, *account.doubts][:3]) or "it has no route"
        raise FormatError(f"{path}: no scenario in it can be played here: {reasons}")
    progress(len(routes), len(routes))
    free_drives = sum(scenario.type == FREE_DRIVE for scenario in scenarios)
    account.contents.append(
        f"{counted(len(routes), 'route')}: {counted(len(scenarios) - free_drives, 'scenario')}, "
        f"{counted(free_drives, 'free drive')} of routes without scenarios"
    )
    return tuple(scenarios)


def _left_out(report: ImportReport, error: SSADError, town: str, place: str) -> None:
    """Note what is left out: its town is not imported, or, which is doubtful, it does not fit the town."""
    if str(error) == NO_TOWN.format(town):
        report.omit(str(error), place)
    else:
        report.doubt(f"left out: {error}", place)


def _free_drive(route_id: str, town: str, points: tuple[Pose, ...], path: Path) -> Scenario:
    """Return the free drive of a route, checked. RouteError: its town is not imported, or does not allow it."""
    source = f"leaderboard route {route_id} of {path.name}"
    scenario = free_drive(f"leaderboard/{route_id}/{FREE_DRIVE}", town, points, source=source)
    scenario_from(scenario_data(scenario))  # checks names and places before they are used
    if town not in town_names():
        raise RouteError(NO_TOWN.format(town))
    build_episode(scenario, load_town(town), seed=0)
    return scenario


def _points(values: AttributeReader, route: Node) -> tuple[Pose, ...]:
    """Return the key points of a route, each with the heading to the next."""
    elements = route.findall("waypoints/position") or route.findall("waypoint")
    positions = [_place(values, element) for element in elements]
    # Repeated points have no heading to the next.
    positions = [
        position
        for index, position in enumerate(positions)
        if index == 0 or math.dist(position, positions[index - 1]) > 0.1
    ]
    if len(positions) < 2:
        raise values.error(route, f"route {route.get('id', '?')[:40]} needs two positions, has {len(positions)}")
    headings = [math.atan2(end[1] - start[1], end[0] - start[0]) for start, end in pairwise(positions)]
    return tuple(
        Pose(*position, heading) for position, heading in zip(positions, [*headings, headings[-1]], strict=True)
    )


def _place(values: AttributeReader, item: Node) -> tuple[float, float]:
    return values.number(item, "x"), 0.0 - values.number(item, "y")


def _scenario_of_item(values: AttributeReader, item: Node, base: Scenario, report: ImportReport) -> Scenario:
    """The scenario of an item of a route, with the actors of its type. RouteError: its town does not allow it."""
    type_name = base.group
    add_actors = TYPES[type_name]
    trigger = item.find("trigger_point")
    is_empty = getattr(add_actors, "func", add_actors) is add_no_actors
    if trigger is not None:
        yaw = -math.radians(math.remainder(values.number(trigger, "yaw"), 360.0))
        base = replace(base, trigger=None if is_empty else Pose(*_place(values, trigger), yaw))
    elif not is_empty:
        raise values.error(item, f"'{type_name}' has no trigger_point")
    scenario_from(scenario_data(base))  # checks names and places before they are used
    graph = load_town(base.town)
    route = route_along(graph, base.route)
    point_distance = sum(
        math.dist((start_point.x, start_point.y), (end_point.x, end_point.y))
        for start_point, end_point in pairwise(base.route)
    )
    if route.length > ROUND * point_distance + 50.0:
        raise RouteError(
            f"scenario {base.name}: its points make {point_distance:.0f} m, the lanes that join "
            f"them {route.length:.0f} m"
        )
    start = 0 if is_empty else trigger_index(base, route)
    site = ScenarioBuilder(base, graph, route, start, item, values, generator("leaderboard", base.name))
    add_actors(site)
    for child in item:
        if child.tag not in site.used_names and child.tag != "trigger_point":
            report.omit(f"{child.tag[:40]} of {type_name}", base.name)
    return replace(base, actors=tuple(site.actors), signals=site.signals, target_speed=site.target_speed)


def _restored_scenario(values: AttributeReader, item: Node, source: Node, base: Scenario) -> Scenario:
    """The scenario that SSAD wrote; its route and trigger are those of the file where somebody has moved them."""
    try:
        content = json.loads(values.text(source, "scenario"))
    except (ValueError, RecursionError) as error:
        raise values.error(source, f"scenario is not JSON: {str(error)[:100]}") from None
    if not isinstance(content, dict):
        raise values.error(source, "scenario is not a mapping of keys")
    scenario = scenario_from(content | {"town": base.town})
    is_unmoved = len(scenario.route) == len(base.route) and all(
        math.dist((stored_point.x, stored_point.y), (file_point.x, file_point.y)) < MOVED
        for stored_point, file_point in zip(scenario.route, base.route, strict=True)
    )
    scenario = scenario if is_unmoved else replace(scenario, route=base.route)
    trigger = item.find("trigger_point")
    if trigger is None or scenario.trigger is None:
        return scenario
    x, y = _place(values, trigger)
    if math.dist((x, y), (scenario.trigger.x, scenario.trigger.y)) < MOVED:
        return scenario
    return replace(scenario, trigger=Pose(x, y, -math.radians(math.remainder(values.number(trigger, "yaw"), 360.0))))


# ---------------------------------------------------------------- out


def export_leaderboard(scenarios: Sequence[Scenario], out: Path, *, seed: int = 0) -> ExportedFiles:
    """Write routes.xml of leaderboard 2.0: for each scenario a route with its type and trigger.

    Args:
        scenarios: The scenarios.
        out: Output folder.
        seed: Seed of the episodes that are built to check the scenarios.

    Returns:
        The file, and the features that it does not carry over.

    Raises:
        SSADError: A scenario cannot be built, or a file cannot be written.
    """
    root, omissions = Element("routes"), list[str]()
    for index, scenario in enumerate(scenarios):
        built_episode = episode(scenario, seed)
        type_name = TYPES_2.get(scenario.type, scenario.group if scenario.group in TYPES else ALONE)
        if type_name == ALONE:
            omissions.append(f"actors of a {scenario.type}: the leaderboard drives its ego alone ({ALONE})")
        else:
            omissions.append("who takes part, and how: the leaderboard's type has actors and numbers of its own")
        route = SubElement(root, "route", id=str(index), town=scenario.town)
        SubElement(SubElement(route, "weathers"), "weather", route_percentage="0", sun_altitude_angle="45.0")
        waypoints = SubElement(route, "waypoints")
        for pose in scenario.route:
            SubElement(waypoints, "position", _xyz(pose))
        element = SubElement(SubElement(route, "scenarios"), "scenario", name=scenario.name, type=type_name)
        SubElement(
            element,
            "trigger_point",
            _xyz(_trigger(built_episode.scenario)) | {"yaw": _yaw(_trigger(built_episode.scenario))},
        )
        SubElement(element, OWN, scenario=dump_json(scenario_data(scenario)))
    return [_write(root, make_folder(out) / "routes.xml")], omissions


def export_leaderboard1(scenarios: Sequence[Scenario], out: Path, *, seed: int = 0) -> ExportedFiles:
    """Write routes.xml and scenarios.json of leaderboard 1.0; see `export_leaderboard`."""
    root, omissions = Element("routes"), list[str]()
    towns: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for index, scenario in enumerate(_exportable_scenarios(scenarios, TYPES_1, seed, omissions)):
        route = SubElement(root, "route", id=str(index), town=scenario.town)
        built_episode = episode(scenario, seed)
        for pose in _dense_route(built_episode):
            SubElement(route, "waypoint", _xyz(pose) | {"pitch": "0.0", "roll": "0.0", "yaw": _yaw(pose)})
        trigger = _trigger(scenario)
        event: dict[str, Any] = {"transform": _xyz(trigger) | {"pitch": "0.0", "yaw": _yaw(trigger)}}
        actor_places = [(agent.model, agent.pose) for agent in built_episode.agents[1:]]
        event["other_actors"] = {"front": [_xyz(pose) | {"yaw": _yaw(pose)} for model, pose in actor_places if model]}
        towns.setdefault(scenario.town, {}).setdefault(TYPES_1[scenario.type], []).append(event)
    blocks = [
        {
            town: [
                {"scenario_type": type_name, "available_event_configurations": events}
                for type_name, events in events_by_type.items()
            ]
        }
        for town, events_by_type in towns.items()
    ]
    folder = make_folder(out)
    write_atomic(folder / "scenarios.json", dump_json({"available_scenarios": blocks}, indent=1) + "\n")
    return [_write(root, folder / "routes.xml"), folder / "scenarios.json"], omissions


def _exportable_scenarios(
    scenarios: Sequence[Scenario], types: Mapping[str, str], seed: int, omissions: list[str]
) -> list[Scenario]:
    """Those that have a type; what is lost of them."""
    supported = []
    for scenario in scenarios:
        if scenario.type not in types:
            omissions.append(f"scenarios of type {scenario.type}: the leaderboard has none such")
            continue
        episode(scenario, seed)
        omissions.append("who takes part, and how: the leaderboard's type has actors and numbers of its own")
        if scenario.parameters:
            omissions.append(f"parameters {', '.join(sorted(scenario.parameters))}")
        supported.append(scenario)
    if not supported:
        raise SSADError(f"none of these scenarios has a counterpart in the leaderboard; it plays: {', '.join(types)}")
    return supported


def _dense_route(built: Episode) -> list[Pose]:
    """A point of the ego's route each 5 m, and its end: a trigger must lie on the lines between them."""
    route = built.agents[0].route
    assert route is not None
    row_indices = [*range(0, len(route.xy) - 1, 5), len(route.xy) - 1]
    rows = np.column_stack([route.xy, route.yaw]).astype(np.float64)
    return [Pose(*row) for row in rows[row_indices].tolist()]


def _trigger(scenario: Scenario) -> Pose:
    return scenario.trigger if scenario.trigger is not None else scenario.route[0]


def _xyz(pose: Pose) -> dict[str, str]:
    return {"x": f"{pose.x:.3f}", "y": f"{0.0 - pose.y:.3f}", "z": "0.0"}


def _yaw(pose: Pose) -> str:
    return f"{0.0 - math.degrees(pose.yaw):.4f}"


def _write(root: Element, path: Path) -> Path:
    indent(root, " ")
    write_atomic(path, '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n")
    return path
