"""Routes through a lane graph: shortest by length with a price on lane changes, sampled evenly, changes smoothed."""

from __future__ import annotations

import heapq
import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ssad.errors import RouteError
from ssad.roads.graph import LaneGraph
from ssad.roads.query import nearest_all
from ssad.types import F64, I32, LaneType, Pose, Route

CHANGE = 20.0  # m of road that a lane change takes
CHANGE_COST = 15.0  # m of detour that one lane change is worth
SHORT_CHANGE = 6.0  # m, least length in which a change is planned when nothing longer fits
SNAP = 4.0  # m from a lane's edge at which a key point still belongs to it
_SLACK = 1.5  # m further than the nearest lane at which another lane is still a candidate for a key point
_TURNED = np.radians(75.0)  # a key point with a heading lies on lanes that run within this of it


@dataclass(frozen=True)
class _Spot:
    """A place on a lane."""

    lane: int
    s: float
    cost: float = 0.0


def route_along(graph: LaneGraph, keypoints: Sequence[Pose | tuple[float, float]], *, spacing: float = 1.0) -> Route:
    """The shortest drive through key points [n >= 2], in their order, along lanes and lane changes.

    A `Pose` selects among lanes that run its way; a bare (x, y) only by distance. Ends are the projections of the
    first and last key point. RouteError: too few points, one that is off the road, or no way between two of them.
    """
    if len(keypoints) < 2:
        raise RouteError(f"town '{graph.name}': a route needs at least two key points, not {len(keypoints)}")
    stages = [_candidates(graph, k, point, last=k == len(keypoints) - 1) for k, point in enumerate(keypoints)]
    # cheapest way to each candidate of a stage, with the piece of path that leads there
    best: list[tuple[float, list[_Spot]]] = [(spot.cost, [spot]) for spot in stages[0]]
    for k in range(1, len(stages)):
        here: list[tuple[float, list[_Spot]]] = []
        starts = [(cost, path[-1]) for cost, path in best]
        for spot in stages[k]:
            found = _search(graph, starts, spot)
            if found is not None:
                cost, begin, way = found
                here.append((cost + spot.cost, best[begin][1] + way))
        if not here:
            (xa, ya), (xb, yb) = _xy(keypoints[k - 1]), _xy(keypoints[k])
            raise RouteError(
                f"town '{graph.name}': no way along the lanes from key point {k - 1} ({xa:.1f}, {ya:.1f}) to "
                f"{k} ({xb:.1f}, {yb:.1f}); move one of them or add a key point between"
            )
        best = here
    _, path = min(best, key=lambda item: item[0])
    return _sample(graph, path, spacing)


def random_route(graph: LaneGraph, lane: int, s: float, length: float, rng: np.random.Generator) -> Route:
    """A drive of `length` m from arc length s of a lane, taking a random driving successor at every lane's end.

    It ends early where the road does. RouteError: less than 1 m of road is left.
    """
    path, rest = [_Spot(lane, s)], length
    while True:
        here = path[-1]
        free = float(graph.length[here.lane]) - here.s
        if rest <= free:
            path.append(_Spot(here.lane, here.s + rest))
            break
        path.append(_Spot(here.lane, float(graph.length[here.lane])))
        rest -= free
        after = [int(n) for n in graph.successors(here.lane) if graph.kind[n] == LaneType.DRIVING]
        if not after:
            break
        path.append(_Spot(after[int(rng.integers(len(after)))], 0.0))
    if length - rest < 1.0 and path[-1].s - s < 1.0 and len(path) <= 2:
        raise RouteError(f"town '{graph.name}': lane {lane} ends within 1 m of arc length {s:.1f}; start earlier")
    return _sample(graph, path, 1.0)


def _xy(point: Pose | tuple[float, float]) -> tuple[float, float]:
    return (point.x, point.y) if isinstance(point, Pose) else (float(point[0]), float(point[1]))


def _candidates(graph: LaneGraph, k: int, point: Pose | tuple[float, float], *, last: bool) -> list[_Spot]:
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
        yaw = graph.at(int(lane[i]), float(s[i]))[2]
        off = abs((yaw - point.yaw + np.pi) % (2 * np.pi) - np.pi) if isinstance(point, Pose) else 0.0
        half = 0.5 * graph.at(int(lane[i]), float(s[i]))[3]
        # a place near the middle of a lane that runs the right way is what the author meant
        price = 20.0 * max(float(gap[i]) + half, 0.0) + (30.0 * off if off < _TURNED else 1000.0)
        spots.append(_Spot(int(lane[i]), float(s[i]), price))
    turned = [spot for spot in spots if spot.cost < 1000.0]
    spots = turned or spots
    return sorted(spots, key=lambda spot: spot.cost)[:8]


