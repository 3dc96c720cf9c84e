"""Placement of actors: lane arithmetic shared by the scenario classes. Units as in `ssad.core.types`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ssad.core.errors import RouteError
from ssad.core.rotations import wrap_scalar
from ssad.core.types import F64, Controller, EpisodeAgent, LaneType, Phase, PhaseTrigger, Pose, Route, Scenario
from ssad.scenarios.dynamic.knowledge._caching import cached_by_identity

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph

DEFAULT_TRIGGER = 30.0
"""Where on the route a scenario without a trigger has it, m from the start: as in SafeBench's routes."""
_SHOULDER = 2.0  # CARLA's maps draw parking strips as shoulders wider than this
_STRAIGHT = 0.3  # a path that strays less than this from a straight line is driven straight, as SafeBench does
MAX_LENGTH = 1e5  # m of a path: a slip of units beyond it would fill the memory
_PATH = 150.0  # length of the path that an actor gets on a bending road, m


@dataclass(frozen=True)
class LanePosition:
    """Point on a lane's centre line: arc length s m from the lane's start."""

    lane: int
    s: float


def move_pose(pose: Pose, forward: float, left: float, turn: float = 0.0) -> Pose:
    """Move a pose in its own frame, then turn it."""
    cosine, sine = math.cos(pose.yaw), math.sin(pose.yaw)
    return Pose(
        pose.x + cosine * forward - sine * left, pose.y + sine * forward + cosine * left, wrap_scalar(pose.yaw + turn)
    )


# ---------------------------------------------------------------- lanes


def pose_at(graph: LaneGraph, place: LanePosition) -> Pose:
    """Return the pose on the centre line, heading along traffic; clamped to the lane's ends."""
    x, y, yaw, _ = graph.at(place.lane, place.s)
    return Pose(x, y, wrap_scalar(yaw))


def width_at(graph: LaneGraph, place: LanePosition) -> float:
    """Return the width of the lane at a position, m."""
    return graph.at(place.lane, place.s)[3]


def project(graph: LaneGraph, lane: int, x: float, y: float) -> LanePosition:
    """Return the point of a lane's centre line nearest to (x, y)."""
    span = graph.points(lane)
    xy, arc_length = graph.xy[span].astype(np.float64), graph.s[span].astype(np.float64)
    starts, segments = xy[:-1], np.diff(xy, axis=0)
    fractions = np.clip(
        ((x - starts[:, 0]) * segments[:, 0] + (y - starts[:, 1]) * segments[:, 1])
        / np.maximum((segments**2).sum(1), 1e-12),
        0.0,
        1.0,
    )
    offsets = starts + fractions[:, None] * segments - (x, y)
    nearest = int(np.argmin((offsets**2).sum(1)))
    return LanePosition(
        lane, float(arc_length[nearest] + fractions[nearest] * (arc_length[nearest + 1] - arc_length[nearest]))
    )


def adjacent_place(graph: LaneGraph, place: LanePosition, side: str) -> LanePosition | None:
    """Return the same position on the lane to the left or right in driving direction, None without one."""
    neighbour = int((graph.left if side == "left" else graph.right)[place.lane])
    if neighbour < 0:
        return None
    pose = pose_at(graph, place)
    return project(graph, neighbour, pose.x, pose.y)


def turn_of(graph: LaneGraph, lane: int) -> float:
    """Return the turn of a lane from start to end, rad, left positive."""
    span = graph.points(lane)
    yaw = np.unwrap(graph.yaw[span].astype(np.float64))
    return float(yaw[-1] - yaw[0])


@cached_by_identity(1 << 14)
def straightest_successor(graph: LaneGraph, lane: int) -> int | None:
    """Return the driving successor that turns least, None at the end of the road."""
    successors = [
        int(successor) for successor in graph.successors(lane) if graph.kind[successor] == LaneType.DRIVING
    ] or [int(successor) for successor in graph.successors(lane)]
    return min(successors, key=lambda successor: (abs(turn_of(graph, successor)), successor), default=None)


def place_ahead(
    graph: LaneGraph, place: LanePosition, distance: float, *, stop_at_junction: bool = False
) -> LanePosition:
    """Return the position `distance` m further on, straight on at forks; clamped to the end of the road."""
    lane, arc_length = place.lane, place.s + distance
    while arc_length > float(graph.length[lane]):
        successor = straightest_successor(graph, lane)
        if successor is None or (stop_at_junction and graph.junction[lane] < 0 <= graph.junction[successor]):
            return LanePosition(lane, float(graph.length[lane]))
        arc_length -= float(graph.length[lane])
        lane = successor
    return LanePosition(lane, arc_length)


