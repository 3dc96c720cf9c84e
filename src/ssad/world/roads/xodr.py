"""Validated OpenDRIVE text and its structure: sections, lanes, links, signals.

Everything is checked before C++ code reads the file. Geometry is not evaluated here; `carla.Map` does that (see
`bake`).
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
# Signal types follow the OpenDRIVE convention that CARLA's maps use.
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
    """Connection of a road's end: kind "road" or "junction", its id, and the contact point of that road."""

    kind: str
    id: int
    contact: str


@dataclass(frozen=True)
class Lane:
    """Lane of a section; `mark` is the marking on its edge away from the road's centre."""

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
class MapRoad:
    """Road with its sections, the connections of its ends, and its lights and signs."""

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
    """Path through a junction: lanes of the incoming road -> lanes of the connecting road."""

    incoming: int
    connecting: int
    contact: str
    lanes: tuple[tuple[int, int], ...]


@dataclass(frozen=True)
class Network:
    """Structure of an OpenDRIVE file, without geometry.

    Attributes:
        roads: By id.
        junctions: Connections by id of the junction.
        lights: Ids of the traffic lights.
        phase: Id of a light -> position of its controller in the cycle.
        signs: Kind of each sign by id.
    """

    roads: dict[int, MapRoad]
    junctions: dict[int, tuple[Connection, ...]]
    lights: tuple[str, ...]
    phase: dict[str, int]
    signs: dict[str, SignKind] = field(default_factory=dict)