def _beside(graph: LaneGraph, lane: int) -> list[int]:
    """Driving lanes to which traffic on a lane may change: neighbours of the same direction, outside junctions."""
    found = []
    if graph.junction[lane] < 0:
        for other in (int(graph.left[lane]), int(graph.right[lane])):
            if other >= 0 and graph.kind[other] == LaneType.DRIVING and graph.same_direction(lane, other):
                found.append(other)
    return found


def _search(graph: LaneGraph, starts: list[tuple[float, _Spot]], goal: _Spot) -> tuple[float, int, list[_Spot]] | None:
    """Dijkstra from several spots to one: cost, which start, and the spots passed (lane ends, change points).

    A node is a lane entered at an arc length; entering it later by a lane change never beats entering it earlier
    with the same cost, so a lane is settled once, apart from the start lanes where the goal may lie behind.
    """
    queue: list[tuple[float, int, int, float, int, int]] = []  # cost, order, lane, s, start, parent
    nodes: list[tuple[int, float, int]] = []  # lane, s, parent
    for i, (cost, spot) in enumerate(starts):
        heapq.heappush(queue, (cost, len(queue), spot.lane, spot.s, i, -1))
    order, settled = len(queue), set()
    while queue:
        cost, _, lane, s, start, parent = heapq.heappop(queue)
        if lane < 0:  # the goal
            spots: list[_Spot] = [goal]
            while parent >= 0:
                here, at, parent = nodes[parent]
                spots.append(_Spot(here, at))
            return cost, start, spots[::-1][1:] if len(spots) > 1 else spots
        is_start = parent < 0
        if not is_start and lane in settled:
            continue
        if not is_start:
            settled.add(lane)
        node = len(nodes)
        nodes.append((lane, s, parent))
        if lane == goal.lane and goal.s >= s - 1e-6:
            heapq.heappush(queue, (cost + goal.s - s, order, -1, goal.s, start, node))
            order += 1
        end = float(graph.length[lane])
        for after in graph.successors(lane).tolist():
            if graph.kind[after] == LaneType.DRIVING and after not in settled:
                heapq.heappush(queue, (cost + end - s, order, after, 0.0, start, node))
                order += 1
        for other in _beside(graph, lane):
            if other in settled:
                continue
            to = float(graph.length[other])
            # the change happens somewhere ahead on this stretch; where is decided when the path is drawn
            left = to - min(s * to / end, to)
            price = CHANGE_COST + 40.0 * max(0.0, 1.0 - left / CHANGE)
            heapq.heappush(queue, (cost + price, order, other, min(s * to / end, to), start, node))
            order += 1
    return None


@dataclass
class _Run:
    """A stretch of one lane of a path, with the side to which the path leaves it (0: to a successor)."""

    lane: int
    s0: float
    s1: float


def _runs(graph: LaneGraph, path: list[_Spot]) -> list[list[_Run]]:
    """The path as corridors: inside a corridor lanes follow one another; between corridors lies a lane change."""
    corridors: list[list[_Run]] = [[_Run(path[0].lane, path[0].s, path[0].s)]]
    for spot in path[1:]:
        run = corridors[-1][-1]
        if spot.lane == run.lane and spot.s >= run.s1:
            run.s1 = spot.s
        elif spot.lane in graph.successors(run.lane):
            run.s1 = float(graph.length[run.lane])
            corridors[-1].append(_Run(spot.lane, 0.0, spot.s))
        else:
            corridors.append([_Run(spot.lane, spot.s, spot.s)])
    return corridors


def _line(graph: LaneGraph, runs: list[_Run]) -> tuple[F64, I32]:
    """Points [n, 6] (x, y, cos, sin, speed limit, width) of lane stretches in order, and their lanes [n]."""
    rows, lanes = [], []
    for run in runs:
        part = graph.points(run.lane)
        inner = graph.s[part][(graph.s[part] > run.s0 + 0.05) & (graph.s[part] < run.s1 - 0.05)]
        for s in [run.s0, *inner.tolist(), run.s1]:
            x, y, yaw, width = graph.at(run.lane, s)
            rows.append((x, y, np.cos(yaw), np.sin(yaw), float(graph.speed_limit[run.lane]), width))
            lanes.append(run.lane)
    return np.array(rows, np.float64), np.array(lanes, np.int32)


