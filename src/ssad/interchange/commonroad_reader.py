"""CommonRoad XML 2020a as a scenario: obstacles repeat their trajectories, the planning problem is driven by the ego.

Where the lanelets are those of a town here, the scenario takes place in that town; else they become one. Whatever has
no counterpart is named in `ReadCommonRoad.lost`.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np

from ssad.core.errors import ConfigError, FormatError, MapError, RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.safeio import MIB, read_xml
from ssad.core.types import F64, LaneType, Limits, Pose, Route, Scenario, SignalPlan
from ssad.interchange.commonroad_lanelets import ReadLanes, read_lanes
from ssad.interchange.commonroad_obstacles import Obstacles
from ssad.interchange.commonroad_writer import benchmark_map
from ssad.interchange.commonroad_xml import STEP, VERSION, Texts, own_values
from ssad.interchange.ego_start import start_parameters
from ssad.interchange.scenario_parts import plan_of, scenario_name
from ssad.scenarios.dynamic import build_episode
from ssad.scenarios.dynamic.knowledge._placing import Place, lane_path
from ssad.scenarios.dynamic.schema import MAX_SPEED
from ssad.world.roads import is_town, load_town, route_along, town_names
from ssad.world.roads.query import nearest_all

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

MAX_BYTES: Final = 128 * MIB
WAY: Final = 200.0  # m along its lane that an ego without a place to reach gets
ALIKE: Final = 0.01  # m between the lanes of a file and those of a town that count as the same


@dataclass(frozen=True)
class ReadCommonRoad:
    """A scenario from a CommonRoad file.

    Attributes:
        scenario: The scenario.
        graph: Its town.
        known: Whether the town can be loaded by its name; else the graph must be stored.
        lost: What of the file it does not carry, a line each.
    """

    scenario: Scenario
    graph: LaneGraph
    known: bool
    lost: tuple[str, ...]


def read_commonroad(path: Path, *, town: str | None = None, map_name: str | None = None) -> ReadCommonRoad:
    """The scenario of a file.

    Args:
        path: The file.
        town: What a town of its lanelets is called; None: as the file.
        map_name: Town that it takes place in, or a file of it, instead of its lanelets.

    Raises:
        FormatError: The file is broken, or is no CommonRoad XML 2020a.
        MapError, UnknownNameError: Its lanelets make no town, or there is no town of that name.
        RouteError: The ego's way does not lie on the town's roads.
        ConfigError: It makes no scenario that can be driven.
    """
    root = read_xml(path, limit=MAX_BYTES)
    where = str(path)
    if root.tag != "commonRoad":
        raise FormatError(f"{where}: not CommonRoad XML: its root is <{root.tag[:40]}>")
    version = root.get("commonRoadVersion", "")
    if version != VERSION:
        raise FormatError(f"{where}: commonRoadVersion is '{version[:20]}'; only {VERSION} is read")
    reader = _Reader(where, root)
    try:
        return reader.read(Path(path).stem, town or Path(path).stem, map_name)
    except (MapError, RouteError, ConfigError) as error:
        text = " ".join(str(error).split())
        raise type(error)(text if where in text else f"{where}: {text}") from None


class _Reader:
    def __init__(self, where: str, root: Element) -> None:
        self.root, self.texts = root, Texts(where)
        self.lost: Counter[str] = Counter()
        self.own = own_values(root.get("source", ""))
        self.dt = self.texts.number(root.get("timeStepSize"), root, "timeStepSize")
        if not 0.0 < self.dt <= 10.0:
            raise self.texts.fail(root, f"timeStepSize is {self.dt:g} s")
        self.obstacles = Obstacles(self.texts, self.lost, self.dt)

    def read(self, stem: str, town: str, map_name: str | None) -> ReadCommonRoad:
        """The scenario, checked, and what was lost."""
        lanes, graph, known, name = self._town(town, map_name)
        problem = self._problem()
        start, speed = self._start(problem)
        limits, goal, target = self._goal(problem, lanes, speed)
        route, line = self._route(graph, start, goal)
        told = scenario_name(self.own.get("name", "")) or scenario_name(self.root.get("benchmarkID", ""))
        scenario = Scenario(
            name=told or scenario_name(stem) or "imported",
            type="Custom",
            town=name,
            route=route,
            parameters=start_parameters(line, start, speed, digits=6),
            limits=limits,
            target_speed=target,
            group=self.own.get("group", ""),
            actors=self.obstacles.read(self.root, start, limits),
            signals=self._signals(lanes, graph, line, limits),
            source=f"CommonRoad {Path(self.texts.where).name}",
        )
        for tag in ("phantomObstacle", "environmentObstacle", "location/environment"):
            if count := len(self.root.findall(tag)):
                self.lost[tag] += count
        build_episode(scenario, graph, seed=0)  # whatever is still wrong with it is said now
        lost = tuple(f"{text}{f' ({n} times)' if n > 1 else ''}" for text, n in self.lost.items())
        return ReadCommonRoad(scenario, graph, known, lost)

    # ------------------------------------------------------------ where

    def _town(self, town: str, map_name: str | None) -> tuple[ReadLanes, LaneGraph, bool, str]:
        """The file's lanes, the town that it takes place in, whether that is known, and its name."""
        lanes = read_lanes(self.root, self.texts, town, self.lost)
        if map_name is not None:
            known = is_town(map_name)
            graph = load_town(map_name)
            return lanes, (graph if known else replace(graph, name=town)), known, (map_name if known else town)
        if is_town(self.own.get("town", "")):
            graph = load_town(self.own["town"])
            if _alike(graph, lanes.graph):
                return lanes, graph, True, graph.name
        label = self.root.get("benchmarkID", "").partition("_")[2].partition("-")[0]
        for name in town_names():
            if benchmark_map(name) == label and _alike(load_town(name), lanes.graph):
                return lanes, load_town(name), True, name
        if lanes.cycles:
            self.lost[f"the cycles of {lanes.cycles} traffic lights: they run this program's own"] += 1
        return lanes, lanes.graph, False, town

    def _signals(self, lanes: ReadLanes, graph: LaneGraph, line: Route, limits: Limits) -> SignalPlan:
        """The plan that forces just the lights that always show the same."""
        if not lanes.states:
            return SignalPlan()
        ruled = _ruled(lanes.graph)
        number = {stops: k for k, stops in _ruled(graph).items()}
        wanted = {number[ruled[k]]: state for k, state in lanes.states.items() if ruled.get(k) in number}
        until = max(60.0, limits.max_time)
        if "signals_until" in self.own:
            until = self.texts.number(self.own["signals_until"], self.root, "source: signals_until")
        plan = plan_of(graph, line, wanted, until) if len(wanted) == len(lanes.states) else None
        if plan is None:
            self.lost[f"the states of {len(lanes.states)} signals, which no signal plan here gives"] += 1
        return plan or SignalPlan()

    # ------------------------------------------------------------ the ego

    def _problem(self) -> Element:
        problems = self.root.findall("planningProblem")
        if not problems:
            raise self.texts.fail("commonRoad", "it has no planningProblem: nothing says where the ego goes")
        if len(problems) > 1:
            self.lost[f"{len(problems) - 1} more planning problems: the first is driven"] += 1
        return problems[0]

    def _start(self, problem: Element) -> tuple[Pose, float]:
        state = problem.find("initialState")
        if state is None:
            raise self.texts.fail(problem, "initialState is missing")
        pose = self.obstacles.pose(state, problem)
        speed = self.obstacles.middle(state, "velocity", problem, 0.0)
        if speed < 0.0:
            raise self.texts.fail(problem, f"it starts with {speed:g} m/s")
        if self.obstacles.middle(state, "time", problem, 0.0) != 0.0:
            self.lost["the step at which the planning problem begins: it is step 0"] += 1
        return pose, min(speed, MAX_SPEED)

    def _goal(self, problem: Element, lanes: ReadLanes, speed: float) -> tuple[Limits, Pose | None, float]:
        """Limits, the place to reach, and the target speed."""
        goals = problem.findall("goalState")
        if not goals:
            raise self.texts.fail(problem, "goalState is missing")
        if len(goals) > 1:
            self.lost[f"{len(goals) - 1} more goal states: the first is the goal"] += 1
        goal = goals[0]
        begin, end = self.texts.value(goal.find("time"), problem, "goalState: time")
        steps = round(end * self.dt / STEP)
        if steps < 1:
            raise self.texts.fail(problem, f"its goal is to be reached at step {end:g}")
        if begin > 0.0:
            self.lost["the earliest time of the goal"] += 1
        if goal.find("orientation") is not None:
            self.lost["the orientation of the goal"] += 1
        limits = Limits(max_steps=steps, max_time=max(Limits().max_time, steps * STEP))
        if self.own.get("contact") in ("end", "count", "remove"):
            limits = replace(limits, contact=self.own["contact"])  # type: ignore[arg-type]
        if "max_distance" in self.own:
            way = self.texts.number(self.own["max_distance"], self.root, "source: max_distance")
            limits = replace(limits, max_distance=max(way, 1.0))
        target = Scenario.target_speed
        if (velocity := goal.find("velocity")) is not None:
            low, target = self.texts.value(velocity, problem, "goalState: velocity")
            if low > 0.0:
                self.lost["the least speed at the goal"] += 1
        elif speed > 1.0:
            target = speed
        if not 0.1 <= target <= MAX_SPEED:
            target = min(max(target, Scenario.target_speed), MAX_SPEED)
            self.lost[f"the speed at the goal: the ego drives at {target:g} m/s"] += 1
        return limits, self._region(goal.find("position"), problem, lanes), target

    def _region(self, position: Element | None, problem: Element, lanes: ReadLanes) -> Pose | None:
        """The middle of a goal region; None: there is none."""
        if position is None or not len(position):
            return None
        if len(position) > 1:
            self.lost["more than one goal region: the first is the goal"] += 1
        region = position[0]
        if region.tag == "lanelet":
            ref = self.texts.whole(region.get("ref"), problem, "goalState: lanelet")
            if ref not in lanes.lane_of:
                raise self.texts.fail(problem, f"its goal is lanelet {ref}, which is not there")
            lane = lanes.lane_of[ref]
            x, y, yaw, _ = lanes.graph.at(lane, max(float(lanes.graph.length[lane]) - 1.0, 0.0))
            return Pose(x, y, yaw)
        if region.tag == "polygon":
            corners = self.texts.points(region, problem, "goalState: polygon")
            if len(corners) < 3:
                raise self.texts.fail(problem, "its goal is a polygon of fewer than 3 points")
            return Pose(*corners[:, :2].mean(0).tolist())
        if region.tag not in ("circle", "rectangle"):
            raise self.texts.fail(problem, f"its goal is a {region.tag[:40]}, which is not read")
        x, y = (
            self.texts.number(region.findtext(f"center/{axis}"), problem, f"goalState: center: {axis}") for axis in "xy"
        )
        return Pose(x, y)

    def _route(self, graph: LaneGraph, start: Pose, goal: Pose | None) -> tuple[tuple[Pose, ...], Route]:
        """Key points of the ego's way, and the way."""
        if goal is None:
            self.lost[f"the ego has no place to reach: {WAY:g} m along its lane"] += 1
            return self._ahead(graph, start)
        try:
            line = route_along(graph, (start, (goal.x, goal.y)))
            route = start, Pose(goal.x, goal.y, float(wrap_angle(line.yaw[-1])))
            return route, route_along(graph, route)
        except RouteError as error:
            if _lane_under(graph, start) is None or "no way" not in str(error):
                raise RouteError(f"{self.texts.where}: the way of the ego: {error}") from None
        self.lost[f"no way along the lanes leads to the goal: {WAY:g} m along the ego's lane"] += 1
        return self._ahead(graph, start)

    def _ahead(self, graph: LaneGraph, start: Pose) -> tuple[tuple[Pose, ...], Route]:
        """The way along the lane under the ego, straight on where lanes part."""
        place = _lane_under(graph, start)
        if place is None:
            raise RouteError(f"{self.texts.where}: the ego does not stand on a road of '{graph.name}'")
        path = lane_path(graph, place, WAY)
        if len(path) < 3:
            raise RouteError(f"{self.texts.where}: the road ends before the ego")
        kept = np.unique(np.linspace(0, len(path) - 2, 9).astype(int))[1:]
        step = path[kept + 1] - path[kept]
        rows = np.column_stack([path[kept], np.arctan2(step[:, 1], step[:, 0])])
        route = (start, *(Pose(x, y, yaw) for x, y, yaw in rows.tolist()))
        return route, route_along(graph, route)


