"""Where actors stand: arithmetic on lanes that the scenario classes share. Units as in `ssad.types`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ssad.errors import RouteError
from ssad.types import F64, Condition, Controller, EpisodeAgent, LaneType, Phase, Pose, Route, Scenario
from ssad.world.models import model

if TYPE_CHECKING:
    from ssad.roads.graph import LaneGraph

EGO_SPEED = 9.0
"""Speed (m/s) that the ego is taken to keep when an actor is placed to meet it.

SafeBench wants 8 m/s of its egos and an ego that sees nothing drives 10 m/s: bodies are long enough to meet both.
"""
_LATERAL = 2.5  # m/s^2 in bends, and
_SLOW_DOWN = 2.0  # m/s^2 before them: how drivers take a turn at a junction
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
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


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
    off = np.hypot(route.xy[:, 0] - scenario.trigger.x, route.xy[:, 1] - scenario.trigger.y)
    best = int(np.argmin(off))
    if off[best] > 5.0:
        raise RouteError(
            f"scenario {scenario.name}: the trigger is {off[best]:.1f} m off the route; put it on the route"
        )
    return best


def route_place(graph: LaneGraph, scenario: Scenario, route: Route, index: int) -> Place:
    """The lane under a point of the route. RouteError where the route has left the lane graph."""
    lane = int(route.lane[index])
    if lane < 0:
        raise RouteError(f"scenario {scenario.name}: no lane under the route at {index * route.spacing:.0f} m")
    return project(graph, lane, float(route.xy[index, 0]), float(route.xy[index, 1]))


def trigger_place(graph: LaneGraph, scenario: Scenario, route: Route) -> Place:
    """The lane under the trigger."""
    return route_place(graph, scenario, route, trigger_index(scenario, route))


def junction_span(graph: LaneGraph, scenario: Scenario, route: Route) -> tuple[int, int]:
    """Route points where the first junction after the trigger begins and where it has ended. RouteError."""
    first = trigger_index(scenario, route) if scenario.trigger is not None else 0
    inside = (route.lane >= 0) & (graph.junction[np.maximum(route.lane, 0)] >= 0)
    entries = np.flatnonzero(inside[first:])
    if not len(entries):
        raise RouteError(f"scenario {scenario.name}: the route passes no junction after its trigger")
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


# ---------------------------------------------------------------- an actor that meets the ego


def time_to_cover(distance: float, top_speed: float, acceleration: float) -> float:
    """Seconds that a standing vehicle takes for `distance` m at full throttle up to `top_speed`."""
    ramp = top_speed**2 / (2.0 * acceleration)
    if distance <= ramp:
        return math.sqrt(2.0 * max(distance, 0.0) / acceleration)
    return top_speed / acceleration + (distance - ramp) / top_speed


def ego_times(route: Route) -> F64:
    """Seconds [N] at which an ego that keeps `EGO_SPEED`, and slows down for bends, passes the route's points."""
    turn = np.abs(np.gradient(np.unwrap(route.yaw.astype(np.float64)), route.spacing))
    turn = np.convolve(np.pad(turn, 1, mode="edge"), np.ones(3) / 3.0, mode="valid")
    speed = np.minimum(EGO_SPEED, np.sqrt(_LATERAL / np.maximum(turn, 1e-6)))
    room = 2.0 * _SLOW_DOWN * route.spacing * np.arange(len(speed))
    speed = np.sqrt(np.minimum.accumulate((speed**2 + room)[::-1])[::-1] - room)
    return np.concatenate([[0.0], np.cumsum(2.0 * route.spacing / (speed[:-1] + speed[1:]))])


def _approaches(graph: LaneGraph, junction: int) -> Iterator[tuple[int, int]]:
    """(approach lane, lane inside the junction that goes on from it) for driving lanes."""
    for lane in np.flatnonzero((graph.junction == junction) & (graph.kind == LaneType.DRIVING)):
        for before in graph.predecessors(int(lane)):
            if graph.junction[before] != junction:
                yield int(before), int(lane)


