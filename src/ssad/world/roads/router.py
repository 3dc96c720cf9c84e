"""Routes through a lane graph: shortest by length with a price on lane changes, sampled evenly, changes smoothed."""

from __future__ import annotations

import heapq
import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ssad.core.errors import RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F64, I32, LaneType, Pose, Route
from ssad.world.roads.query import nearest_all

CHANGE = 20.0  # m of road that a lane change takes
CHANGE_COST = 15.0  # m of detour that one lane change is worth
HASTE = 10.0  # m of detour that each metre is worth by which a lane change is shorter than CHANGE
LEAST_CHANGE = 10.0  # m; no change is made in less
BESIDE_COST = 25.0  # m of detour for passing an inner key point one lane aside
SNAP = 4.0  # m from a lane's edge at which a key point still belongs to it
_SLACK = 1.5  # m further than the nearest lane at which another lane is still a candidate for a key point
_TURNED = np.radians(75.0)  # a key point with a heading lies on lanes that run within this of it
_WRONG_WAY = 1000.0


@dataclass(frozen=True)
class _Spot:
    """A place on a lane, and what it costs to take it for a key point."""

    lane: int
    s: float
    cost: float = 0.0


@dataclass(frozen=True)
class _Leg:
    """A stretch of lanes that follow one another.

    Attributes:
        parts: Lane, s0 and s1 of each.
        old: Lane beside this stretch, and the place on it, from which the path changes lanes while it drives this
            stretch.
    """

    parts: tuple[tuple[int, float, float], ...]
    old: tuple[int, float] | None = None


def route_along(graph: LaneGraph, keypoints: Sequence[Pose | tuple[float, float]], *, spacing: float = 1.0) -> Route:
    """The shortest drive through key points, in their order, along lanes and lane changes.

    The ends are the projections of the first and last key point; one between them may be passed in the lane beside it.

    Args:
        graph: The town.
        keypoints: Two or more. A `Pose` selects among lanes that run in its direction, a bare (x, y) only by distance.
        spacing: Distance between two points of the route, m.

    Raises:
        RouteError: There are too few points, one is off the road, or no way leads from one to the next.
    """
    if len(keypoints) < 2:
        raise RouteError(f"town '{graph.name}': a route needs at least two key points, not {len(keypoints)}")
    last = len(keypoints) - 1
    stages = [_candidates(graph, k, point, inner=0 < k < last) for k, point in enumerate(keypoints)]
    best: list[tuple[float, _Spot, list[_Leg]]] = [(spot.cost, spot, []) for spot in stages[0]]
    for k in range(1, len(stages)):
        here: list[tuple[float, _Spot, list[_Leg]]] = []
        for spot in stages[k]:
            found = _search(graph, [(cost, start) for cost, start, _ in best], spot)
            if found is not None:
                cost, begin, legs = found
                here.append((cost + spot.cost, spot, best[begin][2] + legs))
        if not here:
            (xa, ya), (xb, yb) = _xy(keypoints[k - 1]), _xy(keypoints[k])
            raise RouteError(
                f"town '{graph.name}': no way along the lanes from key point {k - 1} ({xa:.1f}, {ya:.1f}) to "
                f"{k} ({xb:.1f}, {yb:.1f}); move one of them or add a key point between"
            )
        best = here
    return _draw(graph, min(best, key=lambda item: item[0])[2], spacing)


def random_route(graph: LaneGraph, lane: int, s: float, length: float, rng: np.random.Generator) -> Route:
    """A drive that takes a random driving successor at the end of every lane.

    Args:
        graph: The town.
        lane: Lane that it starts on.
        s: Arc length on that lane, m.
        length: Length of the drive, m; it ends early where the road does.
        rng: Source of randomness.

    Raises:
        RouteError: Nothing of the road is left.
    """
    legs, rest = [], length
    while True:
        end = min(s + rest, float(graph.length[lane]))
        legs.append(_Leg(((lane, s, end),)))
        rest -= end - s
        after = [int(n) for n in graph.successors(lane) if graph.kind[n] == LaneType.DRIVING]
        if rest <= 1e-6 or not after:
            break
        lane, s = after[int(rng.integers(len(after)))], 0.0
    return _draw(graph, legs, 1.0)


def _xy(point: Pose | tuple[float, float]) -> tuple[float, float]:
    return (point.x, point.y) if isinstance(point, Pose) else (float(point[0]), float(point[1]))


