"""CommonRoad's lanelets, signs, lights and intersections as a lane graph; the inverse of `commonroad_lanes`.

The middle of its bounds is the centre line of a lane, and lanes side by side form a road.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ssad.core.import_report import ImportReport
from ssad.core.lane_graph import LaneGraph, Marking, SignKind
from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, LaneType, SignalState
from ssad.interchange import commonroad_xml as xml
from ssad.interchange.commonroad_xml import TextReader, element_name

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

SPEED: Final = 50.0 / 3.6  # m/s without a sign
MAX_LANELETS: Final = 20_000
_TURNS = ("Right", "Straight", "Left")
_ASKEW = math.radians(15.0)
_MIN_STEP = 1e-3  # m between points of a lane; closer ones are dropped


@dataclass(frozen=True)
class ImportedLanes:
    """The roads of a CommonRoad file.

    Attributes:
        graph: Their lane graph.
        lane_of: Id of a lanelet -> its lane.
        states: Number of a signal -> the state that its light shows permanently.
        cycles: Number of lights that change.
    """

    graph: LaneGraph
    lane_of: Mapping[int, int]
    states: Mapping[int, SignalState]
    cycles: int


def read_lanes(root: Element, texts: TextReader, name: str, report: ImportReport) -> ImportedLanes:
    """Build the lane graph of a file's lanelets.

    Args:
        root: The document.
        texts: Reads its texts.
        name: Name of the town.
        report: Filled with what came in, what is not carried over, and what is doubtful.

    Raises:
        FormatError: Lanelets are broken, or have dangling references.
        MapError: They form no valid town.
    """
    elements = root.findall("lanelet")
    if not elements:
        raise texts.error("commonRoad", "it has no lanelet")
    if len(elements) > MAX_LANELETS:
        raise texts.error("commonRoad", f"{len(elements)} lanelets, at most {MAX_LANELETS}")
    types_by_element = {
        id(lanelet): [type_element.text or "" for type_element in lanelet.iterfind("laneletType")]
        for lanelet in elements
    }
    crosswalks = [lanelet for lanelet in elements if "crosswalk" in types_by_element[id(lanelet)]]
    lanelets = [lanelet for lanelet in elements if "crosswalk" not in types_by_element[id(lanelet)]]
    if not lanelets:
        raise texts.error("commonRoad", "it has no lanelet but crosswalks")
    lane_of: dict[int, int] = {}
    for lane_index, element in enumerate(lanelets):
        lanelet_id = texts.whole(element.get("id"), element, "id")
        if lanelet_id in lane_of:
            raise texts.error(element, "there are two of this id")
        lane_of[lanelet_id] = lane_index
    return _LaneletReader(
        texts, report, lanelets, lane_of, [types_by_element[id(lanelet)] for lanelet in lanelets]
    ).read(root, name, crosswalks)


class _LaneletReader:
    def __init__(
        self,
        texts: TextReader,
        report: ImportReport,
        lanes: list[Element],
        lane_of: dict[int, int],
        kinds: list[list[str]],
    ) -> None:
        self.texts, self.report, self.lanes, self.lane_of, self.kinds = texts, report, lanes, lane_of, kinds

    def read(self, root: Element, name: str, walks: list[Element]) -> ImportedLanes:
        shapes = self.shapes = [self._shape(element) for element in self.lanes]
        count = len(shapes)
        left, right, road, direction = self._adjacent_lanes()
        successors = [self._lane_refs(element, "successor") for element in self.lanes]
        for lane_index, element in enumerate(self.lanes):
            for predecessor in self._lane_refs(element, "predecessor"):
                # A file may give a link at one of its ends only.
                if lane_index not in successors[predecessor]:
                    successors[predecessor].append(lane_index)
        junction = self._junctions(root, successors)
        markings = [self._markings(element) for element in self.lanes]
        speed_limits = self._limits(root)
        outlines = [
            np.concatenate(
                [
                    self.texts.points(crosswalk.find("leftBound"), crosswalk, "leftBound"),
                    self.texts.points(crosswalk.find("rightBound"), crosswalk, "rightBound")[::-1],
                ]
            )[:, :2]
            for crosswalk in walks
        ]
        self.graph = LaneGraph(
            name=name,
            xy=np.concatenate([shape[:, :2] for shape in shapes]).astype(np.float32),
            z=np.concatenate([shape[:, 2] for shape in shapes]).astype(np.float32),
            yaw=np.concatenate([shape[:, 3] for shape in shapes]).astype(np.float32),
            width=np.concatenate([shape[:, 4] for shape in shapes]).astype(np.float32),
            s=np.concatenate([shape[:, 5] for shape in shapes]).astype(np.float32),
            offset=np.cumsum([0, *(len(shape) for shape in shapes)]).astype(np.int32),
            kind=np.array([_kind(type_names) for type_names in self.kinds], np.uint8),
            road=road,
            section=np.zeros(count, np.int32),
            lane_id=(direction * (np.arange(count) + 1)).astype(np.int32),
            junction=junction,
            speed_limit=speed_limits,
            left=left,
            right=right,
            left_marking=np.array([marking[0] for marking in markings], np.uint8),
            right_marking=np.array([marking[1] for marking in markings], np.uint8),
            succ_offset=np.cumsum([0, *(len(lane_successors) for lane_successors in successors)]).astype(np.int32),
            succ=np.array([lane_index for lane_successors in successors for lane_index in lane_successors], np.int32),
            crosswalk_offset=np.cumsum([0, *(len(outline) for outline in outlines)]).astype(np.int32),
            crosswalk_xy=np.concatenate([np.zeros((0, 2)), *outlines]).astype(np.float32),
            **self._signs(root, shapes, "trafficSign"),
            **self._signals(root, shapes, junction, successors),
        )
        self._note_other_uses()
        return ImportedLanes(self.graph, self.lane_of, self.states, self.cycles)

    def _note_other_uses(self) -> None:
        """Add to the report the uses of lanelets that a lane has not."""
        for element, names in zip(self.lanes, self.kinds, strict=True):
            if element.find("userBidirectional") is not None and _kind(names) == LaneType.DRIVING:
                self.report.omit("traffic in the second direction of lanelets that have two", element_name(element))

    def _shape(self, element: Element) -> F64:
        """Return [N, 6] x, y, z, yaw, width, s of a lanelet."""
        sides = [self.texts.points(element.find(tag), element, tag) for tag in ("leftBound", "rightBound")]
        if min(len(side) for side in sides) < 2:
            raise self.texts.error(element, "a bound has fewer than two points")
        if len(sides[0]) != len(sides[1]):
            self.report.note(
                "lanelets whose bounds have different numbers of points are resampled", element_name(element)
            )
            sides = [_resample(side, max(map(len, sides))) for side in sides]
        middle = 0.5 * (sides[0] + sides[1])
        spacing = np.hypot(*np.diff(middle[:, :2], axis=0).T)
        is_distinct = np.concatenate([[True], spacing > _MIN_STEP])
        sides, middle = [side[is_distinct] for side in sides], middle[is_distinct]
        if len(middle) < 2:
            raise self.texts.error(element, "its points all lie in one place")
        tangent = np.gradient(middle[:, :2], axis=0)
        path_heading = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
        across = (sides[0] - sides[1])[:, :2]
        width = np.hypot(*across.T)
        # where the bounds lie straight across from each other, the line between them gives the heading exactly
        bound_heading = np.arctan2(across[:, 1], across[:, 0]) - 0.5 * np.pi
        heading_error = np.asarray(wrap_angle(bound_heading - path_heading))
        yaw = np.where((np.abs(heading_error) < _ASKEW) & (width > 0.01), path_heading + heading_error, path_heading)
        # Arc length of the circle through both points: the chord times half the turn over its sine.
        half_turn = np.maximum(0.5 * np.abs(np.diff(yaw)), 1e-6)
        arc_steps = np.hypot(*np.diff(middle[:, :2], axis=0).T) * np.where(
            half_turn < 1.0, half_turn / np.sin(half_turn), 1.0
        )
        s = np.concatenate([[0.0], np.cumsum(arc_steps)])
        return np.column_stack([middle, yaw, width, s])

    def _lane_refs(self, element: Element, tag: str) -> list[int]:
        lanes = []
        for lanelet_id in self.texts.ids(element, tag):
            if lanelet_id not in self.lane_of:
                raise self.texts.error(element, f"{tag} {lanelet_id}: there is no such lanelet")
            lanes.append(self.lane_of[lanelet_id])
        return lanes

    def _adjacent_lanes(self) -> tuple[Any, Any, Any, Any]:
        """Return the lanes to the left and right, and the road (lanes side by side) and direction of each lane."""
        count = len(self.lanes)
        sides = np.full((2, count), -1, np.int32)
        neighbours: list[list[tuple[int, int]]] = [[] for _ in range(count)]
        for lane_index, element in enumerate(self.lanes):
            for side_index, tag in enumerate(("adjacentLeft", "adjacentRight")):
                for neighbour, reference in zip(self._lane_refs(element, tag), element.iterfind(tag), strict=True):
                    sign = -1 if reference.get("drivingDir") == "opposite" else 1
                    sides[side_index, lane_index] = neighbour
                    neighbours[lane_index].append((neighbour, sign))
                    neighbours[neighbour].append((lane_index, sign))
        road, direction = np.full(count, -1, np.int32), np.ones(count, np.int32)
        # Lanes that are connected by adjacency form one road: flood fill from each lane without a road.
        for root_lane in range(count):
            if road[root_lane] >= 0:
                continue
            road[root_lane], pending = root_lane, [root_lane]
            while pending:
                lane_index = pending.pop()
                for neighbour, sign in neighbours[lane_index]:
                    if road[neighbour] < 0:
                        road[neighbour], direction[neighbour] = root_lane, direction[lane_index] * sign
                        pending.append(neighbour)
        return sides[0], sides[1], road, -direction

    def _markings(self, element: Element) -> tuple[Marking, Marking]:
        markings = []
        for tag in ("leftBound", "rightBound"):
            marking_name = element.findtext(f"{tag}/lineMarking") or "no_marking"
            markings.append(xml.MARKING_OF.get(marking_name.strip(), Marking.OTHER))
        return markings[0], markings[1]

    def _junctions(self, root: Element, follow: list[list[int]]) -> Any:
        junction = np.full(len(self.lanes), -1, np.int32)
        for junction_index, element in enumerate(root.iterfind("intersection")):
            for incoming in element.iterfind("incoming"):
                pending = [
                    successor
                    for direction in ("Right", "Straight", "Left")
                    for successor in self._lane_refs(incoming, f"successors{direction}")
                ]
                while pending:
                    lane = pending.pop()
                    if junction[lane] < 0:
                        junction[lane] = junction_index
                        pending += [successor for successor in follow[lane] if "intersection" in self.kinds[successor]]
        return junction

    def _limits(self, root: Element) -> Any:
        limit_by_sign: dict[int, float] = {}
        for sign in root.iterfind("trafficSign"):
            for sign_element in sign.iterfind("trafficSignElement"):
                if sign_element.findtext("trafficSignID") in (xml.TOP_SPEED, "R2-1"):
                    limit_by_sign[self.texts.whole(sign.get("id"), sign, "id")] = self.texts.number(
                        sign_element.findtext("additionalValue"), sign, "additionalValue"
                    )
        speed_limits = np.full(len(self.lanes), SPEED, np.float32)
        for lane_index, element in enumerate(self.lanes):
            speeds = [
                limit_by_sign[sign_id]
                for sign_id in self.texts.ids(element, "trafficSignRef")
                if sign_id in limit_by_sign
            ]
            if speeds and not min(speeds) > 0.0:
                raise self.texts.error(element, f"its speed limit is {min(speeds):g} m/s")
            speed_limits[lane_index] = min(speeds, default=SPEED)
        return speed_limits

    def _lanes_by_rule(self, tag: str) -> dict[int, list[tuple[int, float | None]]]:
        """Return id of a sign or light -> lanes that refer to it, and the arc length of their stop line or None."""
        lanes_by_id: dict[int, list[tuple[int, float | None]]] = defaultdict(list)
        for lane, element in enumerate(self.lanes):
            stop_line = element.find("stopLine")
            stop_position = None
            if stop_line is not None:
                corners = self.texts.points(stop_line, element, "stopLine")[:, :2]
                stop_position = corners.mean(0) if len(corners) else None
            refs = {*self.texts.ids(element, tag), *(self.texts.ids(stop_line, tag) if stop_line is not None else ())}
            for reference in sorted(refs):
                lanes_by_id[reference].append(
                    (lane, None if stop_position is None else _project(self.shapes[lane], stop_position))
                )
        return lanes_by_id

    def _place(self, element: Element, fallback: F64) -> F64:
        position = element.find("position")
        xy = self.texts.points(position, element, "position")[:, :2] if position is not None else np.zeros((0, 2))
        return xy[0] if len(xy) else fallback

    def _signs(self, root: Element, shapes: list[F64], tag: str) -> dict[str, Any]:
        lanes_by_sign = self._lanes_by_rule(f"{tag}Ref")
        sign_kinds: list[SignKind] = []
        positions, yaws, rule_rows = [], [], []
        for sign in root.iterfind(tag):
            sign_names = [
                sign_element.findtext("trafficSignID") or "" for sign_element in sign.iterfind("trafficSignElement")
            ]
            lanes = lanes_by_sign.get(self.texts.whole(sign.get("id"), sign, "id"), [])
            kind = next(
                (
                    SignKind.STOP if sign_name in (xml.STOP, "R1-1") else SignKind.YIELD
                    for sign_name in sign_names
                    if sign_name in (xml.STOP, xml.YIELD, "R1-1", "R1-2")
                ),
                None,
            )
            unsupported = sorted(set(sign_names) - {xml.STOP, xml.YIELD, xml.TOP_SPEED, "R1-1", "R1-2", "R2-1"})
            for name in unsupported:
                self.report.omit(f"traffic sign {name[:20]}", element_name(sign))
            if kind is not None and not lanes:
                self.report.doubt("signs that no lanelet refers to are left out", element_name(sign))
            if kind is None or not lanes:
                continue
            end = shapes[lanes[0][0]][-1]
            for lane, s in lanes:
                rule_rows.append((len(sign_kinds), lane, shapes[lane][-1, 5] if s is None else s))
            sign_kinds.append(kind)
            positions.append(self._place(sign, end[:2]))
            yaws.append(float(wrap_angle(end[3])))
        table = np.array(rule_rows, np.float64).reshape(-1, 3)
        return {
            "sign_kind": np.array(sign_kinds, np.uint8),
            "sign_xy": np.array(positions).reshape(-1, 2),
            "sign_yaw": np.array(yaws),
            "rule_sign": table[:, 0],
            "rule_lane": table[:, 1],
            "rule_s": table[:, 2],
        }

    def _signals(self, root: Element, shapes: list[F64], junction: Any, follow: list[list[int]]) -> dict[str, Any]:
        lanes_by_light = self._lanes_by_rule("trafficLightRef")
        self.states: dict[int, SignalState] = {}
        self.cycles = 0
        signal_rows: list[tuple[float, ...]] = []
        stop_rows: list[tuple[int, int, float]] = []
        phases: dict[tuple[tuple[int, str], ...], int] = {}
        for light in root.iterfind("trafficLight"):
            lanes = lanes_by_light.get(self.texts.whole(light.get("id"), light, "id"), [])
            cycle = self._cycle(light)
            if not lanes:
                self.report.doubt("traffic lights that no lanelet refers to are left out", element_name(light))
                continue
            signal_number = len(signal_rows)
            if len({state for _, state in cycle[:-1]}) == 1:
                self.states[signal_number] = xml.STATE_OF[cycle[0][1]]
            else:
                self.cycles += 1
            end = shapes[lanes[0][0]][-1]
            junction_index = next(
                (int(junction[successor]) for successor in follow[lanes[0][0]] if junction[successor] >= 0), -1
            )
            phase = phases.setdefault(cycle, len(phases))
            signal_rows.append((*self._place(light, end[:2]), float(wrap_angle(end[3])), junction_index, phase))
            stop_rows += [(signal_number, lane, shapes[lane][-1, 5] if s is None else s) for lane, s in lanes]
        table, stop_table = (
            np.array(signal_rows, np.float64).reshape(-1, 5),
            np.array(stop_rows, np.float64).reshape(-1, 3),
        )
        return {
            "signal_xy": table[:, :2],
            "signal_yaw": table[:, 2],
            "signal_junction": table[:, 3],
            "signal_phase": table[:, 4],
            "signal_virtual": np.zeros(len(table), bool),
            "stop_signal": stop_table[:, 0],
            "stop_lane": stop_table[:, 1],
            "stop_s": stop_table[:, 2],
        }

    def _cycle(self, light: Element) -> tuple[tuple[int, str], ...]:
        """Return duration in steps and colour of each part of a cycle, followed by its offset."""
        parts = []
        for part in light.iterfind("cycle/cycleElement"):
            colour = (part.findtext("color") or "").strip()
            if colour not in xml.STATE_OF:
                raise self.texts.error(light, f"'{colour[:40]}' is no colour; known: {', '.join(xml.STATE_OF)}")
            parts.append((self.texts.whole(part.findtext("duration"), light, "duration"), colour))
        if (light.findtext("active") or "").strip() == "false" or not parts:
            parts = [(1, "inactive")]
        return (*parts, (self.texts.whole(light.findtext("cycle/timeOffset", "0"), light, "timeOffset"), ""))


def _kind(names: list[str]) -> LaneType:
    lane_types = [
        xml.LANE_TYPE_OF.get(name.strip(), LaneType.DRIVING) for name in names if name.strip() != "intersection"
    ]
    return lane_types[0] if lane_types else LaneType.DRIVING


def _resample(side: F64, count: int) -> F64:
    distances = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(side[:, :2], axis=0).T))])
    sample_distances = np.linspace(0.0, distances[-1], count)
    return np.stack([np.interp(sample_distances, distances, side[:, axis]) for axis in range(3)], 1)


def _project(shape: F64, xy: F64) -> float:
    segment_starts, segment_vectors = shape[:-1, :2], np.diff(shape[:, :2], axis=0)
    fraction = np.clip(
        ((xy - segment_starts) * segment_vectors).sum(1) / np.maximum((segment_vectors**2).sum(1), 1e-12), 0.0, 1.0
    )
    nearest = int(np.argmin(((segment_starts + fraction[:, None] * segment_vectors - xy) ** 2).sum(1)))
    return float(shape[nearest, 5] + fraction[nearest] * (shape[nearest + 1, 5] - shape[nearest, 5]))
