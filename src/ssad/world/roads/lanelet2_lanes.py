"""Lanes of a Lanelet2 map: their shapes, links and neighbours by shared points, and the junctions that they form."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Final

import numpy as np

from ssad.core.errors import MapError
from ssad.core.import_report import ImportReport
from ssad.core.rotations import wrap_scalar
from ssad.core.types import F64, I32, LaneType
from ssad.world.roads import lanelet2_tags as tagging
from ssad.world.roads.lanelet2 import REMEDY, Bound, Lanelet, Lanelet2Options, LaneletMap
from ssad.world.roads.lanelet2_lines import centre_line, crossing
from ssad.world.roads.thinning import thin

FORK: Final = 100.0  # m; a longer lanelet that forks or merges is a road, not part of a junction
MAX_TOTAL: Final = 1.0e6  # m, of all lanelets: bounds the work of the reader
MIN_STEP: Final = 1e-3  # m between points of a lane
NARROW: Final = 0.05  # m; a lanelet that never gets wider has no area
WIDE: Final = 100.0  # m; a wider lanelet is a mistake
SMOOTH: Final = 0.6  # rad; a greater turn between lanes that follow each other is a corner


class LaneletLanes:
    """Lanes of a Lanelet2 map; rows of all lists and arrays are lanes.

    Attributes:
        lanelets: Lanelets that become lanes.
        kinds: Use of each.
        lines: Points of each centre line [., 6]: x, y, z, width, heading, distance.
        crosswalks: Outlines [., 2], m.
        country: Two letters; empty: none.
        row_of: Id of a lanelet -> its lane.
        successors: Lanes that follow each lane.
        predecessors: Lanes before each lane.
        left: Lane on the left; -1 for none.
        right: The same on the right.
        road: Road: lanes side by side.
        forward: Traffic runs along the road.
        left_hand: Traffic keeps to the left.
        lane_id: Ids in a road as OpenDRIVE has them.
        junction: Junction, -1 for none.
    """

    def __init__(self, path: Path, content: LaneletMap, options: Lanelet2Options, report: ImportReport) -> None:
        """Build the lanes; MapError if none is for vehicles."""
        self.path, self.content, self.options, self.report = path, content, options, report
        self.country = tagging.country_of(lanelet.tags for lanelet in content.lanelets)
        self.lanelets: list[Lanelet] = []
        self.kinds: list[LaneType] = []
        self.crosswalks: list[F64] = []
        self.lines: list[F64] = []
        self._sort_lanelets()
        self.row_of = {lanelet.id: lane_index for lane_index, lanelet in enumerate(self.lanelets)}
        self.successors = self._links()
        self.predecessors: list[list[int]] = [[] for _ in self.lanelets]
        for lane_index, followers in enumerate(self.successors):
            for follower in followers:
                self.predecessors[follower].append(lane_index)
        self._smooth_headings()
        self.oncoming = [0, 0]
        self.left, self.right, self.road, self.forward = self._neighbours()
        self.left_hand = self._keeps_left()
        self.lane_id = self._lane_ids()
        self.junction = self._junctions()

    def place(self, lane_index: int) -> str:
        """Return the name of a lane in the file."""
        return f"lanelet {self.lanelets[lane_index].id[:30]}"

    # ------------------------------------------------------------ shapes

    def _sort_lanelets(self) -> None:
        """Collect the lanelets that become lanes, with their shapes, and the outlines of crosswalks."""
        total = 0.0
        samples: list[F64] = []
        for lanelet in self.content.lanelets:
            left, right = (self.points(bound) for bound in (lanelet.left, lanelet.right))
            if tagging.is_crosswalk(lanelet.tags):
                self.crosswalks.append(np.concatenate([left, right[::-1]])[:, :2])
                continue
            kind = tagging.lane_kind(lanelet.tags)
            place = f"lanelet {lanelet.id[:30]}"
            total += max(float(np.hypot(*np.diff(side[:, :2], axis=0).T).sum()) for side in (left, right))
            # Bounds the work of the reader, also for a damaged or crafted file.
            if total > MAX_TOTAL:
                raise MapError(f"{self.path}: more than {MAX_TOTAL:.0f} m of lanelets; {REMEDY}")
            centre = self.content.xyz[list(lanelet.centre)] if lanelet.centre else None
            rows = _with_distance(centre_line(left, right, centre))
            widest = float(rows[:, 3].max(initial=0.0))
            if len(rows) < 2 or not np.isfinite(rows).all() or not NARROW <= widest <= WIDE:
                self.report.doubt(
                    f"a lanelet is narrower than {NARROW:g} m, wider than {WIDE:g} m, or has no length; it is left out",
                    place,
                )
                continue
            if kind is None or kind == LaneType.NONE:
                self.report.omit(
                    f"lanelets of subtype '{lanelet.tags.get('subtype', '')[:30]}' are no road for traffic", place
                )
            if tagging.is_one_way(lanelet.tags) is None:
                text = lanelet.tags.get("one_way", "")
                self.report.doubt(f"one_way='{text[:20]}' is neither yes nor no; yes is taken", place)
            elif not tagging.is_one_way(lanelet.tags) and kind in (LaneType.DRIVING, LaneType.BIKING):
                self.report.omit("traffic in the second direction of lanelets that have two", place)
            for tag in lanelet.tags:
                if tag.startswith("one_way:") and tag != "one_way:vehicle":
                    self.report.omit(f"the direction of single participants: {tag[:40]}", place)
            self.lanelets.append(lanelet)
            self.kinds.append(LaneType.NONE if kind is None else kind)
            samples.append(rows)
        if LaneType.DRIVING not in self.kinds:
            raise MapError(f"{self.path}: no lanelet for vehicles in it; {REMEDY}")
        first = np.cumsum([0, *map(len, samples)])
        joined = np.concatenate(samples)
        self.lines = [joined[rows] for rows in thin(first, joined[:, 5], joined[:, 4], joined[:, 3])]

    def points(self, bound: Bound) -> F64:
        """Return the points of a bound [n, 3], m."""
        return self.content.xyz[list(bound.points)]

    # ------------------------------------------------------------ links

    def _links(self) -> list[list[int]]:
        """Return the lanes that begin at the points at which each lane ends."""
        starts: dict[tuple[int, int, LaneType], list[int]] = defaultdict(list)
        for lane_index, lanelet in enumerate(self.lanelets):
            starts[lanelet.left.points[0], lanelet.right.points[0], self.kinds[lane_index]].append(lane_index)
        return [
            [
                other_lane
                for other_lane in starts.get(
                    (lanelet.left.points[-1], lanelet.right.points[-1], self.kinds[lane_index]), ()
                )
                if other_lane != lane_index
            ]
            for lane_index, lanelet in enumerate(self.lanelets)
        ]

    def _neighbours(self) -> tuple[I32, I32, I32, Any]:
        """Return the lanes to the left and right, the road (lanes side by side), and the direction along the road."""
        count = len(self.lanelets)
        by_left: dict[tuple[int, ...], list[int]] = defaultdict(list)
        by_right: dict[tuple[int, ...], list[int]] = defaultdict(list)
        for lane_index, lanelet in enumerate(self.lanelets):
            by_left[lanelet.left.points].append(lane_index)
            by_right[lanelet.right.points].append(lane_index)
        sides = np.full((2, count), -1, np.int32)
        beside: list[list[tuple[int, int]]] = [[] for _ in range(count)]
        for lane_index, lanelet in enumerate(self.lanelets):
            for side, (points, same, opposite) in enumerate(
                ((lanelet.left.points, by_right, by_left), (lanelet.right.points, by_left, by_right))
            ):
                candidates = [(other_lane, 1) for other_lane in same.get(points, ()) if other_lane != lane_index]
                candidates += [
                    (other_lane, -1) for other_lane in opposite.get(points[::-1], ()) if other_lane != lane_index
                ]
                if not candidates:
                    continue
                other_lane, sign = min(
                    candidates, key=lambda found: (self.kinds[found[0]] != self.kinds[lane_index], -found[1], found[0])
                )
                sides[side, lane_index] = other_lane
                beside[lane_index].append((other_lane, sign))
                beside[other_lane].append((lane_index, sign))
                if sign < 0 and self.kinds[lane_index] == self.kinds[other_lane] == LaneType.DRIVING:
                    self.oncoming[side] += 1
        road, direction = np.full(count, -1, np.int32), np.ones(count, np.int32)
        order = sorted(range(count), key=lambda lane_index: (self.kinds[lane_index] != LaneType.DRIVING, lane_index))
        for number, root in enumerate(order):
            if road[root] >= 0:
                continue
            road[root], pending = number, [root]
            while pending:
                lane_index = pending.pop()
                for other_lane, sign in beside[lane_index]:
                    if road[other_lane] < 0:
                        road[other_lane], direction[other_lane] = number, direction[lane_index] * sign
                        pending.append(other_lane)
        return sides[0], sides[1], road, direction > 0

    def _keeps_left(self) -> bool:
        """Return whether traffic keeps to the left: as asked, by the side of oncoming lanes, or by the country."""
        left_count, right_count = self.oncoming
        by_country = self.country in tagging.LEFT_HAND_COUNTRIES.split() if self.country else None
        if self.options.left_hand is not None:
            result, reason = self.options.left_hand, "as asked"
        elif left_count != right_count:
            result = right_count > left_count
            side = "right" if result else "left"
            reason = f"{max(left_count, right_count)} of {left_count + right_count} oncoming lanes lie on the {side}"
            if by_country is not None and by_country != result:
                self.report.doubt(
                    f"oncoming lanes lie on the {side}, and the region is '{self.country[:20]}'; the lanes decide"
                )
        elif by_country is not None:
            result, reason = by_country, f"region '{self.country}'"
        else:
            result, reason = False, "the map does not say; --left-hand turns it"
        self.report.contents.append(f"{'left' if result else 'right'}-hand traffic: {reason}")
        return result

    def _lane_ids(self) -> I32:
        """Return ids as OpenDRIVE has them: from the middle of the road outwards, growing to the left of the road."""
        places = np.zeros(len(self.lanelets))
        lanes_by_road: dict[int, list[int]] = defaultdict(list)
        for lane_index, road in enumerate(self.road.tolist()):
            lanes_by_road[road].append(lane_index)
        result = np.zeros(len(self.lanelets), np.int32)
        for lanes in lanes_by_road.values():
            members, visited, pending = set(lanes), {lanes[0]}, [lanes[0]]
            while pending:
                lane_index = pending.pop()
                to_left = 1.0 if self.forward[lane_index] else -1.0
                for other_lane, shift in (
                    (int(self.left[lane_index]), to_left),
                    (int(self.right[lane_index]), -to_left),
                ):
                    if other_lane in members and other_lane not in visited:
                        visited.add(other_lane)
                        places[other_lane] = places[lane_index] + shift
                        pending.append(other_lane)
            for forward in (True, False):
                # Lanes along the road lie on its right in right-hand traffic, and have negative ids there.
                is_positive = forward == self.left_hand
                rows = sorted(
                    (lane_index for lane_index in lanes if self.forward[lane_index] == forward),
                    key=lambda lane_index: (places[lane_index], lane_index),
                )
                for rank, lane_index in enumerate(rows if is_positive else rows[::-1], 1):
                    result[lane_index] = rank if is_positive else -rank
        return result

    # ------------------------------------------------------------ junctions

    def _junctions(self) -> I32:
        """Return the junction of each lane, -1 for none.

        Lanelet2 has no junctions. Lanes for vehicles form one where they cross, or where short ones fork or merge, or
        where the map tags a turn; those that touch belong together.
        """
        driving = [lane_index for lane_index, kind in enumerate(self.kinds) if kind == LaneType.DRIVING]
        pairs = list(self._crossings(driving))
        members = {lane_index for pair in pairs for lane_index in pair}
        ends: dict[tuple[str, int, int], list[int]] = defaultdict(list)
        areas: dict[tuple[str, int, int] | str, list[int]] = defaultdict(list)
        for lane_index in driving:
            lanelet = self.lanelets[lane_index]
            ends["start", lanelet.left.points[0], lanelet.right.points[0]].append(lane_index)
            ends["end", lanelet.left.points[-1], lanelet.right.points[-1]].append(lane_index)
            if lanelet.tags.get("turn_direction"):
                members.add(lane_index)
                if area := lanelet.tags.get("intersection_area", ""):
                    areas[area].append(lane_index)
        for rows in ends.values():
            if len(rows) > 1:
                short = [lane_index for lane_index in rows if float(self.lines[lane_index][-1, 5]) <= FORK]
                members.update(short)
        group = list(range(len(self.lanelets)))

        def root(lane_index: int) -> int:
            while group[lane_index] != lane_index:
                group[lane_index] = group[group[lane_index]]
                lane_index = group[lane_index]
            return lane_index

        together = [
            *ends.values(),
            *areas.values(),
            *([lane_index, *self.successors[lane_index]] for lane_index in members),
        ]
        for first, second in pairs:
            group[root(second)] = root(first)
        for rows in together:
            inside = [lane_index for lane_index in rows if lane_index in members]
            for lane_index in inside[1:]:
                group[root(lane_index)] = root(inside[0])
        numbers: dict[int, int] = {}
        result = np.full(len(self.lanelets), -1, np.int32)
        for lane_index in sorted(members):
            result[lane_index] = numbers.setdefault(root(lane_index), len(numbers) + 1)
        return result

    def _crossings(self, driving: list[int]) -> Iterator[tuple[int, int]]:
        """Yield pairs of lanes that cross."""
        boxes = np.array(
            [(*line[:, :2].min(0), *line[:, :2].max(0)) for line in (self.lines[lane_index] for lane_index in driving)]
        )
        for index, lane_index in enumerate(driving):
            rest = boxes[index + 1 :]
            near = (rest[:, :2] <= boxes[index, 2:]).all(1) & (rest[:, 2:] >= boxes[index, :2]).all(1)
            for other_index in np.flatnonzero(near).tolist():
                other_lane = driving[index + 1 + other_index]
                if crossing(self.lines[lane_index][:, :3], self.lines[other_lane][:, :3]):
                    yield lane_index, other_lane

    def _smooth_headings(self) -> None:
        """Share the turn between lanes that follow each other among their ends, so that headings have no step."""
        turns: dict[tuple[int, int], list[float]] = defaultdict(list)
        for lane_index, followers in enumerate(self.successors):
            for follower in followers:
                turn = wrap_scalar(float(self.lines[follower][0, 4] - self.lines[lane_index][-1, 4]))
                if abs(turn) < SMOOTH:
                    turns[lane_index, -1].append(0.5 * turn)
                    turns[follower, 0].append(-0.5 * turn)
        for (lane_index, end), shares in turns.items():
            self.lines[lane_index][end, 4] += sum(shares) / len(shares)


def _with_distance(rows: F64) -> F64:
    """Return rows [S, 4] of x, y, z and width with heading and arc length, without those in one place [., 6]."""
    spacing = np.hypot(*np.diff(rows[:, :2], axis=0).T)
    along = np.concatenate([[0.0], np.cumsum(spacing)])
    # In float32, the arc length of a long lane must still grow from point to point.
    is_distinct = np.concatenate([[True], np.diff(np.floor(along / MIN_STEP)) > 0])
    rows, along = rows[is_distinct], along[is_distinct]
    if len(rows) < 2:
        return np.zeros((0, 6))
    tangent = np.gradient(rows[:, :2], axis=0)
    yaw = np.unwrap(np.arctan2(tangent[:, 1], tangent[:, 0]))
    return np.column_stack([rows, yaw, along])
