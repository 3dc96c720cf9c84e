"""Where actors stand: arithmetic on lanes that the scenario classes share. Units as in `ssad.core.types`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ssad.core.errors import RouteError
from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, Condition, Controller, EpisodeAgent, LaneType, Phase, Pose, Route, Scenario
from ssad.scenarios.dynamic.knowledge._remember import remembered

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph

DEFAULT_TRIGGER = 30.0
"""Where on the route a scenario without a trigger has it, m from the start: as in SafeBench's routes."""
_SHOULDER = 2.0  # CARLA's maps draw parking strips as shoulders wider than this
_STRAIGHT = 0.3  # a path that strays less than this from a straight line is driven straight, as SafeBench does
_PATH = 150.0  # length of the path that an actor gets on a bending road, m


@dataclass(frozen=True)
class Place:
    """A point on a lane's centre line: arc length s m from the lane's start."""

    lane: int
    s: float


def wrap(angle: float) -> float:
    """The angle in [-pi, pi)."""
    return float(wrap_angle(angle))


def shifted(pose: Pose, forward: float, left: float, turn: float = 0.0) -> Pose:
    """The pose moved in its own frame, then turned."""
    c, s = math.cos(pose.yaw), math.sin(pose.yaw)
    return Pose(pose.x + c * forward - s * left, pose.y + s * forward + c * left, wrap(pose.yaw + turn))


# ---------------------------------------------------------------- lanes


def pose_at(graph: LaneGraph, place: Place) -> Pose:
    """Pose on the centre line, heading along traffic; held inside the lane's ends."""
    x, y, yaw, _ = graph.at(place.lane, place.s)
    return Pose(x, y, wrap(yaw))


def width_at(graph: LaneGraph, place: Place) -> float:
    """Width of the lane there, m."""
    return graph.at(place.lane, place.s)[3]


def project(graph: LaneGraph, lane: int, x: float, y: float) -> Place:
    """The point of the lane's centre line nearest to (x, y)."""
    span = graph.points(lane)
    xy, s = graph.xy[span].astype(np.float64), graph.s[span].astype(np.float64)
    a, d = xy[:-1], np.diff(xy, axis=0)
    t = np.clip(((x - a[:, 0]) * d[:, 0] + (y - a[:, 1]) * d[:, 1]) / np.maximum((d**2).sum(1), 1e-12), 0.0, 1.0)
    off = a + t[:, None] * d - (x, y)
    i = int(np.argmin((off**2).sum(1)))
    return Place(lane, float(s[i] + t[i] * (s[i + 1] - s[i])))


def beside(graph: LaneGraph, place: Place, side: str) -> Place | None:
    """The same place on the lane to the left or right as the lane's traffic sees it, None without one."""
    lane = int((graph.left if side == "left" else graph.right)[place.lane])
    if lane < 0:
        return None
    pose = pose_at(graph, place)
    return project(graph, lane, pose.x, pose.y)


def turn_of(graph: LaneGraph, lane: int) -> float:
    """How much a lane turns from its start to its end, rad, left positive."""
    span = graph.points(lane)
    yaw = np.unwrap(graph.yaw[span].astype(np.float64))
    return float(yaw[-1] - yaw[0])


@remembered(1 << 14)
def straightest(graph: LaneGraph, lane: int) -> int | None:
    """The driving successor that turns least, None at the end of the road."""
    after = [int(n) for n in graph.successors(lane) if graph.kind[n] == LaneType.DRIVING] or [
        int(n) for n in graph.successors(lane)
    ]
    return min(after, key=lambda n: (abs(turn_of(graph, n)), n), default=None)


def ahead(graph: LaneGraph, place: Place, distance: float, *, stop_at_junction: bool = False) -> Place:
    """The place `distance` m further on, straight on at forks; the end of the road if it comes before."""
    lane, s = place.lane, place.s + distance
    while s > float(graph.length[lane]):
        after = straightest(graph, lane)
        if after is None or (stop_at_junction and graph.junction[lane] < 0 <= graph.junction[after]):
            return Place(lane, float(graph.length[lane]))
        s -= float(graph.length[lane])
        lane = after
    return Place(lane, s)


