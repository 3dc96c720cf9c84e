"""Places of a leaderboard scenario on the ego's route, and the actors at these places."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final

import numpy as np

from ssad.core.errors import RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, Actor, EpisodeLimits, LaneType, Phase, PhaseTrigger, Pose, Route, Scenario, SignalPlan
from ssad.scenarios.dynamic.knowledge._meeting import time_to_cover
from ssad.scenarios.dynamic.knowledge._placing import (
    LanePosition,
    adjacent_place,
    junction_span,
    lane_path,
    move_pose,
    place_ahead,
    place_behind,
    pose_at,
    route_place,
    turn_of,
    width_at,
)
from ssad.world.models import MODELS
from ssad.world.roads import route_along
from ssad.world.roads.query import nearest_all

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

    from ssad.interchange.openscenario_document import AttributeReader

SPEED: Final = 8.0  # m/s, assumed speed of the ego where the leaderboard measures seconds to a place
PICK_UP: Final = 2.5  # m/s^2, assumed acceleration of the ego at the start
LIMITS: Final = EpisodeLimits(max_steps=900, max_time=90.0)
FLOW: Final = 45.0  # s during which a flow adds cars
LONGEST: Final = 600.0  # m, largest length of a flow's path
CARS: Final = ("compact", "coupe", "suv", "car")
_ROAD = (LaneType.DRIVING, LaneType.PARKING, LaneType.BIKING, LaneType.SHOULDER)
_NEAR = 10.0  # m between a place of the file and its lane
_THIN = math.radians(0.5)  # rad of turning, and
_LONG = 20.0  # m of driving, after which a trajectory gets another row


@dataclass
class ScenarioBuilder:
    """A scenario of a route file in its town, while its actors are being added.

    Attributes:
        scenario: Name, town, route and trigger.
        graph: Lane graph of the town.
        route: The ego's route.
        start: Route point at which the leaderboard starts the scenario.
        item: The element of the file.
        values: Reads the attributes of elements.
        random: Draws what the leaderboard draws.
        used_names: Tags of the parameters that were read.
        actors: Actors added so far.
        signals: States of the traffic lights.
        target_speed: Target speed of the ego, m/s.
    """

    scenario: Scenario
    graph: LaneGraph
    route: Route
    start: int
    item: Element
    values: AttributeReader
    random: np.random.Generator
    used_names: set[str] = field(default_factory=set)
    actors: list[Actor] = field(default_factory=list)
    signals: SignalPlan = field(default_factory=SignalPlan)
    target_speed: float = SPEED

    # ------------------------------------------------------------ the numbers of the file

    def number(self, tag: str, default: float, low: float, high: float) -> float:
        """Return the number `value` of a child. FormatError if it is none, or outside its range."""
        return self._bounded(tag, "value", default, low, high)

    def interval(self, tag: str, default: tuple[float, float], low: float, high: float) -> tuple[float, float]:
        """Return the numbers `from` and `to` of a child, or twice its `value`; FormatError as in `number`."""
        element = self.item.find(tag)
        if element is not None and element.get("from") is None:
            value = self.number(tag, default[0], low, high)
            return value, value
        start, end = (
            self._bounded(tag, key, fallback, low, high) for key, fallback in zip(("from", "to"), default, strict=True)
        )
        return min(start, end), max(start, end)

    def _bounded(self, tag: str, key: str, default: float, low: float, high: float) -> float:
        element = self.item.find(tag)
        self.used_names.add(tag)
        if element is None:
            return default
        value = self.values.number(element, key)
        if not low <= value <= high:
            raise self.values.error(element, f"{key} is {value:g}, outside {low:g} to {high:g}")
        return value

    def word(self, tag: str, default: str, allowed: Sequence[str] = ()) -> str:
        """Return the text `value` of a child. FormatError if it is not allowed."""
        element = self.item.find(tag)
        self.used_names.add(tag)
        value = default if element is None else self.values.text(element, "value")
        if allowed and value not in allowed:
            raise self.values.error(tag, f"'{value[:40]}' is not one of {', '.join(allowed)}")
        return value

    def side(self) -> float:
        """Return 1 if the scenario comes from the right of the road, -1 if from the left."""
        return 1.0 if self.word("direction", "right", ("left", "right")) == "right" else -1.0

    def lane_at(self, tag: str) -> LanePosition:
        """The lane under a place of the file. FormatError where it is missing, RouteError off the road."""
        element = self.item.find(tag)
        self.used_names.add(tag)
        if element is None:
            raise self.values.error(self.item, f"'{self.item.get('type')}' has no {tag}")
        # The file has CARLA's left-handed frame. 0.0 - y instead of -y avoids a negative zero.
        position = self.values.number(element, "x"), 0.0 - self.values.number(element, "y")
        lane, s, gap = nearest_all(self.graph, position, (LaneType.DRIVING, LaneType.BIKING))
        nearest = int(np.argmin(gap))
        if gap[nearest] > _NEAR:
            raise self.error(f"{tag} is {gap[nearest]:.0f} m off the road")
        return LanePosition(int(lane[nearest]), float(s[nearest]))

    def error(self, message: str) -> RouteError:
        """Return a RouteError that names the scenario."""
        return RouteError(f"scenario {self.scenario.name}: {message}")

    # ------------------------------------------------------------ places

    def point(self, distance: float, *, in_junction: bool = False) -> int:
        """The route point `distance` m after the trigger, before the next junction unless it may lie in one."""
        index = self.start + round(distance / self.route.spacing)
        if not in_junction:
            lanes = self.route.lane[self.start : index + 1]
            inside = np.flatnonzero((lanes >= 0) & (self.graph.junction[lanes] >= 0))
            if len(inside) and inside[0] > 0:
                index = self.start + int(inside[0]) - 1
        if index >= len(self.route.xy):
            raise self.error(f"the route ends {index - len(self.route.xy) + 1:.0f} m before its place")
        return index

    def pose(self, index: int, right: float = 0.0, turn: float = 0.0) -> Pose:
        """Return the pose of a route point, moved to the right, m, and turned to the left, rad."""
        x, y = self.route.xy[index].tolist()
        return move_pose(Pose(x, y, float(self.route.yaw[index])), 0.0, -right, turn)

    def place(self, index: int) -> LanePosition:
        """Return the lane under a route point."""
        return route_place(self.graph, self.scenario, self.route, index)

    def width(self, index: int) -> float:
        """Return the width of the lane at a route point, m."""
        return width_at(self.graph, self.place(index))

    def edge_distance(self, index: int, side: float, kinds: Sequence[LaneType] = _ROAD) -> float:
        """Return the distance to the outer edge of the last lane of these kinds, m, oncoming lanes included."""
        ego_lane, pose = self.place(index), self.pose(index)
        outermost, neighbour_side = ego_lane, "right" if side > 0.0 else "left"
        while (neighbour := adjacent_place(self.graph, outermost, neighbour_side)) is not None and self.graph.kind[
            neighbour.lane
        ] in kinds:
            # Seen from an oncoming lane, the next lane further out is to its right.
            if not self.graph.is_same_direction(outermost.lane, neighbour.lane):
                neighbour_side = "right"
            outermost = neighbour
        outermost_pose = pose_at(self.graph, outermost)
        return math.dist((pose.x, pose.y), (outermost_pose.x, outermost_pose.y)) + 0.5 * width_at(self.graph, outermost)

    def oncoming_lane(self, index: int) -> LanePosition:
        """Return the lane to the left with oncoming traffic. RouteError if there is none."""
        neighbour = adjacent_place(self.graph, self.place(index), "left")
        if (
            neighbour is None
            or self.graph.kind[neighbour.lane] != LaneType.DRIVING
            or self.graph.is_same_direction(self.place(index).lane, neighbour.lane)
        ):
            raise self.error(f"{self.item.get('type')} needs an oncoming lane to the left of the ego's")
        return neighbour

    def junction(self) -> tuple[int, int]:
        """Return the route points at which the first junction after the trigger begins and ends."""
        return junction_span(self.graph, self.scenario, self.route)

    def approach(self, sides: Sequence[float]) -> tuple[LanePosition, int]:
        """Find the lane into the ego's junction from given sides, and the lane straight on from it.

        If several lanes qualify, the one whose path comes nearest to the ego's is taken.

        Args:
            sides: Headings relative to the ego's, rad, in order of preference.

        Returns:
            The end of the lane into the junction, and the lane inside it.

        Raises:
            RouteError: There is no such lane.
        """
        entry_point, exit_point = self.junction()
        junction = int(self.graph.junction[self.route.lane[entry_point]])
        heading = float(self.route.yaw[max(entry_point - 1, 0)])
        ego_path = self.route.xy[entry_point : exit_point + 15].astype(np.float64)
        best: tuple[int, float, LanePosition, int] | None = None
        for junction_lane in np.flatnonzero(
            (self.graph.junction == junction) & (self.graph.kind == LaneType.DRIVING)
        ).tolist():
            for entry_lane in self.graph.predecessors(junction_lane).tolist():
                if (
                    self.graph.junction[entry_lane] == junction
                    or entry_lane == self.place(max(entry_point - 1, 0)).lane
                ):
                    continue
                yaw = pose_at(self.graph, LanePosition(entry_lane, float(self.graph.length[entry_lane]))).yaw
                turns = [abs(float(wrap_angle(yaw - heading - side))) for side in sides]
                rank = next((side_index for side_index, turn in enumerate(turns) if turn < math.radians(45)), None)
                if rank is None or abs(turn_of(self.graph, junction_lane)) > math.radians(45):
                    continue
                crossing_path = lane_path(
                    self.graph, LanePosition(junction_lane, 0.0), float(self.graph.length[junction_lane]) + 15.0
                )
                gap = float(np.hypot(*(ego_path[:, None] - crossing_path[None]).transpose(2, 0, 1)).min())
                if best is None or (rank, gap) < best[:2]:
                    best = rank, gap, LanePosition(entry_lane, float(self.graph.length[entry_lane])), junction_lane
        if best is None:
            raise self.error(f"no lane comes into junction {junction} from where {self.item.get('type')} wants it")
        return best[2], best[3]

    def before_junction(self, place: LanePosition, distance: float) -> LanePosition:
        """Return the place `distance` m back along lanes, or the last one before a junction."""
        farthest = place
        for step_back in np.arange(2.0, distance + 0.1, 2.0).tolist():
            candidate = place_behind(self.graph, place, step_back)
            if self.graph.junction[candidate.lane] >= 0:
                break
            farthest = candidate
        return farthest

    # ------------------------------------------------------------ when

    def ego_reaches(self, index: int, actor: Pose) -> PhaseTrigger:
        """Return the condition that the ego reaches a route point.

        It is expressed as a distance from the next actor to be added, which waits at `actor`.
        """
        position = self.route.xy[min(max(index, 0), len(self.route.xy) - 1)].tolist()
        return PhaseTrigger("ego_distance", math.dist(position, (actor.x, actor.y)), len(self.actors))

    def ego_is_seconds_before(self, index: int, seconds: float, min_distance: float, actor: Pose) -> PhaseTrigger:
        """Return the condition that the ego is so many seconds or metres before a route point; see `ego_reaches`."""
        return self.ego_reaches(index - round(max(seconds * SPEED, min_distance) / self.route.spacing), actor)

    def arrival_time(self, index: int) -> float:
        """Seconds after which an ego that starts from rest and then keeps `SPEED` comes to a route point."""
        return time_to_cover(index * self.route.spacing, SPEED, PICK_UP)

    # ------------------------------------------------------------ who

    def add(self, name: str, model: str, pose: Pose, phases: Sequence[Phase] = (), path: F64 | None = None) -> None:
        """Add an actor that stands, or follows its phases along a path [N, 2]."""
        rounded_path = () if path is None else tuple((round(x, 3), round(y, 3)) for x, y in path.tolist())
        self.actors.append(Actor(name, model, pose, tuple(phases), rounded_path))

    def draw_car_model(self) -> str:
        """Draw a model of a car."""
        return str(self.random.choice(CARS))

    def add_driver(self, name: str, start: LanePosition, distance: float, speed: float) -> None:
        """Add a car that the Autopilot drives straight on for a distance; it reacts to the ego."""
        lane_points = lane_path(self.graph, start, distance)
        distances = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(lane_points, axis=0).T))])
        key_distances = np.linspace(0.0, distances[-1], max(2, math.ceil(distances[-1] / 40.0)))
        key_points = tuple(
            (
                float(np.interp(key_distance, distances, lane_points[:, 0])),
                float(np.interp(key_distance, distances, lane_points[:, 1])),
            )
            for key_distance in key_distances
        )
        pose = pose_at(self.graph, start)
        self.actors.append(
            Actor(name, self.draw_car_model(), pose, path=key_points, policy="autopilot", target_speed=speed)
        )

    def add_oncoming_cars(self, index: int, gap: tuple[float, float], *, after: float = 5.0) -> None:
        """Add oncoming cars.

        The first passes a route point `after` seconds after an ego that then waits there.

        Args:
            index: The route point.
            gap: Range of the distance between two cars, m.
            after: Time after the ego's arrival, s.
        """
        lane = self.oncoming_lane(index)
        speed = min(float(self.route.speed_limit[index]), 1.5 * SPEED)
        distance_back = speed * (self.arrival_time(index) + after) - 0.5 * speed**2 / MODELS["compact"].max_accel
        previous_start: LanePosition | None = None
        for _ in range(6):
            start = place_behind(self.graph, lane, distance_back)
            if previous_start is not None and self.distance_between(start, previous_start) < 8.0:
                return  # the road begins here, so no car can start further back
            if self.graph.junction[start.lane] < 0:
                self.add_driver(f"oncoming car {len(self.actors)}", start, distance_back + 80.0, speed)
                previous_start = start
            distance_back += float(self.random.uniform(*gap))

    def add_flow(self, path: F64, gap: tuple[float, float], speed: float, *, models: Sequence[str] = CARS) -> None:
        """Vehicles that come one after another along a way [N, 2] at a steady speed, whatever is in their way.

        They appear where it begins and leave where it ends; at the start they are all along it.
        """
        path_length = float(np.hypot(*np.diff(path, axis=0).T).sum())
        if path_length > LONGEST:
            raise self.error(f"the way of its flow has {path_length:.0f} m, more than {LONGEST:.0f} m")
        template = _timed_rows(path, speed)
        start_time = -float(template[-1, 0])
        while (start_time := start_time + float(self.random.uniform(*gap)) / speed) < FLOW:
            rows = template.copy()
            rows[:, 0] += start_time
            rows = rows.round(3)
            model = str(self.random.choice(models))
            actor_name = f"{'cyclist' if model == 'bicycle' else 'car'} {len(self.actors)}"
            pose = Pose(*rows[0, 1:].tolist())
            self.actors.append(Actor(actor_name, model, pose, trajectory=tuple(map(tuple, rows.tolist()))))

    def path_between(self, start: LanePosition, end: LanePosition) -> F64:
        """Return the path [N, 2] along lanes from one place to another. RouteError if there is none."""
        start_pose, end_pose = pose_at(self.graph, start), pose_at(self.graph, end)
        try:
            return route_along(self.graph, [start_pose, end_pose]).xy.astype(np.float64)
        except RouteError as error:
            raise self.error(str(error)) from None

    def offset_path(self, path: F64, right: float | F64) -> F64:
        """A way moved to the right, m: by one number or one for each point."""
        heading = np.gradient(path, axis=0)
        normal = np.stack([heading[:, 1], -heading[:, 0]], 1) / np.maximum(np.hypot(*heading.T), 1e-9)[:, None]
        moved: F64 = path + np.atleast_1d(right)[:, None] * normal
        return moved

    def parallel_path(self, index: int, distance: float, right: float, *, into: float = 0.0) -> F64:
        """Return a path beside the ego's route.

        Args:
            index: Route point at which it begins.
            distance: Length, m.
            right: Offset to the right, m.
            into: Length after which it has merged into the ego's lane, m; 0: never.

        Raises:
            RouteError: The route is too short.
        """
        path = self.route.xy[index : index + max(3, round(distance / self.route.spacing))].astype(np.float64)
        if len(path) < 3:
            raise self.error("the route ends too soon")
        offset_share = np.ones(len(path))
        if into > 0.0:
            progress = np.clip(self.route.spacing * np.arange(len(path)) / into, 0.0, 1.0)
            # A half cosine has no kink at either end, so a vehicle can follow it.
            offset_share = 0.5 * (1.0 + np.cos(np.pi * progress))
        return self.offset_path(path, right * offset_share)

    def place_ahead(self, start: LanePosition, distance: float) -> LanePosition:
        """Return the place `distance` m ahead along lanes, straight on."""
        return place_ahead(self.graph, start, distance)

    def distance_between(self, first: LanePosition, second: LanePosition) -> float:
        """Return the distance between two places, m."""
        first_pose, second_pose = pose_at(self.graph, first), pose_at(self.graph, second)
        return math.dist((first_pose.x, first_pose.y), (second_pose.x, second_pose.y))


def _timed_rows(path: F64, speed: float) -> F64:
    """Rows [M, 4] of time, x, y and yaw of a drive along a way at a speed; few where it is straight."""
    steps = np.diff(path, axis=0)
    path, steps = path[np.concatenate([[True], np.hypot(*steps.T) > 1e-6])], steps[np.hypot(*steps.T) > 1e-6]
    if len(steps) < 1:
        raise RouteError("a flow needs a way of some metres")
    distances = np.concatenate([[0.0], np.cumsum(np.hypot(*steps.T))])
    yaw = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    # Headings belong to segments: at a point, take the mean of both sides.
    yaw = np.concatenate([yaw[:1], 0.5 * (yaw[1:] + yaw[:-1]), yaw[-1:]])
    row_indices = [0]
    for index in range(1, len(distances)):
        previous = row_indices[-1]
        if (
            index == len(distances) - 1
            or abs(yaw[index] - yaw[previous]) > _THIN
            or distances[index] - distances[previous] > _LONG
        ):
            row_indices.append(index)
    return np.column_stack([distances / speed, path, yaw])[row_indices]