def place_behind(graph: LaneGraph, place: LanePosition, distance: float) -> LanePosition:
    """Return the position `distance` m further back, straight on at forks; clamped to the start of the road."""
    lane, arc_length = place.lane, place.s - distance
    while arc_length < 0.0:
        predecessors = [
            predecessor
            for predecessor in graph.predecessors(lane).tolist()
            if straightest_successor(graph, predecessor) == lane
        ]
        if not predecessors:
            return LanePosition(lane, 0.0)
        lane = min(predecessors, key=lambda predecessor: abs(turn_of(graph, predecessor)))
        arc_length += float(graph.length[lane])
    return LanePosition(lane, arc_length)


def lane_path(graph: LaneGraph, place: LanePosition, distance: float) -> F64:
    """Return points [N, 2] from a position on, straight on at forks, at most `distance` m."""
    pose = pose_at(graph, place)
    parts, lane, start, remaining = [np.array([[pose.x, pose.y]])], place.lane, place.s, distance
    while True:
        span = graph.points(lane)
        arc_length = graph.s[span]
        # Successive lanes share their end point; the 5 cm margin drops the duplicate.
        parts.append(graph.xy[span][(arc_length > start + 0.05) & (arc_length <= start + remaining)].astype(np.float64))
        remaining -= float(arc_length[-1]) - start
        successor = straightest_successor(graph, lane)
        if remaining <= 0.0 or successor is None:
            return np.concatenate(parts)
        lane, start = successor, 0.0


def polyline_route(xy: F64, *, spacing: float = 1.0) -> Route:
    """Return a route along points [N, 2] off the lane graph. RouteError if it is too short or beyond 100 km."""
    steps = np.hypot(*np.diff(xy, axis=0).T)
    distinct = np.concatenate([[True], steps > 1e-6])
    xy = xy[distinct]
    arc_length = np.concatenate([[0.0], np.cumsum(steps[steps > 1e-6])])
    if len(xy) < 2 or arc_length[-1] < spacing:
        raise RouteError(f"a path of {arc_length[-1]:.2f} m is too short; give it at least {spacing:g} m")
    if not arc_length[-1] <= MAX_LENGTH:
        raise RouteError(
            f"a path of {arc_length[-1] / 1000:.3g} km is too long; give it at most {MAX_LENGTH / 1000:g} km"
        )
    positions = np.arange(0.0, arc_length[-1] + 1e-9, spacing)
    resampled = np.stack(
        [np.interp(positions, arc_length, xy[:, 0]), np.interp(positions, arc_length, xy[:, 1])], axis=1
    )
    step = np.diff(resampled, axis=0)
    yaw = np.arctan2(step[:, 1], step[:, 0])
    count = len(resampled)
    return Route(
        xy=resampled.astype(np.float32),
        yaw=np.append(yaw, yaw[-1]).astype(np.float32),
        lane=np.full(count, -1, dtype=np.int32),
        speed_limit=np.full(count, 50.0, dtype=np.float32),
        width=np.full(count, 3.5, dtype=np.float32),
        spacing=spacing,
    )


def bending_route(graph: LaneGraph, place: LanePosition) -> Route | None:
    """Return the lane's path if it bends, None if a straight line keeps the lane (as SafeBench's actors do)."""
    xy = lane_path(graph, place, _PATH)
    pose = pose_at(graph, place)
    lateral = -math.sin(pose.yaw) * (xy[:, 0] - pose.x) + math.cos(pose.yaw) * (xy[:, 1] - pose.y)
    if len(xy) < 3 or float(np.abs(lateral).max()) < _STRAIGHT:
        return None
    return polyline_route(xy)


# ---------------------------------------------------------------- the ego's route


def trigger_index(scenario: Scenario, route: Route) -> int:
    """Return the route point nearest to the trigger, by default 30 m after the start. RouteError beyond 5 m."""
    if scenario.trigger is None:
        return min(round(DEFAULT_TRIGGER / route.spacing), len(route.xy) - 1)
    index, distance = _nearest_point(route, scenario.trigger)
    if distance > 5.0:
        raise RouteError(
            f"scenario {scenario.name}: the trigger is {distance:.1f} m off the route; put it on the route"
        )
    return index


@cached_by_identity()
def _nearest_point(route: Route, pose: Pose) -> tuple[int, float]:
    """Return the index of the route point nearest to a pose, and its distance."""
    distances = np.hypot(route.xy[:, 0] - pose.x, route.xy[:, 1] - pose.y)
    nearest = int(np.argmin(distances))
    return nearest, float(distances[nearest])


