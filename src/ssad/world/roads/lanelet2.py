"""Content of a Lanelet2 map (OSM XML): lanelets with their bounds, regulatory elements, and coordinates.

The file is checked here and becomes a lane graph in `lanelet2_graph`.

Source:
    Poggenhans et al., Lanelet2: A high-definition map framework for the future of automated driving (ITSC 2018), and
    the tags as documented by the library and by Autoware.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final, Literal, NoReturn

import numpy as np

from ssad.core.errors import FormatError, MapError
from ssad.core.import_report import ImportReport
from ssad.core.safeio import MIB, read_xml
from ssad.core.types import F64
from ssad.world.roads.projection import UTM_LATITUDES, local, utm
from ssad.world.roads.reference_line import Index

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

MAX_BYTES: Final = 64 * MIB
MAX_LANELETS: Final = 20_000
MAX_HEIGHT: Final = 1.0e5  # m
MAX_LOCAL: Final = 1.0e8  # m; projected coordinates reach 2e7
MAX_EXTENT: Final = 1.0e5  # m from the middle of a map to its furthest lanelet
COARSE: Final = 1.0e4  # m from the origin, beyond which float32 coordinates are coarser than a millimetre
SAME_PLACE: Final = 0.01  # m; points of bounds that are closer count as one
UNCLEAR: Final = 0.2  # relative difference of the distances between ends, below which they do not tell a direction
REMEDY: Final = "correct the map and import it again"

ProjectionName = Literal["utm", "local"]
Tags = Mapping[str, str]


@dataclass(frozen=True)
class Lanelet2Options:
    """Answers to what a Lanelet2 map leaves open.

    Attributes:
        origin: Latitude and longitude, degrees, of the town's origin; None: the middle of the map.
        projection: "utm", or "local": transverse Mercator around the origin; None: local_x and local_y where the map
            has them, else UTM.
        left_hand: Traffic keeps to the left; None: as the map suggests.
    """

    origin: tuple[float, float] | None = None
    projection: ProjectionName | None = None
    left_hand: bool | None = None


@dataclass(frozen=True)
class Way:
    """Line of a map: rows of its points, and its tags."""

    id: str
    points: tuple[int, ...]
    tags: Tags


@dataclass(frozen=True)
class Bound:
    """Side of a lanelet in the direction of traffic.

    Attributes:
        points: Rows of its points.
        tags: Of its first line.
        is_reversed: Whether the points run against the line in the file.
    """

    points: tuple[int, ...]
    tags: Tags
    is_reversed: bool


@dataclass(frozen=True)
class Lanelet:
    """Lanelet with its bounds in the direction of traffic.

    Attributes:
        id: Its id.
        left: Left bound.
        right: Right bound.
        tags: Its tags.
        rules: Ids of its regulatory elements.
        centre: Rows of the points of its centre line, in the direction of traffic, where the file gives it.
    """

    id: str
    left: Bound
    right: Bound
    tags: Tags
    rules: tuple[str, ...]
    centre: tuple[int, ...] = ()


@dataclass(frozen=True)
class Rule:
    """Regulatory element.

    Attributes:
        id: Its id.
        tags: Its tags.
        members: Role -> ids of ways or lanelets.
    """

    id: str
    tags: Tags
    members: Mapping[str, tuple[str, ...]]

    @property
    def subtype(self) -> str:
        """Kind of rule, such as "traffic_light"."""
        return self.tags.get("subtype", "")


@dataclass(frozen=True)
class LaneletMap:
    """Content of a Lanelet2 map.

    Attributes:
        xyz: Points [P, 3], m, in the coordinates of the town.
        lanelets: All lanelets that have a shape.
        rules: Regulatory elements by id.
        ways: Lines by id.
        origin: What is added to x and y to get the coordinates of the projection, m.
        lanelet_ways: Ids of the lines of lanelets, also of those without a shape.
    """

    xyz: F64
    lanelets: tuple[Lanelet, ...]
    rules: Mapping[str, Rule]
    ways: Mapping[str, Way]
    origin: tuple[float, float]
    lanelet_ways: frozenset[str]


def read_lanelet_map(
    path: Path, options: Lanelet2Options | None = None, report: ImportReport | None = None
) -> LaneletMap:
    """Check a Lanelet2 map and return its content.

    Args:
        path: The file.
        options: Origin and projection.
        report: Filled with what the file holds and the map does not, and with doubts.

    Raises:
        MapError: The file is invalid; the message names file and element.
    """
    account = ImportReport(str(path)) if report is None else report
    return _Reader(path, options or Lanelet2Options(), account).read()


class _Reader:
    def __init__(self, path: Path, options: Lanelet2Options, report: ImportReport) -> None:
        self.path, self.options, self.report = path, options, report

    def fail(self, location: str, problem: str) -> NoReturn:
        raise MapError(f"{self.path}: {location}: {problem}; {REMEDY}")

    def no_points(self, members: list[dict[str, tuple[str, ...]]]) -> tuple[str, str]:
        """Return the first line that is missing, or the place of the first doubt, for a map without bounds."""
        problem = "no lanelet in it has a bound with points"
        for roles in members:
            for element_id in (*roles.get("left", ()), *roles.get("right", ())):
                if element_id not in self.ways:
                    return f"way {element_id[:30]}", f"{problem}: the map lacks this line"
        return self.first_doubt(problem)

    def first_doubt(self, problem: str) -> tuple[str, str]:
        """Return the place of the first doubt, and a problem of the whole map with the reason of that doubt."""
        for reason, places in self.report.doubts.items():
            place = next(filter(None, places), "<osm>")
            return place, f"{problem}: {reason.partition(';')[0]}"
        return "<osm>", problem

    def read(self) -> LaneletMap:
        root = self.root()
        elements = {tag: self.present(root, tag) for tag in ("node", "way", "relation")}
        relation_tags = {id(element): _tags(element) for element in elements["relation"]}
        lanelet_elements = [
            element for element in elements["relation"] if relation_tags[id(element)].get("type") == "lanelet"
        ]
        if not lanelet_elements:
            raise MapError(
                f"{self.path}: no lanelet in it: OpenStreetMap's roads have no lanes with bounds; give a Lanelet2 map"
            )
        if len(lanelet_elements) > MAX_LANELETS:
            self.fail("<osm>", f"{len(lanelet_elements)} lanelets, at most {MAX_LANELETS}")
        self.point_rows = {element_id: row for row, element_id in enumerate(self.ids(elements["node"]))}
        self.ways = self.read_ways(elements["way"])
        self.ids(elements["relation"])
        rules = {}
        for element in elements["relation"]:
            tags = relation_tags[id(element)]
            if tags.get("type") == "regulatory_element":
                rules[element.get("id", "")] = self.rule(element, tags)
            elif tags.get("type") == "multipolygon":
                self.report.omit("areas", f"{tags.get('subtype', 'without a subtype')[:30]}")
            elif tags.get("type") != "lanelet":
                self.report.omit(f"relations of type '{tags.get('type', '')[:30]}'", f"relation {_name(element)}")
        members = [_members(element) for element in lanelet_elements]
        used = self.used_points(members)
        self.xyz, origin = self.coordinates(elements["node"], used)
        self.same = _joined(self.xyz, used)
        merged_count = len(used) - len({self.same[row] for row in used.tolist()})
        if merged_count:
            self.report.note(f"points of bounds within {SAME_PLACE:g} m count as one", count=merged_count)
        lanelets = [
            lanelet
            for element, roles in zip(lanelet_elements, members, strict=True)
            if (lanelet := self.lanelet(element, relation_tags[id(element)], roles)) is not None
        ]
        if not lanelets:
            self.fail(*self.first_doubt("no lanelet in it has a shape"))
        self.check_rules(lanelets, rules)
        lanelet_ways = frozenset(
            element_id
            for roles in members
            for role, element_ids in roles.items()
            if role != "regulatory_element"
            for element_id in element_ids
        )
        return LaneletMap(self.xyz, tuple(lanelets), rules, self.ways, origin, lanelet_ways)

    def root(self) -> Element:
        try:
            root = read_xml(self.path, limit=MAX_BYTES)
        except FormatError as error:
            raise MapError(f"{error}; give a complete Lanelet2 map (.osm)") from None
        if root.tag != "osm":
            self.fail(f"<{str(root.tag)[:40]}>", "the root element is not <osm>")
        generator = root.get("generator", "")
        self.report.contents.append(f"Lanelet2 map{f', written by {generator[:40]}' if generator else ''}")
        return root

    def present(self, root: Element, tag: str) -> list[Element]:
        """Return the elements with a tag that are not deleted: editors keep those in the file."""
        elements = root.findall(tag)
        present = [
            element for element in elements if element.get("action") != "delete" and element.get("visible") != "false"
        ]
        if len(present) < len(elements):
            self.report.note(f"deleted {tag}s are passed over", count=len(elements) - len(present))
        return present

    def ids(self, elements: list[Element]) -> list[str]:
        element_ids = [element.get("id", "") for element in elements]
        repeated = [element_id for element_id, count in Counter(element_ids).items() if count > 1]
        if repeated:
            self.fail(f"{elements[0].tag} {repeated[0][:30]}", f"two {elements[0].tag}s have this id")
        return element_ids

    def read_ways(self, elements: list[Element]) -> dict[str, Way]:
        ways = {}
        for element_id, element in zip(self.ids(elements), elements, strict=True):
            point_rows: list[int] = []
            for reference in element.iterfind("nd"):
                row = self.point_rows.get(reference.get("ref", ""))
                if row is None:
                    place = f"way {element_id[:30]}, node {reference.get('ref', '')[:30]}"
                    self.report.doubt("a line refers to a point that the map lacks", place)
                elif not point_rows or point_rows[-1] != row:
                    point_rows.append(row)
            ways[element_id] = Way(element_id, tuple(point_rows), _tags(element))
        return ways

    def rule(self, element: Element, tags: Tags) -> Rule:
        return Rule(element.get("id", ""), tags, _members(element))

    def used_points(self, members: list[dict[str, tuple[str, ...]]]) -> Index:
        """Return the rows of the points of all bounds, sorted."""
        point_rows = {
            row
            for roles in members
            for role in ("left", "right", "centerline")
            for element_id in roles.get(role, ())
            if element_id in self.ways
            for row in self.ways[element_id].points
        }
        if not point_rows:
            self.fail(*self.no_points(members))
        return np.array(sorted(point_rows))

    # ------------------------------------------------------------ coordinates

    def number(self, text: str | None, place: str, limit: float) -> float:
        """Return a finite number, nan where the text is missing or empty."""
        if text is None or not text.strip():
            return math.nan
        try:
            value = float(text)
        except ValueError:
            self.fail(place, f"'{text[:30]}' is not a number")
        if not math.isfinite(value) or abs(value) > limit:
            self.fail(place, f"'{text[:30]}' is not finite or beyond {limit:g}")
        return value

    def coordinates(self, nodes: list[Element], used: Index) -> tuple[F64, tuple[float, float]]:
        """Return the points [P, 3] in the town's coordinates, and the origin of these."""
        point_rows = []
        for node in nodes:
            tags, place = _tags(node), f"node {_name(node)}"
            point_rows.append(
                (
                    self.number(node.get("lat"), f"{place}, lat", 90.0),
                    self.number(node.get("lon"), f"{place}, lon", 540.0),
                    self.number(tags.get("local_x"), f"{place}, local_x", MAX_LOCAL),
                    self.number(tags.get("local_y"), f"{place}, local_y", MAX_LOCAL),
                    self.number(tags.get("ele"), f"{place}, ele", MAX_HEIGHT),
                )
            )
        table = np.array(point_rows, np.float64).reshape(-1, 5)
        height = table[:, 4]
        without_height = int(np.isnan(height[used]).sum())
        if 0 < without_height < len(used):
            self.report.doubt("points without a height lie at 0 m", count=without_height)
        xy, origin = self.plane(table, used, [_name(node) for node in nodes])
        extent = float(np.abs(xy[used] - 0.5 * (xy[used].min(0) + xy[used].max(0))).max())
        if extent > MAX_EXTENT:
            self.fail("<osm>", f"its lanelets lie {extent:.0f} m from their middle, the limit is {MAX_EXTENT:.0f} m")
        return np.column_stack([xy, np.nan_to_num(height)]), origin

    def plane(self, table: F64, used: Index, element_ids: list[str]) -> tuple[F64, tuple[float, float]]:
        """Return x and y of the points, and the origin of these."""
        has_local = np.isfinite(table[used, 2:4]).all(1)
        is_asked = self.options.origin is not None or self.options.projection is not None
        if has_local.all() and not is_asked:
            xy = table[:, 2:4]
            middle = np.round(0.5 * (xy[used].min(0) + xy[used].max(0)))
            shift = middle if np.abs(xy[used]).max() > COARSE else np.zeros(2)
            shifted = f", shifted by ({-shift[0]:.0f}, {-shift[1]:.0f})" if shift.any() else ""
            self.report.contents.append(f"coordinates: local_x and local_y{shifted}")
            return xy - shift, (float(shift[0]), float(shift[1]))
        has_place = np.isfinite(table[used, :2]).all(1)
        if not has_place.all():
            row = int(used[np.flatnonzero(~has_place)[0]])
            self.fail(f"node {element_ids[row]}", "it has neither latitude and longitude nor local_x and local_y")
        if has_local.any() and not is_asked:
            self.report.doubt(
                "only some points have local_x and local_y; latitude and longitude are used", count=int(has_local.sum())
            )
        latitude, longitude = table[:, 0], table[:, 1]
        if np.ptp(longitude[used]) > 180.0:
            longitude = np.where(longitude < 0.0, longitude + 360.0, longitude)
        middle = 0.5 * (table[used, :2].min(0) + table[used, :2].max(0))
        middle[1] = 0.5 * (longitude[used].min() + longitude[used].max())
        origin = self.options.origin or (round(float(middle[0]), 7), round(float(middle[1]), 7))
        if self.options.projection == "local":
            projection = local(*origin)
            xy, shift = projection.project(latitude, longitude), np.zeros(2)
            self.report.contents.append(f"coordinates: {projection.name}")
        else:
            xy, shift = self.utm(latitude, longitude, origin)
        if self.options.origin is not None:
            distance = float(np.hypot(*(0.5 * (xy[used].min(0) + xy[used].max(0)))))
            if distance > COARSE:
                self.report.doubt(
                    f"the map lies {distance / 1000.0:.0f} km from --origin: coordinates are coarser than a millimetre"
                )
        return xy, (float(shift[0]), float(shift[1]))

    def utm(self, latitude: F64, longitude: F64, origin: tuple[float, float]) -> tuple[F64, F64]:
        """Return x and y less those of the origin, and these."""
        if not UTM_LATITUDES[0] <= origin[0] <= UTM_LATITUDES[1]:
            self.fail("<osm>", f"UTM ends at latitude {UTM_LATITUDES[1]:g} degrees: add --projection local")
        projection = utm(*origin)
        place = projection.project(np.array([origin[0]]), np.array([origin[1]]))[0]
        shift = place if self.options.origin is not None else np.round(place)
        self.report.contents.append(
            f"coordinates: {projection.name}, shifted by ({-shift[0]:.2f}, {-shift[1]:.2f})"
            f"{f': the origin is at {origin[0]:.7f}, {origin[1]:.7f}' if self.options.origin is not None else ''}"
        )
        return projection.project(latitude, longitude) - shift, shift

    # ------------------------------------------------------------ lanelets

    def lanelet(self, element: Element, tags: Tags, roles: dict[str, tuple[str, ...]]) -> Lanelet | None:
        """Return a lanelet; None, with a doubt, where its bounds give no shape."""
        place = f"lanelet {_name(element)}"
        lines = []
        for side in ("left", "right"):
            element_ids = roles.get(side, ())
            lines_place = ", ".join([place, *(f"way {element_id[:30]}" for element_id in element_ids)])
            missing = [element_id for element_id in element_ids if element_id not in self.ways]
            if not element_ids or missing:
                reason = "a lanelet refers to a line that the map lacks" if missing else "a lanelet lacks a bound"
                self.report.doubt(f"{reason}; it is left out", f"{place}, way {missing[0][:30]}" if missing else place)
                return None
            point_rows = self.chain([self.ways[element_id] for element_id in element_ids])
            if point_rows is None:
                self.report.doubt("the lines of a bound do not join; the lanelet is left out", lines_place)
                return None
            if len(point_rows) < 2 or _extent(self.xyz[list(point_rows)]) < SAME_PLACE:
                self.report.doubt("a bound has fewer than two points; the lanelet is left out", lines_place)
                return None
            lines.append((point_rows, self.ways[element_ids[0]].tags))
        (left, left_tags), (right, right_tags) = lines
        turn_left, turn_right = directions(self.xyz[list(left), :2], self.xyz[list(right), :2])
        bounds = [
            Bound(point_rows[::-1] if turned else point_rows, bound_tags, turned)
            for point_rows, bound_tags, turned in ((left, left_tags, turn_left), (right, right_tags, turn_right))
        ]
        centre = self.centre(roles.get("centerline", ()), bounds, place)
        for role, element_ids in roles.items():
            if role not in ("left", "right", "centerline", "regulatory_element"):
                self.report.omit(f"members of lanelets in the role '{role[:30]}'", place, count=len(element_ids))
        return Lanelet(element.get("id", ""), bounds[0], bounds[1], tags, roles.get("regulatory_element", ()), centre)

    def chain(self, ways: list[Way]) -> tuple[int, ...] | None:
        """Return the points of lines that follow each other, in the direction of the first; None if they do not."""
        point_rows = [self.same[row] for row in ways[0].points]
        for way in ways[1:]:
            following = [self.same[row] for row in way.points]
            if not point_rows or not following:
                return None
            if following[0] != point_rows[-1] and following[-1] == point_rows[-1]:
                following.reverse()
            elif following[0] != point_rows[-1] and point_rows[0] in (following[0], following[-1]):
                point_rows.reverse()
                if following[0] != point_rows[-1]:
                    following.reverse()
            if following[0] != point_rows[-1]:
                return None
            point_rows += following[1:]
        return tuple(row for index, row in enumerate(point_rows) if not index or row != point_rows[index - 1])

    def centre(self, element_ids: tuple[str, ...], bounds: list[Bound], place: str) -> tuple[int, ...]:
        """Return the points of the centre line that the file gives, if it leads from one end to the other."""
        if len(element_ids) != 1 or element_ids[0] not in self.ways:
            if element_ids:
                self.report.doubt("the centre line of a lanelet is not one line of the map", place)
            return ()
        point_rows = tuple(self.same[row] for row in self.ways[element_ids[0]].points)
        if len(point_rows) < 2:
            self.report.doubt("the centre line of a lanelet has fewer than two points", place)
            return ()
        start, end = (
            0.5 * (self.xyz[bounds[0].points[index], :2] + self.xyz[bounds[1].points[index], :2]) for index in (0, -1)
        )
        first, last = self.xyz[point_rows[0], :2], self.xyz[point_rows[-1], :2]
        if math.dist(first, start) + math.dist(last, end) > math.dist(first, end) + math.dist(last, start):
            point_rows, first, last = point_rows[::-1], last, first
        half_width = 0.5 * max(
            math.dist(self.xyz[bounds[0].points[index], :2], self.xyz[bounds[1].points[index], :2]) for index in (0, -1)
        )
        if max(math.dist(first, start), math.dist(last, end)) > half_width:
            self.report.doubt("the centre line of a lanelet does not reach its ends; the middle is taken", place)
            return ()
        return point_rows

    def check_rules(self, lanelets: list[Lanelet], rules: Mapping[str, Rule]) -> None:
        """Doubt references to regulatory elements that are missing."""
        for lanelet in lanelets:
            for element_id in lanelet.rules:
                if element_id not in rules:
                    place = f"lanelet {lanelet.id[:30]}, relation {element_id[:30]}"
                    self.report.doubt("a lanelet refers to a regulatory element that the map lacks", place)