def behind(graph: LaneGraph, place: Place, distance: float) -> Place:
    """The place `distance` m further back, straight on at forks; where the road begins if it begins before."""
    lane, s = place.lane, place.s - distance
    while s < 0.0:
        before = [n for n in graph.predecessors(lane).tolist() if straightest(graph, n) == lane]
        if not before:
            return Place(lane, 0.0)
        lane = min(before, key=lambda n: abs(turn_of(graph, n)))
        s += float(graph.length[lane])
    return Place(lane, s)


def lane_path(graph: LaneGraph, place: Place, distance: float) -> F64:
    """Points [N, 2] from a place on, straight on at forks, at most `distance` m."""
    pose = pose_at(graph, place)
    parts, lane, start, left = [np.array([[pose.x, pose.y]])], place.lane, place.s, distance
    while True:
        span = graph.points(lane)
        s = graph.s[span]
        parts.append(graph.xy[span][(s > start + 0.05) & (s <= start + left)].astype(np.float64))
        left -= float(s[-1]) - start
        after = straightest(graph, lane)
        if left <= 0.0 or after is None:
            return np.concatenate(parts)
        lane, start = after, 0.0


def polyline_route(xy: F64, *, spacing: float = 1.0) -> Route:
    """A route along points [N, 2] off the lane graph. RouteError if it has no length."""
    steps = np.hypot(*np.diff(xy, axis=0).T)
    keep = np.concatenate([[True], steps > 1e-6])
    xy = xy[keep]
    s = np.concatenate([[0.0], np.cumsum(steps[steps > 1e-6])])
    if len(xy) < 2 or s[-1] < spacing:
        raise RouteError(f"a path of {s[-1]:.2f} m is too short; give it at least {spacing:g} m")
    at = np.arange(0.0, s[-1] + 1e-9, spacing)
    out = np.stack([np.interp(at, s, xy[:, 0]), np.interp(at, s, xy[:, 1])], axis=1)
    step = np.diff(out, axis=0)
    yaw = np.arctan2(step[:, 1], step[:, 0])
    count = len(out)
    return Route(
        xy=out.astype(np.float32),
        yaw=np.append(yaw, yaw[-1]).astype(np.float32),
        lane=np.full(count, -1, dtype=np.int32),
        speed_limit=np.full(count, 50.0, dtype=np.float32),
        width=np.full(count, 3.5, dtype=np.float32),
        spacing=spacing,
    )


def bending_route(graph: LaneGraph, place: Place) -> Route | None:
    """The lane's path if it bends, None if going straight keeps the lane (what SafeBench's actors do)."""
    xy = lane_path(graph, place, _PATH)
    pose = pose_at(graph, place)
    left = -math.sin(pose.yaw) * (xy[:, 0] - pose.x) + math.cos(pose.yaw) * (xy[:, 1] - pose.y)
    if len(xy) < 3 or float(np.abs(left).max()) < _STRAIGHT:
        return None
    return polyline_route(xy)


# ---------------------------------------------------------------- the ego's route


def trigger_index(scenario: Scenario, route: Route) -> int:
    """Route point nearest to the trigger; without one, 30 m after the start. RouteError if it is far off."""
    if scenario.trigger is None:
        return min(round(DEFAULT_TRIGGER / route.spacing), len(route.xy) - 1)
    best, off = _nearest_point(route, scenario.trigger)
    if off > 5.0:
        raise RouteError(f"scenario {scenario.name}: the trigger is {off:.1f} m off the route; put it on the route")
    return best


@remembered()
def _nearest_point(route: Route, pose: Pose) -> tuple[int, float]:
    """The route point nearest to a pose, and how far off it is."""
    off = np.hypot(route.xy[:, 0] - pose.x, route.xy[:, 1] - pose.y)
    best = int(np.argmin(off))
    return best, float(off[best])


def route_place(graph: LaneGraph, scenario: Scenario, route: Route, index: int) -> Place:
    """The lane under a point of the route. RouteError where the route has left the lane graph."""
    if route.lane[index] < 0:
        raise RouteError(f"scenario {scenario.name}: no lane under the route at {index * route.spacing:.0f} m")
    return _lane_under(graph, route, index)


