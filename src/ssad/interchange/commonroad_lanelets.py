"""CommonRoad's lanelets, signs, lights and intersections as a lane graph: of what `commonroad_lanes` writes, the same.

The middle of its bounds is the centre line of a lane, and what lies side by side is a road.
"""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ssad.core.lane_graph import LaneGraph, Marking, SignKind
from ssad.core.rotations import wrap_angle
from ssad.core.types import F64, LaneType, SignalState
from ssad.interchange import commonroad_xml as xml
from ssad.interchange.commonroad_xml import Texts

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

SPEED: Final = 50.0 / 3.6  # m/s where no sign tells another limit
MAX_LANELETS: Final = 20_000
_TURNS = ("Right", "Straight", "Left")
_ASKEW = math.radians(15.0)
_MIN_STEP = 1e-3  # m between points of a lane that are kept


@dataclass(frozen=True)
class ReadLanes:
    """The roads of a CommonRoad file.

    Attributes:
        graph: Their lane graph.
        lane_of: Id of a lanelet -> its lane.
        states: Number of a signal -> the one state that its light always shows.
        cycles: How many lights change.
    """

    graph: LaneGraph
    lane_of: Mapping[int, int]
    states: Mapping[int, SignalState]
    cycles: int


def read_lanes(root: Element, texts: Texts, name: str, lost: Counter[str]) -> ReadLanes:
    """The lane graph of a file's lanelets.

    Args:
        root: The document.
        texts: Reads its texts.
        name: What the town is called.
        lost: Takes what is not carried over.

    Raises:
        FormatError: Lanelets are broken, or refer to what there is not.
        MapError: They make no town.
    """
    elements = root.findall("lanelet")
    if not elements:
        raise texts.fail("commonRoad", "it has no lanelet")
    if len(elements) > MAX_LANELETS:
        raise texts.fail("commonRoad", f"{len(elements)} lanelets, at most {MAX_LANELETS}")
    kinds = {id(e): [t.text or "" for t in e.iterfind("laneletType")] for e in elements}
    walks = [e for e in elements if "crosswalk" in kinds[id(e)]]
    lanes = [e for e in elements if "crosswalk" not in kinds[id(e)]]
    if not lanes:
        raise texts.fail("commonRoad", "it has no lanelet but crosswalks")
    lane_of: dict[int, int] = {}
    for k, element in enumerate(lanes):
        number = texts.whole(element.get("id"), element, "id")
        if number in lane_of:
            raise texts.fail(element, "there are two of this id")
        lane_of[number] = k
    return _Lanes(texts, lost, lanes, lane_of, [kinds[id(e)] for e in lanes]).read(root, name, walks)


