"""Placement of signals and signs: position, controlled lanes, and phases of simultaneous green."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from functools import cached_property
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
    """Lane data for the placement of signals; rows are lanes."""

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
    forward: npt.NDArray[np.bool_]  # [L] traffic runs along the road
    left_hand: bool  # traffic keeps to the left
    stop_lines: F64  # [., 2] x, y of the middles of painted lines

    @cached_property
    def lanes_of_junction(self) -> dict[int, list[int]]:
        """Lanes of each junction."""
        lanes: dict[int, list[int]] = {}
        for lane_index, junction in enumerate(self.junction.tolist()):
            lanes.setdefault(junction, []).append(lane_index)
        return lanes

    @cached_property
    def crosswalk_boxes(self) -> F64:
        """Lowest and highest x and y of each crosswalk [C, 2, 2]."""
        boxes = [(corners.min(axis=0), corners.max(axis=0)) for corners in self.crosswalks]
        return np.array(boxes, np.float64).reshape(-1, 2, 2)

    def post_beside(self, lane: int) -> tuple[float, float]:
        """Return x and y of a post beside the end of an outermost lane."""
        x, y, yaw = self.end[lane]
        lateral = (0.5 * float(self.width[lane]) + 1.0) * (-1.0 if self.left_hand else 1.0)
        return float(x + lateral * np.sin(yaw)), float(y - lateral * np.cos(yaw))


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
    signal_rows: list[tuple[float, float, float, int, int, bool]] = []
    stop_rows: list[tuple[int, int, float]] = []
    for junction, arms in _arms(data).items():
        approaches = [approach for approach in arms if approach.lanes]
        junction_lanes = data.lanes_of_junction.get(junction, [])
        for approach in approaches:
            approach.light = _facing(data, approach, junction_lanes)
        has_lights = any(approach.light for approach in approaches)
        if not approaches or (
            not has_lights and (len(arms) < ARMS or not _ways_meet(data, approaches, set(junction_lanes)))
        ):
            continue
        for approach, phase in zip(approaches, _phases(data, approaches), strict=True):
            # The outermost lane: OpenDRIVE numbers lanes outwards from the centre.
            outer = min(approach.lanes, key=lambda lane_index: -abs(data.keys[lane_index][2]))
            x, y, yaw = data.end[outer]
            if approach.light and approach.light in data.lights:
                x, y = data.lights[approach.light][:2]
            else:
                x, y = data.post_beside(outer)
            stop_rows += [(len(signal_rows), lane, _stop(data, lane)) for lane in approach.lanes]
            signal_rows.append((x, y, yaw, junction, phase, not has_lights))
    signal_table = np.array(signal_rows, np.float64).reshape(-1, 6)
    stop_table = np.array(stop_rows, np.float64).reshape(-1, 3)
    return {
        "signal_xy": signal_table[:, :2],
        "signal_yaw": signal_table[:, 2],
        "signal_junction": signal_table[:, 3].astype(np.int32),
        "signal_phase": signal_table[:, 4].astype(np.int32),
        "signal_virtual": signal_table[:, 5].astype(bool),
        "stop_signal": stop_table[:, 0].astype(np.int32),
        "stop_lane": stop_table[:, 1].astype(np.int32),
        "stop_s": stop_table[:, 2],
    }


def place_signs(data: Approaches) -> dict[str, Any]:
    """The sign and rule arrays of a LaneGraph: the stop and yield signs of the map that stand at junctions.

    A sign rules the lanes of one approach: those that the map names, by road and direction or by the connecting lanes
    behind them; where it names several approaches, the one that ends nearest to the sign.
    """
    predecessors: dict[int, list[int]] = {}
    for lane_index, successors in enumerate(data.links):
        for successor in successors:
            predecessors.setdefault(successor, []).append(lane_index)
    signed_lanes: dict[str, set[int]] = {}
    for lane_index, (road, _, lane) in enumerate(data.keys):
        for placement in data.network.roads[road].signs:
            in_direction = placement.way == 0 or (placement.way > 0) == data.forward[lane_index]
            if placement.sign not in data.network.signs or not in_direction:
                continue
            if placement.low == 0 == placement.high or placement.low <= lane <= placement.high:
                signed_lanes.setdefault(placement.sign, set()).update(
                    [lane_index] if data.junction[lane_index] < 0 else predecessors.get(lane_index, [])
                )
    sign_rows: list[tuple[float, float, float, int]] = []
    rule_rows: list[tuple[int, int, float]] = []
    for sign in sorted(signed_lanes, key=lambda sign_id: (len(sign_id), sign_id)):
        lanes = _lanes_of_approach(data, sign, signed_lanes[sign])
        if not lanes:
            continue
        outer_lane = min(lanes, key=lambda lane_index: -abs(data.keys[lane_index][2]))
        x, y, yaw = data.end[outer_lane]
        if sign in data.lights:
            x, y = data.lights[sign][:2]
        else:
            x, y = data.post_beside(outer_lane)
        rule_rows += [(len(sign_rows), lane, _stop(data, lane)) for lane in lanes]
        sign_rows.append((x, y, yaw, int(data.network.signs[sign])))
    sign_table = np.array(sign_rows, np.float64).reshape(-1, 4)
    rule_table = np.array(rule_rows, np.float64).reshape(-1, 3)
    return {
        "sign_kind": sign_table[:, 3].astype(np.uint8),
        "sign_xy": sign_table[:, :2],
        "sign_yaw": sign_table[:, 2],
        "rule_sign": rule_table[:, 0].astype(np.int32),
        "rule_lane": rule_table[:, 1].astype(np.int32),
        "rule_s": rule_table[:, 2],
    }


def _lanes_of_approach(data: Approaches, sign: str, sign_lanes: set[int]) -> list[int]:
    """Of the lanes that a sign is for, those of one approach to a junction."""
    approaches: dict[tuple[int, bool], list[int]] = {}
    for lane_index in sorted(sign_lanes):
        leads_in = any(
            data.junction[successor] >= 0 and data.kind[successor] == LaneType.DRIVING
            for successor in data.links[lane_index]
        )
        if data.kind[lane_index] == LaneType.DRIVING and data.junction[lane_index] < 0 and leads_in:
            approaches.setdefault((data.keys[lane_index][0], bool(data.forward[lane_index])), []).append(lane_index)
    if len(approaches) < 2 or sign not in data.lights:
        return next(iter(approaches.values()), [])
    x, y = data.lights[sign][:2]
    return min(
        approaches.values(),
        key=lambda lanes: min(np.hypot(*(data.end[lane_index, :2] - [x, y])) for lane_index in lanes),
    )


def _arms(data: Approaches) -> dict[int, list[_Approach]]:
    """Arms of every junction: (road, end) pairs, with the driving lanes that lead in (may be none)."""
    arms_by_junction: dict[int, dict[tuple[int, bool], _Approach]] = {}
    for lane_index, successors in enumerate(data.links):
        if data.kind[lane_index] != LaneType.DRIVING:
            continue
        road = data.keys[lane_index][0]
        for successor in successors:
            if data.kind[successor] != LaneType.DRIVING:
                continue
            own_junction, next_junction = int(data.junction[lane_index]), int(data.junction[successor])
            if own_junction == next_junction:
                continue
            if next_junction >= 0:
                approach = arms_by_junction.setdefault(next_junction, {}).setdefault(
                    (road, bool(data.forward[lane_index])), _Approach(next_junction, [])
                )
                if lane_index not in approach.lanes:
                    approach.lanes.append(lane_index)
            if own_junction >= 0:
                exit_road = data.keys[successor][0]
                arms_by_junction.setdefault(own_junction, {}).setdefault(
                    (exit_road, not data.forward[successor]), _Approach(own_junction, [])
                )
    return {
        junction: [successors[key] for key in sorted(successors)]
        for junction, successors in sorted(arms_by_junction.items())
    }


def _ways_meet(data: Approaches, arms: list[_Approach], inner: set[int]) -> bool:
    """Return True if ways of different arms come close enough for contact; never at a motorway's interchange."""
    paths_by_arm = [
        [
            data.line[connecting_lane][0]
            for connecting_lane in sorted(
                {connecting_lane for lane_index in arm.lanes for connecting_lane in data.links[lane_index]} & inner
            )
        ]
        for arm in arms
    ]
    pairs = (
        (path, other_path)
        for arm_index, own_paths in enumerate(paths_by_arm)
        for other_paths in paths_by_arm[arm_index + 1 :]
        for path in own_paths
        for other_path in other_paths
    )
    return any(
        float(np.hypot(*np.moveaxis(path[:, None] - other_path[None], -1, 0)).min()) < TOUCHING
        for path, other_path in pairs
    )


