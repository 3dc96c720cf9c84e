"""Map and route planner that hosted leaderboard agents find in place of CARLA's, over a town's lane graph.

Positions are CARLA's: y to the right, yaw clockwise, degrees. Source of the interface: CARLA's Python API
(carla.Map, carla.Waypoint) and its agents.navigation.global_route_planner.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ssad.core.errors import ConfigError
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.types import I32, LaneType, Pose, Route
from ssad.drivers.leaderboard.carla_types import RoadOption
from ssad.world.roads import LaneQuery, town_xodr
from ssad.world.roads.router import route_along

TURN: Final = math.radians(30.0)  # a path through a junction that turns less counts as straight


def transform_of(x: float, y: float, yaw: float, z: float = 0.0) -> Any:
    """Return carla.Transform of a pose in the world frame: m, rad."""
    carla = sys.modules["carla"]
    return carla.Transform(carla.Location(x=x, y=-y, z=z), carla.Rotation(yaw=-math.degrees(yaw)))


def road_options(route: Route, graph: LaneGraph) -> I32:
    """Return the `RoadOption` of each point of a route [N]: the turn at a junction, else following the lane."""
    in_junction = (route.lane >= 0) & (graph.junction[route.lane] >= 0)
    options = np.full(len(route.xy), int(RoadOption.LANEFOLLOW), np.int32)
    entries = np.flatnonzero(in_junction & ~np.concatenate([[False], in_junction[:-1]]))
    for entry in entries.tolist():
        exits = np.flatnonzero(~in_junction[entry:])
        exit_index = entry + int(exits[0]) if len(exits) else len(in_junction) - 1
        turn = float(wrap_angle(float(route.yaw[exit_index] - route.yaw[entry])))
        command = RoadOption.LEFT if turn > TURN else RoadOption.RIGHT if turn < -TURN else RoadOption.STRAIGHT
        options[entry : exit_index + 1] = int(command)
    return options


class TownMap:
    """Map of a town, as carla.Map: waypoints on driving lanes, and the OpenDRIVE file."""

    def __init__(self, graph: LaneGraph) -> None:
        self.graph, self.name = graph, graph.name
        self._query = LaneQuery(graph)

    def get_waypoint(self, location: Any, project_to_road: bool = True, lane_type: Any = None) -> Waypoint | None:
        """Return the waypoint on the nearest driving lane.

        Args:
            location: carla.Location.
            project_to_road: Whether a location beside the lanes is moved to the nearest.
            lane_type: Ignored: there are driving lanes alone.

        Returns:
            None where there is no lane near, or, without `project_to_road`, none under it.
        """
        nearest = self._query.nearest([[location.x, -location.y]], (LaneType.DRIVING,))
        if nearest.lane[0] < 0 or not (project_to_road or nearest.is_inside[0]):
            return None
        return Waypoint(self, int(nearest.lane[0]), float(nearest.s[0]))

    def generate_waypoints(self, distance: float) -> list[Waypoint]:
        """Return waypoints on all driving lanes, `distance` metres apart."""
        return [
            Waypoint(self, lane, float(s))
            for lane in np.flatnonzero(self.graph.kind == LaneType.DRIVING).tolist()
            for s in np.arange(0.0, float(self.graph.length[lane]), distance)
        ]

    def to_opendrive(self) -> str:
        """Return the town's OpenDRIVE file."""
        return town_xodr(self.name)


