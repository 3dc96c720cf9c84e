"""Where signals and signs stand, which lanes they stop, and which signals are green together."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.geometry import in_polygon
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F64, LaneType
from ssad.world.roads.xodr import Network

ARMS = 3  # a junction with fewer arms needs no signal
TOUCHING = 2.5  # m between the middles of two ways at which they meet
FACING = -0.7  # cosine: two arms face each other below it, and go the same way above its opposite
SETBACK = 1.0  # m from the stop line to a crosswalk
_TAIL = 15.0  # m before the end of a lane in which a crosswalk moves its stop line


@dataclass(frozen=True)
class Approaches:
    """What signal placement needs to know of the lanes; rows are lanes."""

    network: Network
    keys: list[tuple[int, int, int]]
    kind: npt.NDArray[Any]
    junction: npt.NDArray[Any]
    links: list[list[int]]
    end: F64  # [L, 3] x, y, yaw
    begin: F64
    width: F64
    line: list[tuple[F64, F64]]  # xy [., 2], s [.]
    crosswalks: list[F64]
    lights: dict[str, list[float]]  # x, y, yaw of signals of any kind


@dataclass
class _Approach:
    """Lanes of one arm that lead into a junction, and the light of the map that faces them (if any)."""

    junction: int
    lanes: list[int]
    light: str | None = None


def place_signals(data: Approaches) -> dict[str, Any]:
    """The signal and stop arrays of a LaneGraph.

    Every arm of a junction with lights gets one signal and a stop line on each of its lanes; a junction of at
    least three arms without lights gets the same, marked virtual, if ways of different arms meet there. Phases
    come from the map's controllers where every light has one, else arms that face each other share a phase.
    """
    signals: list[tuple[float, float, float, int, int, bool]] = []
    stops: list[tuple[int, int, float]] = []
    for junction, arms in _arms(data).items():
        approaches = [arm for arm in arms if arm.lanes]
        inner = [i for i in range(len(data.keys)) if data.junction[i] == junction]
        for arm in approaches:
            arm.light = _facing(data, arm, inner)
        real = any(arm.light for arm in approaches)
        if not approaches or (not real and (len(arms) < ARMS or not _meet(data, approaches, set(inner)))):
            continue
        for arm, phase in zip(approaches, _phases(data, approaches), strict=True):
            outer = min(arm.lanes, key=lambda i: -abs(data.keys[i][2]))
            x, y, yaw = data.end[outer]
            if arm.light and arm.light in data.lights:
                x, y = data.lights[arm.light][:2]
            else:
                aside = 0.5 * data.width[outer] + 1.0
                x, y = x + aside * np.sin(yaw), y - aside * np.cos(yaw)
            stops += [(len(signals), lane, _stop(data, lane)) for lane in arm.lanes]
            signals.append((x, y, yaw, junction, phase, not real))
    table = np.array(signals, np.float64).reshape(-1, 6)
    line = np.array(stops, np.float64).reshape(-1, 3)
    return {
        "signal_xy": table[:, :2],
        "signal_yaw": table[:, 2],
        "signal_junction": table[:, 3].astype(np.int32),
        "signal_phase": table[:, 4].astype(np.int32),
        "signal_virtual": table[:, 5].astype(bool),
        "stop_signal": line[:, 0].astype(np.int32),
        "stop_lane": line[:, 1].astype(np.int32),
        "stop_s": line[:, 2],
    }


def place_signs(data: Approaches) -> dict[str, Any]:
    """The sign and rule arrays of a LaneGraph: the stop and yield signs of the map that stand at junctions.

    A sign rules the lanes of one approach: those that the map names, by road and direction or by the connecting lanes
    behind them; where it names several approaches, the one that ends nearest to the sign.
    """
    before: dict[int, list[int]] = {}
    for i, found in enumerate(data.links):
        for j in found:
            before.setdefault(j, []).append(i)
    named: dict[str, set[int]] = {}
    for i, (road, _, lane) in enumerate(data.keys):
        for place in data.network.roads[road].signs:
            ahead = place.way == 0 or place.way * lane < 0
            if place.sign not in data.network.signs or not ahead:
                continue
            if place.low == 0 == place.high or place.low <= lane <= place.high:
                named.setdefault(place.sign, set()).update([i] if data.junction[i] < 0 else before.get(i, []))
    signs: list[tuple[float, float, float, int]] = []
    rules: list[tuple[int, int, float]] = []
    for sign in sorted(named, key=lambda name: (len(name), name)):
        lanes = _approach(data, sign, named[sign])
        if not lanes:
            continue
        outer = min(lanes, key=lambda i: -abs(data.keys[i][2]))
        x, y, yaw = data.end[outer]
        if sign in data.lights:
            x, y = data.lights[sign][:2]
        else:
            aside = 0.5 * data.width[outer] + 1.0
            x, y = x + aside * np.sin(yaw), y - aside * np.cos(yaw)
        rules += [(len(signs), lane, _stop(data, lane)) for lane in lanes]
        signs.append((x, y, yaw, int(data.network.signs[sign])))
    table = np.array(signs, np.float64).reshape(-1, 4)
    ruled = np.array(rules, np.float64).reshape(-1, 3)
    return {
        "sign_kind": table[:, 3].astype(np.uint8),
        "sign_xy": table[:, :2],
        "sign_yaw": table[:, 2],
        "rule_sign": ruled[:, 0].astype(np.int32),
        "rule_lane": ruled[:, 1].astype(np.int32),
        "rule_s": ruled[:, 2],
    }


def _approach(data: Approaches, sign: str, named: set[int]) -> list[int]:
    """Of the lanes that a sign is for, those of one approach to a junction."""
    ways: dict[tuple[int, bool], list[int]] = {}
    for i in sorted(named):
        leads_in = any(data.junction[j] >= 0 and data.kind[j] == LaneType.DRIVING for j in data.links[i])
        if data.kind[i] == LaneType.DRIVING and data.junction[i] < 0 and leads_in:
            ways.setdefault((data.keys[i][0], data.keys[i][2] < 0), []).append(i)
    if len(ways) < 2 or sign not in data.lights:
        return next(iter(ways.values()), [])
    x, y = data.lights[sign][:2]
    return min(ways.values(), key=lambda lanes: min(np.hypot(*(data.end[i, :2] - [x, y])) for i in lanes))


def _arms(data: Approaches) -> dict[int, list[_Approach]]:
    """Arms of every junction: (road, end) pairs, with the driving lanes that lead in (may be none)."""
    arms: dict[int, dict[tuple[int, bool], _Approach]] = {}
    for i, found in enumerate(data.links):
        if data.kind[i] != LaneType.DRIVING:
            continue
        road, _, lane = data.keys[i]
        for j in found:
            if data.kind[j] != LaneType.DRIVING:
                continue
            here, there = int(data.junction[i]), int(data.junction[j])
            if here == there:
                continue
            if there >= 0:
                arm = arms.setdefault(there, {}).setdefault((road, lane < 0), _Approach(there, []))
                if i not in arm.lanes:
                    arm.lanes.append(i)
            if here >= 0:
                out, _, lane_out = data.keys[j]
                arms.setdefault(here, {}).setdefault((out, lane_out > 0), _Approach(here, []))
    return {junction: [found[k] for k in sorted(found)] for junction, found in sorted(arms.items())}


def _meet(data: Approaches, arms: list[_Approach], inner: set[int]) -> bool:
    """Whether ways of different arms come so near that two vehicles could touch; not so at a motorway's interchange."""
    ways = [[data.line[j][0] for j in sorted({j for i in arm.lanes for j in data.links[i]} & inner)] for arm in arms]
    pairs = ((a, b) for k, mine in enumerate(ways) for other in ways[k + 1 :] for a in mine for b in other)
    return any(float(np.hypot(*np.moveaxis(a[:, None] - b[None], -1, 0)).min()) < TOUCHING for a, b in pairs)


