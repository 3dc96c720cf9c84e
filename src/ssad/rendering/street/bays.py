"""Parking bays: a strip of the pavement beside the road that is paved for parked vehicles and outlined in white."""

from __future__ import annotations

import numpy as np

from ssad.core.lane_graph import LaneGraph
from ssad.core.rotations import wrap_scalar
from ssad.core.types import LaneType
from ssad.rendering.meshes.mesh import F64
from ssad.rendering.street.free_ground import FreeGround, footprint
from ssad.rendering.street.model import MID, NEAR
from ssad.rendering.street.palette import TownMaterials
from ssad.rendering.street.paving import KERB
from ssad.rendering.street.triangles import TriangleBuilder, box, join

Row = tuple[float, float, float, float, float]

SPACING = 6.5  # m between places
END = 9.0  # m from the ends of a street without a bay
WALKWAY = 0.9  # m of pavement left beside a bay
LEAST_DEPTH, MAX_DEPTH = 2.0, 2.7  # m
MAX_TURN = 0.1  # rad along a place: bays are straight
STEP = 0.5  # m between the stations at which the ground is tested
LINE = 0.1  # m, width of the outline
FRONT = 0.12  # m between the border of the road and a bay
ABOVE = 0.008  # m above the pavement
CROSSING = 5.0  # m from a crosswalk to a bay
SHARE = 0.8  # of the sides of streets with bays, where there is room


def lay_bays(triangles: TriangleBuilder, ground: FreeGround, materials: TownMaterials) -> list[Row]:
    """Lay bays along the streets whose pavement is wide enough, where nothing stands; return `Street.bays`."""
    graph, rows = ground.graph, []
    for lane in np.flatnonzero((graph.kind == LaneType.SHOULDER) & (graph.junction < 0)).tolist():
        depth = _depth(graph, lane)
        if depth < LEAST_DEPTH or materials.details.random() > SHARE:
            continue
        for first, last in _free_runs(ground, lane, depth):
            rows += _lay_bay(triangles, graph, materials, lane=lane, stations=(first, last), depth=depth)
    return rows


def _depth(graph: LaneGraph, lane: int) -> float:
    """Return the depth of bays on a shoulder and the pavement beside it, m; 0: there is no room for any."""
    sidewalk, road = int(graph.right[lane]), int(graph.left[lane])
    if sidewalk < 0 or graph.kind[sidewalk] != LaneType.SIDEWALK:
        return 0.0
    if road >= 0 and graph.is_divided(road):
        return 0.0  # nobody parks in a roundabout
    room = float(graph.width[graph.points(lane)].min() + graph.width[graph.points(sidewalk)].min())
    return min(MAX_DEPTH, room - WALKWAY)


def _pose(graph: LaneGraph, lane: int, station: float) -> tuple[float, float, float]:
    """Return the pose of the border between a shoulder and its road, with the heading of the traffic."""
    x, y, yaw, width = graph.at(lane, station)
    return x - 0.5 * width * np.sin(yaw), y + 0.5 * width * np.cos(yaw), yaw


def _free_runs(ground: FreeGround, lane: int, depth: float) -> list[tuple[float, float]]:
    """Return the stretches of a shoulder, at least as long as a place, that are straight and free."""
    graph = ground.graph
    stations = np.arange(END, float(graph.length[lane]) - END, STEP)
    is_free = np.zeros(len(stations) + 1, bool)
    for index, station in enumerate(stations.tolist()):
        _, _, yaw_before = _pose(graph, lane, station - 0.5 * SPACING)
        _, _, yaw_after = _pose(graph, lane, station + 0.5 * SPACING)
        if abs(wrap_scalar(yaw_after - yaw_before)) > MAX_TURN:
            continue
        points = footprint(_pose(graph, lane, station), (-0.5 * STEP, 0.5 * STEP), (-depth, -0.1))
        is_free[index] = not ground.is_occupied(points) and bool((ground.crosswalk_distance(points) > CROSSING).all())
    edges = np.flatnonzero(np.diff(is_free.astype(int), prepend=0)).reshape(-1, 2)
    runs = [(float(stations[first]), float(stations[last - 1])) for first, last in edges.tolist()]
    return [(first, last) for first, last in runs if last - first >= SPACING]


def _lay_bay(
    triangles: TriangleBuilder,
    graph: LaneGraph,
    materials: TownMaterials,
    *,
    lane: int,
    stations: tuple[float, float],
    depth: float,
) -> list[Row]:
    """Lay the bay between two stations of a shoulder; return its places."""
    first, last = stations
    count = int((last - first) / SPACING)
    length = (last - first) / count
    rows: list[Row] = []
    for index in range(count):
        middle = first + (index + 0.5) * length
        x, y, yaw = _pose(graph, lane, middle)
        half, top = 0.5 * length, KERB + ABOVE
        slab = box((-half, FRONT, -0.02), (half, depth, top), materials.bay)
        lines: list[F64] = [
            np.array([(-half, depth - LINE, top - 0.02), (half, depth, top + 0.004)]),
            np.array([(-half, 0.3, top - 0.02), (-half + LINE, depth, top + 0.004)]),
        ]
        if index == count - 1:
            lines.append(np.array([(half - LINE, 0.3, top - 0.02), (half, depth, top + 0.004)]))
        paint = box([low for low, _ in lines], [high for _, high in lines], materials.white, levels=NEAR | MID)
        # The frame of a piece has y to the left; the bay lies to the right of the traffic.
        triangles.place(join([slab, paint]), [(x, y, 0.0, yaw + np.pi)])
        rows.append((x, y, yaw, depth, min(middle - first, last - middle)))
    return rows
