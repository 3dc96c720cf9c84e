"""Road markings and wear: lines, stop lines, crosswalks, arrows, patches, manholes."""

from __future__ import annotations

import numpy as np

from ssad.core.lane_graph import LaneGraph, Marking, SignKind
from ssad.core.rotations import wrap_angle
from ssad.core.types import LaneType
from ssad.rendering.meshes.mesh import F64
from ssad.rendering.street.free_ground import place, polygon_distance
from ssad.rendering.street.model import MID, NEAR
from ssad.rendering.street.palette import TownMaterials
from ssad.rendering.street.paving import Edge, lane_edge, ribbon
from ssad.rendering.street.triangles import TriangleBuilder, flat

PAINT = 0.008  # m above the road
WEAR = 0.004  # m above the road: patches lie under paint
LINE = 0.12  # m
DASH, SPACE = 3.0, 6.0  # m
STOP = 0.4  # m
BAR = 0.5  # m, bars of a crosswalk and the gaps between them
VISIBLE = NEAR | MID
_ARROW = {  # polygons of arrows along x from the tail; y to the left
    "ahead": [[(0.0, -0.08), (2.6, -0.08), (2.6, 0.08), (0.0, 0.08)], [(2.6, -0.35), (4.0, 0.0), (2.6, 0.35)]],
    "left": [
        [(0.0, -0.08), (1.9, -0.08), (1.9, 0.08), (0.0, 0.08)],
        [(1.9, -0.08), (2.45, 0.28), (2.3, 0.4), (1.9, 0.08)],
        [(1.95, 0.62), (2.75, 0.05), (2.9, 0.85)],
    ],
}


def paint_markings(triangles: TriangleBuilder, graph: LaneGraph, materials: TownMaterials) -> None:
    """All markings of the town, and wear."""
    driving_lanes = np.flatnonzero((graph.kind == LaneType.DRIVING) & (graph.junction < 0)).tolist()
    for lane in driving_lanes:
        _paint_lines(triangles, graph, lane, materials)
        _paint_wear(triangles, graph, lane, materials)
    stop_sign_lanes = set(graph.rule_lane[graph.sign_kind[graph.rule_sign] == SignKind.STOP].tolist())
    sign_lanes = set(graph.rule_lane.tolist())
    for signal, lane, s in zip(
        graph.stop_signal.tolist(), graph.stop_lane.tolist(), graph.stop_s.tolist(), strict=True
    ):
        if graph.signal_virtual[signal] and lane not in sign_lanes and graph.is_divided(lane):
            continue  # the ring of a roundabout, a motorway
        if graph.kind[lane] == LaneType.DRIVING:
            give_way = bool(graph.signal_virtual[signal]) and lane not in stop_sign_lanes
            _paint_stop_line(triangles, graph, lane, s, give_way=give_way, materials=materials)
    for crosswalk in range(len(graph.crosswalk_offset) - 1):
        _paint_crosswalk(triangles, graph.crosswalk(crosswalk).astype(np.float64), materials)


def _paint_lines(triangles: TriangleBuilder, graph: LaneGraph, lane: int, materials: TownMaterials) -> None:
    """Lines at both sides of a lane; a line between two lanes is painted by the lower of them."""
    for share, marking, neighbour in (
        (1.0, int(graph.left_marking[lane]), int(graph.left[lane])),
        (0.0, int(graph.right_marking[lane]), int(graph.right[lane])),
    ):
        shares_line = neighbour >= 0 and graph.kind[neighbour] == LaneType.DRIVING
        if marking in (Marking.NONE, Marking.CURB) or (shares_line and neighbour < lane):
            continue
        oncoming = shares_line and not graph.is_same_direction(lane, neighbour)
        material = materials.centre if oncoming else materials.white
        edge = _between_crosswalks(graph, lane_edge(graph, lane, share))
        if edge is None:
            continue
        # Lines between a lane and the shoulder lie within the lane.
        inset = 0.0 if shares_line else (0.06 + LINE / 2) * (1.0 if share == 0.0 else -1.0)
        if marking == Marking.BROKEN:
            _paint_dashes(triangles, edge, inset, material)
        elif marking == Marking.DOUBLE:
            for lateral in (-LINE, LINE):
                _paint_strip(triangles, edge, lateral, material)
        else:
            _paint_strip(triangles, edge, inset, material)