@remembered()
def _lane_under(graph: LaneGraph, route: Route, index: int) -> Place:
    """The lane under a point of a route on the lane graph."""
    return project(graph, int(route.lane[index]), float(route.xy[index, 0]), float(route.xy[index, 1]))


def trigger_place(graph: LaneGraph, scenario: Scenario, route: Route) -> Place:
    """The lane under the trigger."""
    return route_place(graph, scenario, route, trigger_index(scenario, route))


def ahead_and_left(
    graph: LaneGraph, scenario: Scenario, route: Route, *, distance: float, gap: float
) -> tuple[Place, Place]:
    """Places ahead of the trigger: in the ego's lane, and further on in the lane to its left.

    Args:
        graph: The town.
        scenario: What is built.
        route: Of the ego.
        distance: To the first place, m.
        gap: From there to the second, m.

    Raises:
        RouteError: There is no such lane.
    """
    reference = trigger_place(graph, scenario, route)
    left = beside(graph, ahead(graph, reference, distance + gap), "left")
    if left is None:
        raise RouteError(f"scenario {scenario.name}: {scenario.type} needs a lane to the left of the ego's")
    return ahead(graph, reference, distance), left


def junction_span(graph: LaneGraph, scenario: Scenario, route: Route) -> tuple[int, int]:
    """Route points where the first junction after the trigger begins and where it has ended.

    Raises:
        RouteError: The route passes no junction after its trigger.
    """
    span = _first_junction(graph, route, trigger_index(scenario, route) if scenario.trigger is not None else 0)
    if span is None:
        raise RouteError(f"scenario {scenario.name}: the route passes no junction after its trigger")
    return span


@remembered()
def _first_junction(graph: LaneGraph, route: Route, first: int) -> tuple[int, int] | None:
    """Route points where the first junction from point `first` on begins and where it has ended."""
    inside = (route.lane >= 0) & (graph.junction[route.lane] >= 0)
    entries = np.flatnonzero(inside[first:])
    if not len(entries):
        return None
    enter = first + int(entries[0])
    exits = np.flatnonzero(~inside[enter:])
    return enter, enter + int(exits[0]) if len(exits) else len(route.xy) - 1


def to_outermost(graph: LaneGraph, place: Place, *, kinds: Sequence[LaneType]) -> tuple[Place, int]:
    """The rightmost lane of the given kinds beside a place, and how many lanes were crossed.

    A shoulder counts if it is wider than 2 m (CARLA's maps draw parking strips so), and ends the walk.
    """
    crossed = 0
    while True:
        after = beside(graph, place, "right")
        if after is None or graph.kind[after.lane] not in kinds:
            return place, crossed
        shoulder = graph.kind[after.lane] == LaneType.SHOULDER
        if shoulder and width_at(graph, after) <= _SHOULDER:
            return place, crossed
        place, crossed = after, crossed + 1
        if shoulder:
            return place, crossed


# ---------------------------------------------------------------- agents


def go(speed: float, trigger_distance: float) -> Phase:
    """Drive at `speed` once the ego is within `trigger_distance` m of actor 0."""
    return Phase(speed, Condition("ego_distance", trigger_distance, 0))


def go_when_ego_moves(speed: float, trigger_distance: float) -> tuple[Phase, ...]:
    """As `go`, but wait until the ego drives faster than 0.5 m/s."""
    return (
        Phase(0.0, Condition("ego_distance", trigger_distance, 0)),
        Phase(speed, Condition("ego_speed", 0.5)),
    )


def scripted(name: str, body: str, pose: Pose, phases: Sequence[Phase], route: Route | None = None) -> EpisodeAgent:
    """An agent that stands until its first phase begins."""
    return EpisodeAgent(
        name=name,
        model=body,
        controller=Controller.SCRIPT,
        pose=pose,
        target_speed=max(phase.speed for phase in phases),
        phases=tuple(phases),
        route=route,
    )


def standing(name: str, body: str, pose: Pose) -> EpisodeAgent:
    """An agent that never moves."""
    return EpisodeAgent(name=name, model=body, controller=Controller.NONE, pose=pose, target_speed=0.0)