def _sample(graph: LaneGraph, path: list[_Spot], spacing: float) -> Route:
    """Draw the path: corridors one after another, joined by smooth lane changes, then sampled evenly."""
    corridors = _runs(graph, path)
    rows, lanes = _line(graph, corridors[0])
    for before, after in itertools.pairwise(corridors):
        rows, lanes = _change(graph, rows, lanes, before, after)
    xy = rows[:, :2]
    new = np.concatenate([[True], np.hypot(*np.diff(xy, axis=0).T) > 1e-4])
    rows, lanes = rows[new], lanes[new]
    if len(rows) < 2:
        raise RouteError(f"town '{graph.name}': the route has no length; its key points fall on one place")
    return _resample(rows, lanes, spacing)


def _resample(rows: F64, lanes: I32, spacing: float) -> Route:
    """A Route every `spacing` m of a polyline; the last sample is the last whole step."""
    s = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(rows[:, :2], axis=0).T))])
    at = spacing * np.arange(int(np.floor(s[-1] / spacing + 1e-6)) + 1)
    if len(at) < 2:
        at = np.array([0.0, s[-1]])
    column = [np.interp(at, s, rows[:, k]) for k in range(6)]
    owner = np.clip(np.searchsorted(s, at, side="right") - 1, 0, len(s) - 1)
    yaw = np.arctan2(column[3], column[2])
    return Route(
        xy=np.stack(column[:2], axis=1).astype(np.float32),
        yaw=yaw.astype(np.float32),
        lane=lanes[owner].astype(np.int32),
        speed_limit=rows[owner, 4].astype(np.float32),
        width=column[5].astype(np.float32),
        spacing=spacing,
    )


def _change(graph: LaneGraph, rows: F64, lanes: I32, before: list[_Run], after: list[_Run]) -> tuple[F64, I32]:
    """Continue drawn points on the lane beside: a quintic blend of the two centre lines over about CHANGE m.

    It takes place as early as it can: from where the path entered the lane it leaves, as far as both lanes run.
    """
    run, target = before[-1], after[0]
    room = _Run(run.lane, run.s0, float(graph.length[run.lane]))
    ratio = float(graph.length[target.lane]) / float(graph.length[run.lane])
    # on the way out the stretch drawn so far ended where the change begins
    keep = _upto(graph, rows, lanes, run)
    ahead = [_Run(target.lane, min(room.s0 * ratio, float(graph.length[target.lane])), target.s1), *after[1:]]
    if ahead[0].s1 <= ahead[0].s0:
        ahead[0].s1 = max(target.s1, ahead[0].s0)
    old, _ = _line(graph, [room])
    new, new_lane = _line(graph, ahead)
    s_old = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(old[:, :2], axis=0).T))])
    s_new = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(new[:, :2], axis=0).T))])
    span = min(CHANGE, max(s_old[-1], SHORT_CHANGE), max(float(s_new[-1]), SHORT_CHANGE))
    fine = np.unique(np.concatenate([np.arange(0.0, min(span, s_new[-1]), 0.5), s_new]))
    index = np.clip(np.searchsorted(s_new, fine, side="right") - 1, 0, len(s_new) - 1)
    drawn = np.stack([np.interp(fine, s_new, new[:, k]) for k in range(6)], axis=1)
    drawn[:, 4] = new[index, 4]
    owner = new_lane[index]
    # offset from the new lane to the old one, carried on sideways where the old lane has ended
    inside = np.minimum(fine, s_old[-1])
    away = np.stack([np.interp(inside, s_old, old[:, k]) for k in range(2)], axis=1)
    normal = np.stack([-drawn[:, 3], drawn[:, 2]], axis=1)
    base = np.stack([np.interp(inside, s_new, new[:, k]) for k in range(2)], axis=1)
    side = ((away - base) * normal).sum(axis=1)
    t = np.clip(fine / span, 0.0, 1.0)
    blend = 1.0 - t**3 * (10.0 - 15.0 * t + 6.0 * t * t)
    drawn[:, :2] += (blend * side)[:, None] * normal
    owner = np.where((blend > 0.5) & (fine <= s_old[-1]), run.lane, owner).astype(np.int32)
    slope = np.gradient(blend * side, fine) if len(fine) > 1 else np.zeros(len(fine))
    yaw = np.arctan2(drawn[:, 3], drawn[:, 2]) + np.arctan(slope)
    drawn[:, 2], drawn[:, 3] = np.cos(yaw), np.sin(yaw)
    return np.concatenate([rows[:keep], drawn]), np.concatenate([lanes[:keep], owner])


def _upto(graph: LaneGraph, rows: F64, lanes: I32, run: _Run) -> int:
    """How many drawn points lie before the place where a run begins."""
    x, y, yaw, _ = graph.at(run.lane, run.s0)
    along = (rows[:, 0] - x) * np.cos(yaw) + (rows[:, 1] - y) * np.sin(yaw)
    tail = np.flatnonzero((lanes == run.lane) & (along > -0.05))
    return int(tail[0]) if len(tail) else len(rows)
