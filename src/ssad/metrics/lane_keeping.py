"""Metrics of lane keeping: deviation from the middle of the lane, departures from it, and errors of the camera's lane.

The lane is that of the route, so these metrics are not defined for drives that change lanes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ssad.core.lane_graph import LaneGraph
from ssad.core.perception import LANE_CONFIDENCE, PerceivedLane
from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, Bool, EpisodeTrace, LaneType


@dataclass(frozen=True, eq=False)
class PositionInLane:
    """Position of the ego in its lane at each of T steps.

    Attributes:
        deviation: [T] m to the left of the middle of the lane.
        heading: [T] rad to the left of its direction.
        along: [T] distance along the route, m.
        width: [T] width of the lane, m.
    """

    deviation: F64
    heading: F64
    along: F64
    width: F64


def lane_position(trace: EpisodeTrace, graph: LaneGraph) -> PositionInLane:
    """Return the position of the ego in the lane of its route.

    Args:
        trace: The drive.
        graph: Its town.
    """
    route_points = trace.route.astype(np.float64)
    segment_steps = np.diff(route_points, axis=0)
    segment_lengths = np.hypot(*segment_steps.T)
    is_segment = segment_lengths > 1e-6
    segment_starts, segment_steps = route_points[:-1][is_segment], segment_steps[is_segment]
    segment_lengths = segment_lengths[is_segment]
    arc_lengths = np.concatenate([[0.0], np.cumsum(segment_lengths)])[:-1]
    directions = segment_steps / segment_lengths[:, None]
    ego_places = np.stack([trace.x[:, 0], trace.y[:, 0]], 1).astype(np.float64)
    start_offsets = ego_places[:, None] - segment_starts[None]
    segment_along = np.clip((start_offsets * directions).sum(-1), 0.0, segment_lengths)
    nearest_segment = np.hypot(*np.moveaxis(start_offsets - segment_along[..., None] * directions, -1, 0)).argmin(1)
    step_numbers = np.arange(len(ego_places))
    chosen_offset = start_offsets[step_numbers, nearest_segment]
    direction = directions[nearest_segment]
    deviation = direction[:, 0] * chosen_offset[:, 1] - direction[:, 1] * chosen_offset[:, 0]
    route_yaw = np.arctan2(direction[:, 1], direction[:, 0])
    heading = np.asarray(wrap_angle(trace.yaw[:, 0].astype(np.float64) - route_yaw), np.float64)
    return PositionInLane(
        deviation,
        heading,
        arc_lengths[nearest_segment] + segment_along[step_numbers, nearest_segment],
        _widths(graph, segment_starts)[nearest_segment],
    )


def _widths(graph: LaneGraph, points: F64) -> F64:
    """Return the width of the driving lane at each of some points of a route [N], m."""
    is_driving = np.repeat(graph.kind == LaneType.DRIVING, np.diff(graph.offset))
    lane_points, widths = graph.xy[is_driving].astype(np.float64), graph.width[is_driving].astype(np.float64)
    is_near = np.hypot(*(lane_points - points.mean(0)).T) < np.hypot(*(points - points.mean(0)).T).max() + 20.0
    lane_points, widths = lane_points[is_near], widths[is_near]
    nearest = [int(np.square(lane_points - point).sum(1).argmin()) for point in points]
    return np.asarray(widths[nearest], np.float64)


def is_outside(position: PositionInLane, length: float, width: float) -> Bool:
    """Return whether the ego's body crosses a line of its lane at each step [T].

    Args:
        position: Position in the lane.
        length: Length of the ego, m.
        width: Width of the ego, m.
    """
    half = 0.5 * (width * np.abs(np.cos(position.heading)) + length * np.abs(np.sin(position.heading)))
    return np.asarray(np.abs(position.deviation) + half > 0.5 * position.width)


def lane_metrics(
    trace: EpisodeTrace,
    graph: LaneGraph,
    lanes: Sequence[tuple[float, PerceivedLane | None]],
    *,
    place: float | None = None,
    view: float = 0.0,
) -> dict[str, float]:
    """Return the metrics of lane keeping of a drive.

    Args:
        trace: The drive.
        graph: Its town.
        lanes: Time, s, and the lane that the driver believed in, of its steps.
        place: Distance along the route to the perturbation, m; None without one.
        view: Distance before that place at which it comes into view, m.

    Returns:
        lane_deviation: Mean distance to the middle of the lane, m.
        lane_deviation_max: Greatest distance from when the place comes into view, m.
        lane_departure: 1 if the body crosses a line of the lane after that, else 0.
        departure_time: s from when the place comes into view to the first crossing after it; NaN without one.
        lane_error: Mean error of the believed middle of the lane beside the ego, m; NaN if it believed in none.
        lane_detection_rate: Share of the steps in which it detected the lane.
        The greatest distance and the departure are NaN if the drive ends before the place comes into view.
    """
    position = lane_position(trace, graph)
    outside = is_outside(position, float(trace.length[0]), float(trace.width[0]))
    in_view = position.along >= (-np.inf if place is None else place - view)
    start = int(in_view.argmax()) if in_view.any() else len(in_view)
    crossings = np.flatnonzero(outside[start:])
    metrics = {
        "lane_deviation": float(np.abs(position.deviation).mean()),
        "lane_deviation_max": float(np.abs(position.deviation[start:]).max(initial=0.0)) if in_view.any() else np.nan,
        "lane_departure": float(len(crossings) > 0) if in_view.any() else np.nan,
        "departure_time": float(crossings[0]) * trace.dt if len(crossings) else float("nan"),
    }
    lane_errors, detected_count = [], 0
    for lane_time, perceived_lane in lanes:
        nearest_step = min(round(lane_time / trace.dt), len(position.deviation) - 1)
        if perceived_lane is not None:
            # The middle of the lane lies as far to the right as the ego lies to the left of it.
            lane_errors.append(
                abs(perceived_lane.offset * np.cos(position.heading[nearest_step]) + position.deviation[nearest_step])
            )
            detected_count += perceived_lane.confidence >= LANE_CONFIDENCE
    metrics["lane_error"] = float(np.mean(lane_errors)) if lane_errors else float("nan")
    metrics["lane_detection_rate"] = detected_count / max(len(lanes), 1)
    return metrics


def lane_course(trace: EpisodeTrace, graph: LaneGraph, *, spacing: float = 2.0) -> dict[str, list[float]]:
    """Return the deviation from the middle of the lane along a drive, for figures.

    Args:
        trace: The drive.
        graph: Its town.
        spacing: m of the route from one value to the next.

    Returns:
        along: Distance along the route, m.
        deviation: m to the left of the middle of the lane, there.
        margin: Distance of the body from each line in the middle of the lane, m, there.
    """
    position = lane_position(trace, graph)
    furthest = np.maximum.accumulate(position.along)
    along = np.arange(furthest[0], furthest[-1] + 1e-9, spacing)
    steps = np.searchsorted(furthest, along).clip(0, len(furthest) - 1)
    margin = 0.5 * (position.width[steps] - float(trace.width[0]))
    return {
        "along": [round(float(value), 2) for value in along],
        "deviation": [round(float(value), 3) for value in position.deviation[steps]],
        "margin": [round(float(value), 3) for value in margin],
    }
