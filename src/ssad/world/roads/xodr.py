"""OpenDRIVE text, checked before any C++ sees it, and its structure: sections, lanes, links, signals.

Geometry is not evaluated here; that is `carla.Map`'s work (see `bake`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, NoReturn

from ssad.core.errors import FormatError, MapError
from ssad.core.lane_graph import Marking, SignKind
from ssad.core.safeio import MIB, read_xml
from ssad.core.types import LaneType

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

MAX_BYTES = 64 * MIB
MAX_COORDINATE = 1.0e6  # m
MAX_LENGTH = 1.0e5  # m, of one road
MAX_TOTAL = 1.0e6  # m, of all roads: bounds the work of the reader
MAX_CURVATURE = 10.0  # 1/m
PLANS = ("line", "arc", "spiral", "poly3", "paramPoly3")
TRAFFIC_LIGHT = "1000001"
SIGNS = {"206": SignKind.STOP, "205": SignKind.YIELD}  # types of signals that stand still
STENCIL = "Stencil"  # names of paint on the road, to which CARLA's maps give the type of a sign, begin with it

_KINDS = {
    name: kind
    for kind, names in (
        (LaneType.DRIVING, "driving bidirectional entry exit onRamp offRamp connectingRamp"),
        (LaneType.SHOULDER, "shoulder border stop"),
        (LaneType.SIDEWALK, "sidewalk walking"),
        (LaneType.PARKING, "parking"),
        (LaneType.BIKING, "biking"),
        (LaneType.MEDIAN, "median restricted"),
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
_SPEED = {"mph": 0.44704, "km/h": 1.0 / 3.6, "kmh": 1.0 / 3.6, "m/s": 1.0, "": 1.0}
# attributes that must be numbers wherever they stand in a road
_NUMBERS = frozenset(
    {
        "s",
        "t",
        "x",
        "y",
        "z",
        "a",
        "b",
        "c",
        "d",
        "hdg",
        "length",
        "curvature",
        "curvStart",
        "curvEnd",
        "sOffset",
        "tOffset",
        "zOffset",
        "hOffset",
        "width",
        "height",
        "u",
        "v",
        "aU",
        "bU",
        "cU",
        "dU",
        "aV",
        "bV",
        "cV",
        "dV",
        "pRange",
        "pitch",
        "roll",
    }
)


@dataclass(frozen=True)
class Link:
    """Where an end of a road leads: kind "road" or "junction", its id, and the end of that road."""

    kind: str
    id: int
    contact: str


@dataclass(frozen=True)
class Lane:
    """A lane of a section; `mark` is the paint on its edge away from the road's centre."""

    id: int
    kind: LaneType
    mark: Marking
    speed: float | None
    predecessor: int | None
    successor: int | None


@dataclass(frozen=True)
class Section:
    """Lanes of a road between s0 and s1 (m), by id; `centre_mark` is painted between lanes 1 and -1."""

    s0: float
    s1: float
    lanes: dict[int, Lane]
    centre_mark: Marking
    speed: float | None


@dataclass(frozen=True)
class SignalPlace:
    """A traffic light, or a reference to one, on a road; it faces the lanes from low to high (0, 0: all)."""

    signal: str
    low: int
    high: int


