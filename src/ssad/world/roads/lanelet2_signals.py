"""Signals and signs of a Lanelet2 map, from its regulatory elements."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from functools import cached_property
from typing import Any, Final

import numpy as np

from ssad.core.import_report import ImportReport
from ssad.core.lane_graph import SignKind
from ssad.core.types import F64, LaneType
from ssad.world.roads import lanelet2_tags as tagging
from ssad.world.roads.lanelet2 import LaneletMap, Rule
from ssad.world.roads.lanelet2_lanes import LaneletLanes
from ssad.world.roads.lanelet2_lines import position_across
from ssad.world.roads.signals import Approaches, place_signals, place_signs
from ssad.world.roads.xodr import MapRoad, Network, SignalPlace, SignPlace

LIGHT, RIGHT_OF_WAY, ALL_WAY_STOP, SIGN = "traffic_light", "right_of_way", "all_way_stop", "traffic_sign"
ROLES: Final = {
    LIGHT: {"refers", "ref_line", "light_bulbs"},
    "speed_limit": {"refers", "ref_line"},
    SIGN: {"refers", "ref_line"},
    RIGHT_OF_WAY: {"refers", "ref_line", "yield", "right_of_way"},
    ALL_WAY_STOP: {"refers", "ref_line", "yield"},
    "crosswalk": {"refers", "ref_line", "crosswalk_polygon"},
}
"""Subtype of a regulatory element that is read -> roles of its members."""


class RuleReader:
    """Reader of regulatory elements."""

    def __init__(self, content: LaneletMap, lanes: LaneletLanes, report: ImportReport) -> None:
        """Read the rules of a map for its lanes; what is not carried over goes into the report."""
        self.content, self.lanes, self.report = content, lanes, report

    def arrays(self) -> dict[str, Any]:
        """Return the arrays of a `LaneGraph` on signals and signs."""
        lights, light_places, lonely_lights = self.lights()
        signs, sign_places, sign_kinds = self.signs({lane_index for lane_index, _ in light_places})
        approaches = self.approaches(lights, light_places, signs, sign_places, sign_kinds)
        signals = place_signals(approaches)
        signals["stop_s"] = np.array(
            [
                self.light_lines.get(lane, line_position)
                for lane, line_position in zip(signals["stop_lane"].tolist(), signals["stop_s"].tolist(), strict=True)
            ]
        )
        self.add_lonely_lights(signals, lights, lonely_lights)
        self.name_omissions()
        return signals | place_signs(approaches)

    def approach_lanes(self, lane_index: int) -> list[int]:
        """Return the lanes before the junction that a lane crosses, or the lane itself outside of one."""
        junction, pending, visited = int(self.lanes.junction[lane_index]), [lane_index], {lane_index}
        result: list[int] = []
        while pending:
            lane = pending.pop()
            if self.lanes.junction[lane] != junction or junction < 0:
                result.append(lane)
                continue
            for predecessor in self.lanes.predecessors[lane]:
                if predecessor not in visited:
                    visited.add(predecessor)
                    pending.append(predecessor)
        return sorted(result)

    def leads_in(self, lane_index: int) -> bool:
        """Return whether a lane outside of junctions leads into one."""
        return self.lanes.junction[lane_index] < 0 and any(
            self.lanes.junction[follower] >= 0 for follower in self.lanes.successors[lane_index]
        )

    def rules_of(self, subtype: str) -> Iterator[tuple[Rule, list[int]]]:
        """Yield the rules of a subtype, with the lanes for vehicles that refer to them."""
        for rule in self.content.rules.values():
            if rule.subtype == subtype:
                yield rule, self.lanes_by_rule.get(rule.id, [])

    @cached_property
    def lanes_by_rule(self) -> dict[str, list[int]]:
        """Lanes for vehicles that refer to a rule, by its id."""
        lanes: dict[str, list[int]] = defaultdict(list)
        for lane_index, lanelet in enumerate(self.lanes.lanelets):
            for name in lanelet.rules:
                if self.lanes.kinds[lane_index] == LaneType.DRIVING:
                    lanes[name].append(lane_index)
        return dict(lanes)

    @cached_property
    def lanelet_ids(self) -> frozenset[str]:
        """Ids of all lanelets, also of those that become no lane."""
        return frozenset(lanelet.id for lanelet in self.content.lanelets)

    def lights(
        self,
    ) -> tuple[dict[str, list[float]], set[tuple[int, str]], dict[str, list[int]]]:
        """Return the places of lights by rule, pairs of lane and light before junctions, and lanes of other lights."""
        places: dict[str, list[float]] = {}
        lanes_with_lights: set[tuple[int, str]] = set()
        lonely: dict[str, list[int]] = {}
        for rule, lane_indices in self.rules_of(LIGHT):
            if not lane_indices:
                self.report.omit("traffic lights that no lane for vehicles refers to", f"relation {rule.id[:30]}")
                continue
            approaches = sorted({lane for lane_index in lane_indices for lane in self.approach_lanes(lane_index)})
            before = [lane for lane in approaches if self.leads_in(lane)]
            if (xy := self.middle(rule.members.get("refers", ()))) is not None:
                places[rule.id] = [*xy.tolist(), float(self.lanes.lines[(approaches or lane_indices)[0]][-1, 4])]
            else:
                self.report.note("traffic lights without a place stand at the end of their lane", f"relation {rule.id}")
            lanes_with_lights.update((lane, rule.id) for lane in before)
            if not before:
                lonely[rule.id] = lane_indices
        return places, lanes_with_lights, lonely

    def signs(self, with_lights: set[int]) -> tuple[dict[str, list[float]], dict[int, list[str]], dict[str, SignKind]]:
        """Return the places of signs, the signs of each lane, and their kinds: stop and yield before junctions."""
        ruled: dict[int, tuple[SignKind, tuple[str, ...]]] = {}

        def add(lane_index: int, kind: SignKind, refers: tuple[str, ...]) -> None:
            if lane_index not in ruled or kind == SignKind.STOP:
                ruled[lane_index] = (kind, refers)

        for rule, lane_indices in self.rules_of(SIGN):
            kinds = [self.kind_of_sign(name) for name in rule.members.get("refers", ())]
            kind = next((kind for kind in kinds if kind is not None), None)
            if kind is None:
                sign_codes = {self.subtype_of(name) for name in rule.members.get("refers", ())}
                self.report.omit(
                    f"traffic signs: {', '.join(sorted(sign_codes))[:60] or 'of no type'}", f"relation {rule.id}"
                )
                continue
            lanes = [
                lane for lane_index in lane_indices for lane in self.approach_lanes(lane_index) if self.leads_in(lane)
            ]
            if not lanes:
                self.report.omit("stop and yield signs before no junction", f"relation {rule.id[:30]}")
            for lane in lanes:
                add(lane, kind, rule.members.get("refers", ()))
        for rule, _ in self.rules_of(ALL_WAY_STOP):
            for lane in self.ruled_lanes(rule, "yield"):
                for approach in self.approach_lanes(lane):
                    if self.leads_in(approach):
                        add(approach, SignKind.STOP, ())
        for lane, rule in self.yielding_lanes(with_lights):
            kinds = [self.kind_of_sign(name) for name in rule.members.get("refers", ())]
            kind = SignKind.STOP if SignKind.STOP in kinds else SignKind.YIELD
            add(lane, kind, rule.members.get("refers", ()))
        places: dict[str, list[float]] = {}
        signs: dict[int, list[str]] = {}
        kinds_by_sign: dict[str, SignKind] = {}
        for lane_index, (kind, refers) in sorted(ruled.items()):
            sign = f"{self.lanes.road[lane_index]} {self.lanes.forward[lane_index]} {kind.name}"
            kinds_by_sign[sign] = kind
            signs[lane_index] = [sign]
            if (xy := self.middle(refers)) is not None and sign not in places:
                places[sign] = [*xy.tolist(), float(self.lanes.lines[lane_index][-1, 4])]
        return places, signs, kinds_by_sign

    def yielding_lanes(self, with_lights: set[int]) -> Iterator[tuple[int, Rule]]:
        """Yield the lanes before junctions from which every way must yield.

        Right of way of a single turn, as of left turns at lights, follows from the rules of the road in a town.
        """
        yielding: dict[int, Rule] = {}
        for rule, _ in self.rules_of(RIGHT_OF_WAY):
            for lane_index in self.ruled_lanes(rule, "yield"):
                yielding.setdefault(lane_index, rule)
        carried: set[int] = set()
        for lane_index, rule in sorted(yielding.items()):
            for lane in self.approach_lanes(lane_index):
                ways = [
                    lane_index for lane_index in self.lanes.successors[lane] if self.lanes.junction[lane_index] >= 0
                ]
                inside = lane == lane_index or all(way in yielding for way in ways)
                if inside and lane not in with_lights and self.leads_in(lane):
                    carried.add(lane_index)
                    yield lane, rule
        for lane_index in sorted(set(yielding) - carried):
            self.report.omit("right of way of single turns, or at traffic lights", self.lanes.place(lane_index))

    def ruled_lanes(self, rule: Rule, role: str) -> list[int]:
        """Return the lanes for vehicles in a role of a rule."""
        member_ids = rule.members.get(role, ())
        missing = [name for name in member_ids if name not in self.lanelet_ids]
        for name in missing:
            self.report.doubt(
                "a regulatory element refers to a lanelet that the map lacks", f"relation {rule.id[:30]}, {name[:30]}"
            )
        lane_indices = [self.lanes.row_of[name] for name in member_ids if name in self.lanes.row_of]
        return [lane_index for lane_index in lane_indices if self.lanes.kinds[lane_index] == LaneType.DRIVING]

    def middle(self, ways: tuple[str, ...]) -> F64 | None:
        """Return the middle of lines [2]; None where the map has none of them."""
        lane_indices = [
            lane_index for name in ways if name in self.content.ways for lane_index in self.content.ways[name].points
        ]
        places = self.content.xyz[lane_indices, :2]
        return places.mean(axis=0) if lane_indices and np.isfinite(places).all() else None

    def subtype_of(self, way: str) -> str:
        """Return the subtype of a line, such as the code of a sign."""
        return self.content.ways[way].tags.get("subtype", "")[:30] if way in self.content.ways else ""

    def kind_of_sign(self, way: str) -> SignKind | None:
        """Return the meaning of a sign; None: neither stop nor yield."""
        return tagging.sign_kind(self.subtype_of(way), self.lanes.country)

    def approaches(
        self,
        lights: dict[str, list[float]],
        light_places: set[tuple[int, str]],
        signs: dict[str, list[float]],
        sign_places: dict[int, list[str]],
        sign_kinds: dict[str, SignKind],
    ) -> Approaches:
        """Return what signals and signs are placed by."""
        lights_by_road: dict[int, list[SignalPlace]] = defaultdict(list)
        signs_by_road: dict[int, list[SignPlace]] = defaultdict(list)
        for lane_index, light in sorted(light_places):
            lane = int(self.lanes.lane_id[lane_index])
            lights_by_road[int(self.lanes.road[lane_index])].append(SignalPlace(light, lane, lane))
        for lane_index, sign_names in sign_places.items():
            lane = int(self.lanes.lane_id[lane_index])
            signs_by_road[int(self.lanes.road[lane_index])] += [SignPlace(name, 0, lane, lane) for name in sign_names]
        roads = {
            road: MapRoad(road, -1, 0.0, (), None, None, tuple(lights_by_road[road]), tuple(signs_by_road[road]))
            for road in sorted(set(self.lanes.road.tolist()))
        }
        light_names = tuple(sorted({light for _, light in light_places}))
        network = Network(roads, {}, light_names, {}, sign_kinds, left_hand=self.lanes.left_hand)
        lines = [way.points for way in self.content.ways.values() if way.points and way.tags.get("type") == "stop_line"]
        middles = np.array([self.content.xyz[list(line), :2].mean(axis=0) for line in lines]).reshape(-1, 2)
        return Approaches(
            network=network,
            keys=[
                (road, 0, lane)
                for road, lane in zip(self.lanes.road.tolist(), self.lanes.lane_id.tolist(), strict=True)
            ],
            kind=np.array(self.lanes.kinds),
            junction=self.lanes.junction,
            links=self.lanes.successors,
            end=np.array([line[-1, [0, 1, 4]] for line in self.lanes.lines]),
            begin=np.array([line[0, [0, 1, 4]] for line in self.lanes.lines]),
            width=np.array([line[-1, 3] for line in self.lanes.lines]),
            line=[(line[:, :2], line[:, 5]) for line in self.lanes.lines],
            crosswalks=self.lanes.crosswalks,
            lights=lights | signs,
            forward=self.lanes.forward,
            left_hand=self.lanes.left_hand,
            stop_lines=middles[np.isfinite(middles).all(1)],
        )

    @cached_property
    def light_lines(self) -> dict[int, float]:
        """Distance along a lane, m, of the stop line that its traffic light names."""
        result: dict[int, float] = {}
        for rule, lane_indices in self.rules_of(LIGHT):
            for name in rule.members.get("ref_line", ()):
                way = self.content.ways.get(name)
                if way is None or not way.points:
                    continue
                points = self.content.xyz[list(way.points), :2]
                for lane_index in {lane for ruled in lane_indices for lane in (ruled, *self.approach_lanes(ruled))}:
                    line = self.lanes.lines[lane_index]
                    line_position = position_across(line[:, :2], points, 0.5 * float(line[:, 3].max()))
                    if line_position is not None:
                        result[lane_index] = min(max(line_position, 0.0), float(line[-1, 5]))
        return result

    def add_lonely_lights(
        self, signals: dict[str, Any], places: Mapping[str, list[float]], lonely: Mapping[str, list[int]]
    ) -> None:
        """Add the lights that stand before no junction, such as at crosswalks."""
        for name, lane_indices in sorted(lonely.items()):
            number = len(signals["signal_yaw"])
            end = self.lanes.lines[lane_indices[0]][-1]
            x, y = places[name][:2] if name in places else end[:2]
            for key, value in (
                ("signal_xy", [[x, y]]),
                ("signal_yaw", [end[4]]),
                ("signal_junction", [-1]),
                ("signal_phase", [0]),
                ("signal_virtual", [False]),
                ("stop_signal", [number] * len(lane_indices)),
                ("stop_lane", lane_indices),
                (
                    "stop_s",
                    [
                        self.light_lines.get(lane_index, float(self.lanes.lines[lane_index][-1, 5]))
                        for lane_index in lane_indices
                    ],
                ),
            ):
                signals[key] = np.concatenate([signals[key], np.array(value, signals[key].dtype)])

    def name_omissions(self) -> None:
        """Add to the report the rules, their roles and the lines that are not carried over."""
        used: set[str] = set()
        for rule in self.content.rules.values():
            roles = ROLES.get(rule.subtype)
            if roles is None:
                self.report.omit(f"regulatory elements of subtype '{rule.subtype[:30]}'", f"relation {rule.id[:30]}")
                continue
            for role, member_ids in rule.members.items():
                used.update(member_ids)
                if role not in roles:
                    self.report.omit(f"members of {rule.subtype} in the role '{role[:30]}'", f"relation {rule.id[:30]}")
        used |= self.content.lanelet_ways
        for way in self.content.ways.values():
            kind = way.tags.get("type", "")
            if kind and kind != "stop_line" and way.id not in used:
                self.report.omit(f"lines of type '{kind[:30]}' that bound no lanelet", f"way {way.id[:30]}")
