"""Pieces of OpenDRIVE that towns are written from: specifications, reference lines, arms of junctions, XML elements."""

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
    """A road along a polyline with rounded inner corners; its halves are equal.

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
        one_way: Only the right half, driven from the first point to the last.
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
    """A ring of one lane, driven counterclockwise; streets with one lane on each side that end at its middle meet it.

    Arms yield to the ring.

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
    """Where a motorway gains a lane a side: towards the wider part a ramp brings it, away from it a ramp takes it.

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
    """The end of a street at a junction.

    Attributes:
        road: OpenDRIVE id of the street.
        street: Its specification.
        heading: Outwards from the junction, rad.
        at_end: Whether the street ends here; else it begins here.
    """

    road: int
    street: RoadSpec
    heading: float
    at_end: bool

    @property
    def leads_in(self) -> bool:
        """Whether traffic comes from it."""
        return self.at_end or not self.street.one_way

    @property
    def leads_out(self) -> bool:
        """Whether traffic leaves into it."""
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
        return k + (self.street.median > 0.0)


@dataclass
class Junction:
    """Arms that meet.

    Attributes:
        id: OpenDRIVE id.
        place: x, y of the middle, m.
        arms: Ends of the streets that meet here.
        ring: The roundabout, if the junction is where one arm meets a roundabout.
        apart: Distance from the place to the ends of the arms, m; None: as far as right turns need.
    """

    id: int
    place: Point
    arms: list[Arm] = field(default_factory=list)
    ring: Roundabout | None = None
    apart: float | None = None

    @property
    def setback(self) -> float:
        """Distance from the middle to the ends of the arms, m."""
        if self.apart is not None:
            return self.apart
        return max(arm.street.lanes * arm.street.width + 0.5 * arm.street.median for arm in self.arms) + CLEARANCE

    @property
    def crosswalk(self) -> float | None:
        """Distance from the end of an arm to the middle of its crosswalk, m; None without crosswalks."""
        if self.ring:
            return SETBACK_OF_CROSSWALK
        return CROSSWALK_END + 0.5 * CROSSWALK if len(self.arms) > 2 else None


@dataclass(frozen=True)
class Piece:
    """A line (curvature 0) or arc from x, y with heading hdg."""

    x: float
    y: float
    hdg: float
    length: float
    curvature: float


def plan_pieces(street: RoadSpec, start: float, end: float) -> list[Piece]:
    """Reference line of a street between the ends of its arms: lines, and arcs at its corners."""
    points = list(street.points)
    heads = [math.atan2(b[1] - a[1], b[0] - a[0]) for a, b in pairwise(points)]
    points[0] = ahead(points[0], heads[0], start)
    points[-1] = ahead(points[-1], heads[-1], -end)
    pieces, here = [], points[0]
    for i, head in enumerate(heads):
        corner = points[i + 1]
        turn = wrap(heads[i + 1] - head) if i + 1 < len(heads) else 0.0
        tangent = street.radius * math.tan(abs(turn) / 2.0)
        length = math.dist(here, corner) - tangent
        pieces.append(Piece(*here, head, length, 0.0))
        if turn:
            begin = ahead(corner, head, -tangent)
            pieces.append(Piece(*begin, head, street.radius * abs(turn), math.copysign(1.0 / street.radius, turn)))
            here = ahead(corner, heads[i + 1], tangent)
    return pieces


def turn_pieces(start: Point, heading: float, end: Point, turn: float) -> list[Piece]:
    """Reference line from start to end which turns once by `turn` rad: line, arc, line (those with length)."""
    if abs(turn) < 1e-9:
        return [Piece(*start, heading, math.dist(start, end), 0.0)]
    # corner: where the two straight lines meet
    dx, dy = end[0] - start[0], end[1] - start[1]
    out = heading + turn
    before = (dx * math.sin(out) - dy * math.cos(out)) / math.sin(turn)
    after = (dy * math.cos(heading) - dx * math.sin(heading)) / math.sin(turn)
    tangent = min(before, after)
    radius = tangent / math.tan(abs(turn) / 2.0)
    pieces = []
    if before - tangent > 1e-6:
        pieces.append(Piece(*start, heading, before - tangent, 0.0))
    begin = ahead(start, heading, before - tangent)
    pieces.append(Piece(*begin, heading, radius * abs(turn), math.copysign(1.0 / radius, turn)))
    if after - tangent > 1e-6:
        pieces.append(Piece(*ahead(end, out, tangent - after), out, after - tangent, 0.0))
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
    one, two = start.street, end.street
    rows = [("driving", one.width, two.width, start.inward(i), end.outward(j)) for i, j in pairs]
    if kerb and one.shoulder and two.shoulder:
        rows.append(("shoulder", one.shoulder, two.shoulder, start.inward(one.lanes + 1), end.outward(two.lanes + 1)))
        if one.sidewalk and two.sidewalk:
            rows.append(
                ("sidewalk", one.sidewalk, two.sidewalk, start.inward(one.lanes + 2), end.outward(two.lanes + 2))
            )
    for k, (what, width, final, before, after) in enumerate(rows):
        mark = "curb" if what == "shoulder" and one.sidewalk else "none"
        slope = (final - width) / length
        change = (0.0, 3.0 * slope / length, -2.0 * slope / length**2) if eased else (slope, 0.0, 0.0)
        lane = lane_element(group, -k - 1, what, (width, *change), mark=(mark, "white"))
        SubElement(lane[0], "predecessor", id=str(before))
        SubElement(lane[0], "successor", id=str(after))


def road_element(name: str, number: int, junction: int, pieces: list[Piece]) -> Element:
    """A road without lanes; its first child is its link."""
    total = sum(piece.length for piece in pieces)
    road = Element("road", name=name, length=decimal(total), id=str(number), junction=str(junction))
    SubElement(road, "link")
    plan = SubElement(road, "planView")
    s = 0.0
    for piece in pieces:
        item = SubElement(
            plan,
            "geometry",
            s=decimal(s),
            x=decimal(piece.x),
            y=decimal(piece.y),
            hdg=decimal(wrap(piece.hdg)),
            length=decimal(piece.length),
        )
        if piece.curvature:
            SubElement(item, "arc", curvature=decimal(piece.curvature))
        else:
            SubElement(item, "line")
        s += piece.length
    SubElement(SubElement(road, "elevationProfile"), "elevation", s="0", a="0", b="0", c="0", d="0")
    SubElement(road, "lateralProfile")
    return road


def lane_section(road: Element) -> Element:
    """Add a road's lanes with no offset and one section from its start; returns the section."""
    lanes = SubElement(road, "lanes")
    SubElement(lanes, "laneOffset", s="0", a="0", b="0", c="0", d="0")
    return SubElement(lanes, "laneSection", s="0")