@dataclass(frozen=True)
class SignPlace:
    """A stop or yield sign on a road, or a reference to one.

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
class Road:
    """A road: its sections, where its ends lead, and the lights and signs on it."""

    id: int
    junction: int
    length: float
    sections: tuple[Section, ...]
    predecessor: Link | None
    successor: Link | None
    lights: tuple[SignalPlace, ...]
    signs: tuple[SignPlace, ...] = ()


@dataclass(frozen=True)
class Connection:
    """One way through a junction: lanes of the incoming road -> lanes of the connecting road."""

    incoming: int
    connecting: int
    contact: str
    lanes: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Network:
    """What an OpenDRIVE file says besides geometry.

    Attributes:
        roads: By id.
        junctions: Connections by id of the junction.
        lights: Ids of the traffic lights.
        phase: Id of a light -> place of its controller in the cycle.
        signs: Id of a sign -> what it says.
    """

    roads: dict[int, Road]
    junctions: dict[int, tuple[Connection, ...]]
    lights: tuple[str, ...]
    phase: dict[str, int]
    signs: dict[str, SignKind] = field(default_factory=dict)


class _Reader:
    def __init__(self, path: Path) -> None:
        self.path = path

    def fail(self, where: str, what: str) -> NoReturn:
        raise MapError(f"{self.path}: {where}: {what}; correct the map and import it again")

    def number(self, element: Element, name: str, where: str, default: float | None = None) -> float:
        text = element.get(name)
        if text is None:
            if default is not None:
                return default
            self.fail(where, f"<{element.tag}> has no attribute '{name}'")
        try:
            value = float(text)
        except ValueError:
            self.fail(where, f"<{element.tag} {name}='{text[:30]}'> is not a number")
        if not math.isfinite(value) or abs(value) > MAX_COORDINATE:
            self.fail(where, f"<{element.tag} {name}='{text[:30]}'> is not finite or beyond {MAX_COORDINATE:g}")
        return value

    def whole(self, element: Element, name: str, where: str) -> int:
        text = element.get(name, "")
        try:
            value = int(text)
        except ValueError:
            self.fail(where, f"<{element.tag} {name}='{text[:30]}'> is not a whole number")
        if abs(value) >= 2**31:
            self.fail(where, f"<{element.tag} {name}='{text[:30]}'> is too large")
        return value

    def network(self) -> Network:
        path = self.path
        try:
            root = read_xml(path, limit=MAX_BYTES)
        except FormatError as error:
            raise MapError(f"{error}; give a complete OpenDRIVE file (.xodr)") from None
        if root.tag != "OpenDRIVE":
            self.fail(f"<{str(root.tag)[:40]}>", "the root element is not <OpenDRIVE>")
        roads: dict[int, Road] = {}
        total = 0.0
        for element in root.findall("road"):
            road = self.road(element)
            if road.id in roads:
                self.fail(f"road {road.id}", "two roads have this id")
            roads[road.id] = road
            total += road.length
        if not roads:
            self.fail("<OpenDRIVE>", "no road in it")
        if total > MAX_TOTAL:
            self.fail("<OpenDRIVE>", f"{total:.0f} m of road, the limit is {MAX_TOTAL:.0f} m")
        lanes = [lane for road in roads.values() for part in road.sections for lane in part.lanes.values()]
        if not any(lane.kind == LaneType.DRIVING for lane in lanes):
            self.fail("<OpenDRIVE>", "no drivable lane in it")
        junctions = {}
        for element in root.findall("junction"):
            where = f"junction {element.get('id')}"
            junctions[self.whole(element, "id", where)] = self.connections(element, where, roads)
        posts = {s.get("id") for r in root.findall("road") for s in r.findall("signals/signal")}
        for element in root.findall("road"):
            for other in element.findall("signals/signalReference"):
                if other.get("id") not in posts:
                    self.fail(f"road {element.get('id')}", f"it refers to signal {other.get('id')}, which is nowhere")
        for road in roads.values():
            self.linked(road, roads, junctions)
        lamps = [s for r in root.findall("road") for s in r.findall("signals/signal") if _light(s)]
        lights = [post.get("id", "") for post in lamps]
        phase: dict[str, int] = {}
        for element in root.findall("controller"):
            for control in element.findall("control"):
                sequence = element.get("sequence", "0")
                phase.setdefault(control.get("signalId", ""), int(sequence) if sequence.isdigit() else 0)
        signs = {
            s.get("id", ""): SIGNS[s.get("type", "")]
            for r in root.findall("road")
            for s in r.findall("signals/signal")
            if _sign(s)
        }
        return Network(roads, junctions, tuple(dict.fromkeys(lights)), phase, signs)

    def road(self, element: Element) -> Road:
        where = f"road {element.get('id')}"
        for part in element.iter():
            for name in _NUMBERS.intersection(part.keys()):
                if part.tag not in ("object", "userData") or name in ("s", "t"):
                    self.number(part, name, where)
        length = self.number(element, "length", where)
        if not 0.0 < length <= MAX_LENGTH:
            self.fail(where, f"length {length:g} m is not in (0, {MAX_LENGTH:g}]")
        plans = element.findall("planView/geometry")
        if not plans:
            self.fail(where, "<planView> has no <geometry>")
        starts = [self.number(plan, "s", where) for plan in plans]
        if abs(starts[0]) > 1e-3 or starts != sorted(starts):
            self.fail(where, f"its <geometry> elements are not in order from s=0 (the first has s={starts[0]:g})")
        for plan in plans:
            for name in ("s", "x", "y", "hdg", "length"):
                self.number(plan, name, where)
            if float(plan.get("length", "0")) < 0.0:
                self.fail(where, "<geometry> has a negative length")
            shape = [child for child in plan if child.tag != "userData"]
            if len(shape) != 1 or shape[0].tag not in PLANS:
                found = ", ".join(str(child.tag)[:30] for child in shape) or "nothing"
                self.fail(where, f"<geometry> holds {found}; known are {', '.join(PLANS)}")
            for name in ("curvature", "curvStart", "curvEnd"):
                if abs(self.number(shape[0], name, where, 0.0)) > MAX_CURVATURE:
                    self.fail(where, f"{name} is beyond {MAX_CURVATURE:g} 1/m")
        return Road(
            id=self.whole(element, "id", where),
            junction=self.whole(element, "junction", where) if element.get("junction") else -1,
            length=length,
            sections=self.sections(element, where, length),
            predecessor=self.link(element, "predecessor", where),
            successor=self.link(element, "successor", where),
            lights=tuple(_places(element)),
            signs=tuple(_sign_places(element)),
        )

    def link(self, road: Element, name: str, where: str) -> Link | None:
        element = road.find(f"link/{name}")
        if element is None:
            return None
        kind = element.get("elementType", "")
        if kind not in ("road", "junction"):
            self.fail(where, f"<{name} elementType='{kind[:30]}'> is neither road nor junction")
        return Link(kind, self.whole(element, "elementId", where), element.get("contactPoint", "start"))

    def linked(self, road: Road, roads: dict[int, Road], junctions: dict[int, tuple[Connection, ...]]) -> None:
        """Refuse links to what is not there."""
        for link in (road.predecessor, road.successor):
            if link and link.id not in (roads if link.kind == "road" else junctions):
                self.fail(f"road {road.id}", f"it is linked to {link.kind} {link.id}, which the map lacks")

    def connections(self, junction: Element, where: str, roads: dict[int, Road]) -> tuple[Connection, ...]:
        found = []
        for element in junction.findall("connection"):
            pairs = tuple(
                (self.whole(link, "from", where), self.whole(link, "to", where)) for link in element.findall("laneLink")
            )
            incoming = self.whole(element, "incomingRoad", where)
            connecting = self.whole(element, "connectingRoad", where)
            for road in (incoming, connecting):
                if road not in roads:
                    self.fail(where, f"it connects road {road}, which is not in the map")
            found.append(Connection(incoming, connecting, element.get("contactPoint", "start"), pairs))
        return tuple(found)

    def sections(self, road: Element, where: str, length: float) -> tuple[Section, ...]:
        elements = road.findall("lanes/laneSection")
        if not elements:
            self.fail(where, "it has no <laneSection>")
        starts = [self.number(element, "s", where) for element in elements]
        if starts != sorted(starts) or starts[0] < 0.0:
            self.fail(where, "its lane sections are not in order")
        limits = []
        for kind in road.findall("type"):
            speed = kind.find("speed")
            if speed is not None:
                limits.append((self.number(kind, "s", where), self.speed(speed, where)))
        result = []
        for i, element in enumerate(elements):
            end = starts[i + 1] if i + 1 < len(starts) else length
            middle = 0.5 * (end - starts[i])
            lanes: dict[int, Lane] = {}
            centre = Marking.NONE
            for side in ("left", "center", "right"):
                for lane in element.findall(f"{side}/lane"):
                    number = self.whole(lane, "id", where)
                    mark = self.mark(lane, middle, where)
                    if number == 0:
                        centre = mark
                        continue
                    if (number > 0) != (side == "left") or number in lanes:
                        self.fail(where, f"lane {number} is on the wrong side or there twice")
                    lanes[number] = self.lane(lane, number, mark, where)
            known = [value for s, value in limits if s <= starts[i] + middle]
            result.append(Section(starts[i], end, lanes, centre, known[-1] if known else None))
        return tuple(result)

    def lane(self, element: Element, number: int, mark: Marking, where: str) -> Lane:
        linked: list[int | None] = []
        for name in ("predecessor", "successor"):
            link = element.find(f"link/{name}")
            linked.append(None if link is None else self.whole(link, "id", where))
        speed = element.find("speed")
        return Lane(
            number,
            _KINDS.get(element.get("type", "none"), LaneType.NONE),
            mark,
            None if speed is None else self.speed(speed, where),
            *linked,
        )

    def speed(self, element: Element, where: str) -> float | None:
        text = element.get("max", "")
        if text in ("no limit", "undefined", ""):
            return None
        unit = element.get("unit", "")
        if unit not in _SPEED:
            self.fail(where, f"<speed unit='{unit[:30]}'> is not one of mph, km/h, m/s")
        value = self.number(element, "max", where) * _SPEED[unit]
        return value if value > 0.0 else None

    def mark(self, lane: Element, at: float, where: str) -> Marking:
        kind = "none"
        for element in lane.findall("roadMark"):
            if self.number(element, "sOffset", where, 0.0) <= at or kind == "none":
                kind = element.get("type", "none")
        return _MARKS.get(kind, Marking.OTHER)


def read_network(path: Path) -> Network:
    """Check an OpenDRIVE file and give its structure. MapError names file and element."""
    return _Reader(path).network()


def _light(signal: Element) -> bool:
    return signal.get("type") == TRAFFIC_LIGHT and signal.get("dynamic") == "yes"


def _sign(signal: Element) -> bool:
    return signal.get("type") in SIGNS and not signal.get("name", "").startswith(STENCIL)


def _sign_places(road: Element) -> list[SignPlace]:
    """Signs on a road, and references, which may be to signals of any kind."""
    found = []
    for element in [*road.findall("signals/signal"), *road.findall("signals/signalReference")]:
        if element.tag == "signal" and not _sign(element):
            continue
        way = {"+": 1, "-": -1}.get(element.get("orientation", "none"), 0)
        found += [SignPlace(element.get("id", ""), way, low, high) for low, high in _spans(element)]
    return found


def _spans(signal: Element) -> list[tuple[int, int]]:
    """Lanes that a signal is for, lowest and highest of each range; 0, 0 for all."""
    spans = [(int(v.get("fromLane", "0")), int(v.get("toLane", "0"))) for v in signal.findall("validity")]
    return [(min(span), max(span)) for span in spans] or [(0, 0)]


def _places(road: Element) -> list[SignalPlace]:
    found = []
    for element in [*road.findall("signals/signal"), *road.findall("signals/signalReference")]:
        if element.tag == "signal" and not _light(element):
            continue
        found += [SignalPlace(element.get("id", ""), low, high) for low, high in _spans(element)]
    return found
