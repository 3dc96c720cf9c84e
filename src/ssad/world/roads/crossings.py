"""Kerbs of crossings, and the signals of the traffic on them."""

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
LOST_TIME = 1.0  # s from green until the first vehicle reaches a crossing at its stop line
CLEARANCE = 3.0  # s from green until the first vehicle has crossed the junction
_SAMPLE = 0.1  # m


@dataclass(frozen=True)
class SignalledTraffic:
    """Lane over a crossing whose traffic a signal controls.

    Attributes:
        signal: Signal of the town.
        low: Distance from the first end of the crossing to the near edge of the lane, m.
        high: Distance to its far edge, m.
        seconds: Time from the start of green until traffic reaches the crossing, s.
    """

    signal: int
    low: float
    high: float
    seconds: float


@dataclass(frozen=True)
class RoadCrossing:
    """Roadway under a crossing.

    Attributes:
        kerbs: Distances from its first end to the edges of the road, m.
        traffic: Signalled lanes, which decide when walkers may cross. Empty: there are no signals.
    """

    kerbs: tuple[float, float]
    traffic: tuple[SignalledTraffic, ...]


def road_crossings(graph: LaneGraph) -> tuple[RoadCrossing, ...]:
    """Return the roadway under each crossing of `sidewalk_network`, cached with the lane graph."""
    if "road crossings" not in graph.cache:
        query = LaneQuery(graph)
        graph.cache["road crossings"] = tuple(
            RoadCrossing(_kerbs(query, crossing), tuple(_traffic(graph, crossing)))
            for crossing in sidewalk_network(graph).crossings
        )
    crossings: tuple[RoadCrossing, ...] = graph.cache["road crossings"]
    return crossings


def _kerbs(query: LaneQuery, crossing: Crossing) -> tuple[float, float]:
    """Return both edges of the road under a crossing, m; the ends of the crossing if no lane is under it."""
    positions = np.arange(0.0, crossing.length, _SAMPLE)
    points = crossing.xy[0] + np.outer(positions / crossing.length, crossing.xy[1] - crossing.xy[0])
    inside = positions[query.nearest(points, ROADWAY).is_inside]
    return (float(inside[0]), float(inside[-1])) if len(inside) else (0.0, crossing.length)


def _traffic(graph: LaneGraph, crossing: Crossing) -> list[SignalledTraffic]:
    """Return the signalled lanes under a crossing, without turning traffic, which yields to walkers."""
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
    """Return the signals that release straight traffic to a place on a lane, and its travel time from green, s."""
    real = ~graph.signal_virtual[graph.stop_signal]
    stop_rows = np.flatnonzero((graph.stop_lane == lane) & real & (graph.stop_s <= place + 2.0))
    stop_rows = stop_rows[place - graph.stop_s[stop_rows] < NEAR_LINE]
    if len(stop_rows):
        return {int(graph.stop_signal[row]): LOST_TIME for row in stop_rows}
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