def _candidates(graph: LaneGraph, k: int, point: Pose | tuple[float, float], *, inner: bool) -> list[_Spot]:
    """Driving lanes on which a key point may lie, dearer the further off."""
    x, y = _xy(point)
    if not np.isfinite([x, y]).all():
        raise RouteError(f"town '{graph.name}': key point {k} ({x}, {y}) is not finite")
    lane, s, gap = nearest_all(graph, (x, y), (LaneType.DRIVING,))
    near = np.flatnonzero(gap <= min(SNAP, max(float(gap.min()), 0.0) + _SLACK))
    if not len(near):
        raise RouteError(
            f"town '{graph.name}': key point {k} ({x:.1f}, {y:.1f}) is {float(gap.min()):.1f} m from the road; "
            "move it onto a driving lane"
        )
    spots = []
    for i in near:
        _, _, yaw, width = graph.at(int(lane[i]), float(s[i]))
        off = abs(math.remainder(yaw - point.yaw, math.tau)) if isinstance(point, Pose) else 0.0
        # a place near the middle of a lane that runs the right way is what the author meant
        price = 20.0 * max(float(gap[i]) + 0.5 * width, 0.0) + (30.0 * off if off < _TURNED else _WRONG_WAY)
        spots.append(_Spot(int(lane[i]), float(s[i]), price))
    spots = [spot for spot in spots if spot.cost < _WRONG_WAY] or spots
    spots = sorted(spots, key=lambda spot: spot.cost)[:6]
    if inner:
        known = {spot.lane for spot in spots}
        for spot in spots[:2]:
            for other in _beside(graph, spot.lane):
                if other not in known:
                    known.add(other)
                    spots.append(_Spot(other, _across(graph, spot.lane, spot.s, other), spot.cost + BESIDE_COST))
    return spots


def _beside(graph: LaneGraph, lane: int) -> list[int]:
    """Driving lanes to which traffic on a lane may change: neighbours of the same direction, outside junctions."""
    if graph.junction[lane] >= 0:
        return []
    return [
        other
        for other in (int(graph.left[lane]), int(graph.right[lane]))
        if other >= 0 and graph.kind[other] == LaneType.DRIVING and graph.same_direction(lane, other)
    ]


def _across(graph: LaneGraph, lane: int, s: float, other: int) -> float:
    """Arc length on the lane beside, level with s."""
    x, y, _, _ = graph.at(lane, s)
    part = graph.points(other)
    xy = graph.xy[part].astype(np.float64)
    d, p = np.diff(xy, axis=0), np.array([x, y]) - xy[:-1]
    length = np.hypot(d[:, 0], d[:, 1])
    t = np.clip((p * d).sum(axis=1) / length**2, 0.0, 1.0)
    rest = p - t[:, None] * d
    k = int(np.hypot(rest[:, 0], rest[:, 1]).argmin())
    return float(graph.s[part.start + k] + t[k] * length[k])


def _after(graph: LaneGraph, lane: int) -> list[int]:
    return [n for n in graph.successors(lane).tolist() if graph.kind[n] == LaneType.DRIVING]


def _ahead(graph: LaneGraph, lane: int, s: float, distance: float) -> list[tuple[int, float, float]]:
    """Up to `distance` m from s on along a lane and the lanes that follow it, not into a junction or a fork."""
    parts = []
    while True:
        end = min(float(graph.length[lane]), s + distance)
        parts.append((lane, s, end))
        distance -= end - s
        after = _after(graph, lane)
        if distance <= 1e-6 or len(after) != 1 or graph.junction[after[0]] >= 0:
            return parts
        lane, s = after[0], 0.0


def _search(graph: LaneGraph, starts: list[tuple[float, _Spot]], goal: _Spot) -> tuple[float, int, list[_Leg]] | None:
    """Dijkstra from several spots to one: cost, which start, and the legs of the way.

    A node is a lane entered at some arc length. A lane is settled at most twice: entered at its start, and further
    on by a lane change (or as a start), since what lies behind that place can then not be reached.
    """
    count = itertools.count()  # ties go to what was found first, so that the answer never varies
    queue: list[tuple[float, int, int, float, int, int, _Leg | None]] = [
        (cost, next(count), spot.lane, spot.s, i, -1, None) for i, (cost, spot) in enumerate(starts)
    ]
    heapq.heapify(queue)
    nodes: list[tuple[int, _Leg | None]] = []  # parent, leg that led here
    settled: set[tuple[int, bool]] = set()
    while queue:
        cost, _, lane, s, start, parent, leg = heapq.heappop(queue)
        if lane >= 0 and parent >= 0 and (lane, s > 0.5) in settled:
            continue
        settled.add((lane, s > 0.5))
        node = len(nodes)
        nodes.append((parent, leg))
        if lane < 0:
            legs = []
            while node >= 0:
                node, leg = nodes[node]
                if leg is not None:
                    legs.append(leg)
            return cost, start, legs[::-1]

        def push(
            price: float, to: int, at: float, way: _Leg, *, base: float = cost, first: int = start, come: int = node
        ) -> None:
            heapq.heappush(queue, (base + price, next(count), to, at, first, come, way))

        if lane == goal.lane and goal.s >= s - 1e-6:
            push(goal.s - s, -1, goal.s, _Leg(((lane, s, max(goal.s, s)),)))
        end = float(graph.length[lane])
        for after in _after(graph, lane):
            push(end - s, after, 0.0, _Leg(((lane, s, end),)))
        for other in _beside(graph, lane):
            parts = _ahead(graph, other, _across(graph, lane, s, other), CHANGE)
            room = 0.0
            for k, (to, a, b) in enumerate(parts):
                if to == goal.lane and a <= goal.s <= b and room + goal.s - a >= LEAST_CHANGE:
                    span = room + goal.s - a
                    way = _Leg((*parts[:k], (to, a, goal.s)), (lane, s))
                    push(span + CHANGE_COST + HASTE * (CHANGE - span), -1, goal.s, way)
                room += b - a
            if room >= LEAST_CHANGE:
                price = room + CHANGE_COST + HASTE * (CHANGE - room)
                push(price, parts[-1][0], parts[-1][2], _Leg(tuple(parts), (lane, s)))
    return None


