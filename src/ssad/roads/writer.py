"""Writes streets and junctions as OpenDRIVE 1.4: the geometry of towns that are made of straight arms and arcs."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import pairwise
from xml.etree.ElementTree import Element, SubElement, indent, tostring

Point = tuple[float, float]
CLEARANCE = 8.0  # m from the outer edge of the widest arm to the stop lines: sets the radius of right turns
CROSSWALK = 3.0  # m, width
CROSSWALK_END = 1.0  # m between a crosswalk and the end of its street
STOP_LINE = CROSSWALK_END + CROSSWALK + 1.0  # m from the end of a street with a crosswalk to where it is waited
SIGN_ASIDE = 0.75  # m from the kerb to the post of a sign
YIELDS = 3  # at every so manieth T-junction without lights the stem yields, elsewhere it stops


@dataclass(frozen=True)
class RoadSpec:
    """A road of equal halves along a polyline whose inner corners are rounded with `radius` m.

    lanes a side of `width` m, then a shoulder and a sidewalk (m, 0: none); `limit` in mph; signals and crosswalks
    belong to the junctions where streets end.
    """

    points: tuple[Point, ...]
    lanes: int
    width: float
    shoulder: float
    sidewalk: float
    limit: float
    radius: float = 20.0


@dataclass(frozen=True)
class Town:
    """Streets whose ends meet at junctions; arms leave a junction along the axes. signalled: junction places; all other
    junctions of three arms or more get signs."""

    name: str
    streets: tuple[RoadSpec, ...]
    signalled: tuple[Point, ...] = ()


@dataclass(frozen=True)
class _Piece:
    """A line (curvature 0) or arc from x, y with heading hdg."""

    x: float
    y: float
    hdg: float
    length: float
    curvature: float


@dataclass(frozen=True)
class _Arm:
    """The end of a street at a junction. heading: outwards from the junction; at_end: the street ends here."""

    road: int
    street: RoadSpec
    heading: float
    at_end: bool

    def inward(self, k: int) -> int:
        """OpenDRIVE id of the k-th lane from the middle (1 the innermost) that leads into the junction."""
        return -k if self.at_end else k

    def outward(self, k: int) -> int:
        """The same for the lane that leads out."""
        return k if self.at_end else -k


@dataclass
class _Junction:
    id: int
    place: Point
    arms: list[_Arm] = field(default_factory=list)

    @property
    def setback(self) -> float:
        """Distance from the middle to the ends of the arms, m."""
        return max(arm.street.lanes * arm.street.width for arm in self.arms) + CLEARANCE


def write_town(town: Town) -> str:
    """The town as OpenDRIVE text, the same for the same town."""
    junctions = _junctions(town)
    at = {junction.place: junction for junction in junctions}
    root = Element("OpenDRIVE")
    SubElement(root, "header", revMajor="1", revMinor="4", name=town.name, version="1", north="0", south="0",
               east="0", west="0", vendor="SSAD")  # fmt: skip
    roads: list[Element] = []
    lengths: dict[int, float] = {}
    for number, street in enumerate(town.streets, start=1):
        ends = (at[street.points[0]], at[street.points[-1]])
        pieces = _plan(street, ends[0].setback, ends[1].setback)
        lengths[number] = sum(piece.length for piece in pieces)
        roads.append(_street(number, street, pieces, ends))
    for junction in junctions:
        _connect(roads, root, junction)
    places = set(town.signalled)
    stems = 0
    for junction in junctions:
        if junction.place in places:
            _signals(root, roads, junction, lengths)
            continue
        ruled = _ruled(junction)
        stems += len(ruled) == 1
        _signs(roads, junction, ruled, lengths, stop=len(ruled) > 1 or stems % YIELDS > 0)
    root[1:1] = roads
    indent(root, " ")
    return '<?xml version="1.0" encoding="UTF-8"?>\n' + tostring(root, encoding="unicode") + "\n"


def _junctions(town: Town) -> list[_Junction]:
    found: dict[Point, _Junction] = {}
    for number, street in enumerate(town.streets, start=1):
        for place, inner, at_end in (
            (street.points[0], street.points[1], False),
            (street.points[-1], street.points[-2], True),
        ):
            junction = found.setdefault(place, _Junction(1000 * (len(found) + 1), place))
            heading = math.atan2(inner[1] - place[1], inner[0] - place[0])
            junction.arms.append(_Arm(number, street, heading, at_end))
    return list(found.values())


def _plan(street: RoadSpec, start: float, end: float) -> list[_Piece]:
    """Reference line of a street between the ends of its arms: lines, and arcs at its corners."""
    points = list(street.points)
    heads = [math.atan2(b[1] - a[1], b[0] - a[0]) for a, b in pairwise(points)]
    points[0] = _ahead(points[0], heads[0], start)
    points[-1] = _ahead(points[-1], heads[-1], -end)
    pieces, here = [], points[0]
    for i, head in enumerate(heads):
        corner = points[i + 1]
        turn = _wrap(heads[i + 1] - head) if i + 1 < len(heads) else 0.0
        tangent = street.radius * math.tan(abs(turn) / 2.0)
        length = math.dist(here, corner) - tangent
        pieces.append(_Piece(*here, head, length, 0.0))
        if turn:
            begin = _ahead(corner, head, -tangent)
            pieces.append(_Piece(*begin, head, street.radius * abs(turn), math.copysign(1.0 / street.radius, turn)))
            here = _ahead(corner, heads[i + 1], tangent)
    return pieces


def _turn(start: Point, heading: float, end: Point, turn: float) -> list[_Piece]:
    """Reference line from start to end which turns once by `turn` rad: line, arc, line (those with length)."""
    if abs(turn) < 1e-9:
        return [_Piece(*start, heading, math.dist(start, end), 0.0)]
    # corner: where the two straight lines meet
    dx, dy = end[0] - start[0], end[1] - start[1]
    out = heading + turn
    before = (dx * math.sin(out) - dy * math.cos(out)) / math.sin(turn)
    after = (dy * math.cos(heading) - dx * math.sin(heading)) / math.sin(turn)
    tangent = min(before, after)
    radius = tangent / math.tan(abs(turn) / 2.0)
    pieces = []
    if before - tangent > 1e-6:
        pieces.append(_Piece(*start, heading, before - tangent, 0.0))
    begin = _ahead(start, heading, before - tangent)
    pieces.append(_Piece(*begin, heading, radius * abs(turn), math.copysign(1.0 / radius, turn)))
    if after - tangent > 1e-6:
        pieces.append(_Piece(*_ahead(end, out, tangent - after), out, after - tangent, 0.0))
    return pieces


def _street(number: int, street: RoadSpec, pieces: list[_Piece], ends: tuple[_Junction, _Junction]) -> Element:
    road = _road(f"street {number}", number, -1, pieces)
    for name, junction in zip(("predecessor", "successor"), ends, strict=True):
        SubElement(road[0], name, elementType="junction", elementId=str(junction.id))
    kind = Element("type", s="0", type="rural" if not street.sidewalk else "town")
    SubElement(kind, "speed", max=f"{street.limit:g}", unit="mph")
    road.insert(1, kind)
    lanes = _section(road)
    middle = ("broken", "yellow") if street.lanes == 1 else ("solid solid", "yellow")
    for side, sign in (("left", 1), ("center", 0), ("right", -1)):
        group = SubElement(lanes, side)
        if not sign:
            _mark(SubElement(group, "lane", id="0", type="none", level="false"), *middle)
            continue
        rows = [
            ("driving", street.width, ("broken", "white") if k < street.lanes else ("solid", "white"))
            for k in range(1, street.lanes + 1)
        ]
        if street.shoulder:
            rows.append(("shoulder", street.shoulder, ("curb" if street.sidewalk else "none", "white")))
        if street.sidewalk:
            rows.append(("sidewalk", street.sidewalk, ("none", "white")))
        table = [(sign * (k + 1), row) for k, row in enumerate(rows)]
        for lane, (what, width, mark) in sorted(table, key=lambda item: -item[0]):
            _lane(group, lane, what, width, 0.0, mark=mark)
    objects = SubElement(road, "objects")
    length = sum(piece.length for piece in pieces)
    for k, junction in enumerate(ends):
        if len(junction.arms) > 2 and street.sidewalk:
            aside = CROSSWALK_END + 0.5 * CROSSWALK
            _crosswalk(objects, number, k, length - aside if k else aside, street)
    SubElement(road, "signals")  # the last child: `_signals` fills it
    return road


def _crosswalk(objects: Element, number: int, k: int, s: float, street: RoadSpec) -> None:
    half = street.lanes * street.width + street.shoulder
    name = {"id": str(100 * number + k), "name": "crosswalk", "type": "crosswalk", "orientation": "none"}
    place = {"s": _f(s), "t": "0", "zOffset": "0", "hdg": "0"}
    item = SubElement(objects, "object", name | place, length=_f(CROSSWALK), width=_f(2 * half))
    outline = SubElement(item, "outline")
    u, v = 0.5 * CROSSWALK, half
    for a, b in ((-u, -v), (u, -v), (u, v), (-u, v), (-u, -v)):
        SubElement(outline, "cornerLocal", u=_f(a), v=_f(b), z="0", height="0")


def _connect(roads: list[Element], root: Element, junction: _Junction) -> None:
    """Connecting roads for every movement through a junction."""
    element = SubElement(root, "junction", id=str(junction.id), name=f"junction {junction.id}")
    number = junction.id
    for start in junction.arms:
        for end in junction.arms:
            if start is end:
                continue
            turn = _wrap(end.heading - start.heading - math.pi)
            for pairs in _movements(junction, start, end, turn):
                number += 1
                road = _way(number, junction, start, end, pairs=pairs)
                roads.append(road)
                attributes = {"id": str(number - junction.id - 1), "incomingRoad": str(start.road)}
                joint = SubElement(element, "connection", attributes, connectingRoad=str(number), contactPoint="start")
                for k, (one, _) in enumerate(pairs):
                    SubElement(joint, "laneLink", {"from": str(start.inward(one)), "to": str(-k - 1)})


def _movements(junction: _Junction, start: _Arm, end: _Arm, turn: float) -> list[list[tuple[int, int]]]:
    """Lane pairs (from, to; 1 the innermost) of each connecting road from one arm to another.

    Straight on keeps the lane. Turns join outermost to outermost, or innermost to innermost; where three arms
    meet they may also enter the lane beside, so that lanes are not separate circuits.
    """
    n, m = start.street.lanes, end.street.lanes
    if abs(turn) < 0.1:
        return [[(k, k) for k in range(1, min(n, m) + 1)]]
    one, main, other = (n, m, 1) if turn < 0.0 else (1, 1, m)
    return [[(one, main)], [(one, other)]] if m > 1 and len(junction.arms) == 3 else [[(one, main)]]


def _way(number: int, junction: _Junction, start: _Arm, end: _Arm, *, pairs: list[tuple[int, int]]) -> Element:
    """One connecting road; its reference line runs on the left edge of its leftmost lane."""
    turn = _wrap(end.heading - start.heading - math.pi)
    heading = start.heading + math.pi
    a = _edge(junction, start, -(pairs[0][0] - 1) * start.street.width, inward=True)
    b = _edge(junction, end, -(pairs[0][1] - 1) * end.street.width, inward=False)
    road = _road(f"way {number}", number, junction.id, _turn(a, heading, b, turn))
    for name, arm in (("predecessor", start), ("successor", end)):
        contact = "end" if arm.at_end else "start"
        SubElement(road[0], name, elementType="road", elementId=str(arm.road), contactPoint=contact)
    # a kerb lies to the right of a right turn, and of a way straight on where no arm leaves to the right
    right = _wrap(heading - math.pi / 2.0)
    open_right = any(abs(_wrap(arm.heading - right)) < 0.1 for arm in junction.arms)
    outermost = pairs[-1] == (start.street.lanes, end.street.lanes)
    kerb = outermost and (turn < -0.1 or (abs(turn) <= 0.1 and not open_right))
    _ways(road, start, end, pairs, kerb=kerb)
    return road


def _ways(road: Element, start: _Arm, end: _Arm, pairs: list[tuple[int, int]], *, kerb: bool) -> None:
    """Lanes of a connecting road: those of the movement, and shoulder and sidewalk where it runs along a kerb."""
    length = float(road.get("length", "0"))
    lanes = _section(road)
    centre = SubElement(SubElement(lanes, "center"), "lane", id="0", type="none", level="false")
    _mark(centre, "none", "white")
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
        lane = _lane(group, -k - 1, what, width, (final - width) / length, mark=(mark, "white"))
        SubElement(lane[0], "predecessor", id=str(before))
        SubElement(lane[0], "successor", id=str(after))


def _signals(root: Element, roads: list[Element], junction: _Junction, lengths: dict[int, float]) -> None:
    """A light for every arm, and two controllers: arms along x, then arms along y."""
    element = next(e for e in root.findall("junction") if e.get("id") == str(junction.id))
    groups: dict[int, list[str]] = {}
    for k, arm in enumerate(junction.arms):
        number = str(junction.id + 500 + k)
        phase = 0 if abs(math.cos(arm.heading)) > 0.5 else 1
        groups.setdefault(phase, []).append(number)
        half = arm.street.lanes * arm.street.width + arm.street.shoulder + 0.5
        s = lengths[arm.road] - 0.1 if arm.at_end else 0.1
        # orientation "+": it faces traffic that drives along the road's own direction
        light = SubElement(roads[arm.road - 1][-1], "signal", name="Signal_3Light_Post01", id=number, s=_f(s),
                           t=_f(-half if arm.at_end else half), zOffset="0", hOffset="0", roll="0", pitch="0",
                           orientation="+" if arm.at_end else "-", dynamic="yes", country="OpenDRIVE",
                           type="1000001", subtype="-1", value="-1", text="", height="1.2", width="0.5")  # fmt: skip
        low, high = sorted((arm.inward(1), arm.inward(arm.street.lanes)))
        SubElement(light, "validity", fromLane=str(low), toLane=str(high))
    for phase, numbers in sorted(groups.items()):
        number = str(junction.id + 900 + phase)
        SubElement(element, "controller", id=number, type="0", sequence=str(phase))
        controller = Element("controller", name=f"controller {number}", id=number, sequence=str(phase))
        for name in numbers:
            SubElement(controller, "control", signalId=name, type="0")
        root.insert(list(root).index(element), controller)


def _ruled(junction: _Junction) -> list[_Arm]:
    """Arms of a junction without lights that get a sign: all of a crossroads, the stem of a T-junction."""
    if len(junction.arms) < 3:
        return []
    facing = [any(math.cos(a.heading - b.heading) < -0.9 for b in junction.arms) for a in junction.arms]
    return [arm for arm, faced in zip(junction.arms, facing, strict=True) if all(facing) or not faced]


def _signs(
    roads: list[Element], junction: _Junction, ruled: list[_Arm], lengths: dict[int, float], *, stop: bool
) -> None:
    """A stop or yield sign for each of the arms, beside the line where it is waited."""
    name, kind = ("Sign_Stop", "206") if stop else ("Sign_Yield", "205")
    for k, arm in enumerate(ruled):
        aside = arm.street.lanes * arm.street.width + arm.street.shoulder + SIGN_ASIDE
        back = STOP_LINE if arm.street.sidewalk else 0.1
        post = SubElement(roads[arm.road - 1][-1], "signal", name=name, id=str(junction.id + 700 + k),
                          s=_f(lengths[arm.road] - back if arm.at_end else back), t=_f(-aside if arm.at_end else aside),
                          zOffset="0", hOffset="0", roll="0", pitch="0", orientation="+" if arm.at_end else "-",
                          dynamic="no", country="OpenDRIVE", type=kind, subtype="-1", value="-1", text="",
                          height="0.76", width="0.76")  # fmt: skip
        low, high = sorted((arm.inward(1), arm.inward(arm.street.lanes)))
        SubElement(post, "validity", fromLane=str(low), toLane=str(high))


def _edge(junction: _Junction, arm: _Arm, offset: float, *, inward: bool) -> Point:
    """Point at the end of an arm, `offset` m left of the street's middle as seen by traffic in or out."""
    x, y = _ahead(junction.place, arm.heading, junction.setback)
    return _ahead((x, y), arm.heading + (math.pi if inward else 0.0) + math.pi / 2.0, offset)


