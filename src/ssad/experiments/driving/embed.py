"""Replays as compact data inside the page: quantised, differenced, deflated, base64.

Coordinates are int16 in units of `SCALE` m from the town's origin, angles int16 in units of pi / 32767. An episode too
far out for that has an anchor of its own, and coarser units where it is too long. A block holds its columns one after
the other, each as differences along time (with int16 wrap-around, so nothing is lost).
"""

from __future__ import annotations

import base64
import itertools
import zlib
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.lane_graph import LaneGraph
from ssad.core.lane_strips import LAYERS, junction_areas, make_lane_strips, simplify_polyline
from ssad.core.types import EpisodeTrace, LaneType

SCALE = 0.03  # m
LARGEST = 32767  # units of a coordinate
SPEED = 0.01  # m/s
SHARE = 1000.0  # throttle, brake, steer, completion as thousandths
NEAR = 80.0  # m around the episodes in which lanes are kept


def encode_int16(columns: npt.NDArray[np.int16]) -> str:
    """Encode int16 [C, T] as text: differences along T, little-endian, zlib, base64."""
    differences = np.diff(columns.astype(np.int32), axis=1, prepend=0)
    return base64.b64encode(zlib.compress(differences.astype("<i2").tobytes(), 9)).decode()


def _to_int16(values: npt.NDArray[Any]) -> npt.NDArray[np.int16]:
    return np.clip(np.round(values), -LARGEST, LARGEST).astype(np.int16)


def origin(graph: LaneGraph) -> tuple[float, float]:
    """Return the centre of the town's extent, m: the origin of all coordinates."""
    centre = 0.5 * (graph.xy.min(axis=0).astype(np.float64) + graph.xy.max(axis=0))
    return float(np.round(centre[0], 1)), float(np.round(centre[1], 1))


def _anchor_and_scale(trace: EpisodeTrace, town_origin: tuple[float, float]) -> tuple[tuple[float, float], float]:
    """Return the point that coordinates of an episode count from, m from the town's origin, and their unit, m."""
    positions = np.stack([trace.x[trace.active], trace.y[trace.active]], axis=1)
    points = np.concatenate([positions, trace.route]).astype(np.float64) - town_origin
    low, high = points.min(axis=0), points.max(axis=0)
    if max(-low.min(), high.max()) <= LARGEST * SCALE:
        return (0.0, 0.0), SCALE
    anchor_x, anchor_y = np.round(0.5 * (low + high), 1).tolist()
    return (anchor_x, anchor_y), max(SCALE, float((high - low).max() / 2 + 1.0) / LARGEST)


def episode_data(trace: EpisodeTrace, graph: LaneGraph) -> dict[str, Any]:
    """Data of one episode for the page.

    Args:
        trace: The episode.
        graph: Its town.

    Returns:
        The agents' bodies; the anchor and the unit of coordinates; the packed motion: [3 A + 1 rows of T] x, y, yaw per
        agent, then presence (bits of 15 agents a row); the packed record of the ego; its route; the turn signals, where
        they change; and the events.
    """
    town_origin = origin(graph)
    anchor, scale = _anchor_and_scale(trace, town_origin)
    origin_x, origin_y = town_origin[0] + anchor[0], town_origin[1] + anchor[1]
    agent_count = len(trace.names)
    rows = []
    for agent in range(agent_count):
        rows += [(trace.x[:, agent] - origin_x) / scale, (trace.y[:, agent] - origin_y) / scale]
        rows.append(np.arctan2(np.sin(trace.yaw[:, agent]), np.cos(trace.yaw[:, agent])) / np.pi * LARGEST)
    # presence as bits of 15 agents a row
    presence = []
    for first_agent in range(0, agent_count, 15):
        bits = 1 << np.arange(min(15, agent_count - first_agent))
        presence.append(trace.active[:, first_agent : first_agent + 15].astype(np.int64) @ bits)
    record = [
        trace.speed[:, 0] / SPEED,
        trace.throttle * SHARE,
        trace.brake * SHARE,
        trace.steer * SHARE,
        trace.route_complete * 10.0,
        _distance_to_nearest(trace) / SPEED,
        trace.off_road.astype(np.float64),
    ]
    contacts = [[int(step), int(trace.contact_agent[step])] for step in np.flatnonzero(trace.contact)]
    return {
        "dt": trace.dt,
        "steps": len(trace.accel),
        "names": list(trace.names),
        "kinds": trace.kind.tolist(),
        "size": np.round(np.stack([trace.length, trace.width], 1), 2).tolist(),
        "anchor": list(anchor),
        "scale": scale,
        "motion": encode_int16(np.stack([_to_int16(np.asarray(row)) for row in [*rows, *presence]])),
        "record": encode_int16(np.stack([_to_int16(row) for row in record])),
        "route": encode_int16(
            _to_int16((simplify_polyline(trace.route.astype(np.float64)) - [origin_x, origin_y]) / scale).T
        ),
        "hits": contacts,
        "red": np.flatnonzero(trace.red_light).tolist(),
        "signals": [
            _state_changes(trace.signal[:, column], int(signal)) for column, signal in enumerate(trace.signal_ids)
        ],
        "turn_signals": [
            [agent, _state_changes(trace.turn_signal[:, agent], agent)[1]]
            for agent in np.flatnonzero(trace.turn_signal.any(axis=0)).tolist()
        ],
        "end": trace.end,
    }


