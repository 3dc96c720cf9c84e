"""Routes through a lane graph: shortest paths with penalised lane changes, sampled evenly, with smooth changes."""

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
LEAST_CHANGE = 10.0  # m; shorter lane changes are not made
BESIDE_COST = 25.0  # m of detour for passing an inner key point one lane aside
SNAP = 4.0  # m from a lane's edge at which a key point still belongs to it
_SLACK = 1.5  # m further than the nearest lane at which another lane is still a candidate for a key point
_TURNED = np.radians(75.0)  # a key point with a heading lies on lanes that run within this of it
_WRONG_WAY = 1000.0


@dataclass(frozen=True)
class _Spot:
    """Place on a lane, and the cost of using it for a key point."""

    lane: int
    s: float
    cost: float = 0.0


@dataclass(frozen=True)
class _Leg:
    """Stretch of consecutive lanes.

    Attributes:
        parts: Lane, s0 and s1 of each.
        previous_lane: Lane beside this stretch, and the place on it, from which the path changes lanes here;
            None: the path keeps its lane.
    """

    parts: tuple[tuple[int, float, float], ...]
    previous_lane: tuple[int, float] | None = None


def route_along(graph: LaneGraph, keypoints: Sequence[Pose | tuple[float, float]], *, spacing: float = 1.0) -> Route:
    """Return the shortest route through key points, in their order, along lanes and lane changes.

    The ends are the projections of the first and last key point; one between them may be passed in an adjacent lane.

    Args:
        graph: The town.
        keypoints: Two or more. A `Pose` selects among lanes that run in its direction, a bare (x, y) only by
            distance.
        spacing: Distance between two points of the route, m.

    Raises:
        RouteError: There are too few points, one is off the road, or no path leads from one to the next.
    """
    if len(keypoints) < 2:
        raise RouteError(f"town '{graph.name}': a route needs at least two key points, not {len(keypoints)}")
    last = len(keypoints) - 1
    stages = [_candidates(graph, index, point, inner=0 < index < last) for index, point in enumerate(keypoints)]
    # Dynamic programming over the key points: the best path to every candidate of a stage.
    best: list[tuple[float, _Spot, list[_Leg]]] = [(spot.cost, spot, []) for spot in stages[0]]
    for index in range(1, len(stages)):
        reached: list[tuple[float, _Spot, list[_Leg]]] = []
        for spot in stages[index]:
            path = _search(graph, [(cost, start) for cost, start, _ in best], spot)
            if path is not None:
                cost, start_index, legs = path
                reached.append((cost + spot.cost, spot, best[start_index][2] + legs))
        if not reached:
            (x0, y0), (x1, y1) = _xy(keypoints[index - 1]), _xy(keypoints[index])
            raise RouteError(
                f"town '{graph.name}': no way along the lanes from key point {index - 1} ({x0:.1f}, {y0:.1f}) to "
                f"{index} ({x1:.1f}, {y1:.1f}); move one of them or add a key point between"
            )
        best = reached
    return _draw(graph, min(best, key=lambda candidate: candidate[0])[2], spacing)


def random_route(graph: LaneGraph, lane: int, s: float, length: float, random_generator: np.random.Generator) -> Route:
    """Return a route that takes a random driving successor at the end of every lane.

    Args:
        graph: The town.
        lane: Lane that it starts on.
        s: Arc length on that lane, m.
        length: Length of the route, m; it ends early where the road does.
        random_generator: Source of randomness.

    Raises:
        RouteError: The road ends at the start.
    """
    legs, remaining = [], length
    while True:
        lane_end = min(s + remaining, float(graph.length[lane]))
        legs.append(_Leg(((lane, s, lane_end),)))
        remaining -= lane_end - s
        successors = [
            int(successor) for successor in graph.successors(lane) if graph.kind[successor] == LaneType.DRIVING
        ]
        if remaining <= 1e-6 or not successors:
            break
        lane, s = successors[int(random_generator.integers(len(successors)))], 0.0
    return _draw(graph, legs, 1.0)


def _xy(point: Pose | tuple[float, float]) -> tuple[float, float]:
    return (point.x, point.y) if isinstance(point, Pose) else (float(point[0]), float(point[1]))


