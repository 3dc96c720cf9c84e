"""Structure and geometry of an OpenDRIVE file (versions 1.4 to 1.8): roads, lanes, links, junctions, signals.

The file is checked here and evaluated in `lane_sampling`. What is not carried over, and what is likely to be wrong,
goes into an `ImportReport`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Final, NoReturn

from ssad.core.errors import FormatError, MapError
from ssad.core.import_report import ImportReport
from ssad.core.lane_graph import Marking, SignKind
from ssad.core.safeio import MIB, parse_xml, read_xml
from ssad.core.types import LaneType
from ssad.world.roads.reference_line import CLOTHOID, CURVE, PlanPiece

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

MAX_BYTES = 64 * MIB
MAX_COORDINATE = 1.0e8  # m; projected coordinates reach 2e7
MAX_EXTENT = 1.0e6  # m from the middle of a map to its furthest road
MAX_LENGTH = 1.0e5  # m, of one road
MAX_TOTAL = 1.0e6  # m, of all roads: bounds the work of the reader
MAX_TURN = 200.0  # rad, of one piece of a reference line
MAX_COEFFICIENT = 1.0e30  # of a polynomial, which may be of a piece of a nanometre
FAR = 1.0e4  # m; beyond it, float32 coordinates are coarser than a millimetre, and the origin is shifted
PLANS = ("line", "arc", "spiral", "poly3", "paramPoly3")
TRAFFIC_LIGHTS = frozenset({"1000001", "1000009", "1000010", "1000011"})  # for vehicles, by shape of their lenses
# "" holds for OpenDRIVE's own catalogue and for the German one, from which it stems.
SIGNS: Final = {
    ("", "206"): SignKind.STOP,
    ("", "205"): SignKind.YIELD,
    ("us", "r1-1"): SignKind.STOP,
    ("us", "r1-2"): SignKind.YIELD,
    ("at", "52-24"): SignKind.STOP,
    ("at", "52-23"): SignKind.YIELD,
    ("gb", "601.1"): SignKind.STOP,
    ("gb", "602"): SignKind.YIELD,
    ("fr", "ab4"): SignKind.STOP,
    ("fr", "ab3a"): SignKind.YIELD,
    ("es", "r-2"): SignKind.STOP,
    ("es", "r-1"): SignKind.YIELD,
    ("se", "b2"): SignKind.STOP,
    ("se", "b1"): SignKind.YIELD,
    ("jp", "330-a"): SignKind.STOP,
}
# Usual limits outside towns, m/s, where a map states the type of a road and no limit (Germany: 130, 100 km/h).
TYPE_SPEEDS: Final = {"motorway": 130.0 / 3.6, "rural": 100.0 / 3.6, "lowSpeed": 30.0 / 3.6}
SPEED_SIGNS: Final = {("", "274"): 1.0 / 3.6, ("us", "r2-1"): 0.44704, ("at", "52-10a"): 1.0 / 3.6}  # default unit
STOP_LINES: Final = {("", "294"), ("at", "haltelinie")}
COUNTRIES: Final = {
    "opendrive": "",
    "de": "",
    "deu": "",
    "germany": "",
    "usa": "us",
    "united states": "us",
    "can": "us",
    "ca": "us",
    "aut": "at",
    "austria": "at",
    "uk": "gb",
    "gbr": "gb",
    "fra": "fr",
    "esp": "es",
    "swe": "se",
    "jpn": "jp",
}
GERMAN: Final = frozenset({"de", "deu", "germany"})
_PLAN = "road/planView/geometry"
STENCIL = "Stencil"  # names of paint on the road, to which CARLA's maps give the type of a sign, begin with it

_KINDS = {
    name: kind
    for kind, names in (
        (LaneType.DRIVING, "driving bidirectional entry exit onRamp offRamp connectingRamp slipLane"),
        (LaneType.DRIVING, "bus taxi HOV mwyEntry mwyExit"),
        (LaneType.SHOULDER, "shoulder border stop"),
        (LaneType.SIDEWALK, "sidewalk walking"),
        (LaneType.PARKING, "parking"),
        (LaneType.BIKING, "biking"),
        (LaneType.MEDIAN, "median restricted"),
        (LaneType.NONE, "none curb"),
    )
    for name in names.split()
}
_MARKS = {
    "none": Marking.NONE,
    "broken": Marking.BROKEN,
    "solid": Marking.SOLID,
    "solid solid": Marking.DOUBLE,
    "curb": Marking.CURB,
}
_SPEED = {"mph": 0.44704, "km/h": 1.0 / 3.6, "kmh": 1.0 / 3.6, "kph": 1.0 / 3.6, "m/s": 1.0, "": 1.0}

Cubic = tuple[float, float, float, float, float]  # start, a, b, c, d


@dataclass(frozen=True)
class Link:
    """Connection of a road's end.

    Attributes:
        kind: "road" or "junction".
        id: Of that road or junction.
        contact: End of that road, "start" or "end"; "" where the file does not say.
        s: Position on that road, m, of a connection between its ends (virtual junctions); None: at an end.
    """

    kind: str
    id: int
    contact: str
    s: float | None = None


@dataclass(frozen=True)
class Lane:
    """Lane of a section.

    Attributes:
        id: Its number in the file.
        kind: Use.
        mark: Marking on its edge away from the road's centre.
        speed: Limit, m/s.
        predecessors: Lanes that the file links to its start, in the direction of the road.
        successors: The same for its end.
        forward: Traffic runs along the road.
        widths: Widths by distance from the start of the section, m.
        borders: Lateral positions of its outer edge by that distance, m, where the file gives these.
    """

    id: int
    kind: LaneType
    mark: Marking
    speed: float | None
    predecessors: tuple[int, ...]
    successors: tuple[int, ...]
    forward: bool
    widths: tuple[Cubic, ...]
    borders: tuple[Cubic, ...]


@dataclass(frozen=True)
class Section:
    """Lanes of a road between s0 and s1 (m), by id.

    Attributes:
        s0: Start, m.
        s1: End, m.
        lanes: By id.
        centre_mark: Painted between lanes 1 and -1.
        speed: Limit of the road, m/s.
        base: Position from which widths are measured, m: `s0`, unless the section is part of one in the file.
    """

    s0: float
    s1: float
    lanes: dict[int, Lane]
    centre_mark: Marking
    speed: float | None
    base: float


@dataclass(frozen=True)
class SignalPlace:
    """Traffic light on a road, or a reference to one; it applies to the lanes from low to high (0, 0: all)."""

    signal: str
    low: int
    high: int


@dataclass(frozen=True)
class SignPlace:
    """Stop or yield sign on a road, or a reference to one.

    Attributes:
        sign: Id of the signal.
        way: Traffic it applies to: along the road (1), against it (-1) or both (0).
        low: Lowest id of the lanes it applies to; 0 with `high` 0: all lanes.
        high: Highest id of those lanes.
    """

    sign: str
    way: int
    low: int
    high: int


@dataclass(frozen=True)
class Placement:
    """Position of a signal or an object: s and t on a road, m, and its heading there, rad; or x, y, heading."""

    road: int
    s: float
    t: float
    heading: float
    inertial: bool = False


@dataclass(frozen=True)
class Outline:
    """Crosswalk: corners by u and v, m, around a placement, or by s and t on its road."""

    place: Placement
    corners: tuple[tuple[float, float], ...]
    on_road: bool


@dataclass(frozen=True)
class MapRoad:
    """Road with its geometry, sections, the connections of its ends, and its lights and signs."""

    id: int
    junction: int
    length: float
    sections: tuple[Section, ...]
    predecessor: Link | None
    successor: Link | None
    lights: tuple[SignalPlace, ...]
    signs: tuple[SignPlace, ...] = ()
    plan: tuple[PlanPiece, ...] = ()
    offsets: tuple[Cubic, ...] = ()
    elevations: tuple[Cubic, ...] = ()
    superelevations: tuple[Cubic, ...] = ()
    left_hand: bool = False
    crosswalks: tuple[Outline, ...] = ()
    stop_lines: tuple[Placement, ...] = ()


@dataclass(frozen=True)
class Connection:
    """Path through a junction: lanes of the incoming road -> lanes of the connecting (or directly linked) road."""

    incoming: int
    connecting: int
    contact: str
    lanes: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Network:
    """Content of an OpenDRIVE file.

    Attributes:
        roads: By id.
        junctions: Connections by id of the junction.
        lights: Ids of the traffic lights.
        phase: Id of a light -> position of its controller in the cycle.
        signs: Kind of each sign by id.
        signal_places: Position of each signal of any kind by id.
        origin: What is added to x and y to get the coordinates of the file's projection, m.
        shift: What was subtracted from the coordinates in the file, m.
        road_names: Number of each road by its id in the file.
        left_hand: Most roads have left-hand traffic.
        turn_on_red: Turns to the near side are allowed on red: unless traffic keeps to the left, or the signals carry
            the code of a country that forbids them.
    """

    roads: dict[int, MapRoad]
    junctions: dict[int, tuple[Connection, ...]]
    lights: tuple[str, ...]
    phase: dict[str, int]
    signs: dict[str, SignKind] = field(default_factory=dict)
    signal_places: dict[str, Placement] = field(default_factory=dict)
    origin: tuple[float, float] = (0.0, 0.0)
    shift: tuple[float, float] = (0.0, 0.0)
    road_names: dict[str, int] = field(default_factory=dict)
    left_hand: bool = False
    turn_on_red: bool = True


class _Reader:
    def __init__(self, path: Path, report: ImportReport) -> None:
        self.path = path
        self.report = report
        self.road_ids: dict[str, int] = {}
        self.junction_ids: dict[str, int] = {}
        self.left_hand = False
        self.origin = ((0.0, 0.0), (0.0, 0.0))  # subtracted from the file's coordinates; added by its header

    def fail(self, location: str, problem: str) -> NoReturn:
        raise MapError(f"{self.path}: {location}: {problem}; correct the map and import it again")

    def number(
        self,
        element: Element,
        name: str,
        location: str,
        default: float | None = None,
        *,
        limit: float = MAX_COORDINATE,
    ) -> float:
        text = element.get(name)
        if text is None:
            if default is not None:
                return default
            self.fail(location, f"<{element.tag}> has no attribute '{name}'")
        try:
            value = float(text)
        except ValueError:
            self.fail(location, f"<{element.tag} {name}='{text[:30]}'> is not a number")
        if not math.isfinite(value) or abs(value) > limit:
            self.fail(location, f"<{element.tag} {name}='{text[:30]}'> is not finite or beyond {limit:g}")
        return value

    def whole(self, element: Element, name: str, location: str) -> int:
        text = element.get(name, "")
        try:
            value = int(text)
        except ValueError:
            self.fail(location, f"<{element.tag} {name}='{text[:30]}'> is not a whole number")
        if abs(value) >= 2**31:
            self.fail(location, f"<{element.tag} {name}='{text[:30]}'> is too large")
        return value

    def network(self) -> Network:
        root = self.root()
        road_elements, junction_elements = root.findall("road"), root.findall("junction")
        self.road_ids = self.numbered([element.get("id", "") for element in road_elements], "road")
        names = [element.get("id", "") for element in junction_elements]
        names += [name for element in road_elements if (name := element.get("junction", "-1")) not in ("-1", "")]
        self.junction_ids = self.numbered(list(dict.fromkeys(names)), "junction")
        if len({element.get("id", "") for element in junction_elements}) < len(junction_elements):
            self.report.doubt("two junctions have one id; their connections are joined")
        self.common_rule(road_elements)
        self.origin = self.find_origin(root, road_elements)
        roads: dict[int, MapRoad] = {}
        total_length = 0.0
        for element in road_elements:
            road = self.road(element)
            roads[road.id] = road
            total_length += road.length
        if not roads:
            self.fail("<OpenDRIVE>", "no road in it")
        # Bounds the work of the reader, also for a damaged or crafted file.
        if total_length > MAX_TOTAL:
            self.fail("<OpenDRIVE>", f"{total_length:.0f} m of road, the limit is {MAX_TOTAL:.0f} m")
        lanes = [lane for road in roads.values() for section in road.sections for lane in section.lanes.values()]
        if not any(lane.kind == LaneType.DRIVING for lane in lanes):
            self.fail("<OpenDRIVE>", "no drivable lane in it")
        junctions: dict[int, tuple[Connection, ...]] = {}
        for element in junction_elements:
            number = self.junction_ids[element.get("id", "")]
            junctions[number] = (*junctions.get(number, ()), *self.connections(element, f"junction {number}"))
        roads = {key: self.with_known_links(road, junctions) for key, road in roads.items()}
        (shift_x, shift_y), (offset_x, offset_y) = self.origin
        signals = self.signals(root, road_elements)
        return replace(
            signals,
            roads=_split_at_contacts(roads),
            junctions=junctions,
            origin=(shift_x + offset_x, shift_y + offset_y),
            shift=(shift_x, shift_y),
            road_names=self.road_ids,
            left_hand=self.left_hand,
            turn_on_red=self.turn_on_red(road_elements),
        )

    def root(self) -> Element:
        try:
            root = read_xml(self.path, limit=MAX_BYTES)
        except FormatError as error:
            raise MapError(f"{error}; give a complete OpenDRIVE file (.xodr)") from None
        if _without_namespace(root).tag != "OpenDRIVE":
            self.fail(f"<{str(root.tag)[:40]}>", "the root element is not <OpenDRIVE>")
        header = root.find("header")
        version = "?" if header is None else f"{header.get('revMajor', '?')}.{header.get('revMinor', '?')}"
        self.report.contents.append(f"OpenDRIVE {version[:12]}")
        return root

    def numbered(self, names: list[str], word: str) -> dict[str, int]:
        """Return a whole number for each id: itself, or the next free one for ids that are text."""
        numbers: dict[str, int] = {}
        taken: set[int] = set()
        texts = []
        for name in names:
            if name in numbers:
                self.fail(f"{word} {name[:30]}", f"two {word}s have this id")
            number = int(name) if name.strip().isdecimal() and len(name) < 11 else 2**31
            if number >= 2**31 or number in taken:
                if not name:
                    self.fail(f"<{word}>", f"a {word} has no attribute 'id'")
                texts.append(name)
            numbers[name] = number
            taken.add(number)
        free = max((number for number in taken if number < 2**31), default=0) + 1
        for name in texts:
            numbers[name] = free
            self.report.note(f"ids of {word}s that are no whole numbers are numbered", f"'{name[:40]}' is {free}")
            free += 1
        return numbers

    def common_rule(self, roads: list[Element]) -> None:
        """Note which side of the road traffic keeps to."""
        rules = {road.get("rule", "RHT").upper() for road in roads}
        for rule in sorted(rules - {"LHT", "RHT"}):
            self.report.doubt(f"rule='{rule[:20]}' is neither RHT nor LHT; right-hand traffic is taken")
        left_count = sum(road.get("rule", "RHT").upper() == "LHT" for road in roads)
        if left_count not in (0, len(roads)):
            self.report.doubt(
                f"{left_count} of {len(roads)} roads have left-hand traffic, the others right-hand traffic"
            )
        self.left_hand = 2 * left_count > len(roads)
        self.report.contents.append(f"rule of the road: {'left' if self.left_hand else 'right'}-hand traffic")

    def turn_on_red(self, roads: list[Element]) -> bool:
        """Return whether turns to the near side on red are allowed."""
        codes = [
            signal.get("country", "").strip().lower()
            for road in roads
            for signal in road.findall("signals/signal")
            if signal.get("country", "").strip().lower() not in ("", "opendrive")
        ]
        country = max(sorted(set(codes)), key=codes.count, default="")
        is_allowed = not self.left_hand and COUNTRIES.get(country, country) in ("", "us") and country not in GERMAN
        self.report.contents.append(f"turns to the near side on red: {'' if is_allowed else 'not '}allowed")
        return is_allowed

    def find_origin(self, root: Element, roads: list[Element]) -> tuple[tuple[float, float], tuple[float, float]]:
        """Return what is subtracted from the file's coordinates, and what its header adds to them."""
        points = []
        for road in roads:
            location = f"road {road.get('id')}"
            for geometry in road.findall("planView/geometry"):
                points.append((self.number(geometry, "x", location), self.number(geometry, "y", location)))
        shift = _shift(points)
        if shift != (0.0, 0.0):
            self.report.contents.append(f"origin shifted to ({shift[0]:.0f}, {shift[1]:.0f})")
        extent = max((max(abs(x - shift[0]), abs(y - shift[1])) for x, y in points), default=0.0)
        if extent > MAX_EXTENT:
            self.fail("<OpenDRIVE>", f"its roads lie {extent:.0f} m from their middle, the limit is {MAX_EXTENT:.0f} m")
        offset = (0.0, 0.0)
        element = root.find("header/offset")
        if element is not None:
            offset = (self.number(element, "x", "header", 0.0), self.number(element, "y", "header", 0.0))
            turn = self.number(element, "hdg", "header", 0.0)
            self.report.contents.append(f"the header adds ({offset[0]:.2f}, {offset[1]:.2f}) to reach its projection")
            if turn:
                self.report.omit(f"the header's rotation to its projection by {math.degrees(turn):.2f} degrees")
        return shift, offset

    def road(self, element: Element) -> MapRoad:
        number = self.road_ids[element.get("id", "")]
        location = f"road {element.get('id')}"
        length = self.number(element, "length", location)
        if not 0.0 < length <= MAX_LENGTH:
            self.fail(location, f"length {length:g} m is not in (0, {MAX_LENGTH:g}]")
        plan = self.plan(element, location)
        end = plan[-1].s + plan[-1].length
        if abs(end - length) > 0.01:
            self.report.doubt(
                "the geometry of a road is not as long as the road", f"{location}: {end:.2f}, {length:.2f} m"
            )
        rule = element.get("rule", "RHT").upper()
        junction = element.get("junction", "-1")
        offsets = self.cubics(element.findall("lanes/laneOffset"), "s", location)
        if offsets and offsets[0][0] > 0.0:
            offsets = ((0.0, 0.0, 0.0, 0.0, 0.0), *offsets)
        for name in ("lateralProfile/shape", "lateralProfile/crossSectionSurface", "railroad", "surface/CRG"):
            if element.find(name) is not None:
                self.report.omit(f"<{name.rpartition('/')[2]}> of roads", location)
        return MapRoad(
            id=number,
            junction=-1 if junction in ("-1", "") else self.junction_ids[junction],
            length=length,
            sections=self.sections(element, location, length, left_hand=rule == "LHT"),
            predecessor=self.link(element, "predecessor", location),
            successor=self.link(element, "successor", location),
            lights=tuple(_places(element)),
            signs=tuple(_sign_places(element)),
            plan=plan,
            offsets=offsets,
            elevations=self.cubics(element.findall("elevationProfile/elevation"), "s", location),
            superelevations=self.cubics(element.findall("lateralProfile/superelevation"), "s", location),
            left_hand=rule == "LHT",
            crosswalks=tuple(self.crosswalks(element, number, location)),
            stop_lines=tuple(self.stop_lines(element, number, location)),
        )

    def plan(self, road: Element, location: str) -> tuple[PlanPiece, ...]:
        geometries = road.findall("planView/geometry")
        if not geometries:
            self.fail(location, "<planView> has no <geometry>")
        pieces = [self.piece(geometry, location) for geometry in geometries]
        if any(after.s < before.s for before, after in pairwise(pieces)):
            self.report.doubt("the <geometry> elements of a road are not in order; they are sorted", location)
            pieces.sort(key=lambda piece: piece.s)
        if abs(pieces[0].s) > 1e-3:
            self.fail(location, f"its <geometry> elements do not begin at s=0 (the first has s={pieces[0].s:g})")
        return tuple(pieces)

    def piece(self, geometry: Element, location: str) -> PlanPiece:
        s, x, y, heading, length = (self.number(geometry, name, location) for name in ("s", "x", "y", "hdg", "length"))
        if length < 0.0:
            self.fail(location, "<geometry> has a negative length")
        shapes = [child for child in geometry if child.tag in PLANS]
        if len(shapes) != 1:
            names = ", ".join(str(child.tag)[:30] for child in geometry) or "nothing"
            self.fail(location, f"<geometry> holds {names}; known are {', '.join(PLANS)}")
        shape, kind = shapes[0], CLOTHOID
        values: tuple[float, ...] = (0.0, 0.0)
        if shape.tag == "arc":
            values = (self.number(shape, "curvature", location),) * 2
        elif shape.tag == "spiral":
            values = (self.number(shape, "curvStart", location), self.number(shape, "curvEnd", location))
        elif shape.tag == "poly3":
            kind = CURVE
            values = (
                0.0,
                1.0,
                0.0,
                0.0,
                *(self.number(shape, name, location, limit=MAX_COEFFICIENT) for name in "abcd"),
                0.0,
            )
        elif shape.tag == "paramPoly3":
            kind = CURVE
            range_name = shape.get("pRange", "normalized").strip().lower()
            if range_name not in ("arclength", "normalized"):
                self.report.doubt("pRange is neither arcLength nor normalized; normalized is taken", location)
            coefficients = [f"{letter}{axis}" for axis in "UV" for letter in "abcd"]
            end = length if range_name == "arclength" else 1.0
            numbers = [self.number(shape, name, location, limit=MAX_COEFFICIENT) for name in coefficients]
            values = (*numbers, max(end, 1e-9))
        if kind == CLOTHOID and max(map(abs, values)) * length > MAX_TURN:
            self.fail(location, f"a <geometry> turns by more than {MAX_TURN:g} rad")
        return PlanPiece(s, x - self.shift[0], y - self.shift[1], heading, length, kind, values, shape.tag)

    def cubics(self, elements: Iterable[Element], start: str, location: str) -> tuple[Cubic, ...]:
        """Return polynomials in order of their starts."""
        rows: list[Cubic] = []
        for element in elements:
            position = self.number(element, start, location)
            a, b, c, d = (self.number(element, name, location, limit=MAX_COEFFICIENT) for name in "abcd")
            rows.append((position, a, b, c, d))
        if rows != sorted(rows, key=lambda row: row[0]):
            self.report.doubt("polynomials of a road are not in order; they are sorted", location)
            rows.sort(key=lambda row: row[0])
        return tuple(rows)

    def link(self, road: Element, name: str, location: str) -> Link | None:
        element = road.find(f"link/{name}")
        if element is None:
            return None
        kind, target = element.get("elementType", ""), element.get("elementId", "")
        if not kind:
            kind = "road" if element.get("contactPoint") else "junction"
        if kind not in ("road", "junction"):
            self.fail(location, f"<{name} elementType='{kind[:30]}'> is neither road nor junction")
        number = (self.road_ids if kind == "road" else self.junction_ids).get(target)
        if number is None:
            self.report.doubt(
                f"a road is linked to a {kind} that the map lacks; it ends there", f"{location} to {target[:30]}"
            )
            return None
        s = self.number(element, "elementS", location) if element.get("elementS") else None
        return Link(kind, number, element.get("contactPoint", ""), s)

    def with_known_links(self, road: MapRoad, junctions: dict[int, tuple[Connection, ...]]) -> MapRoad:
        """Return a road without links to junctions that only roads mention."""
        links: list[Link | None] = []
        for link in (road.predecessor, road.successor):
            is_missing = link is not None and link.kind == "junction" and link.id not in junctions
            if is_missing:
                self.report.doubt("a road is linked to a junction that the map lacks; it ends there", f"road {road.id}")
            links.append(None if is_missing else link)
        if road.junction >= 0 and road.junction not in junctions:
            self.report.doubt("a road belongs to a junction that the map lacks", f"road {road.id}")
        return replace(road, predecessor=links[0], successor=links[1])

    def connections(self, junction: Element, location: str) -> Iterator[Connection]:
        for element in junction.findall("connection"):
            ids = []
            for names in (("incomingRoad",), ("connectingRoad", "linkedRoad")):
                name = next((element.get(name, "") for name in names if element.get(name)), "")
                ids.append(self.road_ids.get(name))
                if ids[-1] is None and not (element.get("type") == "virtual" and not name):
                    self.report.doubt(
                        "a junction connects a road that the map lacks", f"{location}, road {name[:30] or '(none)'}"
                    )
            if ids[0] is None or ids[1] is None:
                continue
            lane_pairs = tuple(
                (self.whole(link, "from", location), self.whole(link, "to", location))
                for link in element.findall("laneLink")
            )
            yield Connection(ids[0], ids[1], element.get("contactPoint", ""), lane_pairs)

    def sections(self, road: Element, location: str, length: float, *, left_hand: bool) -> tuple[Section, ...]:
        elements = road.findall("lanes/laneSection")
        if not elements:
            self.fail(location, "it has no <laneSection>")
        starts = [self.number(element, "s", location) for element in elements]
        if starts != sorted(starts) or starts[0] < 0.0:
            self.fail(location, "its lane sections are not in order")
        if starts[0] > 0.01:
            self.report.doubt("a road begins without lanes", f"{location}: {starts[0]:.2f} m")
        limits = self.speed_limits(road, location)
        result = []
        for index, element in enumerate(elements):
            section_end = starts[index + 1] if index + 1 < len(starts) else max(length, starts[index])
            middle = 0.5 * (section_end - starts[index])
            lanes: dict[int, Lane] = {}
            centre_mark = Marking.NONE
            for side_name in ("left", "center", "right"):
                for lane in element.findall(f"{side_name}/lane"):
                    lane_id = self.whole(lane, "id", location)
                    marking = self.mark(lane, middle, location)
                    if lane_id == 0:
                        centre_mark = marking
                        continue
                    if lane_id in lanes:
                        self.fail(location, f"lane {lane_id} is there twice")
                    if (lane_id > 0) != (side_name == "left"):
                        self.report.doubt(
                            f"a lane is listed under <{side_name}>; its id says that it is on the other side",
                            f"{location}, lane {lane_id}",
                        )
                    lanes[lane_id] = self.lane(lane, lane_id, marking, location, left_hand=left_hand)
            valid_limits = [value for position, value in limits if position <= starts[index] + middle]
            result.append(
                Section(
                    starts[index],
                    section_end,
                    lanes,
                    centre_mark,
                    valid_limits[-1] if valid_limits else None,
                    starts[index],
                )
            )
        return tuple(result)

    def speed_limits(self, road: Element, location: str) -> list[tuple[float, float | None]]:
        """Return positions and limits of a road, m/s: of its types, of its signs if no type has one, or as usual."""
        limits = []
        for road_type in road.findall("type"):
            speed = road_type.find("speed")
            if speed is not None:
                limits.append((self.number(road_type, "s", location), self.speed(speed, location)))
        if limits:
            return limits
        for signal in road.findall("signals/signal"):
            unit = SPEED_SIGNS.get(_sign_code(signal))
            text = signal.get("value", "")
            if unit is None or not text:
                continue
            value = self.number(signal, "value", location)
            unit = _SPEED.get(signal.get("unit", ""), unit) if signal.get("unit") else unit
            if value > 0.0:
                limits.append(
                    (0.0 if signal.get("orientation") == "-" else self.number(signal, "s", location), value * unit)
                )
        if limits:
            return sorted(limits, key=lambda limit: limit[0])
        types = [
            (self.number(road_type, "s", location), road_type.get("type", "")) for road_type in road.findall("type")
        ]
        return (
            [(s, TYPE_SPEEDS.get(kind)) for s, kind in types] if any(kind in TYPE_SPEEDS for _, kind in types) else []
        )

    def lane(self, element: Element, number: int, mark: Marking, location: str, *, left_hand: bool) -> Lane:
        place = f"{location}, lane {number}"
        links = [
            tuple(self.whole(link, "id", location) for link in element.findall(f"link/{name}"))
            for name in ("predecessor", "successor")
        ]
        kind_name = element.get("type", "none")
        if kind_name not in _KINDS:
            self.report.omit(f"lanes of type '{kind_name[:30]}' are no road for traffic", place)
        kind = _KINDS.get(kind_name, LaneType.NONE)
        direction = element.get("direction", "standard")
        if direction not in ("standard", "reversed", "both"):
            self.report.doubt("a lane's direction is none of standard, reversed, both; standard is taken", place)
        if direction == "both" or kind_name == "bidirectional":
            self.report.omit("traffic in the second direction of lanes that have two", place)
        widths = self.cubics(element.findall("width"), "sOffset", location)
        borders = () if widths else self.cubics(element.findall("border"), "sOffset", location)
        if not widths and not borders:
            self.report.doubt("a lane has no width", place)
        speed = element.find("speed")
        return Lane(
            id=number,
            kind=kind,
            mark=mark,
            speed=None if speed is None else self.speed(speed, location),
            predecessors=links[0],
            successors=links[1],
            forward=(number < 0) ^ left_hand ^ (direction == "reversed"),
            widths=widths,
            borders=borders,
        )

    def speed(self, element: Element, location: str) -> float | None:
        text = element.get("max", "")
        if text in ("no limit", "undefined", ""):
            return None
        unit = element.get("unit", "")
        if unit not in _SPEED:
            self.fail(location, f"<speed unit='{unit[:30]}'> is not one of mph, km/h, m/s")
        value = self.number(element, "max", location) * _SPEED[unit]
        return value if value > 0.0 else None

    def mark(self, lane: Element, distance: float, location: str) -> Marking:
        kind = "none"
        for element in lane.findall("roadMark"):
            if self.number(element, "sOffset", location, 0.0) <= distance or kind == "none":
                kind = element.get("type", "none")
        return _MARKS.get(kind, Marking.OTHER)

    # ------------------------------------------------------------ signals and objects

    def signals(self, root: Element, roads: list[Element]) -> Network:
        """Return a network that holds the signals alone."""
        lights: dict[str, None] = {}
        signs: dict[str, SignKind] = {}
        places: dict[str, Placement] = {}
        for road in roads:
            location = f"road {road.get('id')}"
            for signal in road.findall("signals/signal"):
                name = signal.get("id", "")
                places.setdefault(name, self.placement(signal, self.road_ids[road.get("id", "")], location))
                code = _sign_code(signal)
                if _light(signal):
                    lights[name] = None
                elif _sign(signal):
                    signs[name] = SIGNS[code]
                elif code not in SPEED_SIGNS and code not in STOP_LINES:
                    country = f" of country '{signal.get('country', '')[:20]}'" if code[0] else ""
                    self.report.omit(f"signals of type '{signal.get('type', '')[:20]}'{country}", location)
        for road in roads:
            for reference in road.findall("signals/signalReference"):
                if reference.get("id", "") not in places:
                    self.report.doubt(
                        "a road refers to a signal that the map lacks",
                        f"road {road.get('id')}, signal {reference.get('id', '')[:30]}",
                    )
        phase: dict[str, int] = {}
        for element in root.findall("controller"):
            for control in element.findall("control"):
                sequence = element.get("sequence", "0")
                phase.setdefault(control.get("signalId", ""), int(sequence) if sequence.isdecimal() else 0)
        return Network({}, {}, tuple(lights), phase, signs, places)

    def placement(self, element: Element, road: int, location: str) -> Placement:
        """Return the place of a signal or an object."""
        turn = self.number(element, "hOffset" if element.tag == "signal" else "hdg", location, 0.0)
        inertial = element.find("positionInertial")
        if inertial is not None:
            x, y = (self.number(inertial, name, location) for name in "xy")
            heading = self.number(inertial, "hdg", location, 0.0)
            return Placement(road, x - self.shift[0], y - self.shift[1], heading, inertial=True)
        element_on_road = element.find("positionRoad")
        if element_on_road is not None and element_on_road.get("roadId", "") in self.road_ids:
            element, road = element_on_road, self.road_ids[element_on_road.get("roadId", "")]
            turn = self.number(element, "hOffset", location, 0.0)
        turn += math.pi if element.get("orientation") == "-" and element.tag != "object" else 0.0
        return Placement(road, self.number(element, "s", location), self.number(element, "t", location, 0.0), turn)

    def crosswalks(self, road: Element, number: int, location: str) -> Iterator[Outline]:
        for element in road.findall("objects/object"):
            kind = element.get("type", "").lower()
            if kind != "crosswalk":
                if not _is_stop_line(element):
                    self.report.omit(f"objects of type '{kind[:30]}'", location)
                continue
            outline = next(
                (outline for path in ("outline", "outlines/outline") for outline in element.findall(path)), None
            )
            place = self.placement(element, number, location)
            corners: list[tuple[float, float]] = []
            on_road = False
            if outline is not None:
                corners = [
                    (self.number(corner, "u", location), self.number(corner, "v", location))
                    for corner in outline.findall("cornerLocal")
                ]
                if not corners:
                    on_road = True
                    corners = [
                        (self.number(corner, "s", location), self.number(corner, "t", location))
                        for corner in outline.findall("cornerRoad")
                    ]
            elif element.get("length") and element.get("width"):
                half_length, half_width = (0.5 * self.number(element, name, location) for name in ("length", "width"))
                corners = [
                    (sign_u * half_length, sign_v * half_width)
                    for sign_u, sign_v in ((1, 1), (1, -1), (-1, -1), (-1, 1))
                ]
            if len(corners) > 1 and math.dist(corners[0], corners[-1]) < 1e-3:
                corners.pop()
            if len(corners) < 3:
                self.report.doubt("a crosswalk has no outline of at least three corners", location)
                continue
            yield Outline(place, tuple(corners), on_road)

    def stop_lines(self, road: Element, number: int, location: str) -> Iterator[Placement]:
        for element in (*road.findall("signals/signal"), *road.findall("objects/object")):
            if _is_stop_line(element):
                yield self.placement(element, number, location)

    @property
    def shift(self) -> tuple[float, float]:
        return self.origin[0]