class _Lanes:
    def __init__(
        self, texts: Texts, lost: Counter[str], lanes: list[Element], lane_of: dict[int, int], kinds: list[list[str]]
    ) -> None:
        self.texts, self.lost, self.lanes, self.lane_of, self.kinds = texts, lost, lanes, lane_of, kinds

    def read(self, root: Element, name: str, walks: list[Element]) -> ReadLanes:
        shapes = self.shapes = [self._shape(element) for element in self.lanes]
        count = len(shapes)
        left, right, road, hand = self._beside()
        follow = [self._lane_refs(element, "successor") for element in self.lanes]
        for k, element in enumerate(self.lanes):
            for before in self._lane_refs(element, "predecessor"):
                if k not in follow[before]:
                    follow[before].append(k)
        junction = self._junctions(root, follow)
        marks = [self._marks(element) for element in self.lanes]
        limits = self._limits(root)
        places = [
            np.concatenate(
                [
                    self.texts.points(w.find("leftBound"), w, "leftBound"),
                    self.texts.points(w.find("rightBound"), w, "rightBound")[::-1],
                ]
            )[:, :2]
            for w in walks
        ]
        self.graph = LaneGraph(
            name=name,
            xy=np.concatenate([shape[:, :2] for shape in shapes]).astype(np.float32),
            z=np.concatenate([shape[:, 2] for shape in shapes]).astype(np.float32),
            yaw=np.concatenate([shape[:, 3] for shape in shapes]).astype(np.float32),
            width=np.concatenate([shape[:, 4] for shape in shapes]).astype(np.float32),
            s=np.concatenate([shape[:, 5] for shape in shapes]).astype(np.float32),
            offset=np.cumsum([0, *(len(shape) for shape in shapes)]).astype(np.int32),
            kind=np.array([_kind(names) for names in self.kinds], np.uint8),
            road=road,
            section=np.zeros(count, np.int32),
            lane_id=(hand * (np.arange(count) + 1)).astype(np.int32),
            junction=junction,
            speed_limit=limits,
            left=left,
            right=right,
            left_marking=np.array([mark[0] for mark in marks], np.uint8),
            right_marking=np.array([mark[1] for mark in marks], np.uint8),
            succ_offset=np.cumsum([0, *(len(after) for after in follow)]).astype(np.int32),
            succ=np.array([k for after in follow for k in after], np.int32),
            crosswalk_offset=np.cumsum([0, *(len(place) for place in places)]).astype(np.int32),
            crosswalk_xy=np.concatenate([np.zeros((0, 2)), *places]).astype(np.float32),
            **self._signs(root, shapes, "trafficSign"),
            **self._signals(root, shapes, junction, follow),
        )
        return ReadLanes(self.graph, self.lane_of, self.states, self.cycles)

    def _shape(self, element: Element) -> F64:
        """[N, 6] x, y, z, yaw, width, s of a lanelet."""
        sides = [self.texts.points(element.find(tag), element, tag) for tag in ("leftBound", "rightBound")]
        if min(len(side) for side in sides) < 2:
            raise self.texts.fail(element, "a bound has fewer than two points")
        if len(sides[0]) != len(sides[1]):
            self.lost["lanelets whose bounds have different numbers of points are resampled"] += 1
            sides = [_resampled(side, max(map(len, sides))) for side in sides]
        middle = 0.5 * (sides[0] + sides[1])
        apart = np.hypot(*np.diff(middle[:, :2], axis=0).T)
        kept = np.concatenate([[True], apart > _MIN_STEP])
        sides, middle = [side[kept] for side in sides], middle[kept]
        if len(middle) < 2:
            raise self.texts.fail(element, "its points all lie in one place")
        run = np.gradient(middle[:, :2], axis=0)
        along = np.unwrap(np.arctan2(run[:, 1], run[:, 0]))
        across = (sides[0] - sides[1])[:, :2]
        width = np.hypot(*across.T)
        # bounds that lie just across each other tell the heading itself
        square = np.arctan2(across[:, 1], across[:, 0]) - 0.5 * np.pi
        off = np.asarray(wrap_angle(square - along))
        yaw = np.where((np.abs(off) < _ASKEW) & (width > 0.01), along + off, along)
        half = np.maximum(0.5 * np.abs(np.diff(yaw)), 1e-6)
        step = np.hypot(*np.diff(middle[:, :2], axis=0).T) * np.where(half < 1.0, half / np.sin(half), 1.0)
        s = np.concatenate([[0.0], np.cumsum(step)])
        return np.column_stack([middle, yaw, width, s])

    def _lane_refs(self, element: Element, tag: str) -> list[int]:
        found = []
        for ref in self.texts.ids(element, tag):
            if ref not in self.lane_of:
                raise self.texts.fail(element, f"{tag} {ref}: there is no such lanelet")
            found.append(self.lane_of[ref])
        return found

    def _beside(self) -> tuple[Any, Any, Any, Any]:
        """Lanes to the left and right, and the road (lanes side by side) and hand (direction in it) of each lane."""
        count = len(self.lanes)
        sides = np.full((2, count), -1, np.int32)
        joined: list[list[tuple[int, int]]] = [[] for _ in range(count)]
        for k, element in enumerate(self.lanes):
            for side, tag in enumerate(("adjacentLeft", "adjacentRight")):
                for other, item in zip(self._lane_refs(element, tag), element.iterfind(tag), strict=True):
                    sign = -1 if item.get("drivingDir") == "opposite" else 1
                    sides[side, k] = other
                    joined[k].append((other, sign))
                    joined[other].append((k, sign))
        road, hand = np.full(count, -1, np.int32), np.ones(count, np.int32)
        for first in range(count):
            if road[first] >= 0:
                continue
            road[first], waiting = first, [first]
            while waiting:
                k = waiting.pop()
                for other, sign in joined[k]:
                    if road[other] < 0:
                        road[other], hand[other] = first, hand[k] * sign
                        waiting.append(other)
        return sides[0], sides[1], road, -hand

    def _marks(self, element: Element) -> tuple[Marking, Marking]:
        found = []
        for tag in ("leftBound", "rightBound"):
            told = element.findtext(f"{tag}/lineMarking") or "no_marking"
            found.append(xml.MARKING_OF.get(told.strip(), Marking.OTHER))
        return found[0], found[1]

    def _junctions(self, root: Element, follow: list[list[int]]) -> Any:
        junction = np.full(len(self.lanes), -1, np.int32)
        for k, element in enumerate(root.iterfind("intersection")):
            for incoming in element.iterfind("incoming"):
                waiting = [
                    n for t in ("Right", "Straight", "Left") for n in self._lane_refs(incoming, f"successors{t}")
                ]
                while waiting:
                    lane = waiting.pop()
                    if junction[lane] < 0:
                        junction[lane] = k
                        waiting += [n for n in follow[lane] if "intersection" in self.kinds[n]]
        return junction

    def _limits(self, root: Element) -> Any:
        told: dict[int, float] = {}
        for sign in root.iterfind("trafficSign"):
            for part in sign.iterfind("trafficSignElement"):
                if part.findtext("trafficSignID") in (xml.TOP_SPEED, "R2-1"):
                    told[self.texts.whole(sign.get("id"), sign, "id")] = self.texts.number(
                        part.findtext("additionalValue"), sign, "additionalValue"
                    )
        limits = np.full(len(self.lanes), SPEED, np.float32)
        for k, element in enumerate(self.lanes):
            speeds = [told[ref] for ref in self.texts.ids(element, "trafficSignRef") if ref in told]
            if speeds and not min(speeds) > 0.0:
                raise self.texts.fail(element, f"its speed limit is {min(speeds):g} m/s")
            limits[k] = min(speeds, default=SPEED)
        return limits

    def _ruled(self, tag: str) -> dict[int, list[tuple[int, float | None]]]:
        """Id of a sign or light -> lanes that refer to it, and the arc length of their stop line if they have one."""
        found: dict[int, list[tuple[int, float | None]]] = defaultdict(list)
        for lane, element in enumerate(self.lanes):
            line = element.find("stopLine")
            xy = None
            if line is not None:
                corners = self.texts.points(line, element, "stopLine")[:, :2]
                xy = corners.mean(0) if len(corners) else None
            refs = {*self.texts.ids(element, tag), *(self.texts.ids(line, tag) if line is not None else ())}
            for ref in sorted(refs):
                found[ref].append((lane, None if xy is None else _project(self.shapes[lane], xy)))
        return found

    def _place(self, element: Element, fallback: F64) -> F64:
        position = element.find("position")
        xy = self.texts.points(position, element, "position")[:, :2] if position is not None else np.zeros((0, 2))
        return xy[0] if len(xy) else fallback

    def _signs(self, root: Element, shapes: list[F64], tag: str) -> dict[str, Any]:
        ruled = self._ruled(f"{tag}Ref")
        kinds: list[SignKind] = []
        places, yaws, rules = [], [], []
        for sign in root.iterfind(tag):
            names = [part.findtext("trafficSignID") or "" for part in sign.iterfind("trafficSignElement")]
            lanes = ruled.get(self.texts.whole(sign.get("id"), sign, "id"), [])
            kind = next(
                (
                    SignKind.STOP if n in (xml.STOP, "R1-1") else SignKind.YIELD
                    for n in names
                    if n in (xml.STOP, xml.YIELD, "R1-1", "R1-2")
                ),
                None,
            )
            other = sorted(set(names) - {xml.STOP, xml.YIELD, xml.TOP_SPEED, "R1-1", "R1-2", "R2-1"})
            for name in other:
                self.lost[f"traffic sign {name[:20]}"] += 1
            if kind is None or not lanes:
                continue
            end = shapes[lanes[0][0]][-1]
            for lane, s in lanes:
                rules.append((len(kinds), lane, shapes[lane][-1, 5] if s is None else s))
            kinds.append(kind)
            places.append(self._place(sign, end[:2]))
            yaws.append(float(wrap_angle(end[3])))
        table = np.array(rules, np.float64).reshape(-1, 3)
        return {
            "sign_kind": np.array(kinds, np.uint8),
            "sign_xy": np.array(places).reshape(-1, 2),
            "sign_yaw": np.array(yaws),
            "rule_sign": table[:, 0],
            "rule_lane": table[:, 1],
            "rule_s": table[:, 2],
        }

    def _signals(self, root: Element, shapes: list[F64], junction: Any, follow: list[list[int]]) -> dict[str, Any]:
        ruled = self._ruled("trafficLightRef")
        self.states: dict[int, SignalState] = {}
        self.cycles = 0
        rows: list[tuple[float, ...]] = []
        stops: list[tuple[int, int, float]] = []
        phases: dict[tuple[tuple[int, str], ...], int] = {}
        for light in root.iterfind("trafficLight"):
            lanes = ruled.get(self.texts.whole(light.get("id"), light, "id"), [])
            cycle = self._cycle(light)
            if not lanes:
                self.lost["traffic lights that no lanelet refers to"] += 1
                continue
            number = len(rows)
            if len({state for _, state in cycle[:-1]}) == 1:
                self.states[number] = xml.STATE_OF[cycle[0][1]]
            else:
                self.cycles += 1
            end = shapes[lanes[0][0]][-1]
            inside = next((int(junction[n]) for n in follow[lanes[0][0]] if junction[n] >= 0), -1)
            phase = phases.setdefault(cycle, len(phases))
            rows.append((*self._place(light, end[:2]), float(wrap_angle(end[3])), inside, phase))
            stops += [(number, lane, shapes[lane][-1, 5] if s is None else s) for lane, s in lanes]
        table, line = np.array(rows, np.float64).reshape(-1, 5), np.array(stops, np.float64).reshape(-1, 3)
        return {
            "signal_xy": table[:, :2],
            "signal_yaw": table[:, 2],
            "signal_junction": table[:, 3],
            "signal_phase": table[:, 4],
            "signal_virtual": np.zeros(len(table), bool),
            "stop_signal": line[:, 0],
            "stop_lane": line[:, 1],
            "stop_s": line[:, 2],
        }

    def _cycle(self, light: Element) -> tuple[tuple[int, str], ...]:
        """Duration in steps and colour of the parts of a cycle, and its offset."""
        parts = []
        for part in light.iterfind("cycle/cycleElement"):
            colour = (part.findtext("color") or "").strip()
            if colour not in xml.STATE_OF:
                raise self.texts.fail(light, f"'{colour[:40]}' is no colour; known: {', '.join(xml.STATE_OF)}")
            parts.append((self.texts.whole(part.findtext("duration"), light, "duration"), colour))
        if (light.findtext("active") or "").strip() == "false" or not parts:
            parts = [(1, "inactive")]
        return (*parts, (self.texts.whole(light.findtext("cycle/timeOffset", "0"), light, "timeOffset"), ""))


def _kind(names: list[str]) -> LaneType:
    told = [xml.LANE_TYPE_OF.get(name.strip(), LaneType.DRIVING) for name in names if name.strip() != "intersection"]
    return told[0] if told else LaneType.DRIVING


def _resampled(side: F64, count: int) -> F64:
    u = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(side[:, :2], axis=0).T))])
    at = np.linspace(0.0, u[-1], count)
    return np.stack([np.interp(at, u, side[:, k]) for k in range(3)], 1)


def _project(shape: F64, xy: F64) -> float:
    a, d = shape[:-1, :2], np.diff(shape[:, :2], axis=0)
    t = np.clip(((xy - a) * d).sum(1) / np.maximum((d**2).sum(1), 1e-12), 0.0, 1.0)
    i = int(np.argmin(((a + t[:, None] * d - xy) ** 2).sum(1)))
    return float(shape[i, 5] + t[i] * (shape[i + 1, 5] - shape[i, 5]))