def _distance_to_nearest(trace: EpisodeTrace) -> npt.NDArray[np.float64]:
    """Rough free distance to the nearest other agent, m (centres less half lengths): for the read-out only."""
    if len(trace.names) < 2:
        return np.full(len(trace.accel), 300.0)
    distances = np.hypot(trace.x[:, 1:] - trace.x[:, :1], trace.y[:, 1:] - trace.y[:, :1])
    distances = distances - 0.5 * (trace.length[1:] + trace.length[0])
    nearest = np.where(trace.active[:, 1:], distances, np.inf).min(axis=1)
    clipped: npt.NDArray[np.float64] = np.clip(np.nan_to_num(nearest.astype(np.float64), posinf=300.0), 0.0, 300.0)
    return clipped


def _state_changes(states: npt.NDArray[np.integer[Any]], index: int) -> list[Any]:
    """Return [index, [[step, state], ...]]: only where the state changes."""
    change_steps = np.flatnonzero(np.diff(states.astype(np.int16), prepend=-9))
    return [index, [[int(step), int(states[step])] for step in change_steps]]


def town_data(graph: LaneGraph, traces: Iterable[EpisodeTrace]) -> dict[str, Any]:
    """Return lanes within `NEAR` m of the episodes' routes as strips and edge lines, and the signals."""
    route_points = np.concatenate([trace.route[::10] for trace in traces]).astype(np.float64)
    cells = {tuple(cell) for cell in np.floor(route_points / NEAR).astype(int)}
    # Cells of the grid next to those with a route: every lane within one cell's width is kept.
    near_cells = {(x + i, y + j) for x, y in cells for i in (-1, 0, 1) for j in (-1, 0, 1)}
    origin_x, origin_y = origin(graph)
    shapes: list[list[Any]] = []
    lanes = make_lane_strips(graph)
    for area in junction_areas(graph, lanes):
        if any(tuple(cell) in near_cells for cell in np.floor(area / NEAR).astype(int)):
            shapes.append([LAYERS[LaneType.DRIVING], 1, [0, 0], len(area), _flatten(area, origin_x, origin_y)])
    for strip in lanes:
        end_centres = 0.5 * (strip.left[[0, -1]] + strip.right[[0, -1]])
        # A long straight strip may have no corner near the route: its ends are tested by their centres too.
        test_points = np.concatenate([strip.outline, end_centres])
        if any(tuple(cell) in near_cells for cell in np.floor(test_points / NEAR).astype(int)):
            lines = _line_codes(graph, strip.lane)
            shapes.append(
                [strip.layer, int(strip.junction), lines, len(strip.left), _flatten(strip.outline, origin_x, origin_y)]
            )
    signals = [[round(float(x) - origin_x, 2), round(float(y) - origin_y, 2)] for x, y in graph.signal_xy]
    return {
        "origin": [origin_x, origin_y],
        "strips": shapes,
        "signals": signals,
        "crosswalks": _crosswalks(graph, origin_x, origin_y),
    }


def _line_codes(graph: LaneGraph, lane: int) -> list[int]:
    """Return line codes of the left and right edge: 0 none, 1 broken, 2 solid, 3 double (between opposing lanes)."""
    line_codes = []
    for side in (graph.left, graph.right):
        neighbour = int(side[lane])
        if graph.junction[lane] >= 0 or graph.kind[lane] != LaneType.DRIVING:
            line_codes.append(0)
        elif neighbour < 0 or graph.kind[neighbour] != LaneType.DRIVING:
            line_codes.append(2)
        elif graph.forward[neighbour] == graph.forward[lane]:
            line_codes.append(1)
        else:
            line_codes.append(3)
    return line_codes


def _flatten(xy: npt.NDArray[np.float64], origin_x: float, origin_y: float) -> list[float]:
    return [round(float(value), 2) for value in (xy - [origin_x, origin_y]).reshape(-1)]


def _crosswalks(graph: LaneGraph, origin_x: float, origin_y: float) -> list[list[float]]:
    offsets: Sequence[int] = graph.crosswalk_offset.tolist()
    return [
        _flatten(graph.crosswalk_xy[start:end].astype(np.float64), origin_x, origin_y)
        for start, end in itertools.pairwise(offsets)
    ]
