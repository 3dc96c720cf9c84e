"""A crossroads small enough to know every number of: four arms of 100 m, two lanes of 3.5 m each way.

The lane of an ego from the south and the junction have the number 0, which is easily taken for none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
import pytest

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import LaneType, Route

LANE = 3.5
HALF = 15.0  # the junction reaches this far from the centre
ARM = 100.0
SHOULDER = 1.5


@dataclass
class Draft:
    """Lanes as they are drawn, one list an array."""

    xy: list[np.ndarray] = field(default_factory=list)
    width: list[float] = field(default_factory=list)
    kind: list[int] = field(default_factory=list)
    road: list[int] = field(default_factory=list)
    lane_id: list[int] = field(default_factory=list)
    junction: list[int] = field(default_factory=list)
    left: dict[int, int] = field(default_factory=dict)
    right: dict[int, int] = field(default_factory=dict)
    succ: dict[int, list[int]] = field(default_factory=dict)

    def add(
        self,
        xy: np.ndarray,
        road: int,
        lane_id: int,
        junction: int = -1,
        *,
        kind: int = 1,
        width: float = LANE,
    ) -> int:
        self.xy.append(np.asarray(xy, float))
        self.width.append(width)
        self.kind.append(kind)
        self.road.append(road)
        self.lane_id.append(lane_id)
        self.junction.append(junction)
        return len(self.xy) - 1


def _line(a: complex, b: complex) -> np.ndarray:
    count = max(round(abs(b - a)), 1) + 1
    z = a + (b - a) * np.linspace(0.0, 1.0, count)
    return np.stack([z.real, z.imag], axis=1)


def _bend(a: complex, da: complex, b: complex, db: complex) -> np.ndarray:
    t = np.linspace(0.0, 1.0, 40)
    reach = 0.55 * abs(b - a) / math.sqrt(2.0) * 1.0
    p = [a, a + da * reach, b - db * reach, b]
    z = (1 - t) ** 3 * p[0] + 3 * (1 - t) ** 2 * t * p[1] + 3 * (1 - t) * t**2 * p[2] + t**3 * p[3]
    return np.stack([z.real, z.imag], axis=1)


def crossroads_graph() -> LaneGraph:
    """Arms 0 east, 1 north, 2 west, 3 south; roads 10 + arm; junction 0 with a signal an approach."""
    draft = Draft()
    into: dict[tuple[int, int], int] = {}
    out: dict[tuple[int, int], int] = {}
    for arm in (3, 0, 1, 2):
        d = 1j**arm  # away from the centre
        for k in range(2):
            off = (0.5 + k) * LANE
            # right-hand traffic: seen outwards, lanes that leave are to the right (-1j)
            into[arm, k] = draft.add(_line(d * (HALF + ARM) + 1j * d * off, d * HALF + 1j * d * off), 10 + arm, 1 + k)
            out[arm, k] = draft.add(_line(d * HALF - 1j * d * off, d * (HALF + ARM) - 1j * d * off), 10 + arm, -1 - k)
        for table, sign in ((out, -1), (into, 1)):
            edge = (2 * LANE + SHOULDER / 2) * sign
            ends = (HALF, HALF + ARM) if sign < 0 else (HALF + ARM, HALF)
            line = _line(d * ends[0] + 1j * d * edge, d * ends[1] + 1j * d * edge)
            side = draft.add(line, 10 + arm, 3 * sign, kind=int(LaneType.SHOULDER), width=SHOULDER)
            draft.right[table[arm, 0]] = table[arm, 1]
            draft.left[table[arm, 1]] = table[arm, 0]
            draft.right[table[arm, 1]] = side
            draft.left[side] = table[arm, 1]
        draft.left[out[arm, 0]] = into[arm, 0]
        draft.left[into[arm, 0]] = out[arm, 0]
    for arm in range(4):
        for k in range(2):
            # counter-clockwise: +1 is to the right of one who comes in, +2 straight on, +3 left
            for turn, allowed in ((1, k == 1), (2, True), (3, k == 0)):
                if not allowed:
                    continue
                to = (arm + turn) % 4
                a, b = draft.xy[into[arm, k]][-1], draft.xy[out[to, k]][0]
                start, end = complex(*a), complex(*b)
                path = _line(start, end) if turn == 2 else _bend(start, -(1j**arm), end, 1j**to)
                lane = draft.add(path, 100 + 10 * arm + turn, -1 - k, junction=0)
                draft.succ.setdefault(into[arm, k], []).append(lane)
                draft.succ[lane] = [out[to, k]]
    count = len(draft.xy)
    step = [np.diff(xy, axis=0) for xy in draft.xy]
    s = [np.concatenate([[0.0], np.cumsum(np.hypot(*d.T))]) for d in step]
    yaw = [np.arctan2(d[:, 1], d[:, 0]) for d in step]
    rows = np.array([len(xy) for xy in draft.xy])
    succ = [draft.succ.get(i, []) for i in range(count)]
    signals = [into[arm, 0] for arm in range(4)]
    return LaneGraph(
        name="Crossroads",
        xy=np.concatenate(draft.xy),
        z=np.zeros(rows.sum()),
        yaw=np.concatenate([np.append(y, y[-1]) for y in yaw]),
        width=np.repeat(draft.width, rows),
        s=np.concatenate(s),
        offset=np.concatenate([[0], np.cumsum(rows)]),
        kind=draft.kind,
        road=draft.road,
        section=np.zeros(count),
        lane_id=draft.lane_id,
        junction=draft.junction,
        speed_limit=np.full(count, 13.9),
        left=[draft.left.get(i, -1) for i in range(count)],
        right=[draft.right.get(i, -1) for i in range(count)],
        left_marking=np.zeros(count),
        right_marking=np.zeros(count),
        succ_offset=np.concatenate([[0], np.cumsum([len(n) for n in succ])]),
        succ=np.concatenate([np.array(n, int) for n in succ]),
        signal_xy=np.array([draft.xy[n][-1] for n in signals]),
        signal_yaw=np.array([yaw[n][-1] for n in signals]),
        signal_junction=np.zeros(4),
        signal_phase=[0, 1, 0, 1],
        signal_virtual=np.ones(4, bool),
        stop_signal=np.repeat(np.arange(4), 2),
        stop_lane=[into[arm, k] for arm in range(4) for k in range(2)],
        stop_s=np.full(8, ARM),
        crosswalk_offset=[0],
        crosswalk_xy=np.zeros((0, 2)),
    )


@pytest.fixture(scope="session")
def crossroads() -> LaneGraph:
    """Roads along both axes; an ego from the south drives north at x = 1.75 (inner lane) or 5.25 (outer)."""
    return crossroads_graph()


def lane_of(graph: LaneGraph, road: int, lane_id: int) -> int:
    """The lane with these OpenDRIVE ids."""
    return int(np.flatnonzero((graph.road == road) & (graph.lane_id == lane_id))[0])


def route_over(graph: LaneGraph, lanes: list[tuple[int, int]], start: float = 0.0) -> Route:
    """A route along whole lanes (road, lane id), from `start` m on the first one, a point a metre."""
    xy, lane = [], []
    for i, (road, lane_id) in enumerate(lanes):
        n = lane_of(graph, road, lane_id)
        for s in np.arange(start if i == 0 else 0.0, float(graph.length[n]) - 0.5, 1.0):
            xy.append(graph.at(n, float(s))[:2])
            lane.append(n)
    points = np.array(xy)
    step = np.diff(points, axis=0)
    yaw = np.arctan2(step[:, 1], step[:, 0])
    return Route(
        xy=points.astype(np.float32),
        yaw=np.append(yaw, yaw[-1]).astype(np.float32),
        lane=np.array(lane, np.int32),
        speed_limit=np.full(len(points), 13.9, np.float32),
        width=np.full(len(points), 3.5, np.float32),
    )


class Routes:
    """Ways of an ego from the south, 70 m before the junction."""

    def __init__(self, graph: LaneGraph) -> None:
        self.straight = route_over(graph, [(13, 1), (132, -1), (11, -1)], 30.0)
        self.straight_outer = route_over(graph, [(13, 2), (132, -2), (11, -2)], 30.0)
        self.left = route_over(graph, [(13, 1), (133, -1), (12, -1)], 30.0)
        self.right = route_over(graph, [(13, 2), (131, -2), (10, -2)], 30.0)


@pytest.fixture(scope="session")
def routes(crossroads: LaneGraph) -> Routes:
    """Routes over the crossroads."""
    return Routes(crossroads)
