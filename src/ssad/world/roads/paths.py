"""A lane graph from the paths that vehicles have driven, where no map is at hand."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np

from ssad.core.errors import MapError
from ssad.core.lane_graph import LaneGraph, no_signals
from ssad.core.types import F64, Bool, LaneType

WIDTH: Final = 3.5  # m
STEP: Final = 1.0  # m between points of a lane
APART: Final = 0.25  # m that a path must move on to count as another point
LEAST: Final = 10.0  # m, the shortest lane
BEFORE, AFTER = 5.0, 30.0  # m that the first path goes on straight at its ends
ALIGNED: Final = np.radians(45.0)


def graph_of_paths(name: str, paths: Sequence[F64], *, speeds: Sequence[float], width: float = WIDTH) -> LaneGraph:
    """Lanes along paths.

    The first path is a lane from end to end, a little longer than it is. Of each other path, the stretches become lanes
    that no lane before it covers (half a width beside, the same way). Lanes do not join, nor is anything known about
    who has the right of way.

    Args:
        name: Of the town.
        paths: Places [N, 2] of the middles of vehicles in the order of time, m.
        speeds: Speed limit along each path, m/s.
        width: Of the lanes, m.

    Raises:
        MapError: The first path is shorter than 10 m.
    """
    lanes: list[F64] = []
    limits: list[float] = []
    for number, (path, speed) in enumerate(zip(paths, speeds, strict=True)):
        even = _even(path)
        if number == 0:
            if len(even) < LEAST / STEP:
                raise MapError(f"town '{name}': a path of less than {LEAST:g} m makes no lane")
            even = _longer(even)
        if len(even) < 2:
            continue
        free = ~_covered(even, lanes, 0.5 * width)
        edges = np.flatnonzero(np.diff(np.concatenate([[False], free, [False]]).astype(int)))
        for start, stop in edges.reshape(-1, 2).tolist():
            if stop - start > LEAST / STEP:
                lanes.append(even[start:stop])
                limits.append(speed)
    count = [len(lane) for lane in lanes]
    total, amount = sum(count), len(lanes)
    along = [np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(lane, axis=0).T))]) for lane in lanes]
    none, alone = np.zeros(0, np.int32), np.full(amount, -1, np.int32)
    return LaneGraph(
        name=name,
        xy=np.concatenate(lanes).astype(np.float32),
        z=np.zeros(total, np.float32),
        yaw=np.concatenate([_headings(lane) for lane in lanes]).astype(np.float32),
        width=np.full(total, width, np.float32),
        s=np.concatenate(along).astype(np.float32),
        offset=np.concatenate([[0], np.cumsum(count)]).astype(np.int32),
        kind=np.full(amount, LaneType.DRIVING, np.uint8),
        road=np.arange(amount, dtype=np.int32),
        section=np.zeros(amount, np.int32),
        lane_id=alone,
        junction=alone,
        speed_limit=np.array(limits, np.float32),
        left=alone,
        right=alone,
        left_marking=np.zeros(amount, np.uint8),
        right_marking=np.zeros(amount, np.uint8),
        succ_offset=np.zeros(amount + 1, np.int32),
        succ=none,
        **no_signals(),
    )


def _even(path: F64) -> F64:
    """A path with a point each `STEP`; where it stands, trembles or goes back it has none."""
    kept = [path[0]]
    ahead = np.zeros(2)
    for point in path[1:]:
        move = point - kept[-1]
        far = float(np.hypot(*move))
        if far >= APART and float(move @ ahead) >= 0.0:
            kept.append(point)
            ahead = move / far
    xy = np.array(kept, np.float64)
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(xy, axis=0).T))]) if len(xy) > 1 else np.zeros(1)
    at = np.arange(0.0, s[-1] + 1e-9, STEP)
    return np.stack([np.interp(at, s, xy[:, 0]), np.interp(at, s, xy[:, 1])], 1)


def _longer(path: F64) -> F64:
    """A path that goes on straight at its ends."""
    first, last = path[0] - path[1], path[-1] - path[-2]
    before = path[0] + np.arange(BEFORE, 0.0, -STEP)[:, None] * (first / np.hypot(*first))
    after = path[-1] + np.arange(STEP, AFTER + 1e-9, STEP)[:, None] * (last / np.hypot(*last))
    return np.concatenate([before, path, after])


def _headings(path: F64) -> F64:
    """Heading [N] of a path at its points."""
    run = np.gradient(path, axis=0)
    return np.asarray(np.unwrap(np.arctan2(run[:, 1], run[:, 0])))


def _covered(path: F64, lanes: Sequence[F64], beside: float) -> Bool:
    """Which points of a path lie at most so far (m) beside a lane that runs the same way."""
    found = np.zeros(len(path), bool)
    yaw = _headings(path)
    for lane in lanes:
        away = np.hypot(path[:, None, 0] - lane[None, :, 0], path[:, None, 1] - lane[None, :, 1])
        nearest = away.argmin(1)
        turn = np.remainder(_headings(lane)[nearest] - yaw + np.pi, 2 * np.pi) - np.pi
        found |= (away.min(1) <= beside) & (np.abs(turn) <= ALIGNED)
    return found