def _facing(data: Approaches, arm: _Approach, inner: list[int]) -> str | None:
    """The light that the map ties to an arm: on its own lanes, or on the connecting lanes after them."""
    known = set(data.network.lights)
    votes: Counter[str] = Counter()
    after = {j for i in arm.lanes for j in data.links[i]} & set(inner)
    for i in [*arm.lanes, *sorted(after)]:
        road, _, lane = data.keys[i]
        for place in data.network.roads[road].lights:
            spans_all = place.low == 0 == place.high
            if place.signal not in known or (spans_all and i in arm.lanes):
                continue  # a post beside the approach without a list of lanes may face another road
            if spans_all or place.low <= lane <= place.high:
                votes[place.signal] += 1
    return min(votes, key=lambda signal: (-votes[signal], signal)) if votes else None


def _phases(data: Approaches, arms: list[_Approach]) -> list[int]:
    """Phase of each arm: the map's, unless it shows green to arms that cross."""
    given = [data.network.phase.get(arm.light or "") for arm in arms]
    if all(phase is not None for phase in given) and len(set(given)) > 1:
        order = sorted({phase for phase in given if phase is not None})
        mapped = [order.index(phase) for phase in given if phase is not None]
        pairs = ((k, m) for k in range(len(arms)) for m in range(k) if mapped[k] == mapped[m])
        if not any(_cross(data, arms[k], arms[m]) for k, m in pairs):
            return mapped
    phases: list[int] = []
    for k, arm in enumerate(arms):
        same = -1
        for m in range(k):
            if _heading(data, arm, arms[m]) < FACING and same < 0:
                same = phases[m]
        phases.append(same if same >= 0 else max(phases, default=-1) + 1)
    return phases


