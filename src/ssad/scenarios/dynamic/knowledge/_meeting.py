"""Where an actor must stand so that it meets the ego in a junction. Units as in `ssad.core.types`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ssad.core.errors import RouteError
from ssad.core.types import F64, LaneType, Route, Scenario
from ssad.scenarios.dynamic.knowledge._placing import (
    Place,
    junction_span,
    lane_path,
    pose_at,
    turn_of,
    wrap,
)
from ssad.scenarios.dynamic.knowledge._remember import remembered
from ssad.world.models import model

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph

EGO_SPEED = 9.0
"""Speed (m/s) that the ego is taken to keep when an actor is placed to meet it.

SafeBench wants 8 m/s of its egos and an ego that sees nothing drives 10 m/s: bodies are long enough to meet both.
"""
_LATERAL = 2.5  # m/s^2 in bends, and
_SLOW_DOWN = 2.0  # m/s^2 before them: how drivers take a turn at a junction


def time_to_cover(distance: float, top_speed: float, acceleration: float) -> float:
    """Seconds that a standing vehicle takes for `distance` m at full throttle up to `top_speed`."""
    ramp = top_speed**2 / (2.0 * acceleration)
    if distance <= ramp:
        return math.sqrt(2.0 * distance / acceleration)
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

    The actor stands before the junction, and both reach the point where their paths meet at one moment, as nearly as
    the road allows. The search is done once for a route; its answer is kept.

    Args:
        graph: Lane graph of the town.
        scenario: The scenario; its trigger says from where on the junction is looked for.
        route: The ego's route.
        sides: Wanted headings of the approach relative to the ego's, rad, best first (-pi/2: from the left).
        trigger_distance: The actor starts when the ego is this near to it, m,
        speed: at full throttle up to this speed, m/s.
        body: Model of the actor.

    Returns:
        The place on the approach.

    Raises:
        RouteError: The route has no junction, or no approach to it crosses the ego's path.
    """
    span = junction_span(graph, scenario, route)
    place = _search(graph, route, span, tuple(sides), trigger_distance, speed, body)
    if place is None:
        junction = int(graph.junction[route.lane[span[0]]])
        raise RouteError(
            f"scenario {scenario.name}: no lane into junction {junction} crosses the ego's route; give placements"
        )
    return place


@remembered()
def _search(  # noqa: PLR0917  a remembered function takes its arguments by position
    graph: LaneGraph,
    route: Route,
    span: tuple[int, int],
    sides: tuple[float, ...],
    trigger_distance: float,
    speed: float,
    body: str,
) -> Place | None:
    """The start on the best of the approaches to the junction at points `span` of the route, None without one."""
    enter = span[0]
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
                span=span,
                lanes=(before, inside),
                trigger_distance=trigger_distance,
                speed=speed,
                acceleration=acceleration,
            )
            if found is not None and (best is None or found[0] < best[0] - 1e-9):
                best = found
        if best is not None:
            return best[1]
    return None


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