def _facing(data: Approaches, arm: _Approach, inner: list[int]) -> str | None:
    """The light that the map ties to an arm: on its own lanes, or on the connecting lanes after them."""
    light_ids = set(data.network.lights)
    votes: Counter[str] = Counter()
    connecting_lanes = {successor for lane_index in arm.lanes for successor in data.links[lane_index]} & set(inner)
    for lane_index in [*arm.lanes, *sorted(connecting_lanes)]:
        road, _, lane = data.keys[lane_index]
        for placement in data.network.roads[road].lights:
            spans_all = placement.low == 0 == placement.high
            if placement.signal not in light_ids or (spans_all and lane_index in arm.lanes):
                continue  # a post beside the approach without a list of lanes may face another road
            if spans_all or placement.low <= lane <= placement.high:
                votes[placement.signal] += 1
    return min(votes, key=lambda signal: (-votes[signal], signal)) if votes else None


def _phases(data: Approaches, arms: list[_Approach]) -> list[int]:
    """Phase of each arm: the map's, unless it shows green to arms that cross."""
    map_phases = [data.network.phase.get(arm.light or "") for arm in arms]
    if all(phase is not None for phase in map_phases) and len(set(map_phases)) > 1:
        phase_order = sorted({phase for phase in map_phases if phase is not None})
        mapped_phases = [phase_order.index(phase) for phase in map_phases if phase is not None]
        pairs = (
            (arm_index, other_index)
            for arm_index in range(len(arms))
            for other_index in range(arm_index)
            if mapped_phases[arm_index] == mapped_phases[other_index]
        )
        # Phases that show green to crossing arms at once are not used.
        if not any(_cross(data, arms[arm_index], arms[other_index]) for arm_index, other_index in pairs):
            return mapped_phases
    phases: list[int] = []
    for arm_index, arm in enumerate(arms):
        shared_phase = -1
        for other_index in range(arm_index):
            if _heading(data, arm, arms[other_index]) < FACING and shared_phase < 0:
                shared_phase = phases[other_index]
        phases.append(shared_phase if shared_phase >= 0 else max(phases, default=-1) + 1)
    return phases


