"""Replays as compact data inside the page: quantised, differenced, deflated, base64.

Coordinates are int16 in units of `SCALE` m from the town's origin, angles int16 in units of pi / 32767. A block holds
its columns one after the other, each as differences along time (with int16 wrap-around, so nothing is lost).
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
from ssad.core.lane_strips import LAYERS, junction_areas, strips, thin
from ssad.core.types import EpisodeTrace, LaneType

SCALE = 0.03  # m
SPEED = 0.01  # m/s
SHARE = 1000.0  # throttle, brake, steer, completion as thousandths
NEAR = 80.0  # m around the episodes in which lanes are kept


def pack(columns: npt.NDArray[np.int16]) -> str:
    """int16 [C, T] -> text: differences along T, little-endian, zlib, base64."""
    wide = np.diff(columns.astype(np.int32), axis=1, prepend=0)
    return base64.b64encode(zlib.compress(wide.astype("<i2").tobytes(), 9)).decode()


def _i16(values: npt.NDArray[Any]) -> npt.NDArray[np.int16]:
    return np.clip(np.round(values), -32767, 32767).astype(np.int16)


def origin(graph: LaneGraph) -> tuple[float, float]:
    """Centre of the town's extent, m: what coordinates are relative to."""
    middle = 0.5 * (graph.xy.min(axis=0).astype(np.float64) + graph.xy.max(axis=0))
    return float(np.round(middle[0], 1)), float(np.round(middle[1], 1))


def episode_data(trace: EpisodeTrace, graph: LaneGraph) -> dict[str, Any]:
    """Data of one episode for the page.

    Args:
        trace: The episode.
        graph: Its town.

    Returns:
        The agents' bodies; the packed motion: [3 A + 1 rows of T] x, y, yaw per agent, then presence (bits of 15 agents
        a row); the packed record of the ego; its route; and the events.
    """
    ox, oy = origin(graph)
    agents = len(trace.names)
    rows = []
    for a in range(agents):
        rows += [(trace.x[:, a] - ox) / SCALE, (trace.y[:, a] - oy) / SCALE]
        rows.append(np.arctan2(np.sin(trace.yaw[:, a]), np.cos(trace.yaw[:, a])) / np.pi * 32767)
    # presence as bits of 15 agents a row
    words = []
    for first in range(0, agents, 15):
        bits = 1 << np.arange(min(15, agents - first))
        words.append(trace.active[:, first : first + 15].astype(np.int64) @ bits)
    record = [
        trace.speed[:, 0] / SPEED,
        trace.throttle * SHARE,
        trace.brake * SHARE,
        trace.steer * SHARE,
        trace.route_complete * 10.0,
        _gap(trace) / SPEED,
        trace.off_road.astype(np.float64),
    ]
    hits = [[int(t), int(trace.contact_agent[t])] for t in np.flatnonzero(trace.contact)]
    return {
        "dt": trace.dt,
        "steps": len(trace.accel),
        "names": list(trace.names),
        "kinds": trace.kind.tolist(),
        "size": np.round(np.stack([trace.length, trace.width], 1), 2).tolist(),
        "motion": pack(np.stack([_i16(np.asarray(r)) for r in [*rows, *words]])),
        "record": pack(np.stack([_i16(r) for r in record])),
        "route": pack(_i16((thin(trace.route.astype(np.float64)) - [ox, oy]) / SCALE).T),
        "hits": hits,
        "red": np.flatnonzero(trace.red_light).tolist(),
        "signals": [_changes(trace.signal[:, s], int(i)) for s, i in enumerate(trace.signal_ids)],
        "end": trace.end,
    }


def _gap(trace: EpisodeTrace) -> npt.NDArray[np.float64]:
    """Rough free distance to the nearest other agent, m (centres less half lengths): for the read-out only."""
    if len(trace.names) < 2:
        return np.full(len(trace.accel), 300.0)
    d = np.hypot(trace.x[:, 1:] - trace.x[:, :1], trace.y[:, 1:] - trace.y[:, :1])
    d = d - 0.5 * (trace.length[1:] + trace.length[0])
    least = np.where(trace.active[:, 1:], d, np.inf).min(axis=1)
    out: npt.NDArray[np.float64] = np.clip(np.nan_to_num(least.astype(np.float64), posinf=300.0), 0.0, 300.0)
    return out


def _changes(states: npt.NDArray[np.uint8], index: int) -> list[Any]:
    """[signal, [[step, state], ...]]: only where the state changes."""
    at = np.flatnonzero(np.diff(states.astype(np.int16), prepend=-1))
    return [index, [[int(t), int(states[t])] for t in at]]


def town_data(graph: LaneGraph, traces: Iterable[EpisodeTrace]) -> dict[str, Any]:
    """Lanes within `NEAR` m of the episodes' routes as strips and edge lines, and the signals."""
    places = np.concatenate([t.route[::10] for t in traces]).astype(np.float64)
    cells = {tuple(c) for c in np.floor(places / NEAR).astype(int)}
    near = {(x + i, y + j) for x, y in cells for i in (-1, 0, 1) for j in (-1, 0, 1)}
    ox, oy = origin(graph)
    drawn: list[list[Any]] = []
    lanes = strips(graph)
    for area in junction_areas(graph, lanes):
        if any(tuple(c) in near for c in np.floor(area / NEAR).astype(int)):
            drawn.append([LAYERS[LaneType.DRIVING], 1, [0, 0], len(area), _flat(area, ox, oy)])
    for strip in lanes:
        middle = 0.5 * (strip.left[[0, -1]] + strip.right[[0, -1]])
        both = np.concatenate([strip.ring, middle])
        if any(tuple(c) in near for c in np.floor(both / NEAR).astype(int)):
            lines = _lines(graph, strip.lane)
            drawn.append([strip.layer, int(strip.junction), lines, len(strip.left), _flat(strip.ring, ox, oy)])
    signals = [[round(float(x) - ox, 2), round(float(y) - oy, 2)] for x, y in graph.signal_xy]
    return {"origin": [ox, oy], "strips": drawn, "signals": signals, "crosswalks": _crosswalks(graph, ox, oy)}


def _lines(graph: LaneGraph, lane: int) -> list[int]:
    """How the left and right edge are drawn: 0 nothing, 1 broken, 2 solid, 3 double (between opposing lanes)."""
    out = []
    for side in (graph.left, graph.right):
        other = int(side[lane])
        if graph.junction[lane] >= 0 or graph.kind[lane] != LaneType.DRIVING:
            out.append(0)
        elif other < 0 or graph.kind[other] != LaneType.DRIVING:
            out.append(2)
        elif np.sign(graph.lane_id[other]) == np.sign(graph.lane_id[lane]):
            out.append(1)
        else:
            out.append(3)
    return out


def _flat(xy: npt.NDArray[np.float64], ox: float, oy: float) -> list[float]:
    return [round(float(v), 2) for v in (xy - [ox, oy]).reshape(-1)]


def _crosswalks(graph: LaneGraph, ox: float, oy: float) -> list[list[float]]:
    ends: Sequence[int] = graph.crosswalk_offset.tolist()
    return [_flat(graph.crosswalk_xy[a:b].astype(np.float64), ox, oy) for a, b in itertools.pairwise(ends)]
