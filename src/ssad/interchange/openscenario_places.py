"""Positions of an OpenSCENARIO document as poses in the world, and its routes and trajectories as paths."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from ssad.core.errors import RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.types import LaneType, Pose
from ssad.interchange.openscenario_document import AttributeReader
from ssad.interchange.openscenario_maps import RoadCoordinates
from ssad.interchange.openscenario_trajectories import SampledTrajectory, sample_trajectory
from ssad.scenarios.dynamic.knowledge._placing import LanePosition, move_pose, place_ahead, place_behind, pose_at
from ssad.world.roads import route_along
from ssad.world.roads.query import nearest_all
from ssad.world.roads.xodr import MapRoad

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

LONGEST = 1.0e4  # m along lanes between two entities
NEAR = 2.0  # m outside a lane within which an entity still belongs to it
EDGE = 1.0  # m beyond the end of a road that a position may be
OUTSIDE = 200.0  # m beyond all lanes at which a position is outside the map


class PositionReader:
    """Positions as poses in the world frame; inexact conversions are counted in `doubts`."""

    def __init__(
        self,
        values: AttributeReader,
        graph: LaneGraph,
        *,
        town: str,
        shift: tuple[float, float],
        mirrored: bool,
        doubts: Counter[str],
        starts: Mapping[str, Element],
    ) -> None:
        """Create the reader of one document.

        Args:
            values: Reads the attributes of elements.
            graph: Lane graph of the town.
            town: Its name.
            shift: What is subtracted from world coordinates to get those of the town, m.
            mirrored: World positions are in CARLA's left-handed frame.
            doubts: Counter of what changes a motion and is not carried over.
            starts: Name of an entity -> its position at the start.
        """
        self.values, self.graph, self.doubts, self.starts = values, graph, doubts, starts
        self.roads = RoadCoordinates(town, graph)
        self._shift = shift
        self._hand = -1.0 if mirrored else 1.0
        self._open: set[str] = set()
        self._paths: dict[int, SampledTrajectory] = {}
        self.moved: dict[str, Pose] = {}
        self._kinds: dict[str, Callable[[Element], Pose]] = {
            "WorldPosition": self._world,
            "LanePosition": self._lane,
            "RoadPosition": self._road,
            "RoutePosition": self._route,
            "TrajectoryPosition": self._trajectory,
            "RelativeWorldPosition": self._relative,
            "RelativeObjectPosition": self._relative,
            "RelativeLanePosition": self._along,
            "RelativeRoadPosition": self._along_road,
        }

    def pose(self, position: Element | None, *, within: Element) -> Pose:
        """Return the pose of a Position. FormatError if it is missing, broken, unsupported or outside the map."""
        if position is None or not len(position):
            raise self.values.error(within, "Position is missing or empty")
        kind = position[0].tag
        if kind not in self._kinds:
            raise self.values.error(position[0], f"a {kind} is not read; known: {', '.join(self._kinds)}")
        return self._kinds[kind](position[0])

    def is_supported(self, position: Element | None) -> bool:
        """Return whether a position is of a supported kind; true if it is missing, which `pose` reports."""
        return position is None or not len(position) or position[0].tag in self._kinds

    def start(self, entity: str, *, within: Element) -> Pose:
        """Return the start pose of an entity. FormatError if it has none, or positions refer to each other."""
        if entity in self.moved:
            return self.moved[entity]
        if entity not in self.starts:
            raise self.values.error(within, f"entity '{entity}' has no position at the start")
        if entity in self._open:
            raise self.values.error(within, f"the position of '{entity}' depends on itself")
        self._open.add(entity)
        try:
            return self.pose(self.starts[entity], within=within)
        finally:
            self._open.discard(entity)

    def check_inside(self, entity: str, pose: Pose, *, within: Element) -> None:
        """Raise a FormatError if the start of an entity is outside the map."""
        (x_low, y_low), (x_high, y_high) = self.graph.xy.min(0).tolist(), self.graph.xy.max(0).tolist()
        is_inside = x_low - OUTSIDE <= pose.x <= x_high + OUTSIDE and y_low - OUTSIDE <= pose.y <= y_high + OUTSIDE
        if not is_inside:
            raise self.values.error(
                within,
                f"'{entity}' starts at ({pose.x:.6g}, {pose.y:.6g}), outside the map '{self.graph.name}', which has x "
                f"{x_low:.0f} to {x_high:.0f} and y {y_low:.0f} to {y_high:.0f} m",
            )

    def lane_under(self, pose: Pose, *, aligned: bool = True) -> LanePosition | None:
        """Return the driving lane under a pose; with `aligned`, only one with its direction."""
        lanes, positions, distances = nearest_all(self.graph, (pose.x, pose.y), (LaneType.DRIVING,))
        best: tuple[float, LanePosition] | None = None
        for candidate, lane_position, distance in zip(
            lanes.tolist(), positions.tolist(), distances.tolist(), strict=True
        ):
            heading_difference = abs(float(wrap_angle(self.graph.at(candidate, lane_position)[2] - pose.yaw)))
            if (
                distance <= NEAR
                and (not aligned or heading_difference < math.pi / 3)
                and (best is None or max(distance, 0) < best[0])
            ):
                best = max(distance, 0.0), LanePosition(candidate, lane_position)
        return best[1] if best else None

    def trajectory(self, element: Element, entity: str = "") -> SampledTrajectory:
        """Return a Trajectory, sampled; it may begin where an entity starts.

        Raises:
            FormatError: It has no shape that is read, or a position is missing.
        """

        def pose(position: Element | None, within: Element) -> Pose:
            if position is None and entity:
                return self.start(entity, within=within)
            return self.pose(position, within=within)

        if id(element) not in self._paths:
            self._paths[id(element)] = sample_trajectory(element, self.values, pose)
        return self._paths[id(element)]

    def route(self, element: Element) -> SampledTrajectory:
        """Return the way along a Route: on the town's lanes, or straight between waypoints where these do not allow it.

        Raises:
            FormatError: It has fewer than two waypoints.
        """
        if id(element) not in self._paths:
            poses = self.waypoints(element)
            if len(poses) < 2:
                raise self.values.error(element, "a route needs at least two waypoints")
            try:
                route_line = route_along(self.graph, poses)
                xy, heading_angle = route_line.xy.astype(np.float64), route_line.yaw.astype(np.float64)
            except RouteError:
                xy = np.array([(pose.x, pose.y) for pose in poses], np.float64)
                steps = np.diff(xy, axis=0)
                heading_angle = np.arctan2(steps[:, 1], steps[:, 0])
                heading_angle = np.append(heading_angle, heading_angle[-1])
            s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))])
            self._paths[id(element)] = SampledTrajectory(xy, heading_angle, s, None)
        return self._paths[id(element)]

    def waypoints(self, route: Element) -> tuple[Pose, ...]:
        """Return the waypoints of a Route; world positions without a heading face the next one."""
        elements = route.findall("Waypoint")
        poses = [self.pose(element.find("Position"), within=element) for element in elements]
        for index, element in enumerate(elements):
            world = element.find("Position/WorldPosition")
            if world is None or world.get("h") is not None or len(poses) < 2:
                continue
            start, end = poses[index : index + 2] if index + 1 < len(poses) else poses[index - 1 : index + 1]
            heading_angle = math.atan2(end.y - start.y, end.x - start.x)
            poses[index] = Pose(poses[index].x, poses[index].y, heading_angle)
        return tuple(poses)

    def _world(self, element: Element) -> Pose:
        x, y, heading_angle = (
            self.values.number(element, name, 0.0 if name == "h" else None) for name in ("x", "y", "h")
        )
        # Adding 0.0 turns a negative zero into zero.
        return Pose(x - self._shift[0] + 0.0, self._hand * y - self._shift[1] + 0.0, self._hand * heading_angle + 0.0)

    def _apply_orientation(self, element: Element, pose: Pose) -> Pose:
        """Return the pose with an Orientation of the element, relative unless it says absolute."""
        orientation = element.find("Orientation")
        if orientation is None:
            return pose
        heading = self._hand * self.values.number(orientation, "h", 0.0)
        absolute = self.values.text(orientation, "type", "absolute") == "absolute"
        return Pose(pose.x, pose.y, heading if absolute else float(wrap_angle(pose.yaw + heading)))

    # ------------------------------------------------------------ road coordinates

    def _find_road(self, element: Element) -> MapRoad | None:
        """Return the road that an element names; None if the town has no OpenDRIVE."""
        if self.roads.network is None:
            return None
        name = self.values.text(element, "roadId")
        map_road = self.roads.road(name)
        if map_road is None:
            raise self.values.error(element, f"town '{self.graph.name}' has no road {name[:40]}")
        return map_road

    def _position_along(self, element: Element, map_road: MapRoad, s: float) -> float:
        """Return a position on a road, within it. FormatError if it is beyond its end."""
        if not -EDGE <= s <= map_road.length + EDGE:
            name = self.values.text(element, "roadId", str(map_road.id))
            raise self.values.error(element, f"s is {s:g} m; road {name} has {map_road.length:.1f} m")
        return min(max(s, 0.0), map_road.length)

    def _lane(self, element: Element) -> Pose:
        lane_id = int(self.values.number(element, "laneId"))
        offset = self.values.number(element, "offset", 0.0)
        map_road = self._find_road(element)
        if map_road is None:
            return self._lane_without_map(element, lane_id, offset)
        s = self._position_along(element, map_road, self.values.number(element, "s"))
        spot = self.roads.lane(map_road, lane_id, s)
        if spot is None:
            lane_names = ", ".join(map(str, self.roads.lane_ids(map_road, s)))
            name = self.values.text(element, "roadId")
            raise self.values.error(element, f"road {name} has no lane {lane_id} at s {s:g}; it has {lane_names}")
        x, y, heading = self.roads.at(map_road, s, spot.t + offset)
        heading_angle = heading if spot.forward else float(wrap_angle(heading + math.pi))
        return self._apply_orientation(element, Pose(x, y, heading_angle))

    def _lane_without_map(self, element: Element, lane: int, offset: float) -> Pose:
        """Return the pose on a lane of a town without OpenDRIVE, with s along the lane itself."""
        graph, s = self.graph, self.values.number(element, "s")
        map_road = int(self.values.number(element, "roadId"))
        sections = np.flatnonzero((graph.road == map_road) & (graph.lane_id == lane))
        if not len(sections):
            raise self.values.error(element, f"town '{graph.name}' has no lane {lane} of road {map_road}")
        sections = sections[np.argsort(graph.section[sections])]
        length = float(graph.length[sections].sum())
        if not -EDGE <= s <= length + EDGE:
            raise self.values.error(element, f"s is {s:g} m; lane {lane} of road {map_road} has {length:.1f} m")
        self.doubts["positions by road and s are taken along the lane, not along the road's reference line"] += 1
        for section in sections.tolist():
            length = float(graph.length[section])
            if s <= length or section == sections[-1]:
                # Traffic of other lanes runs against s.
                forward = bool(graph.forward[section])
                lane_place = LanePosition(section, min(max(s if forward else length - s, 0.0), length))
                pose = move_pose(pose_at(graph, lane_place), 0.0, offset if forward else -offset)
                return self._apply_orientation(element, pose)
            s -= length
        raise AssertionError

    def _road(self, element: Element) -> Pose:
        lateral_position = self.values.number(element, "t")
        map_road = self._find_road(element)
        if map_road is None:
            raise self.values.error(element, f"town '{self.graph.name}' has no OpenDRIVE, and so no road coordinates")
        s = self._position_along(element, map_road, self.values.number(element, "s"))
        return self._on_road(element, map_road, s, lateral_position)

    def _on_road(self, element: Element, map_road: MapRoad, s: float, lateral_position: float) -> Pose:
        """Return the pose at s and t: along the traffic there, or as an Orientation states."""
        x, y, heading = self.roads.at(map_road, s, lateral_position)
        if element.find("Orientation") is None and not self.roads.forward_at(map_road, s, lateral_position):
            heading = float(wrap_angle(heading + math.pi))
        return self._apply_orientation(element, Pose(x, y, heading))

    # ------------------------------------------------------------ relative positions

    def _relative(self, element: Element) -> Pose:
        reference_pose = self.start(self.values.text(element, "entityRef"), within=element)
        forward = self.values.number(element, "dx", 0.0)
        leftward = self._hand * self.values.number(element, "dy", 0.0)
        if element.tag == "RelativeWorldPosition":
            return self._apply_orientation(
                element, Pose(reference_pose.x + forward, reference_pose.y + leftward, reference_pose.yaw)
            )
        return self._apply_orientation(element, move_pose(reference_pose, forward, leftward))

    def _along_road(self, element: Element) -> Pose:
        """Return the pose ds along and dt across the road of an entity."""
        reference = self.start(self.values.text(element, "entityRef"), within=element)
        lane_place = self.lane_under(reference, aligned=False)
        if lane_place is None:
            raise self.values.error(element, "no lane under the entity that it refers to")
        ds, dt = self.values.number(element, "ds"), self.values.number(element, "dt")
        if abs(ds) > LONGEST:
            raise self.values.error(element, f"ds is {ds:g} m, beyond {LONGEST:g} m")
        side = 1.0 if self.graph.forward[lane_place.lane] else -1.0
        centre = pose_at(self.graph, lane_place)
        aside = -math.sin(centre.yaw) * (reference.x - centre.x) + math.cos(centre.yaw) * (reference.y - centre.y)
        ahead = ds * side
        moved = (
            place_ahead(self.graph, lane_place, ahead) if ahead >= 0.0 else place_behind(self.graph, lane_place, -ahead)
        )
        pose = move_pose(pose_at(self.graph, moved), 0.0, aside + dt * side)
        if element.find("Orientation") is None and abs(wrap_angle(pose.yaw - reference.yaw)) > math.pi / 2:
            pose = Pose(pose.x, pose.y, float(wrap_angle(pose.yaw + math.pi)))
        return self._apply_orientation(element, pose)

    def _along(self, element: Element) -> Pose:
        reference_pose = self.start(self.values.text(element, "entityRef"), within=element)
        lane_place = self.lane_under(reference_pose) or self.lane_under(reference_pose, aligned=False)
        if lane_place is None:
            raise self.values.error(element, "no lane under the entity that it refers to")
        lateral_offset = self.values.number(element, "offset", 0.0)
        distance = self.values.number(element, "ds", self.values.number(element, "dsLane", 0.0))
        lane_count = self.values.lanes(element, "dLane")
        if abs(distance) > LONGEST:
            raise self.values.error(element, f"ds is {distance:g} m, beyond {LONGEST:g} m")
        lane_place = (
            place_ahead(self.graph, lane_place, distance)
            if distance >= 0.0
            else place_behind(self.graph, lane_place, -distance)
        )
        pose = pose_at(self.graph, lane_place)
        to_left = lane_count > 0
        for _ in range(abs(lane_count)):
            lane = int((self.graph.left if to_left else self.graph.right)[lane_place.lane])
            if lane < 0:
                raise self.values.error(element, f"there is no lane {lane_count} beside the entity that it refers to")
            nearest = nearest_all(self.graph, (pose.x, pose.y), (LaneType(int(self.graph.kind[lane])),))
            match = int(np.flatnonzero(nearest[0] == lane)[0])
            to_left ^= not self.graph.is_same_direction(
                lane_place.lane, lane
            )  # what is further left is on the right of those
            lane_place = LanePosition(lane, float(nearest[1][match]))
            pose = pose_at(self.graph, lane_place)
        return self._apply_orientation(element, move_pose(pose, 0.0, lateral_offset))

    # ------------------------------------------------------------ on routes and trajectories

    def _route(self, element: Element) -> Pose:
        route = element.find("RouteRef/Route")
        lane_place = element.find("InRoutePosition")
        content = None if lane_place is None else next(iter(lane_place), None)
        if route is None or content is None:
            raise self.values.error(element, "RouteRef or InRoutePosition is missing, or its catalogue is not there")
        route_line = self.route(route)
        if content.tag in ("FromCurrentEntity", "PositionOfCurrentEntity"):
            current = self.start(self.values.text(content, "entityRef"), within=content)
            nearest = int(np.argmin(np.hypot(route_line.xy[:, 0] - current.x, route_line.xy[:, 1] - current.y)))
            return self._apply_orientation(element, route_line.at(float(route_line.s[nearest])))
        s = self.values.number(content, "pathS")
        if not -EDGE <= s <= float(route_line.s[-1]) + EDGE:
            raise self.values.error(content, f"pathS is {s:g} m; the route has {route_line.s[-1]:.1f} m")
        pose = route_line.at(s)
        lane_place_below = self.lane_under(pose)
        if content.tag in ("FromRoadCoordinates", "PositionInRoadCoordinates"):
            lateral_position = self.values.number(content, "t")
            if lane_place_below is not None:
                return self._apply_orientation(
                    element, self._beside_reference(pose, lane_place_below, lateral_position)
                )
            return self._apply_orientation(element, move_pose(pose, 0.0, lateral_position))
        lane_id = int(self.values.number(content, "laneId"))
        offset = self.values.number(content, "laneOffset", 0.0)
        if lane_place_below is None:
            return self._apply_orientation(element, move_pose(pose, 0.0, offset))
        target = self.neighbour(lane_place_below.lane, lane_id)
        if target is None:
            raise self.values.error(content, f"the road under the route has no lane {lane_id} at pathS {s:g}")
        nearest_lanes = nearest_all(self.graph, (pose.x, pose.y), (LaneType(int(self.graph.kind[target])),))
        match = int(np.flatnonzero(nearest_lanes[0] == target)[0])
        on_lane = pose_at(self.graph, LanePosition(target, float(nearest_lanes[1][match])))
        side = 1.0 if self.graph.forward[target] else -1.0
        moved = move_pose(on_lane, 0.0, offset * side)
        return self._apply_orientation(element, Pose(moved.x, moved.y, pose.yaw))

    def _beside_reference(self, pose: Pose, lane_place: LanePosition, lateral_position: float) -> Pose:
        """Return the pose of a route, moved to t of the road under it."""
        road_number, lane_id = int(self.graph.road[lane_place.lane]), int(self.graph.lane_id[lane_place.lane])
        map_road = None if self.roads.network is None else self.roads.network.roads.get(road_number)
        if map_road is None:
            return move_pose(pose, 0.0, lateral_position)
        section = map_road.sections[min(int(self.graph.section[lane_place.lane]), len(map_road.sections) - 1)]
        forward = bool(self.graph.forward[lane_place.lane])
        s = section.s0 + lane_place.s if forward else section.s1 - lane_place.s
        spot = self.roads.lane(map_road, lane_id, min(max(s, section.s0), section.s1))
        if spot is None:
            return move_pose(pose, 0.0, lateral_position)
        return move_pose(pose, 0.0, (lateral_position - spot.t) * (1.0 if forward else -1.0))

    def neighbour(self, lane: int, lane_id: int) -> int | None:
        """Return the lane with an id in the same section of the road; None if there is none."""
        graph = self.graph
        same = np.flatnonzero(
            (graph.road == graph.road[lane]) & (graph.section == graph.section[lane]) & (graph.lane_id == lane_id)
        )
        return int(same[0]) if len(same) else None

    def _trajectory(self, element: Element) -> Pose:
        trajectory = element.find("TrajectoryRef/Trajectory")
        if trajectory is None:
            raise self.values.error(element, "TrajectoryRef is missing, or its catalogue is not there")
        route_line = self.trajectory(trajectory)
        s, lateral_position = self.values.number(element, "s"), self.values.number(element, "t", 0.0)
        if not -EDGE <= s <= float(route_line.s[-1]) + EDGE:
            raise self.values.error(element, f"s is {s:g} m; the trajectory has {route_line.s[-1]:.1f} m")
        return self._apply_orientation(element, route_line.at(s, lateral_position))
