"""A lane graph as CommonRoad's lanelets, signs, lights and intersections.

A lanelet is one lane of the graph, also sidewalks, shoulders and crosswalks; its bounds are its centre line moved by
half its width to either side.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ssad.core.lane_graph import LaneGraph, Marking, SignKind
from ssad.core.types import F64, LaneType, SignalState
from ssad.core.wording import counted
from ssad.interchange import commonroad_xml as xml
from ssad.interchange.commonroad_xml import add_element
from ssad.scenarios.dynamic.knowledge._placing import turn_of
from ssad.world.episode_arrays import signal_programs

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

FLAT: Final = 0.5  # m between the lowest and highest point of a town that is written without heights
_TURN = math.radians(25.0)


def write_lanes(
    root: Element, graph: LaneGraph, forced: Mapping[int, SignalState], *, dt: float, number: int
) -> tuple[int, list[str]]:
    """Lanelets, signs, lights and intersections of a town.

    Args:
        root: Takes them.
        graph: The town. Lane k becomes lanelet k + 1.
        forced: Signals that show one state all the time.
        dt: Step in which the cycles of lights are counted, s.
        number: First id that is free for what is no lane.

    Returns:
        The next free id, and what is not carried over.
    """
    ids = _IdCounter(number)
    speed_sign_ids = {speed: ids.next_id() for speed in sorted({float(limit) for limit in graph.speed_limit})}
    signal_indices = [
        index for index in range(len(graph.signal_phase)) if not graph.signal_virtual[index] or index in forced
    ]
    light_ids = {index: ids.next_id() for index in signal_indices}
    sign_ids = {index: ids.next_id() for index in range(len(graph.sign_kind))}
    lane_lights: dict[int, list[tuple[float, int]]] = defaultdict(list)
    lane_signs: dict[int, list[tuple[float, int]]] = defaultdict(list)
    for signal, lane, s in zip(graph.stop_signal.tolist(), graph.stop_lane.tolist(), graph.stop_s, strict=True):
        if signal in light_ids:
            lane_lights[lane].append((float(s), light_ids[signal]))
    for sign_index, lane, s in zip(graph.rule_sign.tolist(), graph.rule_lane.tolist(), graph.rule_s, strict=True):
        lane_signs[lane].append((float(s), sign_ids[sign_index]))
    with_heights = float(np.ptp(graph.z)) > FLAT
    for lane in range(graph.lane_count):
        _write_lanelet(
            root,
            graph,
            lane,
            speed_sign_ids[float(graph.speed_limit[lane])],
            lane_lights[lane],
            lane_signs[lane],
            with_heights,
        )
    for index in range(len(graph.crosswalk_offset) - 1):
        _write_crosswalk(root, graph, index, ids.next_id())
    for speed, sign_index in speed_sign_ids.items():
        _write_sign(root, sign_index, xml.TOP_SPEED, graph.xy[0].tolist(), speed)
    for index, sign_index in sign_ids.items():
        _write_sign(
            root,
            sign_index,
            xml.STOP if graph.sign_kind[index] == SignKind.STOP else xml.YIELD,
            graph.sign_xy[index].tolist(),
        )
    programs = signal_programs(graph)
    for index, light_id in light_ids.items():
        _write_light(root, light_id, graph.signal_xy[index], forced.get(index), programs[index].tolist(), dt)
    _write_intersections(root, graph, ids)
    hidden_count = len(graph.signal_phase) - len(signal_indices)
    omissions = [f"{counted(hidden_count, 'place')} of signals that the map does not have"] if hidden_count else []
    return ids.next, omissions


class _IdCounter:
    def __init__(self, first: int) -> None:
        self.next = first

    def next_id(self) -> int:
        self.next += 1
        return self.next - 1


def _bounds(graph: LaneGraph, lane: int, high: bool) -> list[F64]:
    points_slice = graph.points(lane)
    yaw, half_width = graph.yaw[points_slice].astype(np.float64), 0.5 * graph.width[points_slice].astype(np.float64)
    normal = np.stack([-np.sin(yaw), np.cos(yaw)], 1) * half_width[:, None]
    sides = [graph.xy[points_slice] + sign * normal for sign in (1.0, -1.0)]
    return [np.column_stack([side, graph.z[points_slice]]) if high else side for side in sides]


def _write_lanelet(  # noqa: PLR0917
    root: Element,
    graph: LaneGraph,
    lane: int,
    speed: int,
    lights: list[tuple[float, int]],
    signs: list[tuple[float, int]],
    high: bool,
) -> None:
    element = add_element(root, "lanelet", id=lane + 1)
    markings = graph.left_marking[lane], graph.right_marking[lane]
    for tag, bound_points, marking in zip(
        ("leftBound", "rightBound"), _bounds(graph, lane, high), markings, strict=True
    ):
        bound = add_element(element, tag)
        xml.points(bound, bound_points)
        add_element(bound, "lineMarking", xml.MARKINGS[Marking(int(marking))])
    for tag, neighbours in (("predecessor", graph.predecessors(lane)), ("successor", graph.successors(lane))):
        for neighbour in neighbours.tolist():
            add_element(element, tag, ref=neighbour + 1)
    for tag, neighbour in (("adjacentLeft", int(graph.left[lane])), ("adjacentRight", int(graph.right[lane]))):
        if neighbour >= 0:
            same_direction = graph.is_same_direction(lane, neighbour)
            add_element(element, tag, ref=neighbour + 1, drivingDir="same" if same_direction else "opposite")
    if stops := lights or signs:
        x, y, yaw, width = graph.at(lane, stops[0][0])
        half_line = 0.5 * width * np.array([-math.sin(yaw), math.cos(yaw)])
        line = add_element(element, "stopLine")
        xml.points(line, [np.array([x, y]) + half_line, np.array([x, y]) - half_line])
        add_element(line, "lineMarking", "solid")
        for tag, references in (("trafficSignRef", signs), ("trafficLightRef", lights)):
            for _, reference in references:
                add_element(line, tag, ref=reference)
    add_element(element, "laneletType", xml.LANE_TYPES[LaneType(int(graph.kind[lane]))])
    if graph.junction[lane] >= 0:
        add_element(element, "laneletType", "intersection")
    add_element(element, "trafficSignRef", ref=speed)
    for tag, references in (("trafficSignRef", signs), ("trafficLightRef", lights)):
        for _, reference in references:
            add_element(element, tag, ref=reference)


def _write_crosswalk(root: Element, graph: LaneGraph, k: int, number: int) -> None:
    corners = graph.crosswalk(k)
    half = len(corners) // 2
    element = add_element(root, "lanelet", id=number)
    # The outline runs around the crosswalk; both bounds must run in one direction.
    for tag, bound_points in (("leftBound", corners[:half]), ("rightBound", corners[half:][::-1])):
        xml.points(add_element(element, tag), bound_points)
    add_element(element, "laneletType", "crosswalk")
    add_element(element, "userBidirectional", "pedestrian")


def _write_sign(root: Element, number: int, kind: str, place: list[float], value: float | None = None) -> None:
    sign = add_element(root, "trafficSign", id=number)
    sign_element = add_element(sign, "trafficSignElement")
    add_element(sign_element, "trafficSignID", kind)
    if value is not None:
        add_element(sign_element, "additionalValue", value)
    xml.points(add_element(sign, "position"), [place])
    add_element(sign, "virtual", value is not None)


def _write_light(  # noqa: PLR0917
    root: Element, number: int, place: Any, state: SignalState | None, program: list[float], dt: float
) -> None:
    cycle, offset, green, yellow = (round(value / dt) for value in program)
    cycle_parts = [(1, state)] if state is not None else []
    if state is None:
        red_duration = cycle - green - yellow
        cycle_parts = [(green, SignalState.GREEN), (yellow, SignalState.YELLOW), (red_duration, SignalState.RED)]
    light = add_element(root, "trafficLight", id=number)
    cycle_element = add_element(light, "cycle")
    for duration, colour in cycle_parts:
        cycle_part = add_element(cycle_element, "cycleElement")
        add_element(cycle_part, "duration", duration)
        add_element(cycle_part, "color", xml.COLOURS[SignalState(int(colour))])
    if state is None and offset > 0:
        add_element(cycle_element, "timeOffset", offset)
    xml.points(add_element(light, "position"), [place])
    add_element(light, "direction", "all")
    add_element(light, "active", True)


def _write_intersections(root: Element, graph: LaneGraph, numbers: _IdCounter) -> None:
    for junction in sorted({int(lane_junction) for lane_junction in graph.junction} - {-1}):
        inner_lanes = np.flatnonzero((graph.junction == junction) & (graph.kind == LaneType.DRIVING)).tolist()
        lanes_by_entry: dict[int, list[int]] = defaultdict(list)
        for lane in inner_lanes:
            for entry_lane in graph.predecessors(lane).tolist():
                if graph.junction[entry_lane] != junction:
                    lanes_by_entry[entry_lane].append(lane)
        if not lanes_by_entry:
            continue
        element = add_element(root, "intersection", id=numbers.next_id())
        for entry_lane, following in sorted(lanes_by_entry.items()):
            incoming = add_element(element, "incoming", id=numbers.next_id())
            add_element(incoming, "incomingLanelet", ref=entry_lane + 1)
            turns = {lane: turn_of(graph, lane) for lane in following}
            for tag, low, high in (
                ("Right", -math.inf, -_TURN),
                ("Straight", -_TURN, _TURN),
                ("Left", _TURN, math.inf),
            ):
                for lane, turn in turns.items():
                    if low <= turn < high:
                        add_element(incoming, f"successors{tag}", ref=lane + 1)
