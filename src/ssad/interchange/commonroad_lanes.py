"""A lane graph as CommonRoad's lanelets, signs, lights and intersections.

A lanelet is one lane of the graph, also sidewalks, shoulders and crosswalks; its bounds are its centre line, half its
width to either side.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ssad.core.lane_graph import LaneGraph, Marking, SignKind
from ssad.core.types import F64, LaneType, SignalState
from ssad.interchange import commonroad_xml as xml
from ssad.interchange.commonroad_xml import node
from ssad.scenarios.dynamic.knowledge._placing import turn_of
from ssad.world.episode_arrays import signal_programs

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

FLAT: Final = 0.5  # m between the lowest and the highest point of a town whose heights are not written
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
    numbers = _Numbers(number)
    speeds = {speed: numbers.new() for speed in sorted({float(v) for v in graph.speed_limit})}
    lit = [k for k in range(len(graph.signal_phase)) if not graph.signal_virtual[k] or k in forced]
    lights = {k: numbers.new() for k in lit}
    signs = {k: numbers.new() for k in range(len(graph.sign_kind))}
    lane_lights: dict[int, list[tuple[float, int]]] = defaultdict(list)
    lane_signs: dict[int, list[tuple[float, int]]] = defaultdict(list)
    for signal, lane, s in zip(graph.stop_signal.tolist(), graph.stop_lane.tolist(), graph.stop_s, strict=True):
        if signal in lights:
            lane_lights[lane].append((float(s), lights[signal]))
    for sign, lane, s in zip(graph.rule_sign.tolist(), graph.rule_lane.tolist(), graph.rule_s, strict=True):
        lane_signs[lane].append((float(s), signs[sign]))
    high = float(np.ptp(graph.z)) > FLAT
    for lane in range(graph.lanes):
        _lanelet(root, graph, lane, speeds[float(graph.speed_limit[lane])], lane_lights[lane], lane_signs[lane], high)
    for k in range(len(graph.crosswalk_offset) - 1):
        _crosswalk(root, graph, k, numbers.new())
    for speed, sign in speeds.items():
        _sign(root, sign, xml.TOP_SPEED, graph.xy[0].tolist(), speed)
    for k, sign in signs.items():
        _sign(root, sign, xml.STOP if graph.sign_kind[k] == SignKind.STOP else xml.YIELD, graph.sign_xy[k].tolist())
    programs = signal_programs(graph)
    for k, light in lights.items():
        _light(root, light, graph.signal_xy[k], forced.get(k), programs[k].tolist(), dt)
    _intersections(root, graph, numbers)
    hidden = len(graph.signal_phase) - len(lit)
    lost = [f"{hidden} places of signals that the map does not have"] if hidden else []
    return numbers.next, lost


class _Numbers:
    def __init__(self, first: int) -> None:
        self.next = first

    def new(self) -> int:
        self.next += 1
        return self.next - 1


def _bounds(graph: LaneGraph, lane: int, high: bool) -> list[F64]:
    part = graph.points(lane)
    yaw, half = graph.yaw[part].astype(np.float64), 0.5 * graph.width[part].astype(np.float64)
    normal = np.stack([-np.sin(yaw), np.cos(yaw)], 1) * half[:, None]
    sides = [graph.xy[part] + sign * normal for sign in (1.0, -1.0)]
    return [np.column_stack([side, graph.z[part]]) if high else side for side in sides]


def _lanelet(  # noqa: PLR0917
    root: Element,
    graph: LaneGraph,
    lane: int,
    speed: int,
    lights: list[tuple[float, int]],
    signs: list[tuple[float, int]],
    high: bool,
) -> None:
    element = node(root, "lanelet", id=lane + 1)
    marks = graph.left_marking[lane], graph.right_marking[lane]
    for tag, side, mark in zip(("leftBound", "rightBound"), _bounds(graph, lane, high), marks, strict=True):
        bound = node(element, tag)
        xml.points(bound, side)
        node(bound, "lineMarking", xml.MARKINGS[Marking(int(mark))])
    for tag, others in (("predecessor", graph.predecessors(lane)), ("successor", graph.successors(lane))):
        for other in others.tolist():
            node(element, tag, ref=other + 1)
    for tag, other in (("adjacentLeft", int(graph.left[lane])), ("adjacentRight", int(graph.right[lane]))):
        if other >= 0:
            same = graph.same_direction(lane, other)
            node(element, tag, ref=other + 1, drivingDir="same" if same else "opposite")
    if stops := lights or signs:
        x, y, yaw, width = graph.at(lane, stops[0][0])
        across = 0.5 * width * np.array([-math.sin(yaw), math.cos(yaw)])
        line = node(element, "stopLine")
        xml.points(line, [np.array([x, y]) + across, np.array([x, y]) - across])
        node(line, "lineMarking", "solid")
        for tag, refs in (("trafficSignRef", signs), ("trafficLightRef", lights)):
            for _, ref in refs:
                node(line, tag, ref=ref)
    node(element, "laneletType", xml.LANE_TYPES[LaneType(int(graph.kind[lane]))])
    if graph.junction[lane] >= 0:
        node(element, "laneletType", "intersection")
    node(element, "trafficSignRef", ref=speed)
    for tag, refs in (("trafficSignRef", signs), ("trafficLightRef", lights)):
        for _, ref in refs:
            node(element, tag, ref=ref)


def _crosswalk(root: Element, graph: LaneGraph, k: int, number: int) -> None:
    corners = graph.crosswalk(k)
    half = len(corners) // 2
    element = node(root, "lanelet", id=number)
    for tag, side in (("leftBound", corners[:half]), ("rightBound", corners[half:][::-1])):
        xml.points(node(element, tag), side)
    node(element, "laneletType", "crosswalk")
    node(element, "userBidirectional", "pedestrian")


def _sign(root: Element, number: int, kind: str, place: list[float], value: float | None = None) -> None:
    sign = node(root, "trafficSign", id=number)
    part = node(sign, "trafficSignElement")
    node(part, "trafficSignID", kind)
    if value is not None:
        node(part, "additionalValue", value)
    xml.points(node(sign, "position"), [place])
    node(sign, "virtual", value is not None)


def _light(  # noqa: PLR0917
    root: Element, number: int, place: Any, state: SignalState | None, program: list[float], dt: float
) -> None:
    cycle, begin, green, yellow = (round(value / dt) for value in program)
    parts = [(1, state)] if state is not None else []
    if state is None:
        rest = cycle - green - yellow
        parts = [(green, SignalState.GREEN), (yellow, SignalState.YELLOW), (rest, SignalState.RED)]
    light = node(root, "trafficLight", id=number)
    told = node(light, "cycle")
    for duration, shown in parts:
        element = node(told, "cycleElement")
        node(element, "duration", duration)
        node(element, "color", xml.COLOURS[SignalState(int(shown))])
    if state is None and begin > 0:
        node(told, "timeOffset", begin)
    xml.points(node(light, "position"), [place])
    node(light, "direction", "all")
    node(light, "active", True)


def _intersections(root: Element, graph: LaneGraph, numbers: _Numbers) -> None:
    for junction in sorted({int(n) for n in graph.junction} - {-1}):
        inner = np.flatnonzero((graph.junction == junction) & (graph.kind == LaneType.DRIVING)).tolist()
        ways: dict[int, list[int]] = defaultdict(list)
        for lane in inner:
            for before in graph.predecessors(lane).tolist():
                if graph.junction[before] != junction:
                    ways[before].append(lane)
        if not ways:
            continue
        element = node(root, "intersection", id=numbers.new())
        for before, lanes in sorted(ways.items()):
            incoming = node(element, "incoming", id=numbers.new())
            node(incoming, "incomingLanelet", ref=before + 1)
            turns = {lane: turn_of(graph, lane) for lane in lanes}
            for tag, low, high in (
                ("Right", -math.inf, -_TURN),
                ("Straight", -_TURN, _TURN),
                ("Left", _TURN, math.inf),
            ):
                for lane, turn in turns.items():
                    if low <= turn < high:
                        node(incoming, f"successors{tag}", ref=lane + 1)
