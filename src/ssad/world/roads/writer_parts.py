"""OpenDRIVE building blocks of towns: specifications, reference lines, arms of junctions, XML elements."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from xml.etree.ElementTree import Element, SubElement

Point = tuple[float, float]
CLEARANCE = 8.0  # m from the outer edge of the widest arm to the stop lines: sets the radius of right turns
CROSSWALK = 3.0  # m, width
CROSSWALK_END = 1.0  # m between a crosswalk and the end of its street
SETBACK_OF_CROSSWALK = 17.0  # m from the end of an arm to the crosswalk of a roundabout: a car waits beyond it


@dataclass(frozen=True)
class RoadSpec:
    """Road along a polyline with rounded inner corners; its halves are equal.

    Signals and crosswalks belong to the junctions where streets end.

    Attributes:
        points: x, y of the polyline, m.
        lanes: Number of lanes on each side.
        width: Width of a lane, m.
        shoulder: Width of the shoulder, m; 0: none.
        sidewalk: Width of the sidewalk, m; 0: none.
        limit: Speed limit, mph.
        radius: Radius of the corners, m.
        median: Distance between the halves, m.
        one_way: Whether there is only the right half, driven from the first point to the last.
    """

    points: tuple[Point, ...]
    lanes: int
    width: float
    shoulder: float
    sidewalk: float
    limit: float
    radius: float = 20.0
    median: float = 0.0
    one_way: bool = False


@dataclass(frozen=True)
class Roundabout:
    """Ring of one lane, driven counterclockwise. Streets with one lane on each side connect to it and yield to it.

    A street connects if it ends at the ring's middle.

    Attributes:
        place: Middle, m.
        radius: Distance from the middle to the middle of the lane, m.
        width: Width of that lane, m.
        spread: Angle from the axis of an arm to where its traffic joins and leaves the ring, rad.
        limit: Speed limit on the ring, mph.
    """

    place: Point
    radius: float
    width: float = 5.0
    spread: float = math.radians(28.0)
    limit: float = 20.0

    @property
    def island(self) -> float:
        """Radius of the island, m."""
        return self.radius - 0.5 * self.width

    @property
    def setback(self) -> float:
        """Distance from the middle to the ends of the arms, m."""
        return self.island * (1.0 / math.cos(self.spread) + math.tan(self.spread))


@dataclass(frozen=True)
class Interchange:
    """Place at which a motorway gains a lane a side, from a ramp, or loses it to one.

    Both parts, one of n and one of n + 1 lanes a side, end at `place`. The one-way street that ends at `on` goes on as
    the outermost lane of the wider part; the outermost lane that comes from there goes on as the one-way street that
    begins at `off`.
    """

    place: Point
    on: Point
    off: Point


@dataclass(frozen=True)
class Town:
    """Streets whose ends meet at junctions; arms leave a junction along the axes.

    Attributes:
        name: Name of the town.
        streets: All streets.
        signalled: Places of the junctions with traffic lights; all others of three or more arms get signs.
        roundabouts: All roundabouts.
        interchanges: All interchanges.
    """

    name: str
    streets: tuple[RoadSpec, ...]
    signalled: tuple[Point, ...] = ()
    roundabouts: tuple[Roundabout, ...] = ()
    interchanges: tuple[Interchange, ...] = ()


@dataclass(frozen=True)
class Arm:
    """End of a street at a junction.

    Attributes:
        road: OpenDRIVE id of the street.
        street: Its specification.
        heading: Outwards from the junction, rad.
        at_end: Whether the street ends at the junction; else it begins there.
    """

    road: int
    street: RoadSpec
    heading: float
    at_end: bool

    @property
    def leads_in(self) -> bool:
        """True if traffic enters the junction from this arm."""
        return self.at_end or not self.street.one_way

    @property
    def leads_out(self) -> bool:
        """True if traffic leaves the junction into this arm."""
        return not (self.at_end and self.street.one_way)

    def inward(self, k: int) -> int:
        """OpenDRIVE id of the k-th lane from the middle (1 the innermost) that leads into the junction."""
        return -self._id(k) if self.at_end else self._id(k)

    def outward(self, k: int) -> int:
        """The same for the lane that leads out."""
        return self._id(k) if self.at_end else -self._id(k)

    def offset(self, k: int) -> float:
        """Distance of the left edge of the k-th lane from the middle of the street, m."""
        return 0.5 * self.street.median + (k - 1) * self.street.width

    def _id(self, k: int) -> int:
        # A median takes the innermost lane id.
        return k + (self.street.median > 0.0)


@dataclass
class Junction:
    """Junction of arms.

    Attributes:
        id: OpenDRIVE id.
        place: x, y of the middle, m.
        arms: Ends of the streets that meet there.
        ring: The roundabout, if one arm meets a roundabout at this junction.
        arm_distance: Distance from the place to the ends of the arms, m; None: as far as right turns need.
    """

    id: int
    place: Point
    arms: list[Arm] = field(default_factory=list)
    ring: Roundabout | None = None
    arm_distance: float | None = None

    @property
    def setback(self) -> float:
        """Distance from the middle to the ends of the arms, m."""
        if self.arm_distance is not None:
            return self.arm_distance
        return max(arm.street.lanes * arm.street.width + 0.5 * arm.street.median for arm in self.arms) + CLEARANCE

    @property
    def crosswalk(self) -> float | None:
        """Distance from the end of an arm to the middle of its crosswalk, m; None without crosswalks."""
        if self.ring:
            return SETBACK_OF_CROSSWALK
        return CROSSWALK_END + 0.5 * CROSSWALK if len(self.arms) > 2 else None


@dataclass(frozen=True)
class Piece:
    """Line (curvature 0) or arc that starts at x, y with heading hdg."""

    x: float
    y: float
    hdg: float
    length: float
    curvature: float


def plan_pieces(street: RoadSpec, start: float, end: float) -> list[Piece]:
    """Reference line of a street between the ends of its arms: lines, and arcs at its corners."""
    points = list(street.points)
    headings = [
        math.atan2(end_point[1] - start_point[1], end_point[0] - start_point[0])
        for start_point, end_point in pairwise(points)
    ]
    points[0] = ahead(points[0], headings[0], start)
    points[-1] = ahead(points[-1], headings[-1], -end)
    pieces, position = [], points[0]
    for index, heading in enumerate(headings):
        corner = points[index + 1]
        turn_angle = wrap(headings[index + 1] - heading) if index + 1 < len(headings) else 0.0
        tangent = street.radius * math.tan(abs(turn_angle) / 2.0)
        length = math.dist(position, corner) - tangent
        pieces.append(Piece(*position, heading, length, 0.0))
        if turn_angle:
            arc_start = ahead(corner, heading, -tangent)
            pieces.append(
                Piece(
                    *arc_start, heading, street.radius * abs(turn_angle), math.copysign(1.0 / street.radius, turn_angle)
                )
            )
            position = ahead(corner, headings[index + 1], tangent)
    return pieces


def turn_pieces(start: Point, heading: float, end: Point, turn: float) -> list[Piece]:
    """Reference line from start to end which turns once by `turn` rad: line, arc, line (those with length)."""
    if abs(turn) < 1e-9:
        return [Piece(*start, heading, math.dist(start, end), 0.0)]
    # corner: where the two straight lines meet
    dx, dy = end[0] - start[0], end[1] - start[1]
    end_heading = heading + turn
    entry_length = (dx * math.sin(end_heading) - dy * math.cos(end_heading)) / math.sin(turn)
    exit_length = (dy * math.cos(heading) - dx * math.sin(heading)) / math.sin(turn)
    tangent = min(entry_length, exit_length)
    radius = tangent / math.tan(abs(turn) / 2.0)
    pieces = []
    if entry_length - tangent > 1e-6:
        pieces.append(Piece(*start, heading, entry_length - tangent, 0.0))
    arc_start = ahead(start, heading, entry_length - tangent)
    pieces.append(Piece(*arc_start, heading, radius * abs(turn), math.copysign(1.0 / radius, turn)))
    if exit_length - tangent > 1e-6:
        pieces.append(Piece(*ahead(end, end_heading, tangent - exit_length), end_heading, exit_length - tangent, 0.0))
    return pieces


def fill_way(
    road: Element, start: Arm, end: Arm, pairs: list[tuple[int, int]], *, kerb: bool, eased: bool = False
) -> None:
    """Lanes of a connecting road: those of the movement, and shoulder and sidewalk where it runs along a kerb.

    Args:
        road: The connecting road.
        start: Arm that it comes from.
        end: Arm that it leads to.
        pairs: Numbers of the incoming and of the outgoing lane of each.
        kerb: Whether it runs along a kerb.
        eased: Whether the widths of the lanes change without a kink at both ends.
    """
    length = float(road.get("length", "0"))
    lanes = lane_section(road)
    centre = SubElement(SubElement(lanes, "center"), "lane", id="0", type="none", level="false")
    mark_lane(centre, "none", "white")
    group = SubElement(lanes, "right")
    first_street, second_street = start.street, end.street
    lane_specs = [
        ("driving", first_street.width, second_street.width, start.inward(incoming), end.outward(outgoing))
        for incoming, outgoing in pairs
    ]
    if kerb and first_street.shoulder and second_street.shoulder:
        lane_specs.append(
            (
                "shoulder",
                first_street.shoulder,
                second_street.shoulder,
                start.inward(first_street.lanes + 1),
                end.outward(second_street.lanes + 1),
            )
        )
        if first_street.sidewalk and second_street.sidewalk:
            lane_specs.append(
                (
                    "sidewalk",
                    first_street.sidewalk,
                    second_street.sidewalk,
                    start.inward(first_street.lanes + 2),
                    end.outward(second_street.lanes + 2),
                )
            )
    for index, (lane_kind, start_width, end_width, predecessor, successor) in enumerate(lane_specs):
        marking = "curb" if lane_kind == "shoulder" and first_street.sidewalk else "none"
        mean_slope = (end_width - start_width) / length
        coefficients = (
            (0.0, 3.0 * mean_slope / length, -2.0 * mean_slope / length**2) if eased else (mean_slope, 0.0, 0.0)
        )
        lane_node = lane_element(group, -index - 1, lane_kind, (start_width, *coefficients), mark=(marking, "white"))
        SubElement(lane_node[0], "predecessor", id=str(predecessor))
        SubElement(lane_node[0], "successor", id=str(successor))


def road_element(name: str, number: int, junction: int, pieces: list[Piece]) -> Element:
    """Create a road without lanes; its first child is its link."""
    total_length = sum(piece.length for piece in pieces)
    road = Element("road", name=name, length=decimal(total_length), id=str(number), junction=str(junction))
    SubElement(road, "link")
    plan_view = SubElement(road, "planView")
    start = 0.0
    for piece in pieces:
        geometry = SubElement(
            plan_view,
            "geometry",
            s=decimal(start),
            x=decimal(piece.x),
            y=decimal(piece.y),
            hdg=decimal(wrap(piece.hdg)),
            length=decimal(piece.length),
        )
        if piece.curvature:
            SubElement(geometry, "arc", curvature=decimal(piece.curvature))
        else:
            SubElement(geometry, "line")
        start += piece.length
    SubElement(SubElement(road, "elevationProfile"), "elevation", s="0", a="0", b="0", c="0", d="0")
    SubElement(road, "lateralProfile")
    return road


def lane_section(road: Element) -> Element:
    """Add a road's lanes without offset and with one section from its start; return the section."""
    lanes = SubElement(road, "lanes")
    SubElement(lanes, "laneOffset", s="0", a="0", b="0", c="0", d="0")
    return SubElement(lanes, "laneSection", s="0")


