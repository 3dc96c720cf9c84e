"""Start positions of actors that meet the ego in a junction. Units as in `ssad.core.types`."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ssad.core.errors import RouteError
from ssad.core.rotations import wrap_scalar
from ssad.core.types import F64, LaneType, Route, Scenario
from ssad.scenarios.dynamic.knowledge._caching import cached_by_identity
from ssad.scenarios.dynamic.knowledge._placing import (
    LanePosition,
    junction_span,
    lane_path,
    pose_at,
    turn_of,
)
from ssad.world.models import model

if TYPE_CHECKING:
    from ssad.core.lane_graph import LaneGraph

EGO_SPEED = 9.0
"""Speed (m/s) that the ego is taken to keep when an actor is placed to meet it.

SafeBench wants 8 m/s of its egos and an ego that sees nothing drives 10 m/s: bodies are long enough to meet both.
"""
_LATERAL = 2.5  # m/s^2, comfortable lateral acceleration in bends
_SLOW_DOWN = 2.0  # m/s^2, comfortable braking before bends


def time_to_cover(distance: float, top_speed: float, acceleration: float) -> float:
    """Return the seconds that a standing vehicle needs for `distance` m at full throttle up to `top_speed`."""
    acceleration_distance = top_speed**2 / (2.0 * acceleration)
    if distance <= acceleration_distance:
        return math.sqrt(2.0 * distance / acceleration)
    return top_speed / acceleration + (distance - acceleration_distance) / top_speed


def ego_times(route: Route) -> F64:
    """Seconds [N] at which an ego that keeps `EGO_SPEED`, and slows down for bends, passes the route's points."""
    curvature = np.abs(np.gradient(np.unwrap(route.yaw.astype(np.float64)), route.spacing))
    curvature = np.convolve(np.pad(curvature, 1, mode="edge"), np.ones(3) / 3.0, mode="valid")
    speed = np.minimum(EGO_SPEED, np.sqrt(_LATERAL / np.maximum(curvature, 1e-6)))
    braking_term = 2.0 * _SLOW_DOWN * route.spacing * np.arange(len(speed))
    # Backward pass: v^2 may fall by at most 2 a ds per point before a bend.
    speed = np.sqrt(np.minimum.accumulate((speed**2 + braking_term)[::-1])[::-1] - braking_term)
    return np.concatenate([[0.0], np.cumsum(2.0 * route.spacing / (speed[:-1] + speed[1:]))])


def _approaches(graph: LaneGraph, junction: int) -> Iterator[tuple[int, int]]:
    """Yield (approach lane, lane inside the junction that continues it) for driving lanes."""
    for inside_lane in np.flatnonzero((graph.junction == junction) & (graph.kind == LaneType.DRIVING)):
        for approach_lane in graph.predecessors(int(inside_lane)):
            if graph.junction[approach_lane] != junction:
                yield int(approach_lane), int(inside_lane)


def meeting_place(
    graph: LaneGraph,
    scenario: Scenario,
    route: Route,
    *,
    sides: Sequence[float],
    trigger_distance: float,
    speed: float,
    body: str,
) -> LanePosition:
    """Return the start of an actor on an approach of the ego's junction such that it meets the ego.

    The actor stands before the junction; both reach the conflict point at the same time, as closely as the road
    allows. The ego drives as in `ego_times`. The result is cached per route.

    Args:
        graph: Lane graph of the town.
        scenario: The scenario; the junction is searched from its trigger on.
        route: The ego's route.
        sides: Preferred headings of the approach relative to the ego's, rad, best first (-pi/2: from the left).
        trigger_distance: Distance of the ego at which the actor starts, m.
        speed: Speed that the actor accelerates to at full throttle, m/s.
        body: Model of the actor.

    Returns:
        The place on the approach.

    Raises:
        RouteError: The route has no junction, or no approach to it crosses the ego's path.
    """
    span = junction_span(graph, scenario, route)
    start_position = _search(graph, route, span, tuple(sides), trigger_distance, speed, body)
    if start_position is None:
        junction = int(graph.junction[route.lane[span[0]]])
        raise RouteError(
            f"scenario {scenario.name}: no lane into junction {junction} crosses the ego's route; give placements"
        )
    return start_position