def meeting_place(
    graph: LaneGraph,
    scenario: Scenario,
    route: Route,
    *,
    sides: Sequence[float],
    trigger_distance: float,
    speed: float,
    body: str,
) -> Place:
    """Where an actor stands on an approach of the ego's junction so that it meets an ego of `ego_times`.

    sides: wanted headings of the approach relative to the ego's, rad, best first (-pi/2: from the left).
    The actor starts when the ego is within `trigger_distance`, at full throttle up to `speed`; it stands
    before the junction, and both reach the point where their paths meet at one moment, as nearly as the
    road allows. RouteError if no approach crosses the ego's path.
    """
    enter, leave = junction_span(graph, scenario, route)
    junction = int(graph.junction[route.lane[enter]])
    ego_lanes = {int(n) for n in np.unique(route.lane)}
    heading = float(route.yaw[max(enter - 1, 0)])
    acceleration = model(body).max_accel
    best: tuple[float, Place] | None = None
    for side in sides:
        for before, inside in _approaches(graph, junction):
            if before in ego_lanes or abs(turn_of(graph, inside)) > math.radians(35):
                continue
            approach = pose_at(graph, Place(before, float(graph.length[before])))
            if abs(wrap(approach.yaw - heading - side)) > math.radians(40):
                continue
            found = _meet(
                graph,
                route,
                span=(enter, leave),
                lanes=(before, inside),
                trigger_distance=trigger_distance,
                speed=speed,
                acceleration=acceleration,
            )
            if found is not None and (best is None or found[0] < best[0] - 1e-9):
                best = found
        if best is not None:
            return best[1]
    raise RouteError(
        f"scenario {scenario.name}: no lane into junction {junction} crosses the ego's route; give placements"
    )


def _meet(
    graph: LaneGraph,
    route: Route,
    *,
    span: tuple[int, int],
    lanes: tuple[int, int],
    trigger_distance: float,
    speed: float,
    acceleration: float,
) -> tuple[float, Place] | None:
    """(difference of arrival s, place) of the best start on this approach, None if the paths do not meet."""
    (enter, leave), (before, inside) = span, lanes
    path = lane_path(graph, Place(inside, 0.0), float(graph.length[inside]) + 15.0)
    ego = route.xy[enter : min(leave + 15, len(route.xy))].astype(np.float64)
    gap = np.hypot(ego[:, None, 0] - path[None, :, 0], ego[:, None, 1] - path[None, :, 1])
    near = np.flatnonzero(gap.min(axis=1) < 1.5)
    if not len(near):
        return None
    # the point of least gap in the first stretch where the paths are close: the crossing, or where they merge
    stretch = near[: int(np.argmax(np.diff(near, append=near[-1] + 2) > 1)) + 1]
    k = int(stretch[int(np.argmin(np.round(gap[stretch].min(axis=1), 1)))])
    j = int(np.argmin(gap[k]))
    along = float(np.hypot(*np.diff(path[: j + 1], axis=0).T).sum())
    conflict = enter + k
    times = ego_times(route)
    best: tuple[float, Place] | None = None
    for back in np.arange(1.0, float(graph.length[before]), 0.5):
        place = Place(before, float(graph.length[before]) - float(back))
        pose = pose_at(graph, place)
        off = np.hypot(route.xy[: conflict + 1, 0] - pose.x, route.xy[: conflict + 1, 1] - pose.y)
        within = np.flatnonzero(off < trigger_distance)
        if not len(within) or within[0] == 0:
            continue
        ego_time = float(times[conflict] - times[int(within[0])])
        wait = abs(time_to_cover(float(back) + along, speed, acceleration) - ego_time)
        if best is None or wait < best[0] - 1e-9:
            best = (wait, place)
    return best


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