def _between_crosswalks(graph: LaneGraph, edge: Edge) -> Edge | None:
    """Return the part of a line between the crosswalks at its ends, or None if nothing remains."""
    samples = np.arange(0.0, float(edge.s[-1]), 0.25)
    sample_points = np.stack([np.interp(samples, edge.s, edge.xy[:, column]) for column in range(2)], axis=1)
    lower, upper, length = 0.0, float(edge.s[-1]), float(edge.s[-1])
    for column in range(len(graph.crosswalk_offset) - 1):
        corners = graph.crosswalk(column).astype(np.float64)
        centre = corners.mean(axis=0)
        if min(np.hypot(*(centre - edge.xy[0])), np.hypot(*(centre - edge.xy[-1]))) > 12.0:
            continue
        covered = samples[polygon_distance(sample_points, corners) < 0.3]
        if len(covered) and covered[0] < 0.5 * length:
            lower = max(lower, float(covered[-1]) + 0.1)
        elif len(covered):
            upper = min(upper, float(covered[0]) - 1.2)
    if upper - lower < 1.0:
        return None
    inner_s = edge.s[(edge.s > lower + 0.05) & (edge.s < upper - 0.05)]
    s = np.concatenate([[lower], inner_s, [upper]])
    yaw = np.interp(s, edge.s, np.unwrap(edge.yaw))
    xy = np.stack([np.interp(s, edge.s, edge.xy[:, column]) for column in range(2)], axis=1)
    return Edge(edge.lane, xy, yaw, s - lower)


def _paint_strip(
    triangles: TriangleBuilder, edge: Edge, offset: float, material: int, *, width: float = LINE, z: float = PAINT
) -> None:
    """A line along an edge, `offset` m to its left."""
    centre_line = edge.xy + offset * edge.normal
    half_width = 0.5 * width * edge.normal
    triangles.add(ribbon(centre_line + half_width, centre_line - half_width, (z, z), material, levels=VISIBLE))


def _paint_dashes(triangles: TriangleBuilder, edge: Edge, offset: float, material: int) -> None:
    """Dashes that begin and end with half a space."""
    period = DASH + SPACE
    count = max(1, round(float(edge.s[-1]) / period))
    starts = (np.arange(count) + 0.5) * float(edge.s[-1]) / count - DASH / 2
    # Each dash has a middle point, so that it follows bends of the road.
    cut_s = np.stack([starts, starts + DASH / 2, starts + DASH], axis=1).clip(0.0, edge.s[-1])
    xy = np.stack(
        [np.interp(cut_s, edge.s, edge.xy[:, column] + offset * edge.normal[:, column]) for column in range(2)], axis=-1
    )
    normal = np.stack([np.interp(cut_s, edge.s, edge.normal[:, column]) for column in range(2)], axis=-1) * 0.5 * LINE
    left, right = xy + normal, xy - normal
    quads = [
        np.stack([right[:, column], right[:, column + 1], left[:, column + 1], left[:, column]], axis=1)
        for column in range(2)
    ]
    _add_polygons(triangles, np.concatenate(quads), material)


def _add_polygons(
    triangles: TriangleBuilder, corners: F64, material: int, *, z: float = PAINT, levels: int = VISIBLE
) -> None:
    """Flat polygons [n, k, 2] on the road."""
    triangles.add(flat(np.concatenate([corners, np.full((*corners.shape[:2], 1), z)], axis=2), material, levels=levels))


def _paint_stop_line(
    triangles: TriangleBuilder,
    graph: LaneGraph,
    lane: int,
    arc_length: float,
    *,
    give_way: bool,
    materials: TownMaterials,
) -> None:
    """A stop line across a lane, or the teeth of a give-way line; and arrows on multi-lane arms.

    give_way: no signal or stop sign stands here.
    """
    x, y, yaw, width = graph.at(lane, arc_length)
    half_width = 0.5 * width - 0.12
    if give_way:
        tooth_offsets = np.arange(-half_width, half_width - 0.3, 0.75)[:, None, None]
        tooth = np.array([[0.5, 0.0], [0.5, 0.44], [0.0, 0.22]])
        _add_polygons(triangles, place((x, y, yaw), tooth + tooth_offsets * [0.0, 1.0]), materials.white)
    else:
        bar = np.array([[[0.0, -half_width], [STOP, -half_width], [STOP, half_width], [0.0, half_width]]])
        _add_polygons(triangles, place((x, y, yaw), bar), materials.white)
    neighbours = [int(neighbour) for neighbour in (graph.left[lane], graph.right[lane]) if neighbour >= 0]
    if (
        any(
            graph.kind[neighbour] == LaneType.DRIVING and graph.is_same_direction(lane, neighbour)
            for neighbour in neighbours
        )
        and arc_length > 30.0
    ):
        _paint_arrows(triangles, graph, lane, arc_length, materials)