def lane_element(
    group: Element, number: int, kind: str, width: tuple[float, float, float, float], *, mark: tuple[str, str]
) -> Element:
    """Add a lane whose width is a polynomial of the distance from its start; its first child is its link."""
    lane = SubElement(group, "lane", id=str(number), type=kind, level="false")
    SubElement(lane, "link")
    coefficients = dict(zip("abcd", map(decimal, width), strict=True))
    SubElement(lane, "width", {"sOffset": "0"} | coefficients)
    mark_lane(lane, *mark)
    return lane


def mark_lane(lane: Element, kind: str, color: str) -> None:
    """Add the marking on the outer edge of a lane; it may be crossed where it is broken and white."""
    change = "both" if kind == "broken" and color == "white" else "none"
    SubElement(
        lane, "roadMark", sOffset="0", type=kind, weight="standard", color=color, width="0.12", laneChange=change
    )


def ahead(point: Point, heading: float, distance: float) -> Point:
    """Return the point at a distance (m) from a point along a heading (rad)."""
    return point[0] + distance * math.cos(heading), point[1] + distance * math.sin(heading)


def wrap(angle: float) -> float:
    """Wrap an angle to -pi..pi, rad."""
    return math.remainder(angle, 2.0 * math.pi)


def decimal(value: float) -> str:
    """Format a number with nine decimals, so that the last bits of a machine's sine do not show; no minus zero."""
    text = f"{value:.9f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text