def read_network(path: Path, report: ImportReport | None = None) -> Network:
    """Check an OpenDRIVE file and return its content.

    Args:
        path: The file.
        report: Filled with what the file holds and the network does not, and with doubts.

    Raises:
        MapError: The file is invalid; the message names file and element.
    """
    return _Reader(path, ImportReport(str(path)) if report is None else report).network()


def local_coordinates(xodr: bytes) -> bytes:
    """Return an OpenDRIVE text with the coordinates of the town that is made from it.

    It is the same text, unless the origin is shifted; its header then has the shift as its offset.
    """
    from xml.etree import ElementTree

    root = _without_namespace(parse_xml(xodr))
    shift = _shift([(float(place.get("x", "0")), float(place.get("y", "0"))) for place in root.findall(_PLAN)])
    if shift == (0.0, 0.0):
        return xodr
    for path in (_PLAN, ".//positionInertial"):
        for place in root.findall(path):
            for name, value in zip("xy", shift, strict=True):
                place.set(name, repr(float(place.get(name, "0")) - value))
    header = root.find("header")
    if header is None:
        header = ElementTree.Element("header")
        root.insert(0, header)
    offset = header.find("offset")
    if offset is None:
        offset = ElementTree.SubElement(header, "offset", x="0", y="0", z="0", hdg="0")
    for name, value in zip("xy", shift, strict=True):
        offset.set(name, repr(float(offset.get(name, "0")) + value))
    text: bytes = ElementTree.tostring(root, encoding="utf-8", xml_declaration=True)
    return text