def _paint_arrows(
    triangles: TriangleBuilder, graph: LaneGraph, lane: int, arc_length: float, materials: TownMaterials
) -> None:
    """Arrows for the turns that a lane leads to, twice before the stop line."""
    directions = set()
    for successor in graph.successors(lane).tolist():
        points = graph.points(successor)
        turn_angle = float(wrap_angle(graph.yaw[points.stop - 1] - graph.yaw[points.start]))
        directions.add("ahead" if abs(turn_angle) < 0.5 else "left" if turn_angle > 0 else "right")
    for distance in (9.0, 24.0):
        x, y, yaw, _ = graph.at(lane, arc_length - distance)
        for direction in sorted(directions):
            for polygon in _ARROW["ahead" if direction == "ahead" else "left"]:
                polygon_points = np.array([polygon])
                if direction == "right":
                    polygon_points = polygon_points[:, ::-1] * [1.0, -1.0]
                _add_polygons(triangles, place((x, y, yaw), polygon_points), materials.white)


def _paint_crosswalk(triangles: TriangleBuilder, corners: F64, materials: TownMaterials) -> None:
    """Bars along the traffic, over a rectangle [4, 2]: along its shorter sides."""
    if len(corners) != 4:
        return
    first_side, second_side = corners[1] - corners[0], corners[3] - corners[0]
    along, across = (
        (first_side, second_side) if np.hypot(*first_side) < np.hypot(*second_side) else (second_side, first_side)
    )
    span = float(np.hypot(*across))
    unit = across / span
    count = int((span - 0.5) // (2 * BAR))
    bar_starts = 0.5 * (span - (2 * count - 1) * BAR) + 2 * BAR * np.arange(count)
    bar_corners = corners[0] + bar_starts[:, None] * unit
    quads = np.stack(
        [bar_corners, bar_corners + along, bar_corners + along + BAR * unit, bar_corners + BAR * unit], axis=1
    )
    # Faces must be counter-clockwise seen from above, whichever way the rectangle runs.
    if along[0] * unit[1] - along[1] * unit[0] < 0.0:
        quads = quads[:, ::-1]
    _add_polygons(triangles, quads, materials.white)


def _paint_wear(triangles: TriangleBuilder, graph: LaneGraph, lane: int, materials: TownMaterials) -> None:
    """Lighter wheel tracks, repaired patches and manholes on a lane."""
    rng = materials.generator
    for share in (0.27, 0.73):
        _paint_strip(triangles, lane_edge(graph, lane, share), 0.0, materials.worn_paint, width=0.5, z=0.5 * WEAR)
    length = float(graph.length[lane])
    for _ in range(rng.poisson(length / 45.0)):
        x, y, yaw, width = graph.at(lane, float(rng.uniform(2.0, max(2.1, length - 6.0))))
        patch_length, patch_width = rng.uniform(1.0, 4.0), rng.uniform(0.6, 0.8 * width)
        lateral = rng.uniform(-0.5, 0.5) * (width - patch_width)
        lower, upper = lateral - patch_width / 2, lateral + patch_width / 2
        patch = np.array([[[0.0, lower], [patch_length, lower], [patch_length, upper], [0.0, upper]]])
        _add_polygons(triangles, place((x, y, yaw), patch), materials.patch, z=WEAR, levels=NEAR)
    angles = np.arange(8) * np.pi / 4
    disc = 0.32 * np.stack([np.cos(angles), np.sin(angles)], axis=1)[None]
    for _ in range(rng.poisson(length / 40.0)):
        x, y, yaw, width = graph.at(lane, float(rng.uniform(1.0, max(1.1, length - 1.0))))
        cover = place((x, y, yaw), disc + np.array([0.0, rng.uniform(-0.3, 0.3) * width]))
        _add_polygons(triangles, cover, materials.iron, z=1.4 * WEAR, levels=NEAR)
