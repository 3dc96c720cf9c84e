"""Centre lines of lanelets, and where they cross."""

from __future__ import annotations

import math

import numpy as np

from ssad.core.types import F64

STEP = 0.5  # m between samples of a centre line
MAX_SAMPLES = 20_001  # of a lanelet
ROUNDS = 3  # in which a sample moves to the middle of the points of the bounds that are nearest to it
TINY = 1e-9
LEVEL = 2.0  # m, most between the heights of two ways that cross


def centre_line(left: F64, right: F64, centre: F64 | None = None) -> F64:
    """Return samples of the line in the middle of two bounds, with the width there.

    The middle has the same distance from both bounds. Its ends lie between the ends of the bounds, so that lanelets
    that follow each other meet.

    Args:
        left: Points of the left bound [n, 3], m, in the direction of traffic.
        right: Points of the right bound [m, 3].
        centre: Points of a centre line [k, 3] that is given, and is sampled instead.

    Returns:
        Rows [S, 4] of x, y, z and width, m.
    """
    longest = max(_length(left), _length(right))
    count = min(max(math.ceil(longest / STEP) + 1, 5), MAX_SAMPLES)
    if centre is not None:
        middle = _sample(centre, count)
    else:
        middle = 0.5 * (_sample(left, count) + _sample(right, count))
        moved = middle[:, :2].copy()
        for _ in range(ROUNDS):
            moved[1:-1] = 0.5 * (nearest_points(moved[1:-1], left) + nearest_points(moved[1:-1], right))
        steps, moved_steps = np.diff(middle[:, :2], axis=0), np.diff(moved, axis=0)
        # Where a bound doubles back, the nearest point can jump; the simple middle is then kept.
        if ((steps * moved_steps).sum(1) > 0.0).all():
            middle[:, :2] = moved
    width = sum(np.hypot(*(middle[:, :2] - nearest_points(middle[:, :2], side)).T) for side in (left, right))
    return np.column_stack([middle, width])


def crossing(first: F64, second: F64) -> bool:
    """Return whether two lines [., 3] cross away from their ends, at about the same height."""
    starts, steps = first[:-1, :2], np.diff(first[:, :2], axis=0)
    others, other_steps = second[:-1, :2], np.diff(second[:, :2], axis=0)
    offset = others[None] - starts[:, None]
    determinant = steps[:, None, 0] * other_steps[None, :, 1] - steps[:, None, 1] * other_steps[None, :, 0]
    is_parallel = np.abs(determinant) < TINY
    safe = np.where(is_parallel, 1.0, determinant)
    along = (offset[..., 0] * other_steps[None, :, 1] - offset[..., 1] * other_steps[None, :, 0]) / safe
    across = (offset[..., 0] * steps[:, None, 1] - offset[..., 1] * steps[:, None, 0]) / safe
    meets = ~is_parallel & (along >= 0.0) & (along <= 1.0) & (across >= 0.0) & (across <= 1.0)
    rows, columns = np.nonzero(meets)
    if not len(rows):
        return False
    t, u = along[rows, columns], across[rows, columns]
    points = starts[rows] + t[:, None] * steps[rows]
    ends = np.stack([first[0, :2], first[-1, :2], second[0, :2], second[-1, :2]])
    inside = np.hypot(*np.moveaxis(points[:, None] - ends[None], -1, 0)).min(1) > STEP
    height = first[rows, 2] + t * np.diff(first[:, 2])[rows]
    other_height = second[columns, 2] + u * np.diff(second[:, 2])[columns]
    return bool((inside & (np.abs(height - other_height) < LEVEL)).any())


def position_across(line: F64, points: F64, reach: float) -> float | None:
    """Return the distance along a line [., 2] at which a stop line of points [n, 2] lies; None beyond a reach, m."""
    steps = np.hypot(*np.diff(line, axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(steps)])
    middle = points.mean(axis=0)
    nearest, distance = _projection(line, middle[None])
    row, fraction = int(nearest[0]), float(distance[0])
    place = line[row] + fraction * (line[row + 1] - line[row])
    return float(along[row] + fraction * steps[row]) if math.dist(place, middle) <= reach else None


def _sample(line: F64, count: int) -> F64:
    """Return points at equal distances along a line."""
    along = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line[:, :2], axis=0).T))])
    places = np.linspace(0.0, along[-1], count)
    return np.stack([np.interp(places, along, line[:, axis]) for axis in range(3)], axis=1)


def nearest_points(points: F64, line: F64) -> F64:
    """Return the points [N, 2] of a line [., 2] or [., 3] that are nearest to points [N, 2]."""
    rows, fractions = _projection(line[:, :2], points)
    return line[rows, :2] + fractions[:, None] * (line[rows + 1, :2] - line[rows, :2])


def _projection(line: F64, points: F64) -> tuple[F64, F64]:
    """Return the segment of a line that is nearest to each point, and the fraction along it."""
    starts, steps = line[:-1], np.diff(line, axis=0)
    squared = np.maximum((steps**2).sum(1), TINY**2)
    rows, fractions = [np.zeros(0, np.int64)], [np.zeros(0)]
    chunk = max(1, 200_000 // len(starts))  # bounds the memory
    for begin in range(0, len(points), chunk):
        offset = points[begin : begin + chunk, None] - starts[None]
        fraction = np.clip((offset * steps[None]).sum(2) / squared, 0.0, 1.0)
        gap = ((offset - fraction[..., None] * steps[None]) ** 2).sum(2)
        best = gap.argmin(1)
        rows.append(best)
        fractions.append(fraction[np.arange(len(best)), best])
    return np.concatenate(rows), np.concatenate(fractions)


def _length(line: F64) -> float:
    return float(np.hypot(*np.diff(line[:, :2], axis=0).T).sum())