def route_place(graph: LaneGraph, scenario: Scenario, route: Route, index: int) -> LanePosition:
    """Return the lane position under a route point. RouteError if the point is off the lane graph."""
    if route.lane[index] < 0:
        raise RouteError(f"scenario {scenario.name}: no lane under the route at {index * route.spacing:.0f} m")
    return _lane_under(graph, route, index)


@cached_by_identity()
def _lane_under(graph: LaneGraph, route: Route, index: int) -> LanePosition:
    """Return the lane position under a route point on the lane graph."""
    return project(graph, int(route.lane[index]), float(route.xy[index, 0]), float(route.xy[index, 1]))


def trigger_place(graph: LaneGraph, scenario: Scenario, route: Route) -> LanePosition:
    """Return the lane position under the trigger."""
    return route_place(graph, scenario, route, trigger_index(scenario, route))


def ahead_and_left(
    graph: LaneGraph, scenario: Scenario, route: Route, *, distance: float, gap: float
) -> tuple[LanePosition, LanePosition]:
    """Return positions ahead of the trigger: in the ego's lane, and further on in the lane to its left.

    Args:
        graph: The town.
        scenario: The scenario.
        route: The ego's route.
        distance: Distance to the first position, m.
        gap: Distance from there to the second, m.

    Raises:
        RouteError: There is no such lane.
    """
    reference = trigger_place(graph, scenario, route)
    left_position = adjacent_place(graph, place_ahead(graph, reference, distance + gap), "left")
    if left_position is None:
        raise RouteError(f"scenario {scenario.name}: {scenario.type} needs a lane to the left of the ego's")
    return place_ahead(graph, reference, distance), left_position


def junction_span(graph: LaneGraph, scenario: Scenario, route: Route) -> tuple[int, int]:
    """Return the route points at which the first junction after the trigger begins and ends.

    Raises:
        RouteError: The route passes no junction after its trigger.
    """
    span = _first_junction(graph, route, trigger_index(scenario, route) if scenario.trigger is not None else 0)
    if span is None:
        raise RouteError(f"scenario {scenario.name}: the route passes no junction after its trigger")
    return span


@cached_by_identity()
def _first_junction(graph: LaneGraph, route: Route, first: int) -> tuple[int, int] | None:
    """Return the route points at which the first junction from point `first` on begins and ends, or None."""
    in_junction = (route.lane >= 0) & (graph.junction[route.lane] >= 0)
    entries = np.flatnonzero(in_junction[first:])
    if not len(entries):
        return None
    enter = first + int(entries[0])
    exits = np.flatnonzero(~in_junction[enter:])
    return enter, enter + int(exits[0]) if len(exits) else len(route.xy) - 1


def to_outermost(graph: LaneGraph, place: LanePosition, *, kinds: Sequence[LaneType]) -> tuple[LanePosition, int]:
    """Return the rightmost lane of the given kinds beside a position, and the number of lanes crossed.

    A shoulder counts if it is wider than 2 m (CARLA's maps draw parking strips so), and ends the walk.
    """
    crossed = 0
    while True:
        right_position = adjacent_place(graph, place, "right")
        if right_position is None or graph.kind[right_position.lane] not in kinds:
            return place, crossed
        is_shoulder = graph.kind[right_position.lane] == LaneType.SHOULDER
        if is_shoulder and width_at(graph, right_position) <= _SHOULDER:
            return place, crossed
        place, crossed = right_position, crossed + 1
        if is_shoulder:
            return place, crossed


# ---------------------------------------------------------------- agents


def make_drive_phase(speed: float, trigger_distance: float) -> Phase:
    """Return the phase that drives at `speed` once the ego is within `trigger_distance` m of actor 0."""
    return Phase(speed, PhaseTrigger("ego_distance", trigger_distance, 0))


def wait_and_drive_phases(speed: float, trigger_distance: float) -> tuple[Phase, ...]:
    """As `go`, but wait until the ego drives faster than 0.5 m/s."""
    return (
        Phase(0.0, PhaseTrigger("ego_distance", trigger_distance, 0)),
        Phase(speed, PhaseTrigger("ego_speed", 0.5)),
    )


def scripted_agent(
    name: str, body: str, pose: Pose, phases: Sequence[Phase], route: Route | None = None
) -> EpisodeAgent:
    """Return an agent that stands until its first phase begins."""
    return EpisodeAgent(
        name=name,
        model=body,
        controller=Controller.SCRIPT,
        pose=pose,
        target_speed=max(phase.speed or 0.0 for phase in phases),
        phases=tuple(phases),
        route=route,
    )


def standing_agent(name: str, body: str, pose: Pose) -> EpisodeAgent:
    """Return an agent that never moves."""
    return EpisodeAgent(name=name, model=body, controller=Controller.NONE, pose=pose, target_speed=0.0)
