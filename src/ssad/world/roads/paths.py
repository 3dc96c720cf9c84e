"""Lane graphs from driven paths of vehicles, for places without a map."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from ssad.core.errors import MapError
from ssad.core.lane_graph import LaneGraph, empty_signal_arrays
from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, Bool, LaneType

WIDTH: Final = 3.5  # m
STEP: Final = 1.0  # m between points of a lane
MAX_LENGTH: Final = 1e5  # m of a path
APART: Final = 0.25  # m that a path must move on to count as another point
LEAST: Final = 10.0  # m, the shortest lane
BEFORE, AFTER = 5.0, 30.0  # m that the first path goes on straight at its ends
ALIGNED: Final = np.radians(45.0)


def graph_of_paths(name: str, paths: Sequence[F64], *, speeds: Sequence[float], width: float = WIDTH) -> LaneGraph:
    """Return a lane graph with lanes along paths.

    The first path becomes a lane from end to end, slightly extended. Of each other path, the stretches become lanes
    that no earlier lane covers (within half a width, in the same direction). Lanes do not join, and there are no
    priority rules.

    Args:
        name: Of the town.
        paths: Positions [N, 2] of the middles of vehicles in the order of time, m.
        speeds: Speed limit along each path, m/s.
        width: Of the lanes, m.

    Raises:
        MapError: The first path is shorter than 10 m, or a path is longer than 100 km.
    """
    lanes: list[F64] = []
    limits: list[float] = []
    for number, (path, speed) in enumerate(zip(paths, speeds, strict=True)):
        resampled = _resample(path)
        if number == 0:
            if len(resampled) < LEAST / STEP:
                raise MapError(f"town '{name}': a path of less than {LEAST:g} m makes no lane")
            resampled = _extend(resampled)
        if len(resampled) < 2:
            continue
        uncovered = ~_covered_points(resampled, lanes, 0.5 * width)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], uncovered, [False]]).astype(int)))
        for first_index, last_index in edges.reshape(-1, 2).tolist():
            if last_index - first_index > LEAST / STEP:
                lanes.append(resampled[first_index:last_index])
                limits.append(speed)
    point_counts = [len(lane) for lane in lanes]
    point_count, lane_count = sum(point_counts), len(lanes)
    arc_lengths = [np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(lane, axis=0).T))]) for lane in lanes]
    no_links, no_lane = np.zeros(0, np.int32), np.full(lane_count, -1, np.int32)
    return LaneGraph(
        name=name,
        xy=np.concatenate(lanes).astype(np.float32),
        z=np.zeros(point_count, np.float32),
        yaw=np.concatenate([_headings(lane) for lane in lanes]).astype(np.float32),
        width=np.full(point_count, width, np.float32),
        s=np.concatenate(arc_lengths).astype(np.float32),
        offset=np.concatenate([[0], np.cumsum(point_counts)]).astype(np.int32),
        kind=np.full(lane_count, LaneType.DRIVING, np.uint8),
        road=np.arange(lane_count, dtype=np.int32),
        section=np.zeros(lane_count, np.int32),
        lane_id=no_lane,
        junction=no_lane,
        speed_limit=np.array(limits, np.float32),
        left=no_lane,
        right=no_lane,
        left_marking=np.zeros(lane_count, np.uint8),
        right_marking=np.zeros(lane_count, np.uint8),
        succ_offset=np.zeros(lane_count + 1, np.int32),
        succ=no_links,
        **empty_signal_arrays(),
    )


def _resample(path: F64) -> F64:
    """Return a path with a point every `STEP` m, without standstill, jitter and steps back."""
    points = [path[0]]
    direction = np.zeros(2)
    for point in path[1:]:
        move = point - points[-1]
        distance = float(np.hypot(*move))
        # A move against the last direction is jitter or reversing, not progress along the path.
        if distance >= APART and float(move @ direction) >= 0.0:
            points.append(point)
            direction = move / distance
    xy = np.array(points, np.float64)
    arc_length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))]) if len(xy) > 1 else np.zeros(1)
    if not arc_length[-1] <= MAX_LENGTH:
        raise MapError(
            f"a driven path is {arc_length[-1] / 1000:.3g} km long; at most {MAX_LENGTH / 1000:g} km become a lane"
        )
    positions = np.arange(0.0, arc_length[-1] + 1e-9, STEP)
    return np.stack([np.interp(positions, arc_length, xy[:, 0]), np.interp(positions, arc_length, xy[:, 1])], 1)


def _extend(path: F64) -> F64:
    """Extend a path straight at its ends."""
    first, last = path[0] - path[1], path[-1] - path[-2]
    before = path[0] + np.arange(BEFORE, 0.0, -STEP)[:, None] * (first / np.hypot(*first))
    after = path[-1] + np.arange(STEP, AFTER + 1e-9, STEP)[:, None] * (last / np.hypot(*last))
    return np.concatenate([before, path, after])


def _headings(path: F64) -> F64:
    """Return the headings [N] of a path at its points."""
    steps = np.gradient(path, axis=0)
    return np.asarray(np.unwrap(np.arctan2(steps[:, 1], steps[:, 0])))


def _covered_points(path: F64, lanes: Sequence[F64], beside: float) -> Bool:
    """Return the points of a path that lie within `beside` m of a lane in the same direction."""
    covered = np.zeros(len(path), bool)
    yaw = _headings(path)
    for lane in lanes:
        distance = np.hypot(path[:, None, 0] - lane[None, :, 0], path[:, None, 1] - lane[None, :, 1])
        nearest = distance.argmin(1)
        heading_difference = wrap_angle(_headings(lane)[nearest] - yaw)
        covered |= (distance.min(1) <= beside) & (np.abs(heading_difference) <= ALIGNED)
    return covered