class _Reader:
    def __init__(self, path: Path) -> None:
        self.path = path

    def fail(self, location: str, problem: str) -> NoReturn:
        raise MapError(f"{self.path}: {location}: {problem}; correct the map and import it again")

    def number(self, element: Element, name: str, location: str, default: float | None = None) -> float:
        text = element.get(name)
        if text is None:
            if default is not None:
                return default
            self.fail(location, f"<{element.tag}> has no attribute '{name}'")
        try:
            value = float(text)
        except ValueError:
            self.fail(location, f"<{element.tag} {name}='{text[:30]}'> is not a number")
        if not math.isfinite(value) or abs(value) > MAX_COORDINATE:
            self.fail(location, f"<{element.tag} {name}='{text[:30]}'> is not finite or beyond {MAX_COORDINATE:g}")
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
        path = self.path
        try:
            root = read_xml(path, limit=MAX_BYTES)
        except FormatError as error:
            raise MapError(f"{error}; give a complete OpenDRIVE file (.xodr)") from None
        if root.tag != "OpenDRIVE":
            self.fail(f"<{str(root.tag)[:40]}>", "the root element is not <OpenDRIVE>")
        roads: dict[int, MapRoad] = {}
        total_length = 0.0
        for element in root.findall("road"):
            road = self.road(element)
            if road.id in roads:
                self.fail(f"road {road.id}", "two roads have this id")
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
        junctions = {}
        for element in root.findall("junction"):
            location = f"junction {element.get('id')}"
            junctions[self.whole(element, "id", location)] = self.connections(element, location, roads)
        signal_ids = {
            signal.get("id")
            for road_element in root.findall("road")
            for signal in road_element.findall("signals/signal")
        }
        for element in root.findall("road"):
            for reference in element.findall("signals/signalReference"):
                if reference.get("id") not in signal_ids:
                    self.fail(
                        f"road {element.get('id')}", f"it refers to signal {reference.get('id')}, which is nowhere"
                    )
        for road in roads.values():
            self.linked(road, roads, junctions)
        light_signals = [
            signal
            for road_element in root.findall("road")
            for signal in road_element.findall("signals/signal")
            if _light(signal)
        ]
        lights = [light.get("id", "") for light in light_signals]
        phase: dict[str, int] = {}
        for element in root.findall("controller"):
            for control in element.findall("control"):
                sequence = element.get("sequence", "0")
                phase.setdefault(control.get("signalId", ""), int(sequence) if sequence.isdigit() else 0)
        signs = {
            signal.get("id", ""): SIGNS[signal.get("type", "")]
            for road_element in root.findall("road")
            for signal in road_element.findall("signals/signal")
            if _sign(signal)
        }
        return Network(roads, junctions, tuple(dict.fromkeys(lights)), phase, signs)

    def road(self, element: Element) -> MapRoad:
        location = f"road {element.get('id')}"
        for descendant in element.iter():
            for name in _NUMBERS.intersection(descendant.keys()):
                # Objects and user data may hold other text in attributes of these names.
                if descendant.tag not in ("object", "userData") or name in ("s", "t"):
                    self.number(descendant, name, location)
        length = self.number(element, "length", location)
        if not 0.0 < length <= MAX_LENGTH:
            self.fail(location, f"length {length:g} m is not in (0, {MAX_LENGTH:g}]")
        geometries = element.findall("planView/geometry")
        if not geometries:
            self.fail(location, "<planView> has no <geometry>")
        start_positions = [self.number(geometry, "s", location) for geometry in geometries]
        if abs(start_positions[0]) > 1e-3 or start_positions != sorted(start_positions):
            self.fail(
                location, f"its <geometry> elements are not in order from s=0 (the first has s={start_positions[0]:g})"
            )
        for geometry in geometries:
            for name in ("s", "x", "y", "hdg", "length"):
                self.number(geometry, name, location)
            if float(geometry.get("length", "0")) < 0.0:
                self.fail(location, "<geometry> has a negative length")
            shape = [child for child in geometry if child.tag != "userData"]
            if len(shape) != 1 or shape[0].tag not in PLANS:
                child_tags = ", ".join(str(child.tag)[:30] for child in shape) or "nothing"
                self.fail(location, f"<geometry> holds {child_tags}; known are {', '.join(PLANS)}")
            for name in ("curvature", "curvStart", "curvEnd"):
                if abs(self.number(shape[0], name, location, 0.0)) > MAX_CURVATURE:
                    self.fail(location, f"{name} is beyond {MAX_CURVATURE:g} 1/m")
        return MapRoad(
            id=self.whole(element, "id", location),
            junction=self.whole(element, "junction", location) if element.get("junction") else -1,
            length=length,
            sections=self.sections(element, location, length),
            predecessor=self.link(element, "predecessor", location),
            successor=self.link(element, "successor", location),
            lights=tuple(_places(element)),
            signs=tuple(_sign_places(element)),
        )

    def link(self, road: Element, name: str, location: str) -> Link | None:
        element = road.find(f"link/{name}")
        if element is None:
            return None
        kind = element.get("elementType", "")
        if kind not in ("road", "junction"):
            self.fail(location, f"<{name} elementType='{kind[:30]}'> is neither road nor junction")
        return Link(kind, self.whole(element, "elementId", location), element.get("contactPoint", "start"))

    def linked(self, road: MapRoad, roads: dict[int, MapRoad], junctions: dict[int, tuple[Connection, ...]]) -> None:
        """Reject links to roads or junctions that the map lacks."""
        for link in (road.predecessor, road.successor):
            if link and link.id not in (roads if link.kind == "road" else junctions):
                self.fail(f"road {road.id}", f"it is linked to {link.kind} {link.id}, which the map lacks")

    def connections(self, junction: Element, location: str, roads: dict[int, MapRoad]) -> tuple[Connection, ...]:
        connections_by_id = []
        for element in junction.findall("connection"):
            lane_pairs = tuple(
                (self.whole(link, "from", location), self.whole(link, "to", location))
                for link in element.findall("laneLink")
            )
            incoming = self.whole(element, "incomingRoad", location)
            connecting = self.whole(element, "connectingRoad", location)
            for road in (incoming, connecting):
                if road not in roads:
                    self.fail(location, f"it connects road {road}, which is not in the map")
            connections_by_id.append(Connection(incoming, connecting, element.get("contactPoint", "start"), lane_pairs))
        return tuple(connections_by_id)

    def sections(self, road: Element, location: str, length: float) -> tuple[Section, ...]:
        elements = road.findall("lanes/laneSection")
        if not elements:
            self.fail(location, "it has no <laneSection>")
        start_positions = [self.number(element, "s", location) for element in elements]
        if start_positions != sorted(start_positions) or start_positions[0] < 0.0:
            self.fail(location, "its lane sections are not in order")
        speed_limits = []
        for road_type in road.findall("type"):
            speed = road_type.find("speed")
            if speed is not None:
                speed_limits.append((self.number(road_type, "s", location), self.speed(speed, location)))
        result = []
        for index, element in enumerate(elements):
            section_end = start_positions[index + 1] if index + 1 < len(start_positions) else length
            middle = 0.5 * (section_end - start_positions[index])
            lanes: dict[int, Lane] = {}
            centre_mark = Marking.NONE
            for side_name in ("left", "center", "right"):
                for lane in element.findall(f"{side_name}/lane"):
                    lane_id = self.whole(lane, "id", location)
                    marking = self.mark(lane, middle, location)
                    if lane_id == 0:
                        centre_mark = marking
                        continue
                    if (lane_id > 0) != (side_name == "left") or lane_id in lanes:
                        self.fail(location, f"lane {lane_id} is on the wrong side or there twice")
                    lanes[lane_id] = self.lane(lane, lane_id, marking, location)
            valid_limits = [value for position, value in speed_limits if position <= start_positions[index] + middle]
            result.append(
                Section(
                    start_positions[index], section_end, lanes, centre_mark, valid_limits[-1] if valid_limits else None
                )
            )
        return tuple(result)

    def lane(self, element: Element, number: int, mark: Marking, location: str) -> Lane:
        neighbour_ids: list[int | None] = []
        for name in ("predecessor", "successor"):
            link = element.find(f"link/{name}")
            neighbour_ids.append(None if link is None else self.whole(link, "id", location))
        speed = element.find("speed")
        return Lane(
            number,
            _KINDS.get(element.get("type", "none"), LaneType.NONE),
            mark,
            None if speed is None else self.speed(speed, location),
            *neighbour_ids,
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


def read_network(path: Path) -> Network:
    """Validate an OpenDRIVE file and return its structure. MapError names file and element."""
    return _Reader(path).network()


def _light(signal: Element) -> bool:
    return signal.get("type") == TRAFFIC_LIGHT and signal.get("dynamic") == "yes"


def _sign(signal: Element) -> bool:
    return signal.get("type") in SIGNS and not signal.get("name", "").startswith(STENCIL)


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
    spans = [
        (int(validity.get("fromLane", "0")), int(validity.get("toLane", "0")))
        for validity in signal.findall("validity")
    ]
    return [(min(span), max(span)) for span in spans] or [(0, 0)]


def _places(road: Element) -> list[SignalPlace]:
    places = []
    for element in [*road.findall("signals/signal"), *road.findall("signals/signalReference")]:
        if element.tag == "signal" and not _light(element):
            continue
        places += [SignalPlace(element.get("id", ""), low_lane, high_lane) for low_lane, high_lane in _spans(element)]
    return places