def _candidates(graph: LaneGraph, k: int, point: Pose | tuple[float, float], *, inner: bool) -> list[_Spot]:
    """Driving lanes on which a key point may lie, dearer the further off."""
    x, y = _xy(point)
    if not np.isfinite([x, y]).all():
        raise RouteError(f"town '{graph.name}': key point {k} ({x}, {y}) is not finite")
    lane, s, gap = nearest_all(graph, (x, y), (LaneType.DRIVING,))
    candidate_rows = np.flatnonzero(gap <= min(SNAP, max(float(gap.min()), 0.0) + _SLACK))
    if not len(candidate_rows):
        raise RouteError(
            f"town '{graph.name}': key point {k} ({x:.1f}, {y:.1f}) is {float(gap.min()):.1f} m from the road; "
            "move it onto a driving lane"
        )
    spots = []
    for row in candidate_rows:
        _, _, yaw, width = graph.at(int(lane[row]), float(s[row]))
        heading_error = abs(math.remainder(yaw - point.yaw, math.tau)) if isinstance(point, Pose) else 0.0
        # The author most likely means a place near the middle of a lane that runs in the right direction.
        cost = 20.0 * max(float(gap[row]) + 0.5 * width, 0.0) + (
            30.0 * heading_error if heading_error < _TURNED else _WRONG_WAY
        )
        spots.append(_Spot(int(lane[row]), float(s[row]), cost))
    spots = [spot for spot in spots if spot.cost < _WRONG_WAY] or spots
    spots = sorted(spots, key=lambda spot: spot.cost)[:6]
    if inner:
        used_lanes = {spot.lane for spot in spots}
        for spot in spots[:2]:
            for neighbour in _adjacent_lanes(graph, spot.lane):
                if neighbour not in used_lanes:
                    used_lanes.add(neighbour)
                    spots.append(
                        _Spot(neighbour, _level_position(graph, spot.lane, spot.s, neighbour), spot.cost + BESIDE_COST)
                    )
    return spots


def _adjacent_lanes(graph: LaneGraph, lane: int) -> list[int]:
    """Return the driving lanes for a lane change: neighbours of the same direction, outside junctions."""
    if graph.junction[lane] >= 0:
        return []
    return [
        neighbour
        for neighbour in (int(graph.left[lane]), int(graph.right[lane]))
        if neighbour >= 0 and graph.kind[neighbour] == LaneType.DRIVING and graph.is_same_direction(lane, neighbour)
    ]


def _level_position(graph: LaneGraph, lane: int, s: float, adjacent_lane: int) -> float:
    """Return the arc length on the adjacent lane, level with s."""
    x, y, _, _ = graph.at(lane, s)
    span = graph.points(adjacent_lane)
    xy = graph.xy[span].astype(np.float64)
    segments, offsets = np.diff(xy, axis=0), np.array([x, y]) - xy[:-1]
    length = np.hypot(segments[:, 0], segments[:, 1])
    share = np.clip((offsets * segments).sum(axis=1) / length**2, 0.0, 1.0)
    residual = offsets - share[:, None] * segments
    nearest = int(np.hypot(residual[:, 0], residual[:, 1]).argmin())
    return float(graph.s[span.start + nearest] + share[nearest] * length[nearest])


def _successors(graph: LaneGraph, lane: int) -> list[int]:
    return [successor for successor in graph.successors(lane).tolist() if graph.kind[successor] == LaneType.DRIVING]


def _ahead(graph: LaneGraph, lane: int, s: float, distance: float) -> list[tuple[int, float, float]]:
    """Return up to `distance` m from s on along a lane and its successors, not into a junction or a fork."""
    parts = []
    while True:
        lane_end = min(float(graph.length[lane]), s + distance)
        parts.append((lane, s, lane_end))
        distance -= lane_end - s
        successors = _successors(graph, lane)
        if distance <= 1e-6 or len(successors) != 1 or graph.junction[successors[0]] >= 0:
            return parts
        lane, s = successors[0], 0.0


def _search(graph: LaneGraph, starts: list[tuple[float, _Spot]], goal: _Spot) -> tuple[float, int, list[_Leg]] | None:
    """Run Dijkstra from several spots to one; return the cost, the index of the start, and the legs of the path.

    A node is a lane entered at some arc length. A lane is settled at most twice: entered at its start, and further
    on by a lane change (or as a start), since what lies behind that place can then not be reached.
    """
    counter = itertools.count()  # Ties go to the entry pushed first, so that the result is deterministic.
    queue: list[tuple[float, int, int, float, int, int, _Leg | None]] = [
        (cost, next(counter), spot.lane, spot.s, index, -1, None) for index, (cost, spot) in enumerate(starts)
    ]
    heapq.heapify(queue)
    nodes: list[tuple[int, _Leg | None]] = []  # parent, leg that led here
    settled: set[tuple[int, bool]] = set()
    while queue:
        cost, _, lane, s, start, parent, leg = heapq.heappop(queue)
        # A negative lane marks the goal, which may be reached from several lanes.
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
            heapq.heappush(queue, (base + price, next(counter), to, at, first, come, way))

        if lane == goal.lane and goal.s >= s - 1e-6:
            push(goal.s - s, -1, goal.s, _Leg(((lane, s, max(goal.s, s)),)))
        lane_end = float(graph.length[lane])
        for successor in _successors(graph, lane):
            push(lane_end - s, successor, 0.0, _Leg(((lane, s, lane_end),)))
        for neighbour in _adjacent_lanes(graph, lane):
            parts = _ahead(graph, neighbour, _level_position(graph, lane, s, neighbour), CHANGE)
            available = 0.0
            for part_index, (target, part_start, part_end) in enumerate(parts):
                if (
                    target == goal.lane
                    and part_start <= goal.s <= part_end
                    and available + goal.s - part_start >= LEAST_CHANGE
                ):
                    change_length = available + goal.s - part_start
                    change_leg = _Leg((*parts[:part_index], (target, part_start, goal.s)), (lane, s))
                    push(change_length + CHANGE_COST + HASTE * (CHANGE - change_length), -1, goal.s, change_leg)
                available += part_end - part_start
            if available >= LEAST_CHANGE:
                change_cost = available + CHANGE_COST + HASTE * (CHANGE - available)
                push(change_cost, parts[-1][0], parts[-1][2], _Leg(tuple(parts), (lane, s)))
    return None