def _lane_under(graph: LaneGraph, pose: Pose) -> Place | None:
    """The driving lane under a pose that goes its way."""
    lanes, along, gap = nearest_all(graph, (pose.x, pose.y), (LaneType.DRIVING,))
    places = [Place(n, s) for n, s in zip(lanes.tolist(), along.tolist(), strict=True)]
    turn = [abs(float(wrap_angle(graph.at(place.lane, place.s)[2] - pose.yaw))) for place in places]
    good = [k for k in range(len(places)) if gap[k] <= 2.0 and turn[k] < math.pi / 3]
    return places[min(good, key=lambda k: max(float(gap[k]), 0.0))] if good else None


def _alike(town: LaneGraph, found: LaneGraph) -> bool:
    """Whether the lanes of a file are those of a town."""
    same = town.lanes == found.lanes and np.array_equal(town.kind, found.kind)
    ends: list[F64] = [graph.xy[graph.offset[:-1]].astype(np.float64) for graph in (town, found)] if same else []
    return same and bool(np.abs(ends[0] - ends[1]).max() < ALIKE)


def _ruled(graph: LaneGraph) -> Mapping[int, tuple[int, ...]]:
    """The lanes that each signal stops."""
    found: dict[int, tuple[int, ...]] = {}
    for signal, lane in zip(graph.stop_signal.tolist(), graph.stop_lane.tolist(), strict=True):
        found[signal] = (*found.get(signal, ()), lane)
    return {signal: tuple(sorted(lanes)) for signal, lanes in found.items()}