def _heading(data: Approaches, first: _Approach, second: _Approach) -> float:
    """Cosine of the angle between the traffic of two arms: -1 if they face each other."""
    return float(np.cos(data.end[first.lanes[0], 2] - data.end[second.lanes[0], 2]))


def _cross(data: Approaches, first: _Approach, second: _Approach) -> bool:
    """Return True if the traffic of two arms comes neither from opposite sides nor from the same side."""
    return FACING <= _heading(data, first, second) <= -FACING


def _stop(data: Approaches, lane: int) -> float:
    """Arc length of the stop line: the end of the lane, or before a crosswalk or a painted line on its last metres."""
    xy, arc_length = data.line[lane]
    positions = np.arange(max(0.0, arc_length[-1] - _TAIL), arc_length[-1], 0.25)
    points = np.stack([np.interp(positions, arc_length, xy[:, axis]) for axis in range(2)], axis=1)
    stop = float(arc_length[-1])
    boxes = data.crosswalk_boxes
    near = ((boxes[:, 1] >= points.min(axis=0)) & (boxes[:, 0] <= points.max(axis=0))).all(axis=1)
    for row in np.flatnonzero(near).tolist():
        crosswalk = data.crosswalks[row]
        on_crosswalk = in_polygon(points, crosswalk)
        if on_crosswalk.any():
            stop = min(stop, float(positions[on_crosswalk][0]) - SETBACK)
    if len(data.stop_lines):
        offsets = data.stop_lines - xy[-1]
        for line in data.stop_lines[np.hypot(*offsets.T) < _TAIL]:
            distances = np.hypot(*(points - line).T)
            nearest = int(distances.argmin())
            if nearest > 0 and distances[nearest] <= data.width[lane] + 0.25:
                stop = min(stop, float(positions[nearest]))
    return max(stop, 0.0)


def signal_names(graph: LaneGraph, network: Network) -> dict[int, str]:
    """Return the OpenDRIVE id of each signal of a lane graph; virtual signals have none.

    The rule is that of `place_signals`: the map ties a light to lanes of an approach, or to the lanes after them.
    """
    names: dict[int, str] = {}
    light_ids = set(network.lights)
    for signal in np.flatnonzero(~graph.signal_virtual).tolist():
        lanes = graph.stop_lane[graph.stop_signal == signal].tolist()
        connecting_lanes = {
            int(successor) for lane in lanes for successor in graph.successors(lane) if graph.junction[successor] >= 0
        }
        votes: Counter[str] = Counter()
        for lane in [*lanes, *sorted(connecting_lanes)]:
            lane_id = int(graph.lane_id[lane])
            for placement in network.roads[int(graph.road[lane])].lights:
                spans_all = placement.low == 0 == placement.high
                if placement.signal in light_ids and not (spans_all and lane in lanes):
                    votes[placement.signal] += spans_all or placement.low <= lane_id <= placement.high
        winner = min(votes, key=lambda name: (-votes[name], name), default="")
        if votes[winner]:
            names[signal] = winner
    return names