def _line(graph: LaneGraph, leg: _Leg, step: float = math.inf) -> tuple[F64, I32]:
    """Return rows [n, 6] (x, y, cos, sin, speed limit, width) along a leg, at most `step` m apart; lanes [n]."""
    rows = [_part(graph, part, step) for part in leg.parts]
    lanes = [np.full(len(lane_rows), part[0], np.int32) for lane_rows, part in zip(rows, leg.parts, strict=True)]
    return np.concatenate(rows), np.concatenate(lanes)


def _part(graph: LaneGraph, part: tuple[int, float, float], step: float) -> F64:
    """The rows of `_line` for one lane; those of a whole lane are kept, since most routes of a town have it."""
    lane, s0, s1 = part
    whole_rows = math.isinf(step) and s0 == 0.0 and s1 == float(graph.length[lane])
    if whole_rows and lane in graph.cache:
        cached_rows: F64 = graph.cache[lane]
        return cached_rows
    inner_points = graph.s[graph.points(lane)].astype(np.float64) if math.isinf(step) else np.arange(s0, s1, step)
    inner_points = inner_points[(inner_points > s0 + 0.02) & (inner_points < s1 - 0.02)]
    speed_limit = float(graph.speed_limit[lane])
    places = graph.along(lane, [s0, *inner_points.tolist(), s1]).tolist()
    rows = np.array(
        [(x, y, math.cos(yaw), math.sin(yaw), speed_limit, width) for x, y, yaw, width in places], np.float64
    )
    if whole_rows:
        rows.setflags(write=False)
        graph.cache[lane] = rows
    return rows


def _change(graph: LaneGraph, leg: _Leg, old: tuple[int, float]) -> tuple[F64, I32]:
    """Return rows and lanes of a lane change: the new lanes plus an offset that fades as a quintic (no jerk)."""
    rows, lanes = _line(graph, leg, 0.5)
    x, y, _, _ = graph.at(*old)
    lateral = -(x - rows[0, 0]) * rows[0, 3] + (y - rows[0, 1]) * rows[0, 2]
    arc_length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(rows[:, :2], axis=0).T))])
    share = arc_length / arc_length[-1]
    offset = lateral * (1.0 - share**3 * (10.0 - 15.0 * share + 6.0 * share * share))
    slope = -lateral * 30.0 * share * share * (1.0 - share) ** 2 / arc_length[-1]
    rows[:, 0] -= offset * rows[:, 3]
    rows[:, 1] += offset * rows[:, 2]
    yaw = np.arctan2(rows[:, 3], rows[:, 2]) + np.arctan(slope)
    rows[:, 2], rows[:, 3] = np.cos(yaw), np.sin(yaw)
    # The route belongs to the old lane for the first half of the change, as long as that lane lasts.
    on_old_lane = (share < 0.5) & (arc_length < float(graph.length[old[0]]) - old[1])
    return rows, np.where(on_old_lane, old[0], lanes).astype(np.int32)


def _draw(graph: LaneGraph, legs: list[_Leg], spacing: float) -> Route:
    """Return a Route with a point every `spacing` m along the legs; its last point is the last whole step."""
    sampled_legs = [
        _line(graph, leg) if leg.previous_lane is None else _change(graph, leg, leg.previous_lane) for leg in legs
    ]
    rows = np.concatenate([leg_values for leg_values, _ in sampled_legs])
    lanes = np.concatenate([leg_values for _, leg_values in sampled_legs])
    moved = np.concatenate([[True], np.hypot(*np.diff(rows[:, :2], axis=0).T) > 1e-3])
    rows, lanes = rows[moved], lanes[moved]
    arc_length = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(rows[:, :2], axis=0).T))])
    positions = spacing * np.arange(int(np.floor(arc_length[-1] / spacing + 1e-3)) + 1)
    if len(positions) < 2:
        raise RouteError(
            f"town '{graph.name}': the route has no length ({arc_length[-1]:.1f} m from ({rows[0, 0]:.1f}, "
            f"{rows[0, 1]:.1f})); set its key points further apart"
        )
    columns = [np.interp(positions, arc_length, rows[:, column_index]) for column_index in range(6)]
    owner = np.clip(np.searchsorted(arc_length, positions, side="right") - 1, 0, len(arc_length) - 1)
    return Route(
        xy=np.stack(columns[:2], axis=1).astype(np.float32),
        yaw=np.arctan2(columns[3], columns[2]).astype(np.float32),
        lane=lanes[owner],
        speed_limit=rows[owner, 4].astype(np.float32),
        width=columns[5].astype(np.float32),
        spacing=spacing,
    )