def lane_element(
    group: Element, number: int, kind: str, width: tuple[float, float, float, float], *, mark: tuple[str, str]
) -> Element:
    """A lane whose width is a polynomial of the distance from its start; its first child is its link."""
    lane = SubElement(group, "lane", id=str(number), type=kind, level="false")
    SubElement(lane, "link")
    factors = dict(zip("abcd", map(decimal, width), strict=True))
    SubElement(lane, "width", {"sOffset": "0"} | factors)
    mark_lane(lane, *mark)
    return lane


def mark_lane(lane: Element, kind: str, color: str) -> None:
    """Add the paint on the outer edge of a lane; lane changes across it are allowed where it is broken and white."""
    change = "both" if kind == "broken" and color == "white" else "none"
    SubElement(
        lane, "roadMark", sOffset="0", type=kind, weight="standard", color=color, width="0.12", laneChange=change
    )


def ahead(point: Point, heading: float, distance: float) -> Point:
    """The point at a distance (m) from a point along a heading (rad)."""
    return point[0] + distance * math.cos(heading), point[1] + distance * math.sin(heading)


def wrap(angle: float) -> float:
    """An angle in -pi..pi, rad."""
    return math.remainder(angle, 2.0 * math.pi)


def decimal(value: float) -> str:
    """Nine decimals, so that the last bits of a machine's sine do not show; no minus zero."""
    text = f"{value:.9f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text
