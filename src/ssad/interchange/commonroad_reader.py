"""CommonRoad files as scenarios: obstacles replay their trajectories, and the ego gets the planning problem.

XML 2020a is read here, protobuf and XML 2018b through commonroad-io. If the lanelets are those of an existing town,
the scenario takes place in that town; else they become a town. Features without a counterpart are named
in a report.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from ssad.core.errors import ConfigError, FormatError, MapError, RouteError
from ssad.core.import_report import ImportReport
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.safeio import MIB, read_xml
from ssad.core.types import F64, EpisodeLimits, LaneType, Pose, Route, Scenario, SignalPlan
from ssad.core.wording import counted
from ssad.interchange.commonroad_lanelets import ImportedLanes, read_lanes
from ssad.interchange.commonroad_obstacles import ObstacleReader
from ssad.interchange.commonroad_other import convert, is_protobuf
from ssad.interchange.commonroad_writer import benchmark_map
from ssad.interchange.commonroad_xml import STEP, VERSION, TextReader, parse_source
from ssad.interchange.ego_start import start_parameters
from ssad.interchange.scenario_parts import plan_of, scenario_name
from ssad.scenarios.dynamic import build_episode
from ssad.scenarios.dynamic.knowledge._placing import LanePosition, lane_path
from ssad.scenarios.dynamic.schema import MAX_SPEED
from ssad.world.roads import is_town, load_town, route_along, town_names
from ssad.world.roads.graph_report import describe
from ssad.world.roads.query import nearest_all

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

MAX_BYTES: Final = 128 * MIB
OLDER: Final = "2018b"
WAY: Final = 200.0  # m, length of the route along its lane of an ego without a goal
ALIKE: Final = 0.01  # m, largest distance between lanes of a file and of a town that count as the same


@dataclass(frozen=True)
class ImportedCommonRoad:
    """A scenario from a CommonRoad file.

    Attributes:
        scenario: The scenario.
        graph: Its town.
        is_known_town: Whether the town can be loaded by its name; else the graph must be stored.
    """

    scenario: Scenario
    graph: LaneGraph
    is_known_town: bool


def read_commonroad(
    path: Path, *, town: str | None = None, map_name: str | None = None, report: ImportReport | None = None
) -> ImportedCommonRoad:
    """Read the scenario of a file.

    Args:
        path: The file.
        town: Name for a town made of its lanelets; None: the name of the file.
        map_name: Its town, or a file of that town, instead of its lanelets.
        report: Filled with what came in, what is not carried over, and what is doubtful.

    Raises:
        FormatError: The file is broken, or is not a CommonRoad scenario.
        MissingExtraError: It is protobuf or XML 2018b, and commonroad-io is not installed.
        MapError, UnknownNameError: Its lanelets form no valid town, or the named town does not exist.
        RouteError: The ego's route does not lie on the town's roads.
        ConfigError: The scenario cannot be driven.
    """
    location = str(path)
    if is_protobuf(path, limit=MAX_BYTES):
        root = convert(path, protobuf=True, limit=MAX_BYTES)
    else:
        root = read_xml(path, limit=MAX_BYTES)
        if root.tag != "commonRoad":
            raise FormatError(f"{location}: not CommonRoad XML: its root is <{root.tag[:40]}>")
        version = root.get("commonRoadVersion", "")
        if version == OLDER:
            root = convert(path, protobuf=False, limit=MAX_BYTES)
        elif version != VERSION:
            raise FormatError(f"{location}: commonRoadVersion is '{version[:20]}'; {VERSION} and {OLDER} are read")
    account = ImportReport(location) if report is None else report
    version = root.get("commonRoadVersion", "")
    account.contents.append(f"CommonRoad {version[:12]}, benchmark {root.get('benchmarkID', '')[:60] or 'without id'}")
    reader = _Reader(location, root, account)
    try:
        return reader.read(Path(path).stem, town or Path(path).stem, map_name)
    except (MapError, RouteError, ConfigError) as error:
        message = " ".join(str(error).split())
        raise type(error)(message if location in message else f"{location}: {message}") from None


class _Reader:
    def __init__(self, location: str, root: Element, report: ImportReport) -> None:
        self.root, self.texts, self.report = root, TextReader(location), report
        self.own_values = parse_source(root.get("source", ""))
        self.dt = self.texts.number(root.get("timeStepSize"), root, "timeStepSize")
        if not 0.0 < self.dt <= 10.0:
            raise self.texts.error(root, f"timeStepSize is {self.dt:g} s")
        self.obstacles = ObstacleReader(self.texts, report, self.dt)

    def read(self, stem: str, town: str, map_name: str | None) -> ImportedCommonRoad:
        """Return the scenario, checked."""
        lanes, graph, is_known, town_name = self._town(town, map_name)
        problem = self._problem()
        start, speed = self._start(problem)
        limits, goal, target_speed = self._goal(problem, lanes, speed)
        route, ego_route = self._route(graph, start, goal)
        stored_name = scenario_name(self.own_values.get("name", "")) or scenario_name(self.root.get("benchmarkID", ""))
        scenario = Scenario(
            name=stored_name or scenario_name(stem) or "imported",
            type="Custom",
            town=town_name,
            route=route,
            parameters=start_parameters(ego_route, start, speed, digits=6, report=self.report),
            limits=limits,
            target_speed=target_speed,
            group=self.own_values.get("group", ""),
            actors=self.obstacles.read(self.root, start, limits),
            signals=self._signals(lanes, graph, ego_route, limits),
            source=f"CommonRoad {Path(self.texts.location).name}",
        )
        for tag in ("phantomObstacle", "environmentObstacle", "location/environment"):
            if count := len(self.root.findall(tag)):
                self.report.omit(tag.rpartition("/")[2], count=count)
        build_episode(scenario, graph, seed=0)  # reports any remaining error of the scenario
        return ImportedCommonRoad(scenario, graph, is_known)

    # ------------------------------------------------------------ the town

    def _town(self, town: str, map_name: str | None) -> tuple[ImportedLanes, LaneGraph, bool, str]:
        """Return the file's lanes, the town, whether the town can be loaded by name, and its name."""
        lanes = read_lanes(self.root, self.texts, town, self.report)
        if map_name is not None:
            is_known = is_town(map_name)
            graph = load_town(map_name)
            return lanes, (graph if is_known else replace(graph, name=town)), is_known, (map_name if is_known else town)
        if is_town(self.own_values.get("town", "")):
            graph = load_town(self.own_values["town"])
            if _same_lanes(graph, lanes.graph):
                return lanes, graph, True, graph.name
        label = self.root.get("benchmarkID", "").partition("_")[2].partition("-")[0]
        for name in town_names():
            if benchmark_map(name) == label and _same_lanes(load_town(name), lanes.graph):
                return lanes, load_town(name), True, name
        if lanes.cycles:
            self.report.omit(f"the cycles of {lanes.cycles} traffic lights: they run this program's own")
        names = {lane: f"lanelet {lanelet}" for lanelet, lane in lanes.lane_of.items()}
        describe(lanes.graph, f"{lanes.graph.lane_count} lanelets", self.report, names.__getitem__)
        return lanes, lanes.graph, False, town

    def _signals(self, lanes: ImportedLanes, graph: LaneGraph, line: Route, limits: EpisodeLimits) -> SignalPlan:
        """The plan that forces just the lights that always show the same."""
        if not lanes.states:
            return SignalPlan()
        lanes_by_signal = _lanes_by_signal(lanes.graph)
        # Signals have no common ids: they are matched by the lanes that they stop.
        signal_by_lanes = {stops: signal for signal, stops in _lanes_by_signal(graph).items()}
        forced_states = {
            signal_by_lanes[lanes_by_signal[signal]]: state
            for signal, state in lanes.states.items()
            if lanes_by_signal.get(signal) in signal_by_lanes
        }
        end_time = max(60.0, limits.max_time)
        if "signals_until" in self.own_values:
            end_time = self.texts.number(self.own_values["signals_until"], self.root, "source: signals_until")
        plan = plan_of(graph, line, forced_states, end_time) if len(forced_states) == len(lanes.states) else None
        if plan is None:
            self.report.omit(f"the states of {counted(len(lanes.states), 'signal')}, which no signal plan here gives")
        return plan or SignalPlan()

    # ------------------------------------------------------------ the ego

    def _problem(self) -> Element:
        problems = self.root.findall("planningProblem")
        if not problems:
            raise self.texts.error("commonRoad", "it has no planningProblem: nothing says where the ego goes")
        if len(problems) > 1:
            self.report.omit("further planning problems: the first is driven", count=len(problems) - 1)
        return problems[0]

    def _start(self, problem: Element) -> tuple[Pose, float]:
        state = problem.find("initialState")
        if state is None:
            raise self.texts.error(problem, "initialState is missing")
        pose = self.obstacles.pose(state, problem)
        speed = self.obstacles.middle(state, "velocity", problem, 0.0)
        if speed < 0.0:
            raise self.texts.error(problem, f"it starts with {speed:g} m/s")
        if self.obstacles.middle(state, "time", problem, 0.0) != 0.0:
            self.report.omit("the step at which the planning problem begins: it is step 0")
        return pose, min(speed, MAX_SPEED)

    def _goal(self, problem: Element, lanes: ImportedLanes, speed: float) -> tuple[EpisodeLimits, Pose | None, float]:
        """Return the limits, the goal pose, and the target speed."""
        goals = problem.findall("goalState")
        if not goals:
            raise self.texts.error(problem, "goalState is missing")
        if len(goals) > 1:
            self.report.omit("further goal states: the first is the goal", count=len(goals) - 1)
        goal = goals[0]
        begin_step, end_step = self.texts.value(goal.find("time"), problem, "goalState: time")
        steps = round(end_step * self.dt / STEP)
        if steps < 1:
            raise self.texts.error(problem, f"its goal is to be reached at step {end_step:g}")
        if begin_step > 0.0:
            self.report.omit("the earliest time of the goal")
        if goal.find("orientation") is not None:
            self.report.omit("the orientation of the goal")
        limits = EpisodeLimits(max_steps=steps, max_time=max(EpisodeLimits().max_time, steps * STEP))
        if self.own_values.get("contact") in ("end", "count", "remove"):
            limits = replace(limits, contact=self.own_values["contact"])  # type: ignore[arg-type]
        if "max_distance" in self.own_values:
            max_distance = self.texts.number(self.own_values["max_distance"], self.root, "source: max_distance")
            limits = replace(limits, max_distance=max(max_distance, 1.0))
        target_speed = Scenario.target_speed
        if (velocity := goal.find("velocity")) is not None:
            min_speed, target_speed = self.texts.value(velocity, problem, "goalState: velocity")
            if min_speed > 0.0:
                self.report.omit("the least speed at the goal")
        elif speed > 1.0:
            target_speed = speed
        if not 0.1 <= target_speed <= MAX_SPEED:
            target_speed = min(max(target_speed, Scenario.target_speed), MAX_SPEED)
            self.report.omit(f"the speed at the goal: the ego drives at {target_speed:g} m/s")
        return limits, self._region(goal.find("position"), problem, lanes), target_speed

    def _region(self, position: Element | None, problem: Element, lanes: ImportedLanes) -> Pose | None:
        """Return the middle of a goal region; None if there is none."""
        if position is None or not len(position):
            return None
        if len(position) > 1:
            self.report.omit("more than one goal region: the first is the goal")
        region = position[0]
        if region.tag == "lanelet":
            lanelet_id = self.texts.whole(region.get("ref"), problem, "goalState: lanelet")
            if lanelet_id not in lanes.lane_of:
                raise self.texts.error(problem, f"its goal is lanelet {lanelet_id}, which is not there")
            lane = lanes.lane_of[lanelet_id]
            x, y, yaw, _ = lanes.graph.at(lane, max(float(lanes.graph.length[lane]) - 1.0, 0.0))
            return Pose(x, y, yaw)
        if region.tag == "polygon":
            corners = self.texts.points(region, problem, "goalState: polygon")
            if len(corners) < 3:
                raise self.texts.error(problem, "its goal is a polygon of fewer than 3 points")
            return Pose(*corners[:, :2].mean(0).tolist())
        if region.tag not in ("circle", "rectangle"):
            raise self.texts.error(problem, f"its goal is a {region.tag[:40]}, which is not read")
        x, y = (
            self.texts.number(region.findtext(f"center/{axis}"), problem, f"goalState: center: {axis}") for axis in "xy"
        )
        return Pose(x, y)

    def _route(self, graph: LaneGraph, start: Pose, goal: Pose | None) -> tuple[tuple[Pose, ...], Route]:
        """Return the key points of the ego's route, and the route."""
        if goal is None:
            self.report.note(f"the ego has no place to reach: its route is {WAY:g} m along its lane")
            return self._route_ahead(graph, start)
        try:
            ego_route = route_along(graph, (start, (goal.x, goal.y)))
            route = start, Pose(goal.x, goal.y, float(wrap_angle(ego_route.yaw[-1])))
            return route, route_along(graph, route)
        except RouteError as error:
            if _lane_under(graph, start) is None or "no way" not in str(error):
                raise RouteError(f"{self.texts.location}: the way of the ego: {error}") from None
        self.report.doubt(f"no way along the lanes leads to the goal: the route is {WAY:g} m along the ego's lane")
        return self._route_ahead(graph, start)

    def _route_ahead(self, graph: LaneGraph, start: Pose) -> tuple[tuple[Pose, ...], Route]:
        """Return the route along the lane under the ego, straight on where lanes diverge."""
        place = _lane_under(graph, start)
        if place is None:
            raise RouteError(f"{self.texts.location}: the ego does not stand on a road of '{graph.name}'")
        path = lane_path(graph, place, WAY)
        if len(path) < 3:
            raise RouteError(f"{self.texts.location}: the road ends before the ego")
        point_indices = np.unique(np.linspace(0, len(path) - 2, 9).astype(int))[1:]
        directions = path[point_indices + 1] - path[point_indices]
        rows = np.column_stack([path[point_indices], np.arctan2(directions[:, 1], directions[:, 0])])
        route = (start, *(Pose(x, y, yaw) for x, y, yaw in rows.tolist()))
        return route, route_along(graph, route)


