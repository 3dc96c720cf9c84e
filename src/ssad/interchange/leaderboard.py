"""Routes of the CARLA leaderboards: 2.0 (and Bench2Drive) in and out, 1.0 out; `ssad import routes` reads 1.0.

A scenario of a leaderboard is a type, a trigger and numbers; who takes part and what they do is code of the
leaderboard. So a type here becomes the scenario class that plays the same situation, with its own actors, and back.
CARLA's left-handed frame becomes ours here. Types and format: leaderboard 2.0 (leaderboard.carla.org) and Bench2Drive.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from ssad.core.errors import FormatError, SSADError
from ssad.core.safeio import MIB, dotted, dump_json, make_folder, read_xml, write_atomic
from ssad.core.types import Episode, Pose, Scenario, SignalPlan
from ssad.interchange.export import Written, episode
from ssad.interchange.openscenario_places import Values
from ssad.roads import load_town, town_names
from ssad.scenarios.dynamic import CUSTOM, build_episode, parameter_box
from ssad.scenarios.dynamic.schema import problems

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element as Node

MAX_BYTES: Final = 64 * MIB
CLASSES: Final[Mapping[str, str]] = {
    "DynamicObjectCrossing": "StraightObstacle",
    "ParkingCrossingPedestrian": "StraightObstacle",
    "VehicleTurningRoute": "TurningObstacle",
    "VehicleTurningRoutePedestrian": "TurningObstacle",
    "ParkedObstacleTwoWays": "VehiclePassing",
    "OppositeVehicleRunningRedLight": "RedlightRunning",
    "SignalizedJunctionLeftTurn": "UnprotectedLeftTurn",
    "SignalizedJunctionRightTurn": "RightTurn",
    "OppositeVehicleTakingPriority": "CrossingNegotiation",
    "NonSignalizedJunctionLeftTurn": "CrossingNegotiation",
    "NonSignalizedJunctionRightTurn": "CrossingNegotiation",
    "VanillaSignalizedTurnEncounterGreenLight": CUSTOM,
    "VanillaSignalizedTurnEncounterRedLight": CUSTOM,
    "VanillaNonSignalizedTurn": CUSTOM,
    "VanillaNonSignalizedTurnEncounterStopsign": CUSTOM,
}
"""Type of leaderboard 2.0 or Bench2Drive -> the class here that plays it; Custom: nobody but the ego takes part."""
_SIGNALS = {
    "VanillaSignalizedTurnEncounterGreenLight": SignalPlan("green", "red"),
    "VanillaSignalizedTurnEncounterRedLight": SignalPlan("red", "green", until=15.0),
}
_FLOW = {"flow_speed": "speed"}  # number of a type -> parameter of the class
TYPES_2: Final[Mapping[str, str]] = {
    "StraightObstacle": "DynamicObjectCrossing",
    "TurningObstacle": "VehicleTurningRoute",
    "VehiclePassing": "ParkedObstacleTwoWays",
    "RedlightRunning": "OppositeVehicleRunningRedLight",
    "UnprotectedLeftTurn": "SignalizedJunctionLeftTurn",
    "RightTurn": "SignalizedJunctionRightTurn",
    "CrossingNegotiation": "OppositeVehicleTakingPriority",
}
"""Class -> type of leaderboard 2.0."""
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


def read_leaderboard(path: Path) -> tuple[tuple[Scenario, ...], tuple[str, ...]]:
    """The scenarios of a file of routes of leaderboard 2.0.

    Args:
        path: The file.

    Returns:
        A scenario for each on a route that a class here plays, and what is not carried over, a line each.

    Raises:
        FormatError: The file is broken, or no scenario in it can be played.
    """
    root = read_xml(path, limit=MAX_BYTES)
    if root.tag != "routes":
        raise FormatError(f"{path}: not a file of routes: its root is <{root.tag[:40]}>")
    values, lost, found = Values(str(path), root), Counter[str](), list[Scenario]()
    known = town_names()
    for route in root.iterfind("route"):
        ident, town = values.text(route, "id"), values.text(route, "town")
        points = _points(values, route)
        if route.find("weathers/weather") is not None:
            lost["weather of a route"] += 1
        told = route.findall("scenarios/scenario")
        if not told:
            lost["a route without a scenario"] += 1
        for item in told:
            kind = values.text(item, "type")
            name = f"leaderboard/{ident}/{kind}_{sum(s.name.startswith(f'leaderboard/{ident}/') for s in found):02d}"
            if kind not in CLASSES:
                lost[f"type {kind}: no class here plays it"] += 1
                continue
            scenario = _scenario(values, item, points, Scenario(name, CLASSES[kind], town, points), lost)
            scenario = replace(scenario, source=f"leaderboard route {ident} of {path.name}", group=kind)
            for location, message in problems(scenario):
                raise FormatError(f"{path}: route {ident[:40]}: {dotted(location)}: {message}")
            if town not in known:
                lost[f"town {town} is not imported: its scenarios are not checked"] += 1
            else:
                try:
                    build_episode(scenario, load_town(town), seed=0)
                except SSADError as error:
                    lost[str(error)] += 1
                    continue
            found.append(scenario)
    if not found:
        why = "; ".join(list(lost)[:3]) or "it has no route"
        raise FormatError(f"{path}: no scenario in it can be played here: {why}")
    return tuple(found), tuple(f"{text}{f' ({n} times)' if n > 1 else ''}" for text, n in lost.items())


def _points(values: Values, route: Node) -> tuple[Pose, ...]:
    """Key points of a route, each with the heading to the next."""
    xy = [_place(values, item) for item in route.iterfind("waypoints/position")]
    xy = [here for k, here in enumerate(xy) if k == 0 or math.dist(here, xy[k - 1]) > 0.1]
    if len(xy) < 2:
        raise values.fail(route, f"route {route.get('id', '?')[:40]} needs two positions, has {len(xy)}")
    yaw = [math.atan2(b[1] - a[1], b[0] - a[0]) for a, b in pairwise(xy)]
    return tuple(Pose(*here, angle) for here, angle in zip(xy, [*yaw, yaw[-1]], strict=True))


def _place(values: Values, item: Node) -> tuple[float, float]:
    return values.number(item, "x"), 0.0 - values.number(item, "y")


def _scenario(values: Values, item: Node, points: Sequence[Pose], base: Scenario, lost: Counter[str]) -> Scenario:
    """The scenario of an item of a route."""
    kind = values.text(item, "type")
    if base.type == CUSTOM:
        return replace(base, signals=_SIGNALS.get(kind, SignalPlan()))
    trigger = item.find("trigger_point")
    if trigger is None:
        raise values.fail(item, f"'{kind}' has no trigger_point")
    yaw = -math.radians(math.remainder(values.number(trigger, "yaw"), 360.0))
    box, parameters = parameter_box(base.type), {}
    for number in item:
        if number.tag in _FLOW and _FLOW[number.tag] in box:
            limit = box[_FLOW[number.tag]]
            parameters[limit.name] = min(max(values.number(number, "value"), limit.low), limit.high)
        elif number.tag != "trigger_point":
            lost[f"{number.tag} of {kind}: a {base.type} has numbers of its own"] += 1
    return replace(base, trigger=Pose(*_place(values, trigger), yaw), parameters=parameters)


# ---------------------------------------------------------------- out


def export_leaderboard(scenarios: Sequence[Scenario], out: Path, *, seed: int = 0) -> Written:
    """Write routes.xml of leaderboard 2.0: for each scenario a route with its type and trigger.

    Args:
        scenarios: The scenarios.
        out: Folder.
        seed: Of the episodes that are built to check them.

    Raises:
        SSADError: A scenario cannot be built, none has a counterpart, or a file cannot be written.
    """
    root, lost = Element("routes"), list[str]()
    for k, scenario in enumerate(_written(scenarios, TYPES_2, seed, lost)):
        route = SubElement(root, "route", id=str(k), town=scenario.town)
        SubElement(SubElement(route, "weathers"), "weather", route_percentage="0", sun_altitude_angle="45.0")
        places = SubElement(route, "waypoints")
        for pose in scenario.route:
            SubElement(places, "position", _xyz(pose))
        item = SubElement(SubElement(route, "scenarios"), "scenario", name=scenario.name, type=TYPES_2[scenario.type])
        SubElement(item, "trigger_point", _xyz(_trigger(scenario)) | {"yaw": _yaw(_trigger(scenario))})
    return [_write(root, make_folder(out) / "routes.xml")], lost


def export_leaderboard1(scenarios: Sequence[Scenario], out: Path, *, seed: int = 0) -> Written:
    """Write routes.xml and scenarios.json of leaderboard 1.0; see `export_leaderboard`."""
    root, lost = Element("routes"), list[str]()
    towns: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for k, scenario in enumerate(_written(scenarios, TYPES_1, seed, lost)):
        route = SubElement(root, "route", id=str(k), town=scenario.town)
        built = episode(scenario, seed)
        for pose in _dense(built):
            SubElement(route, "waypoint", _xyz(pose) | {"pitch": "0.0", "roll": "0.0", "yaw": _yaw(pose)})
        trigger = _trigger(scenario)
        event: dict[str, Any] = {"transform": _xyz(trigger) | {"pitch": "0.0", "yaw": _yaw(trigger)}}
        places = [(agent.model, agent.pose) for agent in built.agents[1:]]
        event["other_actors"] = {"front": [_xyz(pose) | {"yaw": _yaw(pose)} for model, pose in places if model]}
        towns.setdefault(scenario.town, {}).setdefault(TYPES_1[scenario.type], []).append(event)
    blocks = [
        {town: [{"scenario_type": kind, "available_event_configurations": events} for kind, events in kinds.items()]}
        for town, kinds in towns.items()
    ]
    folder = make_folder(out)
    write_atomic(folder / "scenarios.json", dump_json({"available_scenarios": blocks}, indent=1) + "\n")
    return [_write(root, folder / "routes.xml"), folder / "scenarios.json"], lost


def _written(scenarios: Sequence[Scenario], types: Mapping[str, str], seed: int, lost: list[str]) -> list[Scenario]:
    """Those that have a type; what is lost of them."""
    found = []
    for scenario in scenarios:
        if scenario.type not in types:
            lost.append(f"scenarios of type {scenario.type}: the leaderboard has none such")
            continue
        episode(scenario, seed)
        lost.append("who takes part, and how: the leaderboard's type has actors and numbers of its own")
        if scenario.parameters:
            lost.append(f"parameters {', '.join(sorted(scenario.parameters))}")
        found.append(scenario)
    if not found:
        raise SSADError(f"none of these scenarios has a counterpart in the leaderboard; it plays: {', '.join(types)}")
    return found


def _dense(built: Episode) -> list[Pose]:
    """A point of the ego's route each 5 m, and its end: a trigger must lie on the lines between them."""
    route = built.agents[0].route
    assert route is not None
    kept = [*range(0, len(route.xy) - 1, 5), len(route.xy) - 1]
    rows = np.column_stack([route.xy, route.yaw]).astype(np.float64)
    return [Pose(*row) for row in rows[kept].tolist()]


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