@dataclass(frozen=True)
class Waypoint:
    """Place on a lane, as carla.Waypoint.

    Attributes:
        town_map: Its map.
        lane: Number of the lane in the lane graph.
        s: Arc length along the lane in the direction of traffic, m.
    """

    town_map: TownMap
    lane: int
    s: float

    @property
    def transform(self) -> Any:
        """carla.Transform of the place, along the lane."""
        graph = self.town_map.graph
        points = graph.points(self.lane)
        x, y, yaw, _ = graph.at(self.lane, self.s)
        return transform_of(x, y, yaw, float(np.interp(self.s, graph.s[points], graph.z[points])))

    @property
    def road_id(self) -> int:
        """OpenDRIVE id of the road."""
        return int(self.town_map.graph.road[self.lane])

    @property
    def section_id(self) -> int:
        """Number of the OpenDRIVE lane section."""
        return int(self.town_map.graph.section[self.lane])

    @property
    def lane_id(self) -> int:
        """OpenDRIVE id of the lane."""
        return int(self.town_map.graph.lane_id[self.lane])

    @property
    def lane_width(self) -> float:
        """Width of the lane, m."""
        return float(self.town_map.graph.at(self.lane, self.s)[3])

    @property
    def is_junction(self) -> bool:
        """True if the lane crosses a junction."""
        return self.junction_id >= 0

    @property
    def junction_id(self) -> int:
        """Junction that the lane crosses; -1: none."""
        return int(self.town_map.graph.junction[self.lane])

    def next(self, distance: float) -> list[Waypoint]:
        """Return the waypoints `distance` metres further on, one for each branch."""
        return self._follow(distance, forward=True)

    def previous(self, distance: float) -> list[Waypoint]:
        """Return the waypoints `distance` metres back, one for each branch."""
        return self._follow(distance, forward=False)

    def get_left_lane(self) -> Waypoint | None:
        """Return the waypoint beside it on the left, on a lane of any direction; None: there is no driving lane."""
        return self._beside(int(self.town_map.graph.left[self.lane]))

    def get_right_lane(self) -> Waypoint | None:
        """Return the waypoint beside it on the right; None: there is no driving lane."""
        return self._beside(int(self.town_map.graph.right[self.lane]))

    def _follow(self, distance: float, *, forward: bool) -> list[Waypoint]:
        graph, branches, ends = self.town_map.graph, [(self.lane, self.s, distance)], []
        visited = set()
        while branches:
            lane, s, rest = branches.pop()
            available = float(graph.length[lane]) - s if forward else s
            if rest <= available:
                ends.append(Waypoint(self.town_map, lane, s + rest if forward else s - rest))
                continue
            for neighbour in (graph.successors(lane) if forward else graph.predecessors(lane)).tolist():
                # A loop of short lanes comes back to a lane with the same rest only if it has no length.
                branch = (neighbour, 0.0 if forward else float(graph.length[neighbour]), rest - available)
                if branch not in visited:
                    visited.add(branch)
                    branches.append(branch)
        return ends[::-1]

    def _beside(self, lane: int) -> Waypoint | None:
        graph = self.town_map.graph
        if lane < 0 or graph.kind[lane] != LaneType.DRIVING:
            return None
        share = self.s / max(float(graph.length[self.lane]), 1e-6)
        if not graph.is_same_direction(self.lane, lane):
            share = 1.0 - share
        return Waypoint(self.town_map, lane, share * float(graph.length[lane]))


class GlobalRoutePlanner:
    """Planner of routes along the lanes of a `TownMap`, as in agents.navigation.global_route_planner.

    Args:
        wmap: The map; up to CARLA 0.9.11 an object with the map and the resolution.
        sampling_resolution: Distance between two points of a route, m.
    """

    def __init__(self, wmap: Any, sampling_resolution: float | None = None) -> None:
        if isinstance(wmap, GlobalRoutePlannerDAO):
            wmap, sampling_resolution = wmap.wmap, sampling_resolution or wmap.sampling_resolution
        if not isinstance(wmap, TownMap):
            raise ConfigError("GlobalRoutePlanner needs the map of CarlaDataProvider.get_map()")
        self._map, self._resolution = wmap, float(sampling_resolution or 2.0)

    def setup(self) -> None:
        """Do nothing: nothing has to be built."""

    def trace_route(self, origin: Any, destination: Any) -> list[tuple[Waypoint, Any]]:
        """Return waypoints and the `RoadOption` at each, from one carla.Location to another.

        Raises:
            RouteError: No path leads from one to the other.
        """
        graph = self._map.graph
        # A transform selects among lanes by its direction, a location by distance alone.
        ends = [_keypoint(point) for point in (origin, destination)]
        route = route_along(graph, ends, spacing=self._resolution)
        options = road_options(route, graph).tolist()
        query = LaneQuery(graph).nearest(route.xy, (LaneType.DRIVING,))
        waypoints = []
        for index, (lane, option) in enumerate(zip(route.lane.tolist(), options, strict=True)):
            number = lane if lane >= 0 else int(query.lane[index])
            s = float(query.s[index]) if number == query.lane[index] else _arc_length(graph, number, route.xy[index])
            waypoints.append((Waypoint(self._map, number, s), sys.modules[OPTIONS].RoadOption(option)))
        return waypoints


OPTIONS: Final = "agents.navigation.local_planner"


class GlobalRoutePlannerDAO:
    """Map and resolution for a `GlobalRoutePlanner`, as CARLA up to 0.9.11 passes them."""

    def __init__(self, wmap: Any, sampling_resolution: float) -> None:
        self.wmap, self.sampling_resolution = wmap, sampling_resolution


def _keypoint(point: Any) -> Pose | tuple[float, float]:
    if hasattr(point, "location"):
        return Pose(point.location.x, -point.location.y, -math.radians(point.rotation.yaw))
    return point.x, -point.y


def _arc_length(graph: LaneGraph, lane: int, point: Sequence[float]) -> float:
    """Return the arc length of the point of a lane that is nearest to (x, y)."""
    points = graph.points(lane)
    distances = np.hypot(*(graph.xy[points] - np.asarray(point)).T)
    return float(graph.s[points][int(distances.argmin())])