def _heading(data: Approaches, one: _Approach, other: _Approach) -> float:
    """Cosine of the angle between the traffic of two arms: -1 if they face each other."""
    return float(np.cos(data.end[one.lanes[0], 2] - data.end[other.lanes[0], 2]))


def _cross(data: Approaches, one: _Approach, other: _Approach) -> bool:
    """Whether the traffic of two arms comes neither from opposite sides nor from the same one."""
    return FACING <= _heading(data, one, other) <= -FACING


def _stop(data: Approaches, lane: int) -> float:
    """Arc length of the stop line: the end of the lane, or before a crosswalk on its last metres."""
    xy, s = data.line[lane]
    at = np.arange(max(0.0, s[-1] - _TAIL), s[-1], 0.25)
    points = np.stack([np.interp(at, s, xy[:, k]) for k in range(2)], axis=1)
    stop = float(s[-1])
    for area in data.crosswalks:
        hit = in_polygon(points, area)
        if hit.any():
            stop = min(stop, float(at[hit][0]) - SETBACK)
    return max(stop, 0.0)


def signal_names(graph: LaneGraph, network: Network) -> dict[int, str]:
    """The id that each signal of a lane graph has in the OpenDRIVE map it was made from; virtual ones have none.

    The rule is that of `place_signals`: the map ties a light to lanes of an approach, or to the lanes after them.
    """
    names: dict[int, str] = {}
    known = set(network.lights)
    for signal in np.flatnonzero(~graph.signal_virtual).tolist():
        lanes = graph.stop_lane[graph.stop_signal == signal].tolist()
        after = {int(n) for lane in lanes for n in graph.successors(lane) if graph.junction[n] >= 0}
        votes: Counter[str] = Counter()
        for lane in [*lanes, *sorted(after)]:
            number = int(graph.lane_id[lane])
            for place in network.roads[int(graph.road[lane])].lights:
                spans_all = place.low == 0 == place.high
                if place.signal in known and not (spans_all and lane in lanes):
                    votes[place.signal] += spans_all or place.low <= number <= place.high
        best = min(votes, key=lambda name: (-votes[name], name), default="")
        if votes[best]:
            names[signal] = best
    return names
