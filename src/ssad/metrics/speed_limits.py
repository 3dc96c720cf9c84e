"""Metrics of speed limits that a driver reads from signs: errors of the reading, and speed above the posted limit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F64, EpisodeTrace, LaneType
from ssad.metrics.lane_keeping import lane_position

SETTLING: Final = 4.0  # s after the first sign, in which a driver may still change its speed
KMH: Final = 3.6  # km/h for 1 m/s


def posted_limits(trace: EpisodeTrace, graph: LaneGraph) -> F64:
    """Return the limit that signs post for the ego's lane at each step [T], km/h, rounded to 10."""
    is_driving = np.repeat(graph.kind == LaneType.DRIVING, np.diff(graph.offset))
    points = graph.xy[is_driving].astype(np.float64)
    limits = np.repeat(graph.speed_limit, np.diff(graph.offset))[is_driving].astype(np.float64)
    headings = graph.yaw[is_driving].astype(np.float64)
    posted = np.zeros(len(trace.x))
    for step, (x, y, yaw) in enumerate(np.stack([trace.x[:, 0], trace.y[:, 0], trace.yaw[:, 0]], 1).tolist()):
        # A lane in another direction does not count, however near its points are.
        distances = np.hypot(points[:, 0] - x, points[:, 1] - y) + 50.0 * (np.cos(headings - yaw) < 0.5)
        posted[step] = 10.0 * round(0.1 * KMH * limits[int(distances.argmin())])
    return posted


def limit_metrics(
    trace: EpisodeTrace, graph: LaneGraph, limits: Sequence[tuple[float, int | None]], *, first_sign: float | None
) -> dict[str, float]:
    """Return the metrics of a driver that reads speed limits.

    Args:
        trace: The drive.
        graph: Its town.
        limits: Time, s, of each step, and the limit that the driver has read by then, km/h.
        first_sign: Distance along the route to the first speed-limit sign, m; None: there is none.

    Returns:
        limit_known: Share of the steps past the first sign in which the limit that it has read is the posted one.
        limit_error: Mean absolute difference of the two there, km/h; steps without a reading do not count.
        speeding: Mean speed above the posted limit from `SETTLING` after the first sign on, km/h; slower speeds are 0.
        speeding_max: Greatest speed above it there, km/h.
        All are NaN if the drive does not reach the first sign.
    """
    names = ("limit_known", "limit_error", "speeding", "speeding_max")
    behind = np.flatnonzero(lane_position(trace, graph).along >= (np.inf if first_sign is None else first_sign))
    if not len(behind):
        return dict.fromkeys(names, float("nan"))
    start = int(behind[0])
    posted = posted_limits(trace, graph)
    readings = [
        (step, limit)
        for step, limit in ((min(round(time / trace.dt), len(posted) - 1), limit) for time, limit in limits)
        if step >= start
    ]
    errors = [abs(limit - posted[step]) for step, limit in readings if limit is not None]
    excess = np.maximum(KMH * trace.speed[:, 0].astype(np.float64) - posted, 0.0)[start + round(SETTLING / trace.dt) :]
    return {
        "limit_known": sum(limit == posted[step] for step, limit in readings) / max(len(readings), 1),
        "limit_error": float(np.mean(errors)) if errors else float("nan"),
        "speeding": float(excess.mean()) if len(excess) else float("nan"),
        "speeding_max": float(excess.max()) if len(excess) else float("nan"),
    }