def directions(left: F64, right: F64) -> tuple[bool, bool]:
    """Return whether the left and the right bound must be reversed to run with the traffic.

    Lines may run either way in a file; traffic runs where the left bound is on its left. Where the ends do not tell
    which of them belong together, as in a turn around a small island, each bound has the other on its inner side.

    Args:
        left: Points [n, 2], m.
        right: Points [m, 2], m.
    """
    along = math.dist(left[0], right[0]) + math.dist(left[-1], right[-1])
    against = math.dist(left[0], right[-1]) + math.dist(left[-1], right[0])
    if abs(along - against) < UNCLEAR * (along + against):
        return _lies_left(_middle(right), left), not _lies_left(_middle(left), right)
    turn_right = against < along
    outline = np.concatenate([left, right if turn_right else right[::-1]]) - left[0]
    following = np.roll(outline, -1, axis=0)
    area = float((outline[:, 0] * following[:, 1] - outline[:, 1] * following[:, 0]).sum())
    # Along the left bound and back along the right one is clockwise.
    turn_both = area > 0.0
    return turn_both, turn_both ^ turn_right


def _middle(line: F64) -> F64:
    """Return the middle point of a line [2]."""
    middle: F64 = line[len(line) // 2] if len(line) > 2 else line.mean(axis=0)
    return middle


def _lies_left(point: F64, line: F64) -> bool:
    """Return whether a point lies to the left of a line where it is nearest."""
    steps = np.diff(line, axis=0)
    squared = np.maximum((steps**2).sum(1), 1e-18)
    fraction = np.clip(((point - line[:-1]) * steps).sum(1) / squared, 0.0, 1.0)
    gaps = point - line[:-1] - fraction[:, None] * steps
    distances = (gaps**2).sum(1)
    # At a corner two segments are nearest; the mean of their directions tells the side.
    nearest = distances <= distances.min() + 1e-12
    direction = (steps[nearest] / np.sqrt(squared[nearest])[:, None]).sum(0)
    gap = gaps[int(distances.argmin())]
    return float(direction[0] * gap[1] - direction[1] * gap[0]) > 0.0


def _joined(xyz: F64, used: Index) -> list[int]:
    """Return for each point the first one in its place."""
    from scipy.spatial import cKDTree

    same = list(range(len(xyz)))
    for first, second in sorted(cKDTree(xyz[used]).query_pairs(SAME_PLACE)):
        row, other = int(used[first]), int(used[second])
        same[other] = min(same[other], same[row])
    return same


def _extent(points: F64) -> float:
    return float(np.ptp(points[:, :2], axis=0).max())


def _tags(element: Element) -> dict[str, str]:
    return {tag.get("k", ""): tag.get("v", "").strip() for tag in element.iterfind("tag")}


def _members(element: Element) -> dict[str, tuple[str, ...]]:
    roles: dict[str, list[str]] = {}
    for member in element.iterfind("member"):
        roles.setdefault(member.get("role", ""), []).append(member.get("ref", ""))
    return {role: tuple(element_ids) for role, element_ids in roles.items()}


def _name(element: Element) -> str:
    return element.get("id", "")[:30]
