"""Crossings as walkers and drivers meet them: the kerbs, and the signals of the traffic that is crossed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssad.core.lane_graph import TURN, LaneGraph
from ssad.core.rotations import wrap_scalar
from ssad.core.types import F64, LaneType
from ssad.world.roads.query import LaneQuery
from ssad.world.roads.sidewalks import Crossing, sidewalk_network

ROADWAY = (LaneType.DRIVING, LaneType.PARKING, LaneType.BIKING)
NEAR_LINE = 15.0  # m beyond a stop line within which its signal rules a crossing
NEAR_JUNCTION = 30.0  # m beyond a junction within which its signals do
LOST_TIME = 1.0  # s after green before the first vehicle comes to a crossing at its stop line
CLEARANCE = 3.0  # s after green before one has come through the junction
_SAMPLE = 0.1  # m


@dataclass(frozen=True)
class SignalledTraffic:
    """Traffic over a crossing that a signal lets go.

    Attributes:
        signal: Signal of the town.
        low: Distance from the first end of the crossing at which its lane begins, m.
        high: Distance at which its lane ends, m.
        seconds: Time that it needs after the beginning of green to come there, s.
    """

    signal: int
    low: float
    high: float
    seconds: float


@dataclass(frozen=True)
class RoadCrossing:
    """What a crossing leads over.

    Attributes:
        kerbs: Distances from its first end to the edges of the road, m.
        traffic: Traffic that signals let go; it decides when walkers may cross. Empty: there are no signals.
    """

    kerbs: tuple[float, float]
    traffic: tuple[SignalledTraffic, ...]


def road_crossings(graph: LaneGraph) -> tuple[RoadCrossing, ...]:
    """Return what each crossing of `sidewalk_network` leads over, cached with the lane graph."""
    if "road crossings" not in graph.cache:
        query = LaneQuery(graph)
        graph.cache["road crossings"] = tuple(
            RoadCrossing(_kerbs(query, crossing), tuple(_traffic(graph, crossing)))
            for crossing in sidewalk_network(graph).crossings
        )
    crossings: tuple[RoadCrossing, ...] = graph.cache["road crossings"]
    return crossings


def _kerbs(query: LaneQuery, crossing: Crossing) -> tuple[float, float]:
    """Return where the road under a crossing begins and ends; its ends where no lane is under it."""
    positions = np.arange(0.0, crossing.length, _SAMPLE)
    points = crossing.xy[0] + np.outer(positions / crossing.length, crossing.xy[1] - crossing.xy[0])
    inside = positions[query.nearest(points, ROADWAY).is_inside]
    return (float(inside[0]), float(inside[-1])) if len(inside) else (0.0, crossing.length)


def _traffic(graph: LaneGraph, crossing: Crossing) -> list[SignalledTraffic]:
    """Return the traffic of a crossing that signals let go, without what turns: that yields to walkers."""
    axis = (crossing.xy[1] - crossing.xy[0]) / crossing.length
    traffic = []
    for lane in crossing.lanes:
        points = graph.points(lane)
        rows = graph.along(lane, np.linspace(0.0, float(graph.length[lane]), max(int(graph.length[lane]), 1) + 1))
        offset = rows[:, :2] - crossing.xy[0]
        aside = np.abs(offset[:, 1] * axis[0] - offset[:, 0] * axis[1])
        nearest = int(aside.argmin())
        place = float(np.linspace(0.0, float(graph.length[lane]), len(rows))[nearest])
        middle = float(offset[nearest] @ axis)
        half = 0.5 * float(graph.width[points].max())
        traffic += [
            SignalledTraffic(signal, middle - half, middle + half, seconds)
            for signal, seconds in _signals_before(graph, lane, place).items()
        ]
    return traffic


def _signals_before(graph: LaneGraph, lane: int, place: float) -> dict[int, float]:
    """Return the signals that let straight traffic come to a place on a lane, and the time that it needs, s."""
    real = ~graph.signal_virtual[graph.stop_signal]
    own = np.flatnonzero((graph.stop_lane == lane) & real & (graph.stop_s <= place + 2.0))
    own = own[place - graph.stop_s[own] < NEAR_LINE]
    if len(own):
        return {int(graph.stop_signal[row]): LOST_TIME for row in own}
    signals: dict[int, float] = {}
    connections = [lane] if graph.junction[lane] >= 0 else graph.predecessors(lane).tolist()
    for connection in connections:
        if graph.junction[connection] < 0 or (connection != lane and place > NEAR_JUNCTION):
            continue
        start, end = graph.at(connection, 0.0)[2], graph.at(connection, float(graph.length[connection]))[2]
        is_near_start = connection == lane and place < 0.5 * float(graph.length[lane])
        if abs(wrap_scalar(end - start)) > TURN and not is_near_start:
            continue
        for row in np.flatnonzero(np.isin(graph.stop_lane, graph.predecessors(connection)) & real).tolist():
            signals[int(graph.stop_signal[row])] = LOST_TIME if is_near_start else CLEARANCE
    return signals


def crossing_axis(crossing: Crossing) -> F64:
    """Return the unit vector from the first to the second end of a crossing [2]."""
    return np.asarray((crossing.xy[1] - crossing.xy[0]) / crossing.length, np.float64)
