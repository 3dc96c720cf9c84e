"""Map of an OpenSCENARIO document: the town that has just this map, imported if there is none."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ssad.core.errors import FormatError, MapError
from ssad.core.import_report import ImportReport
from ssad.core.lane_graph import LaneGraph
from ssad.core.safeio import home_folder, read_bytes
from ssad.core.types import LaneType
from ssad.interchange.openscenario_document import AttributeReader
from ssad.world.roads import import_map, is_town, town_xodr
from ssad.world.roads.lane_sampling import LaneSampler
from ssad.world.roads.library import BUILT_IN, town_network
from ssad.world.roads.xodr import MAX_BYTES, Cubic, MapRoad, Network, local_coordinates, read_network

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

EDGE = 0.1  # m beyond the end of a road that a position may be


@dataclass(frozen=True)
class DocumentMap:
    """Map of a document.

    Attributes:
        town: Its town.
        shift: What is subtracted from world coordinates of the document to get those of the town, m.
    """

    town: str
    shift: tuple[float, float] = (0.0, 0.0)


def find_map(root: Element, path: Path, report: ImportReport) -> DocumentMap:
    """Return the town with the map of a document; import the map if no town has it.

    Args:
        root: The document, resolved.
        path: Its file; the map lies relative to it.
        report: Filled with what was imported, or what stands in for a missing map.

    Raises:
        FormatError: The document names no map, or the map is missing.
        MapError: The map is broken.
    """
    values = AttributeReader(str(path))
    logic = root.find("RoadNetwork/LogicFile")
    if logic is None or not logic.get("filepath"):
        raise FormatError(f"{path}: RoadNetwork: names no LogicFile; say which town it is with --map")
    stated = values.text(logic, "filepath")
    relative = Path(stated.replace("\\", "/"))
    stem = re.sub(r"[^\w.\-]+", "_", relative.stem).strip(".") or "map"
    beside = [path.parent / relative] if not relative.is_absolute() else []
    beside += [path.parent / relative.name]
    source = next((file for file in beside if file.suffix == ".xodr" and file.is_file()), None)
    if source is None:
        if not is_town(stem):
            raise values.error(
                logic,
                f"its map is '{stated[:80]}', which is not there, and there is no town '{stem[:80]}'; put the map "
                "beside the scenario, or say which town it is with --map",
            )
        if relative.suffix == ".xodr":
            report.note(f"the map '{stated[:80]}' is not there: the town '{stem}' stands in for it")
        return DocumentMap(stem)
    raw = read_bytes(source, limit=MAX_BYTES)
    content = local_coordinates(raw)
    shift = (0.0, 0.0) if content == raw else read_network(source).shift
    digest = hashlib.sha256(content).hexdigest()
    town_candidates = (stem, f"{stem}-{digest[:8]}", f"{stem}-{digest}")
    for town_name in town_candidates:
        if is_town(town_name) and _content(town_name) == digest:
            return DocumentMap(town_name, shift)
    town_name = next(town_name for town_name in town_candidates if not is_town(town_name))
    if town_name != stem:
        report.note(f"the map is imported as '{town_name}': the town '{stem}' has another map")
    map_report = ImportReport(str(source))
    import_map(source, town_name, home_folder(), report=map_report)
    report.contents.append(f"map {source.name} imported as town '{town_name}'")
    for reason, places in map_report.omissions.items():
        report.note(f"not carried over from the map: {reason}", count=len(places))
    for reason, places in map_report.doubts.items():
        report.doubts.setdefault(f"map: {reason}", []).extend(places)
    return DocumentMap(town_name, shift)


def _content(town_name: str) -> str:
    """Return the hash of a town's map; "" if it has none."""
    stored = home_folder() / "towns" / f"{town_name}.xodr"
    try:
        is_stored = town_name not in BUILT_IN and stored.is_file()
        content = read_bytes(stored, limit=MAX_BYTES) if is_stored else town_xodr(town_name).encode()
    except MapError:
        return ""
    return hashlib.sha256(content).hexdigest()


@dataclass(frozen=True)
class LaneSpot:
    """Middle of a lane at a position of its road.

    Attributes:
        x: m.
        y: m.
        heading: Direction of the road, rad.
        t: Distance from the reference line, m.
        width: Of the lane, m.
        forward: Traffic runs along the road.
    """

    x: float
    y: float
    heading: float
    t: float
    width: float
    forward: bool


class RoadCoordinates:
    """Road coordinates of a town, on the reference lines of its map."""

    def __init__(self, town: str, graph: LaneGraph) -> None:
        self.town, self.graph = town, graph

    @cached_property
    def network(self) -> Network | None:
        """Return the town's network; None if it has no OpenDRIVE."""
        try:
            return town_network(self.town)
        except MapError:
            return None

    @cached_property
    def _sampler(self) -> LaneSampler:
        assert self.network is not None
        return LaneSampler(self.network)

    def road(self, road_name: str) -> MapRoad | None:
        """Return a road by its id in the file; None if there is none."""
        if self.network is None:
            return None
        number = self.network.road_names.get(road_name.strip())
        return None if number is None else self.network.roads.get(number)

    def at(self, road: MapRoad, s: float, t: float) -> tuple[float, float, float]:
        """Return x, y and the direction of a road at s and t, measured from its lane offset's origin."""
        x, y, heading = self._sampler.at(np.array([self._sampler.row[road.id]]), np.array([s]), np.array([t]))
        return float(x[0]), float(y[0]), float(heading[0])

    def lane(self, road: MapRoad, lane: int, s: float) -> LaneSpot | None:
        """Return the middle of a lane at s; None if the road has no such lane there. Lane 0 is the centre line."""
        section = next((lane_section for lane_section in road.sections if s <= lane_section.s1), road.sections[-1])
        offset = _cubic(road.offsets, s)
        inner_edge = width = 0.0
        forward = not road.left_hand
        if lane:
            if lane not in section.lanes:
                return None
            side_sign = 1 if lane > 0 else -1
            for number in range(side_sign, lane + side_sign, side_sign):
                map_lane = section.lanes.get(number)
                if map_lane is None:
                    return None
                forward = map_lane.forward
                inner_edge += side_sign * width
                width = max(_cubic(map_lane.widths, s - section.base), 0.0)
                if map_lane.borders:
                    width = abs(_cubic(map_lane.borders, s - section.base) - inner_edge)
            inner_edge += 0.5 * side_sign * width
        x, y, heading = self.at(road, s, inner_edge + offset)
        return LaneSpot(x, y, heading, inner_edge + offset, width, forward)

    def forward_at(self, road: MapRoad, s: float, t: float) -> bool:
        """Return whether traffic at s and t of a road runs along it; true where there is no driving lane."""
        section = next((lane_section for lane_section in road.sections if s <= lane_section.s1), road.sections[-1])
        spots = [
            (abs(spot.t - t), spot.forward)
            for number, map_lane in section.lanes.items()
            if map_lane.kind == LaneType.DRIVING and (spot := self.lane(road, number, s)) is not None
        ]
        return min(spots)[1] if spots else True

    def lane_ids(self, road: MapRoad, s: float) -> list[int]:
        """Return the ids of the lanes of a road at s."""
        section = next((lane_section for lane_section in road.sections if s <= lane_section.s1), road.sections[-1])
        return sorted(section.lanes)


def _cubic(records: tuple[Cubic, ...], s: float) -> float:
    """Return the value of a piecewise cubic at s; 0 without records."""
    value = 0.0
    for start, a, b, c, d in records:
        if start > s + 1e-9 and start > 0.0:
            break
        ds = s - start
        value = a + ds * (b + ds * (c + ds * d))
    return value