def _road(name: str, number: int, junction: int, pieces: list[_Piece]) -> Element:
    """A road without lanes; its first child is its link."""
    total = sum(piece.length for piece in pieces)
    road = Element("road", name=name, length=_f(total), id=str(number), junction=str(junction))
    SubElement(road, "link")
    plan = SubElement(road, "planView")
    s = 0.0
    for piece in pieces:
        item = SubElement(plan, "geometry", s=_f(s), x=_f(piece.x), y=_f(piece.y), hdg=_f(_wrap(piece.hdg)),
                          length=_f(piece.length))  # fmt: skip
        if piece.curvature:
            SubElement(item, "arc", curvature=_f(piece.curvature))
        else:
            SubElement(item, "line")
        s += piece.length
    SubElement(SubElement(road, "elevationProfile"), "elevation", s="0", a="0", b="0", c="0", d="0")
    SubElement(road, "lateralProfile")
    return road


def _section(road: Element) -> Element:
    lanes = SubElement(road, "lanes")
    SubElement(lanes, "laneOffset", s="0", a="0", b="0", c="0", d="0")
    return SubElement(lanes, "laneSection", s="0")


def _lane(group: Element, number: int, kind: str, width: float, slope: float, *, mark: tuple[str, str]) -> Element:
    """A lane whose width changes by `slope` a metre; its first child is its link."""
    lane = SubElement(group, "lane", id=str(number), type=kind, level="false")
    SubElement(lane, "link")
    SubElement(lane, "width", sOffset="0", a=_f(width), b=_f(slope), c="0", d="0")
    _mark(lane, *mark)
    return lane


def _mark(lane: Element, kind: str, color: str) -> None:
    change = "both" if kind == "broken" and color == "white" else "none"
    SubElement(lane, "roadMark", sOffset="0", type=kind, weight="standard", color=color, width="0.12",
               laneChange=change)  # fmt: skip


def _ahead(point: Point, heading: float, distance: float) -> Point:
    return point[0] + distance * math.cos(heading), point[1] + distance * math.sin(heading)


def _wrap(angle: float) -> float:
    return math.remainder(angle, 2.0 * math.pi)


def _f(value: float) -> str:
    """Nine decimals, so that the last bits of a machine's sine do not show; no minus zero."""
    text = f"{value:.9f}".rstrip("0").rstrip(".")
    return "0" if text in ("-0", "") else text