def _line(graph: LaneGraph, leg: _Leg, step: float = math.inf) -> tuple[F64, I32]:
    """Rows [n, 6] (x, y, cos, sin, speed limit, width) along a leg's lanes, at most `step` m apart; lanes [n]."""
    rows = [_part(graph, part, step) for part in leg.parts]
    lanes = [np.full(len(drawn), part[0], np.int32) for drawn, part in zip(rows, leg.parts, strict=True)]
    return np.concatenate(rows), np.concatenate(lanes)


def _part(graph: LaneGraph, part: tuple[int, float, float], step: float) -> F64:
    """The rows of `_line` for one lane; those of a whole lane are kept, since most routes of a town have it."""
    lane, s0, s1 = part
    whole = math.isinf(step) and s0 == 0.0 and s1 == float(graph.length[lane])
    if whole and lane in graph.kept:
        found: F64 = graph.kept[lane]
        return found
    inner = graph.s[graph.points(lane)].astype(np.float64) if math.isinf(step) else np.arange(s0, s1, step)
    inner = inner[(inner > s0 + 0.02) & (inner < s1 - 0.02)]
    limit = float(graph.speed_limit[lane])
    places = graph.along(lane, [s0, *inner.tolist(), s1]).tolist()
    rows = np.array([(x, y, math.cos(yaw), math.sin(yaw), limit, width) for x, y, yaw, width in places], np.float64)
    if whole:
        rows.setflags(write=False)
        graph.kept[lane] = rows
    return rows


def _change(graph: LaneGraph, leg: _Leg, old: tuple[int, float]) -> tuple[F64, I32]:
    """Rows and lanes of a lane change: the new lanes, and an offset that fades as a quintic (no jerk at its ends)."""
    rows, lanes = _line(graph, leg, 0.5)
    x, y, _, _ = graph.at(*old)
    side = -(x - rows[0, 0]) * rows[0, 3] + (y - rows[0, 1]) * rows[0, 2]
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(rows[:, :2], axis=0).T))])
    t = s / s[-1]
    fade = side * (1.0 - t**3 * (10.0 - 15.0 * t + 6.0 * t * t))
    slope = -side * 30.0 * t * t * (1.0 - t) ** 2 / s[-1]
    rows[:, 0] -= fade * rows[:, 3]
    rows[:, 1] += fade * rows[:, 2]
    yaw = np.arctan2(rows[:, 3], rows[:, 2]) + np.arctan(slope)
    rows[:, 2], rows[:, 3] = np.cos(yaw), np.sin(yaw)
    still = (t < 0.5) & (s < float(graph.length[old[0]]) - old[1])
    return rows, np.where(still, old[0], lanes).astype(np.int32)


def _draw(graph: LaneGraph, legs: list[_Leg], spacing: float) -> Route:
    """A Route every `spacing` m along the legs; its last point is the last whole step."""
    drawn = [_line(graph, leg) if leg.old is None else _change(graph, leg, leg.old) for leg in legs]
    rows = np.concatenate([part for part, _ in drawn])
    lanes = np.concatenate([part for _, part in drawn])
    new = np.concatenate([[True], np.hypot(*np.diff(rows[:, :2], axis=0).T) > 1e-3])
    rows, lanes = rows[new], lanes[new]
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(rows[:, :2], axis=0).T))])
    at = spacing * np.arange(int(np.floor(s[-1] / spacing + 1e-3)) + 1)
    if len(at) < 2:
        raise RouteError(
            f"town '{graph.name}': the route has no length ({s[-1]:.1f} m from ({rows[0, 0]:.1f}, "
            f"{rows[0, 1]:.1f})); set its key points further apart"
        )
    column = [np.interp(at, s, rows[:, k]) for k in range(6)]
    owner = np.clip(np.searchsorted(s, at, side="right") - 1, 0, len(s) - 1)
    return Route(
        xy=np.stack(column[:2], axis=1).astype(np.float32),
        yaw=np.arctan2(column[3], column[2]).astype(np.float32),
        lane=lanes[owner],
        speed_limit=rows[owner, 4].astype(np.float32),
        width=column[5].astype(np.float32),
        spacing=spacing,
    )
