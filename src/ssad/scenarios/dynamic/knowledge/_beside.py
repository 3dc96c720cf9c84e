"""Places beside a path to which the lateral phases of an actor lead."""

from __future__ import annotations

import numpy as np

from ssad.core.errors import RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.triggers import lanes_before
from ssad.core.types import F32, F64, I32, Actor, LaneType, Route
from ssad.world.episode_arrays import lane_left
from ssad.world.roads.query import LaneQuery

_USABLE = (LaneType.DRIVING, LaneType.SHOULDER, LaneType.PARKING, LaneType.BIKING)


def lateral_targets(actor: Actor, graph: LaneGraph, route: Route) -> tuple[F32, ...]:
    """Return the distance left of its path to which each lateral phase of an actor leads.

    Args:
        actor: The actor.
        graph: Lane graph of the town.
        route: Path of the actor.

    Returns:
        For each lateral phase, metres left of the path at each of its points [N]. Where the lane does not exist, the
        value of the nearest point at which it does.

    Raises:
        RouteError: A phase leads to a lane that the road does not have anywhere along the path.
    """
    lane, facing = _lanes_under(graph, route)
    targets = []
    for number, (phase, lanes) in enumerate(zip(actor.lateral, lanes_before(actor.lateral), strict=True)):
        offset = np.zeros(len(lane))
        if lanes:
            offset = _lane_offset(graph, route, lane, facing, lanes)
            exists = np.flatnonzero(np.isfinite(offset))
            if not len(exists):
                count, side = abs(lanes), "left" if lanes > 0 else "right"
                x, y = route.xy[0].tolist()
                raise RouteError(
                    f"actor {actor.name}: lateral phase {number + 1}: the road at ({x:.1f}, {y:.1f}) has no lane"
                    f" {count} to the {side}; change `lanes`, or give an `offset` in metres"
                )
            points = np.arange(len(offset))
            offset = offset[exists[np.abs(points[:, None] - exists).argmin(1)]]
        targets.append((offset + phase.offset).astype(np.float32))
    return tuple(targets)


def _lanes_under(graph: LaneGraph, route: Route) -> tuple[I32, I32]:
    """Return the lane under each point of a path, and 1 where it leads along the path, -1 where against it."""
    nearest = LaneQuery(graph).nearest(route.xy, _USABLE)
    lane = np.where(nearest.is_inside, nearest.lane, -1).astype(np.int32)
    facing = np.zeros(len(lane), np.int32)
    for index in np.unique(lane[lane >= 0]).tolist():
        points, lane_points = np.flatnonzero(lane == index), graph.points(index)
        lane_xy = graph.xy[lane_points].astype(np.float64)
        at = np.clip(np.searchsorted(graph.s[lane_points], nearest.s[points], side="right") - 1, 0, len(lane_xy) - 2)
        step = lane_xy[at + 1] - lane_xy[at]
        along = step[:, 0] * np.cos(route.yaw[points]) + step[:, 1] * np.sin(route.yaw[points])
        facing[points] = np.where(along >= 0.0, 1, -1)
    return lane, facing


def _lane_offset(graph: LaneGraph, route: Route, lane: I32, facing: I32, lanes: int) -> F64:
    """Return the offset of the centre of the lane `lanes` to the left of each point; NaN where there is none."""
    offset = np.full(len(lane), np.nan)
    for start in np.unique(lane[lane >= 0]).tolist():
        for direction in (1, -1):
            points = np.flatnonzero((lane == start) & (facing == direction))
            target = _neighbour(graph, start, lanes * direction) if len(points) else -1
            if target >= 0:
                offset[points] = lane_left(route, points, graph, target)[0]
    return offset


def _neighbour(graph: LaneGraph, lane: int, lanes: int) -> int:
    """Return the lane so many lanes to the left of a lane in its own direction; -1: there is none."""
    side = 1 if lanes > 0 else -1
    for _ in range(abs(lanes)):
        beside = int(graph.left[lane] if side > 0 else graph.right[lane])
        if beside < 0 or graph.kind[beside] not in _USABLE:
            return -1
        if not graph.is_same_direction(lane, beside):
            side = -side
        lane = beside
    return lane
