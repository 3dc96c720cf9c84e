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
from ssad.scenarios.dynamic.knowledge._placing import LanePosition, move_pose, place_ahead, place_behind, pose_at
from ssad.world.roads.query import nearest_all

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

LONGEST = 1.0e4  # m along lanes between two entities
LANES = 20
NEAR = 2.0  # m outside a lane within which an entity still belongs to it
_PARAMETER = re.compile(r"^\$\{?\s*(\w+)\s*\}?$")


class AttributeReader:
    """Attributes of elements with the document's parameters substituted; errors name file and element."""

    def __init__(self, location: str, root: Element) -> None:
        self.location = location
        self.parameters: dict[str, str] = {
            item.get("name", ""): item.get("value", "") for item in root.iter("ParameterDeclaration")
        }

    def error(self, element: Element | str, message: str) -> FormatError:
        """Return a FormatError that names the file and the element."""
        tag = element if isinstance(element, str) else element.tag
        return FormatError(f"{self.location}: {tag}: {message}")

    def text(self, element: Element, name: str, default: str | None = None) -> str:
        """An attribute as text. FormatError if it is missing and there is no default, or its parameter is unknown."""
        value = element.get(name, default)
        if value is None:
            raise self.error(element, f"attribute '{name}' is missing")
        reference = _PARAMETER.match(value)
        if reference is None:
            if value.startswith("$"):
                raise self.error(element, f"{name}: expressions are not read, only $parameter: {value[:60]}")
            return value
        if reference[1] not in self.parameters:
            raise self.error(element, f"{name}: parameter ${reference[1]} is not declared")
        return self.parameters[reference[1]]

    def number(self, element: Element, name: str, default: float | None = None) -> float:
        """Return an attribute as a finite number. FormatError if it is none."""
        number_text = self.text(element, name, None if default is None else repr(default))
        try:
            value = float(number_text)
        except ValueError:
            raise self.error(element, f"{name} is '{number_text[:40]}', not a number") from None
        if not math.isfinite(value):
            raise self.error(element, f"{name} is '{number_text[:40]}', not a finite number")
        return value

    def lanes(self, element: Element, name: str) -> int:
        """A number of lanes to the left, negative to the right. FormatError where no road has as many."""
        value = self.number(element, name, 0.0)
        if abs(value) > LANES:
            raise self.error(element, f"{name} is {value:g}: no road has so many lanes")
        return int(value)