def _without_namespace(root: Element) -> Element:
    """Return a tree with the namespaces of its root and of its roads and junctions removed from its tags."""
    tags = [element.tag for element in (root, *root) if isinstance(element.tag, str)]
    names = ("OpenDRIVE", "header", "road", "junction", "controller")
    prefixes = {tag.removesuffix(name) for tag in tags for name in names if tag.endswith(f"}}{name}")}
    if prefixes:
        for element in root.iter():
            if isinstance(element.tag, str):
                namespace, brace, name = element.tag.rpartition("}")
                element.tag = name if namespace + brace in prefixes else element.tag
    return root


def _shift(points: list[tuple[float, float]]) -> tuple[float, float]:
    """Return what is subtracted from coordinates: the middle of the points in whole metres if they are far away."""
    if not points:
        return 0.0, 0.0
    low, high = ([pick(axis) for axis in zip(*points, strict=True)] for pick in (min, max))
    if max(map(abs, (*low, *high))) <= FAR:
        return 0.0, 0.0
    return float(round(0.5 * (low[0] + high[0]))), float(round(0.5 * (low[1] + high[1])))


def _split_at_contacts(roads: dict[int, MapRoad]) -> dict[int, MapRoad]:
    """Split the lane sections of roads to which others are linked between their ends."""
    contacts: dict[int, set[float]] = {}
    for road in roads.values():
        for link in (road.predecessor, road.successor):
            if link and link.s is not None and link.kind == "road":
                contacts.setdefault(link.id, set()).add(link.s)
    for road_id, positions in contacts.items():
        sections = list(roads[road_id].sections)
        for position in sorted(positions):
            index = next(
                (i for i, section in enumerate(sections) if section.s0 + 0.1 < position < section.s1 - 0.1), None
            )
            if index is None:
                continue
            section = sections[index]
            first = {key: replace(lane, successors=(key,)) for key, lane in section.lanes.items()}
            second = {key: replace(lane, predecessors=(key,)) for key, lane in section.lanes.items()}
            sections[index : index + 1] = [
                replace(section, s1=position, lanes=first),
                replace(section, s0=position, lanes=second),
            ]
        roads[road_id] = replace(roads[road_id], sections=tuple(sections))
    return roads


