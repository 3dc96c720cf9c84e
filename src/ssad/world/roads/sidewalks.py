"""Network of sidewalks and crossings of a town, and random walks over it.

Sidewalks are the lanes of `LaneType.SIDEWALK`. Crossings are the crosswalks of the map. A junction arm without one and
with sidewalks on both sides gets an unmarked crossing if it has traffic lights or traffic up to 65 km/h, since people
cross there too. Where a map leaves out the corners of a junction, its sidewalks are joined by straight edges that cross
no driving lane.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ssad.core.errors import RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_scalar
from ssad.core.types import F64, I32, LaneType, Route
from ssad.world.models import model

JOIN = 1.0  # m within which ends of sidewalks and crossings are one node
REACH = 6.0  # m from the end of a crosswalk to the sidewalk that it leads to
SETBACK = 2.0  # m from the end of a sidewalk at a junction to an unmarked crossing
BESIDE = 25.0  # m of a road around a crosswalk without an unmarked crossing
GAP = 32.0  # m between ends of sidewalks that a map does not connect at a junction, though no lane lies between them
MAX_LENGTH = 35.0  # m from sidewalk to sidewalk; wider roads are not crossed in one go
MAX_SPEED_LIMIT = (
    65.0 / 3.6
)  # m/s, which includes 40 mph; faster roads are crossed at crosswalks and traffic lights alone
UNMARKED_WIDTH = 3.0  # m
SPACING = 0.5  # m between the points of a walk
_SAMPLE = 1.0  # m between the points at which lanes are compared with crossings
_SMOOTHING = 5  # points over which corners of a walk are rounded


@dataclass(frozen=True)
class Crossing:
    """Place at which walkers cross a road.

    Attributes:
        xy: Ends on the sidewalks [2, 2], m.
        width: Width, m.
        crosswalk: Crosswalk of the lane graph; -1: an unmarked crossing.
        lanes: Driving lanes that it crosses, in ascending order.
    """

    xy: F64
    width: float
    crosswalk: int
    lanes: tuple[int, ...]

    @property
    def length(self) -> float:
        """Distance between the ends, m."""
        return math.dist(*self.xy.tolist())


@dataclass(frozen=True)
class SidewalkEdge:
    """Stretch of a sidewalk, or a crossing, between two nodes.

    Attributes:
        nodes: Start and end.
        xy: Centre line from start to end [P, 2], m.
        width: Mean width, m.
        lane: Sidewalk lane; -1: a crossing, or a corner that the map leaves out.
        crossing: Index of the crossing; -1: a sidewalk.
    """

    nodes: tuple[int, int]
    xy: F64
    width: float
    lane: int = -1
    crossing: int = -1

    @property
    def length(self) -> float:
        """Length of the centre line, m."""
        return float(np.hypot(*np.diff(self.xy, axis=0).T).sum())

    def line_from(self, node: int) -> F64:
        """Return the centre line [P, 2] that starts at one of the two nodes."""
        return self.xy if node == self.nodes[0] else self.xy[::-1]

    def opposite(self, node: int) -> int:
        """Return the node at the other end."""
        return self.nodes[1] if node == self.nodes[0] else self.nodes[0]


@dataclass(frozen=True)
class Walk:
    """Path of a walker.

    Attributes:
        route: Points every 0.5 m; `lane` is the sidewalk lane, or -1.
        crossing: Crossing on which each point lies [N]; -1: on a sidewalk.
    """

    route: Route
    crossing: I32


@dataclass(frozen=True)
class SidewalkNetwork:
    """Graph of sidewalks and crossings.

    Attributes:
        node_xy: Places where edges meet [N, 2], m.
        edges: Sidewalks first, then crossings, then corners that the map leaves out.
        crossings: Crossings by index.
    """

    node_xy: F64
    edges: tuple[SidewalkEdge, ...]
    crossings: tuple[Crossing, ...]

    @cached_property
    def edges_at(self) -> tuple[tuple[int, ...], ...]:
        """Edges that begin or end at each node, in ascending order."""
        incident: list[list[int]] = [[] for _ in self.node_xy]
        for index, edge in enumerate(self.edges):
            for node in dict.fromkeys(edge.nodes):
                incident[node].append(index)
        return tuple(tuple(indices) for indices in incident)

    @cached_property
    def component(self) -> I32:
        """Smallest node that can be reached from each node [N]."""
        component = np.arange(len(self.node_xy), dtype=np.int32)
        for edge in self.edges:
            first, second = sorted(int(component[node]) for node in edge.nodes)
            component[component == second] = first
        return component

    def random_walk(
        self,
        edge: int,
        position: float,
        length: float,
        random: np.random.Generator,
        *,
        reverse: bool = False,
        crossing_share: float = 0.5,
        closed: Collection[int] = (),
        offset: float = 0.0,
    ) -> Walk:
        """Draw a walk from a place on an edge; it turns back only where the network ends.

        Args:
            edge: Edge on which it starts.
            position: Distance of the start from the start of the edge, m; clamped to the edge.
            length: Length of the walk, m.
            random: Source of the draws.
            reverse: Walk towards the start of the edge.
            crossing_share: Probability of a walker to take a crossing at its end, if a sidewalk leads on as well.
            closed: Numbers of crossings that it does not take.
            offset: Distance left of the centre line, m; cut to half the width of the narrowest edge.

        Raises:
            RouteError: The edge does not exist, or the length is below the spacing.
        """
        if not 0 <= edge < len(self.edges):
            raise RouteError(f"a walk starts on edge {edge}, the network has {len(self.edges)}; choose another edge")
        if length < SPACING:
            raise RouteError(f"a walk of {length:g} m is too short; ask for {SPACING:g} m or more")
        node = self.edges[edge].nodes[1 if reverse else 0]
        first_line = _resampled(self.edges[edge].line_from(node), SPACING / 2)
        distance = self.edges[edge].length - position if reverse else position
        skip = min(max(int(distance / (SPACING / 2)), 0), len(first_line) - 2)
        lines, edges = [first_line[skip:]], [edge]
        node = self.edges[edge].opposite(node)
        total = _length(lines[0])
        while total < length + SPACING:
            edge = self._next_edge(edge, node, random, crossing_share, closed)
            lines.append(_resampled(self.edges[edge].line_from(node), SPACING / 2))
            edges.append(edge)
            node = self.edges[edge].opposite(node)
            total += _length(lines[-1])
        return self._walk(lines, edges, length, offset)

    def _next_edge(
        self, edge: int, node: int, random: np.random.Generator, crossing_share: float, closed: Collection[int]
    ) -> int:
        onward = [index for index in self.edges_at[node] if index != edge and self.edges[index].crossing not in closed]
        if not onward:
            return edge
        takes_crossing = float(random.uniform()) < crossing_share
        choices = [index for index in onward if (self.edges[index].crossing >= 0) == takes_crossing] or onward
        return choices[int(random.integers(len(choices)))]

    def _walk(self, lines: list[F64], edges: list[int], length: float, offset: float) -> Walk:
        points = np.concatenate(lines)
        owners = np.repeat(edges, [len(line) for line in lines])
        arc_lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        positions = SPACING * np.arange(int(length / SPACING) + 1)
        xy = np.column_stack([np.interp(positions, arc_lengths, column) for column in points.T])
        owner = owners[np.minimum(np.searchsorted(arc_lengths, positions), len(owners) - 1)]
        padding = _SMOOTHING // 2
        if len(xy) > _SMOOTHING:
            weights = np.full(_SMOOTHING, 1.0 / _SMOOTHING)
            middle = np.column_stack([np.convolve(column, weights, mode="valid") for column in xy.T])
            xy[padding:-padding] = middle
        heading = _heading(xy)
        room = 0.5 * min(self.edges[index].width for index in edges)
        left = min(max(offset, -room), room)
        xy = xy + left * np.column_stack([-np.sin(heading), np.cos(heading)])
        route = Route(
            xy=xy.astype(np.float32),
            yaw=_heading(xy).astype(np.float32),
            lane=np.array([self.edges[index].lane for index in owner], np.int32),
            speed_limit=np.full(len(xy), model("walker").max_speed, np.float32),
            width=np.array([self.edges[index].width for index in owner], np.float32),
            spacing=SPACING,
        )
        return Walk(route, np.array([self.edges[index].crossing for index in owner], np.int32))


def sidewalk_network(graph: LaneGraph) -> SidewalkNetwork:
    """Return the sidewalks and crossings of a town, cached with its lane graph.

    A town without sidewalks has an empty network. A crosswalk that does not lead from sidewalk to sidewalk is left out.
    """
    if "sidewalks" not in graph.cache:
        graph.cache["sidewalks"] = _Builder(graph).network()
    network: SidewalkNetwork = graph.cache["sidewalks"]
    return network


@dataclass(frozen=True)
class _Samples:
    """Points of lanes of one kind: their lanes [M], arc lengths [M], places [M, 2] and headings [M]."""

    lane: I32
    s: F64
    xy: F64
    yaw: F64


class _Builder:
    """Builder of the network of one lane graph."""

    def __init__(self, graph: LaneGraph) -> None:
        self.graph = graph
        self.walkways = self._sample(LaneType.SIDEWALK)
        self.driving = self._sample(LaneType.DRIVING)
        self.crossings: list[Crossing] = []
        self.marked: list[tuple[int, F64]] = []  # road and middle of each crossing on a crosswalk
        self.cuts: dict[int, list[float]] = {}

    def network(self) -> SidewalkNetwork:
        if not len(self.walkways.lane):
            return SidewalkNetwork(np.zeros((0, 2)), (), ())
        for index in range(len(self.graph.crosswalk_offset) - 1):
            self._add_crosswalk(index)
        for road, centre, first, second in self._arms():
            if not any(road == other and math.dist(centre, middle) <= BESIDE for other, middle in self.marked):
                self._add(first, second, UNMARKED_WIDTH, -1)
        return self._joined()

    def _sample(self, kind: LaneType) -> _Samples:
        lanes = np.flatnonzero(self.graph.kind == kind)
        positions = [
            np.linspace(0.0, float(self.graph.length[lane]), max(int(self.graph.length[lane] / _SAMPLE), 1) + 1)
            for lane in lanes
        ]
        rows = [self.graph.along(int(lane), values) for lane, values in zip(lanes, positions, strict=True)]
        poses = np.concatenate([np.zeros((0, 4)), *rows])
        counts = [len(values) for values in positions]
        return _Samples(
            np.repeat(lanes, counts).astype(np.int32),
            np.concatenate([np.zeros(0), *positions]),
            poses[:, :2],
            poses[:, 2],
        )

    def _add_crosswalk(self, index: int) -> None:
        """Add the crossing along a crosswalk, at right angles to the nearest driving lane."""
        corners = self.graph.crosswalk(index).astype(np.float64)
        centre = 0.5 * (corners.min(axis=0) + corners.max(axis=0))
        nearest = int(np.argmin(np.hypot(*(self.driving.xy - centre).T)))
        yaw = float(self.driving.yaw[nearest])
        axis = np.array([-math.sin(yaw), math.cos(yaw)])
        extent = (corners - centre) @ axis
        width = float(np.ptp((corners - centre) @ [math.cos(yaw), math.sin(yaw)]))
        feet = []
        for end, side in ((float(extent.min()), -1.0), (float(extent.max()), 1.0)):
            distances = np.hypot(*(self.walkways.xy - (centre + end * axis)).T)
            distances[((self.walkways.xy - centre) @ axis) * side <= 0.0] = np.inf
            row = int(np.argmin(distances))
            if distances[row] > REACH:
                return
            feet.append((int(self.walkways.lane[row]), float(self.walkways.s[row])))
        self._add(feet[0], feet[1], width, index)

    def _arms(self) -> Iterator[tuple[int, F64, tuple[int, float], tuple[int, float]]]:
        """Yield the road of each arm of a junction, its middle, and places on the sidewalks to its right and left."""
        graph = self.graph
        mouths: dict[tuple[int, int, bool], list[tuple[float, float, float]]] = {}
        signalled = set(graph.stop_lane[~graph.signal_virtual[graph.stop_signal]].tolist())
        calm: dict[tuple[int, int, bool], bool] = {}
        for lane in np.flatnonzero((graph.kind == LaneType.DRIVING) & (graph.junction < 0)).tolist():
            for is_end, neighbours in ((True, graph.successors(lane)), (False, graph.predecessors(lane))):
                junctions = graph.junction[neighbours]
                if (junctions >= 0).any():
                    end_of_road = bool(graph.forward[lane]) == is_end
                    key = (int(graph.road[lane]), int(junctions.max()), end_of_road)
                    x, y, yaw, _ = graph.at(lane, float(graph.length[lane]) if is_end else 0.0)
                    is_calm = bool(graph.speed_limit[lane] <= MAX_SPEED_LIMIT) or lane in signalled
                    calm[key] = calm.get(key, False) or is_calm
                    # all headings of an arm lead into the junction
                    mouths.setdefault(key, []).append((x, y, yaw if is_end else wrap_scalar(yaw + math.pi)))
        for key, poses in mouths.items():
            if not calm[key]:
                continue
            centre = np.mean([pose[:2] for pose in poses], axis=0)
            yaw = poses[0][2]
            feet: dict[bool, tuple[float, tuple[int, float]]] = {}
            beside = (graph.kind == LaneType.SIDEWALK) & (graph.road == key[0])
            for lane in np.flatnonzero(beside & (graph.junction < 0)).tolist():
                length = float(graph.length[lane])
                for end, foot in ((0.0, min(SETBACK, length)), (length, max(length - SETBACK, 0.0))):
                    x, y, _, _ = graph.at(lane, end)
                    is_left = math.cos(yaw) * (y - centre[1]) - math.sin(yaw) * (x - centre[0]) > 0.0
                    distance = math.dist((x, y), centre)
                    if distance < feet.get(is_left, (MAX_LENGTH, ()))[0]:
                        feet[is_left] = distance, (lane, foot)
            if len(feet) == 2 and feet[False][1][0] != feet[True][1][0]:
                yield key[0], centre, feet[False][1], feet[True][1]

    def _add(self, first: tuple[int, float], second: tuple[int, float], width: float, crosswalk: int) -> None:
        xy = np.array([self.graph.at(*first)[:2], self.graph.at(*second)[:2]], np.float64)
        lanes = self._crossed_lanes(xy)
        if not lanes or math.dist(*xy.tolist()) > MAX_LENGTH:
            return
        self.crossings.append(Crossing(xy, width, crosswalk, lanes))
        for lane, position in (first, second):
            self.cuts.setdefault(lane, []).append(position)
        if crosswalk >= 0:
            self.marked += [(int(road), xy.mean(axis=0)) for road in np.unique(self.graph.road[list(lanes)])]

    def _crossed_lanes(self, xy: F64) -> tuple[int, ...]:
        """Return the driving lanes whose centre line intersects the segment between two points [2, 2]."""
        way = xy[1] - xy[0]
        length = float(np.hypot(*way))
        offset = self.driving.xy - xy[0]
        along, beside = offset @ way / length, (offset[:, 1] * way[0] - offset[:, 0] * way[1]) / length
        changes = (beside[:-1] > 0.0) != (beside[1:] > 0.0)
        inside = (0.5 * (along[:-1] + along[1:]) >= 0.0) & (0.5 * (along[:-1] + along[1:]) <= length)
        is_crossed = changes & inside & (self.driving.lane[:-1] == self.driving.lane[1:])
        return tuple(int(lane) for lane in np.unique(self.driving.lane[:-1][is_crossed]))

    def _joined(self) -> SidewalkNetwork:
        """Return the network of the sidewalks, cut where crossings begin, and of the crossings."""
        nodes: list[F64] = []

        def node_at(point: F64) -> int:
            distances = np.hypot(*(np.array(nodes).reshape(-1, 2) - point).T)
            if len(nodes) and distances.min() <= JOIN:
                return int(distances.argmin())
            nodes.append(point)
            return len(nodes) - 1

        edges: list[SidewalkEdge] = []
        for lane in np.unique(self.walkways.lane):
            rows = self.walkways.lane == lane
            arc_lengths, points = self.walkways.s[rows], self.walkways.xy[rows]
            width = float(self.graph.width[self.graph.points(int(lane))].mean())
            cuts = sorted({0.0, *self.cuts.get(int(lane), []), float(arc_lengths[-1])})
            for low, high in itertools.pairwise(cuts):
                within = points[(arc_lengths > low) & (arc_lengths < high)]
                ends = self.graph.along(int(lane), [low, high])[:, :2]
                line = np.concatenate([ends[:1], within, ends[1:]])
                link = node_at(line[0]), node_at(line[-1])
                if link[0] != link[1] or _length(line) > 2.0 * JOIN:
                    edges.append(SidewalkEdge(link, line, width, lane=int(lane)))
        for index, crossing in enumerate(self.crossings):
            link = node_at(crossing.xy[0]), node_at(crossing.xy[1])
            edges.append(SidewalkEdge(link, crossing.xy, crossing.width, crossing=index))
        edges += self._corners(np.array(nodes), edges)
        return SidewalkNetwork(np.array(nodes), tuple(edges), tuple(self.crossings))

    def _corners(self, node_xy: F64, edges: list[SidewalkEdge]) -> list[SidewalkEdge]:
        """Return edges between dead ends, the nearest pairs first, each dead end at most once."""
        degree = np.bincount([node for edge in edges for node in edge.nodes], minlength=len(node_xy))
        dead_ends = np.flatnonzero(degree == 1)
        pairs = [
            (math.dist(node_xy[first], node_xy[second]), int(first), int(second))
            for first, second in itertools.combinations(dead_ends, 2)
        ]
        widths = {node: edge.width for edge in edges for node in edge.nodes}
        linked = {tuple(sorted(edge.nodes)) for edge in edges}
        corners: list[SidewalkEdge] = []
        joined: set[int] = set()
        for distance, first, second in sorted(pairs):
            if distance > GAP:
                break
            line = node_xy[[first, second]]
            if joined & {first, second} or (first, second) in linked or self._crossed_lanes(line):
                continue
            joined |= {first, second}
            corners.append(SidewalkEdge((first, second), line, min(widths[first], widths[second])))
        return corners


def _length(line: F64) -> float:
    return float(np.hypot(*np.diff(line, axis=0).T).sum())


def _resampled(line: F64, spacing: float) -> F64:
    """Return points on a polyline, at most `spacing` m apart, both ends included."""
    arc_lengths = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(line, axis=0).T))])
    positions = np.linspace(0.0, arc_lengths[-1], max(math.ceil(arc_lengths[-1] / spacing), 1) + 1)
    return np.column_stack([np.interp(positions, arc_lengths, column) for column in line.T])


def _heading(xy: F64) -> F64:
    """Return the heading at each point of a path [N], rad: that of the step to the next point."""
    steps = np.diff(xy, axis=0)
    heading = np.arctan2(steps[:, 1], steps[:, 0])
    return np.concatenate([heading, heading[-1:]])
