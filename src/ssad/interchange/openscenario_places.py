"""Values and positions of an OpenSCENARIO document: parameters, and every kind of position as a pose in the world."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import numpy as np

from ssad.core.errors import FormatError
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_angle
from ssad.core.types import LaneType, Pose
from ssad.scenarios.dynamic.knowledge._placing import Place, ahead, behind, pose_at, shifted
from ssad.world.roads.query import nearest_all

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

LONGEST = 1.0e4  # m along lanes from one entity to another
LANES = 20
NEAR = 2.0  # m outside a lane at which somebody still belongs to it
_PARAMETER = re.compile(r"^\$\{?\s*(\w+)\s*\}?$")


class Values:
    """Attributes of elements, with the document's parameters put in; errors name file and element."""

    def __init__(self, where: str, root: Element) -> None:
        self.where = where
        self.parameters: dict[str, str] = {
            item.get("name", ""): item.get("value", "") for item in root.iter("ParameterDeclaration")
        }

    def fail(self, element: Element | str, message: str) -> FormatError:
        """A FormatError that says where."""
        tag = element if isinstance(element, str) else element.tag
        return FormatError(f"{self.where}: {tag}: {message}")

    def text(self, element: Element, name: str, default: str | None = None) -> str:
        """An attribute as text. FormatError if it is missing and there is no default, or its parameter is unknown."""
        value = element.get(name, default)
        if value is None:
            raise self.fail(element, f"attribute '{name}' is missing")
        found = _PARAMETER.match(value)
        if found is None:
            if value.startswith("$"):
                raise self.fail(element, f"{name}: expressions are not read, only $parameter: {value[:60]}")
            return value
        if found[1] not in self.parameters:
            raise self.fail(element, f"{name}: parameter ${found[1]} is not declared")
        return self.parameters[found[1]]

    def number(self, element: Element, name: str, default: float | None = None) -> float:
        """An attribute as a finite number. FormatError if it is none."""
        told = self.text(element, name, None if default is None else repr(default))
        try:
            value = float(told)
        except ValueError:
            raise self.fail(element, f"{name} is '{told[:40]}', not a number") from None
        if not math.isfinite(value):
            raise self.fail(element, f"{name} is '{told[:40]}', not a finite number")
        return value

    def lanes(self, element: Element, name: str) -> int:
        """A number of lanes to the left, negative to the right. FormatError where no road has as many."""
        value = self.number(element, name, 0.0)
        if abs(value) > LANES:
            raise self.fail(element, f"{name} is {value:g}: no road has so many lanes")
        return int(value)