class PositionReader:
    """Positions as poses in the world frame; inexact conversions are counted in `omissions`."""

    def __init__(
        self,
        values: AttributeReader,
        graph: LaneGraph,
        *,
        mirrored: bool,
        omissions: Counter[str],
        starts: Mapping[str, Element],
    ) -> None:
        """Create the reader of one document.

        Args:
            values: Reads the attributes of elements.
            graph: Lane graph of the town.
            mirrored: World positions are in CARLA's left-handed frame.
            omissions: Counter of the features that are not carried over.
            starts: Name of an entity -> its position at the start.
        """
        self.values, self.graph, self.omissions, self.starts = values, graph, omissions, starts
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
        """Return the pose of a Position. FormatError if it is missing, broken or of an unsupported kind."""
        if position is None or not len(position):
            raise self.values.error(within, "Position is missing or empty")
        kind = position[0].tag
        if kind not in self._kinds:
            raise self.values.error(within, f"a {kind} is not read; known: {', '.join(self._kinds)}")
        return self._kinds[kind](position[0])

    def is_supported(self, position: Element | None) -> bool:
        """Return whether a position is of a supported kind; true if it is missing, which `pose` reports."""
        return position is None or not len(position) or position[0].tag in self._kinds

    def start(self, entity: str, *, within: Element) -> Pose:
        """Return the start pose of an entity. FormatError if it has none, or positions refer to each other."""
        if entity not in self.starts:
            raise self.values.error(within, f"entity '{entity}' has no position at the start")
        if entity in self._open:
            raise self.values.error(within, f"the position of '{entity}' depends on itself")
        self._open.add(entity)
        try:
            return self.pose(self.starts[entity], within=within)
        finally:
            self._open.discard(entity)

    def lane_under(self, pose: Pose, *, aligned: bool = True) -> LanePosition | None:
        """Return the driving lane under a pose; with `aligned`, only one with its direction."""
        lanes, positions, distances = nearest_all(self.graph, (pose.x, pose.y), (LaneType.DRIVING,))
        best: tuple[float, LanePosition] | None = None
        for candidate, lane_position, distance in zip(
            lanes.tolist(), positions.tolist(), distances.tolist(), strict=True
        ):
            heading_difference = abs(float(wrap_angle(self.graph.at(candidate, lane_position)[2] - pose.yaw)))
            if (
                distance <= NEAR
                and (not aligned or heading_difference < math.pi / 3)
                and (best is None or max(distance, 0) < best[0])
            ):
                best = max(distance, 0.0), LanePosition(candidate, lane_position)
        return best[1] if best else None

    def _world(self, element: Element) -> Pose:
        x, y, yaw = (self.values.number(element, name, 0.0 if name == "h" else None) for name in ("x", "y", "h"))
        # Adding 0.0 turns a negative zero into zero.
        return Pose(x, self._hand * y + 0.0, self._hand * yaw + 0.0)

    def _apply_orientation(self, element: Element, pose: Pose) -> Pose:
        """Return the pose with an Orientation of the element, relative unless it says absolute."""
        orientation = element.find("Orientation")
        if orientation is None:
            return pose
        heading = self._hand * self.values.number(orientation, "h", 0.0)
        absolute = self.values.text(orientation, "type", "absolute") == "absolute"
        return Pose(pose.x, pose.y, heading if absolute else float(wrap_angle(pose.yaw + heading)))

    def _on_lane(self, element: Element, lane: int, s: float) -> LanePosition:
        """Return the place at s of a lane by its OpenDRIVE ids; s is measured along the lane itself."""
        graph = self.graph
        road = int(self.values.number(element, "roadId"))
        sections = np.flatnonzero((graph.road == road) & (graph.lane_id == lane))
        if not len(sections):
            raise self.values.error(element, f"town '{graph.name}' has no lane {lane} of road {road}")
        sections = sections[np.argsort(graph.section[sections])]
        road_length = float(graph.length[sections].sum())
        if not -1.0 <= s <= road_length + 1.0:
            raise self.values.error(element, f"s is {s:g} m; lane {lane} of road {road} has {road_length:.1f} m")
        self.omissions["positions by road and s are taken along the lane, not along the road's reference line"] += 1
        for section in sections.tolist():
            length = float(graph.length[section])
            if s <= length or section == sections[-1]:
                # Traffic of other lanes runs against s.
                return LanePosition(section, min(max(s if self.graph.forward[section] else length - s, 0.0), length))
            s -= length
        raise AssertionError

    def _lane(self, element: Element) -> Pose:
        lane_id = int(self.values.number(element, "laneId"))
        place = self._on_lane(element, lane_id, self.values.number(element, "s"))
        lateral_offset = self.values.number(element, "offset", 0.0) * (1.0 if self.graph.forward[place.lane] else -1.0)
        return self._apply_orientation(element, move_pose(pose_at(self.graph, place), 0.0, lateral_offset))

    def _road(self, element: Element) -> Pose:
        t = self.values.number(element, "t")
        road_id = int(self.values.number(element, "roadId"))
        driving_lanes = np.flatnonzero((self.graph.road == road_id) & (self.graph.kind == LaneType.DRIVING))
        if not len(driving_lanes):
            raise self.values.error(element, f"town '{self.graph.name}' has no driving lane of road {road_id}")
        lane_ids = sorted({int(lane_id) for lane_id in self.graph.lane_id[driving_lanes]}, key=abs)
        nearest_id = next((lane_id for lane_id in lane_ids if lane_id * t > 0.0), lane_ids[0])
        place = self._on_lane(element, nearest_id, self.values.number(element, "s"))
        width = self.graph.at(place.lane, place.s)[3]
        middle = math.copysign((abs(nearest_id) - 0.5) * width, nearest_id)
        lateral_offset = (t - middle) * (1.0 if self.graph.forward[place.lane] else -1.0)
        return self._apply_orientation(element, move_pose(pose_at(self.graph, place), 0.0, lateral_offset))

    def _relative(self, element: Element) -> Pose:
        reference_pose = self.start(self.values.text(element, "entityRef"), within=element)
        forward = self.values.number(element, "dx", 0.0)
        leftward = self._hand * self.values.number(element, "dy", 0.0)
        if element.tag == "RelativeWorldPosition":
            return self._apply_orientation(
                element, Pose(reference_pose.x + forward, reference_pose.y + leftward, reference_pose.yaw)
            )
        return self._apply_orientation(element, move_pose(reference_pose, forward, leftward))

    def _along(self, element: Element) -> Pose:
        reference_pose = self.start(self.values.text(element, "entityRef"), within=element)
        place = self.lane_under(reference_pose)
        if place is None:
            raise self.values.error(element, "no lane under the entity that it refers to")
        lateral_offset = self.values.number(element, "dt" if element.tag == "RelativeRoadPosition" else "offset", 0.0)
        distance = self.values.number(element, "ds", self.values.number(element, "dsLane", 0.0))
        lane_count = self.values.lanes(element, "dLane")
        if abs(distance) > LONGEST:
            raise self.values.error(element, f"ds is {distance:g} m, beyond {LONGEST:g} m")
        place = (
            place_ahead(self.graph, place, distance) if distance >= 0.0 else place_behind(self.graph, place, -distance)
        )
        pose = pose_at(self.graph, place)
        to_left = lane_count > 0
        for _ in range(abs(lane_count)):
            lane = int((self.graph.left if to_left else self.graph.right)[place.lane])
            if lane < 0:
                raise self.values.error(element, f"there is no lane {lane_count} beside the entity that it refers to")
            nearest = nearest_all(self.graph, (pose.x, pose.y), (LaneType(int(self.graph.kind[lane])),))
            match = int(np.flatnonzero(nearest[0] == lane)[0])
            to_left ^= not self.graph.is_same_direction(
                place.lane, lane
            )  # what is further left is on the right of those
            place = LanePosition(lane, float(nearest[1][match]))
            pose = pose_at(self.graph, place)
        return self._apply_orientation(element, move_pose(pose, 0.0, lateral_offset))