@cached_by_identity()
def _search(  # noqa: PLR0917  a remembered function takes its arguments by position
    graph: LaneGraph,
    route: Route,
    span: tuple[int, int],
    sides: tuple[float, ...],
    trigger_distance: float,
    speed: float,
    body: str,
) -> LanePosition | None:
    """Return the start on the best approach to the junction at route points `span`, None without one."""
    entry_index = span[0]
    junction = int(graph.junction[route.lane[entry_index]])
    ego_lanes = {int(lane) for lane in np.unique(route.lane)}
    heading = float(route.yaw[max(entry_index - 1, 0)])
    acceleration = model(body).max_accel
    best: tuple[float, LanePosition] | None = None
    for side in sides:
        for approach_lane, inside_lane in _approaches(graph, junction):
            if approach_lane in ego_lanes or abs(turn_of(graph, inside_lane)) > math.radians(35):
                continue
            approach = pose_at(graph, LanePosition(approach_lane, float(graph.length[approach_lane])))
            if abs(wrap_scalar(approach.yaw - heading - side)) > math.radians(40):
                continue
            candidate = _best_start(
                graph,
                route,
                span=span,
                lanes=(approach_lane, inside_lane),
                trigger_distance=trigger_distance,
                speed=speed,
                acceleration=acceleration,
            )
            if candidate is not None and (best is None or candidate[0] < best[0] - 1e-9):
                best = candidate
        if best is not None:
            return best[1]
    return None


def _best_start(
    graph: LaneGraph,
    route: Route,
    *,
    span: tuple[int, int],
    lanes: tuple[int, int],
    trigger_distance: float,
    speed: float,
    acceleration: float,
) -> tuple[float, LanePosition] | None:
    """Return (difference of arrival s, position) of the best start on an approach, None without a conflict."""
    (entry_index, exit_index), (approach_lane, inside_lane) = span, lanes
    path = lane_path(graph, LanePosition(inside_lane, 0.0), float(graph.length[inside_lane]) + 15.0)
    ego = route.xy[entry_index : min(exit_index + 15, len(route.xy))].astype(np.float64)
    distances = np.hypot(ego[:, None, 0] - path[None, :, 0], ego[:, None, 1] - path[None, :, 1])
    close_points = np.flatnonzero(distances.min(axis=1) < 1.5)
    if not len(close_points):
        return None
    # the point of least gap in the first stretch where the paths are close: the crossing, or where they merge
    stretch = close_points[: int(np.argmax(np.diff(close_points, append=close_points[-1] + 2) > 1)) + 1]
    # Rounding to 0.1 m selects the first of nearly equal points where the paths merge.
    ego_index = int(stretch[int(np.argmin(np.round(distances[stretch].min(axis=1), 1)))])
    path_index = int(np.argmin(distances[ego_index]))
    along = float(np.hypot(*np.diff(path[: path_index + 1], axis=0).T).sum())
    conflict = entry_index + ego_index
    times = ego_times(route)
    best: tuple[float, LanePosition] | None = None
    for setback in np.arange(1.0, float(graph.length[approach_lane]), 0.5):
        start_position = LanePosition(approach_lane, float(graph.length[approach_lane]) - float(setback))
        pose = pose_at(graph, start_position)
        ego_distance = np.hypot(route.xy[: conflict + 1, 0] - pose.x, route.xy[: conflict + 1, 1] - pose.y)
        triggered = np.flatnonzero(ego_distance < trigger_distance)
        if not len(triggered) or triggered[0] == 0:
            continue
        ego_time = float(times[conflict] - times[int(triggered[0])])
        arrival_difference = abs(time_to_cover(float(setback) + along, speed, acceleration) - ego_time)
        if best is None or arrival_difference < best[0] - 1e-9:
            best = (arrival_difference, start_position)
    return best