class Places:
    """Positions as poses in the world frame; what is only nearly right is counted in `lost`."""

    def __init__(
        self, values: Values, graph: LaneGraph, *, mirrored: bool, lost: Counter[str], starts: Mapping[str, Element]
    ) -> None:
        """Positions of one document.

        Args:
            values: Its values.
            graph: Its town.
            mirrored: World positions are in CARLA's left-handed frame.
            lost: Takes what is not carried over.
            starts: Name of an entity -> its position at the start.
        """
        self.values, self.graph, self.lost, self.starts = values, graph, lost, starts
        self._hand = -1.0 if mirrored else 1.0
        self._open: set[str] = set()
        self._kinds: dict[str, Callable[[Element], Pose]] = {
            "WorldPosition": self._world,
            "LanePosition": self._lane,
            "RoadPosition": self._road,
            "RelativeWorldPosition": self._relative,
            "RelativeObjectPosition": self._relative,
            "RelativeLanePosition": self._along,
            "RelativeRoadPosition": self._along,
        }

    def pose(self, position: Element | None, *, within: Element) -> Pose:
        """The pose that a Position means. FormatError if it is missing, broken or of a kind that is not read."""
        if position is None or not len(position):
            raise self.values.fail(within, "Position is missing or empty")
        kind = position[0].tag
        if kind not in self._kinds:
            raise self.values.fail(within, f"a {kind} is not read; known: {', '.join(self._kinds)}")
        return self._kinds[kind](position[0])

    def reads(self, position: Element | None) -> bool:
        """Whether a position is of a kind that is read; a missing one is not: `pose` says so."""
        return position is None or not len(position) or position[0].tag in self._kinds

    def start(self, entity: str, *, within: Element) -> Pose:
        """Where an entity is at the start. FormatError if it has no place, or places refer to each other in a ring."""
        if entity not in self.starts:
            raise self.values.fail(within, f"entity '{entity}' has no position at the start")
        if entity in self._open:
            raise self.values.fail(within, f"the position of '{entity}' depends on itself")
        self._open.add(entity)
        try:
            return self.pose(self.starts[entity], within=within)
        finally:
            self._open.discard(entity)

    def lane_under(self, pose: Pose, *, aligned: bool = True) -> Place | None:
        """The driving lane under a pose, if any goes its way."""
        lane, s, gap = nearest_all(self.graph, (pose.x, pose.y), (LaneType.DRIVING,))
        best: tuple[float, Place] | None = None
        for one, along, off in zip(lane.tolist(), s.tolist(), gap.tolist(), strict=True):
            turn = abs(float(wrap_angle(self.graph.at(one, along)[2] - pose.yaw)))
            if off <= NEAR and (not aligned or turn < math.pi / 3) and (best is None or max(off, 0) < best[0]):
                best = max(off, 0.0), Place(one, along)
        return best[1] if best else None

    def _world(self, element: Element) -> Pose:
        x, y, yaw = (self.values.number(element, name, 0.0 if name == "h" else None) for name in ("x", "y", "h"))
        return Pose(x, self._hand * y + 0.0, self._hand * yaw + 0.0)

    def _turned(self, element: Element, pose: Pose) -> Pose:
        """The pose with an Orientation of the element; relative unless it says absolute."""
        told = element.find("Orientation")
        if told is None:
            return pose
        h = self._hand * self.values.number(told, "h", 0.0)
        absolute = self.values.text(told, "type", "absolute") == "absolute"
        return Pose(pose.x, pose.y, h if absolute else float(wrap_angle(pose.yaw + h)))

    def _on_lane(self, element: Element, lane: int, s: float) -> Place:
        """The place at s of a lane by its OpenDRIVE ids; s is measured along the lane itself."""
        graph = self.graph
        road = int(self.values.number(element, "roadId"))
        rows = np.flatnonzero((graph.road == road) & (graph.lane_id == lane))
        if not len(rows):
            raise self.values.fail(element, f"town '{graph.name}' has no lane {lane} of road {road}")
        rows = rows[np.argsort(graph.section[rows])]
        total = float(graph.length[rows].sum())
        if not -1.0 <= s <= total + 1.0:
            raise self.values.fail(element, f"s is {s:g} m; lane {lane} of road {road} has {total:.1f} m")
        self.lost["positions by road and s are taken along the lane, not along the road's reference line"] += 1
        for row in rows.tolist():
            length = float(graph.length[row])
            if s <= length or row == rows[-1]:
                return Place(row, min(max(s, 0.0), length) if lane < 0 else min(max(length - s, 0.0), length))
            s -= length
        raise AssertionError

    def _lane(self, element: Element) -> Pose:
        lane = int(self.values.number(element, "laneId"))
        place = self._on_lane(element, lane, self.values.number(element, "s"))
        aside = self.values.number(element, "offset", 0.0) * (1.0 if lane < 0 else -1.0)
        return self._turned(element, shifted(pose_at(self.graph, place), 0.0, aside))

    def _road(self, element: Element) -> Pose:
        t = self.values.number(element, "t")
        road = int(self.values.number(element, "roadId"))
        rows = np.flatnonzero((self.graph.road == road) & (self.graph.kind == LaneType.DRIVING))
        if not len(rows):
            raise self.values.fail(element, f"town '{self.graph.name}' has no driving lane of road {road}")
        ids = sorted({int(n) for n in self.graph.lane_id[rows]}, key=abs)
        lane = next((n for n in ids if n * t > 0.0), ids[0])
        place = self._on_lane(element, lane, self.values.number(element, "s"))
        width = self.graph.at(place.lane, place.s)[3]
        middle = math.copysign((abs(lane) - 0.5) * width, lane)
        aside = (t - middle) * (1.0 if lane < 0 else -1.0)
        return self._turned(element, shifted(pose_at(self.graph, place), 0.0, aside))

    def _relative(self, element: Element) -> Pose:
        base = self.start(self.values.text(element, "entityRef"), within=element)
        dx = self.values.number(element, "dx", 0.0)
        dy = self._hand * self.values.number(element, "dy", 0.0)
        if element.tag == "RelativeWorldPosition":
            return self._turned(element, Pose(base.x + dx, base.y + dy, base.yaw))
        return self._turned(element, shifted(base, dx, dy))

    def _along(self, element: Element) -> Pose:
        base = self.start(self.values.text(element, "entityRef"), within=element)
        place = self.lane_under(base)
        if place is None:
            raise self.values.fail(element, "no lane under the entity that it refers to")
        dt = self.values.number(element, "dt" if element.tag == "RelativeRoadPosition" else "offset", 0.0)
        ds = self.values.number(element, "ds", self.values.number(element, "dsLane", 0.0))
        over = self.values.lanes(element, "dLane")
        if abs(ds) > LONGEST:
            raise self.values.fail(element, f"ds is {ds:g} m, beyond {LONGEST:g} m")
        place = ahead(self.graph, place, ds) if ds >= 0.0 else behind(self.graph, place, -ds)
        pose = pose_at(self.graph, place)
        left = over > 0
        for _ in range(abs(over)):
            lane = int((self.graph.left if left else self.graph.right)[place.lane])
            if lane < 0:
                raise self.values.fail(element, f"there is no lane {over} beside the entity that it refers to")
            found = nearest_all(self.graph, (pose.x, pose.y), (LaneType(int(self.graph.kind[lane])),))
            at = int(np.flatnonzero(found[0] == lane)[0])
            left ^= not self.graph.same_direction(place.lane, lane)  # what is further left is on the right of those
            place = Place(lane, float(found[1][at]))
            pose = pose_at(self.graph, place)
        return self._turned(element, shifted(pose, 0.0, dt))