def _sign_code(signal: Element) -> tuple[str, str]:
    """Return country and type of a signal, as in `SIGNS`."""
    country = signal.get("country", "").strip().lower()
    return COUNTRIES.get(country, country), signal.get("type", "").strip().lower()


def _light(signal: Element) -> bool:
    return signal.get("type", "").replace(".", "") in TRAFFIC_LIGHTS and signal.get("dynamic") == "yes"


def _sign(signal: Element) -> bool:
    return _sign_code(signal) in SIGNS and not signal.get("name", "").startswith(STENCIL)


def _is_stop_line(element: Element) -> bool:
    """Return whether a signal or an object is a line to stop at."""
    if element.tag == "signal":
        return _sign_code(element) in STOP_LINES
    name = element.get("name", "").lower().replace(" ", "").replace("_", "")
    return name.startswith("stopline") or (
        element.get("type", "").lower() == "roadmark" and element.get("subtype", "").lower() == "signallines"
    )


def _sign_places(road: Element) -> list[SignPlace]:
    """Return the signs on a road, and references, which may be to signals of any kind."""
    places = []
    for element in [*road.findall("signals/signal"), *road.findall("signals/signalReference")]:
        if element.tag == "signal" and not _sign(element):
            continue
        direction = {"+": 1, "-": -1}.get(element.get("orientation", "none"), 0)
        places += [
            SignPlace(element.get("id", ""), direction, low_lane, high_lane) for low_lane, high_lane in _spans(element)
        ]
    return places


def _spans(signal: Element) -> list[tuple[int, int]]:
    """Return the lowest and highest lane of each range that a signal applies to; 0, 0 for all."""
    spans = []
    for validity in signal.findall("validity"):
        try:
            spans.append((int(validity.get("fromLane", "0")), int(validity.get("toLane", "0"))))
        except ValueError:
            continue
    return [(min(span), max(span)) for span in spans] or [(0, 0)]


def _places(road: Element) -> list[SignalPlace]:
    places = []
    for element in [*road.findall("signals/signal"), *road.findall("signals/signalReference")]:
        if element.tag == "signal" and not _light(element):
            continue
        places += [SignalPlace(element.get("id", ""), low_lane, high_lane) for low_lane, high_lane in _spans(element)]
    return places