def _lane_under(graph: LaneGraph, pose: Pose) -> LanePosition | None:
    """Return the driving lane under a pose with its direction."""
    lanes, distances, lane_distances = nearest_all(graph, (pose.x, pose.y), (LaneType.DRIVING,))
    places = [LanePosition(lane, distance) for lane, distance in zip(lanes.tolist(), distances.tolist(), strict=True)]
    heading_differences = [abs(float(wrap_angle(graph.at(place.lane, place.s)[2] - pose.yaw))) for place in places]
    candidates = [
        index
        for index in range(len(places))
        if lane_distances[index] <= 2.0 and heading_differences[index] < math.pi / 3
    ]
    return places[min(candidates, key=lambda index: max(float(lane_distances[index]), 0.0))] if candidates else None


def _same_lanes(town: LaneGraph, lanes: LaneGraph) -> bool:
    """Return True if the lanes of a file are those of a town."""
    is_same_layout = town.lane_count == lanes.lane_count and np.array_equal(town.kind, lanes.kind)
    start_points: list[F64] = (
        [graph.xy[graph.offset[:-1]].astype(np.float64) for graph in (town, lanes)] if is_same_layout else []
    )
    return is_same_layout and bool(np.abs(start_points[0] - start_points[1]).max() < ALIKE)


def _lanes_by_signal(graph: LaneGraph) -> Mapping[int, tuple[int, ...]]:
    """Return the lanes that each signal stops."""
    lanes_by_signal: dict[int, tuple[int, ...]] = {}
    for signal, lane in zip(graph.stop_signal.tolist(), graph.stop_lane.tolist(), strict=True):
        lanes_by_signal[signal] = (*lanes_by_signal.get(signal, ()), lane)
    return {signal: tuple(sorted(lanes)) for signal, lanes in lanes_by_signal.items()}
