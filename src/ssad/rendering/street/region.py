"""Paved regions of a town: signed distances on a raster, and meshes of such regions without cracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from ssad.core.errors import MapError
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import LaneType
from ssad.rendering.meshes.mesh import F64, I32
from ssad.world.roads.query import segments

MARGIN = 60.0  # m around the lanes that belong to the town
REACH = 10.0  # m up to which distances are exact
HOLE = 200.0  # m^2: smaller gaps between the lanes of a junction are paved
DRIVE = (LaneType.DRIVING, LaneType.PARKING)
BESIDE = (LaneType.SHOULDER, LaneType.BIKING)
WALK = (LaneType.SIDEWALK, LaneType.MEDIAN)
Grid = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Ground:
    """Signed distances at the nodes [ny + 1, nx + 1] of a raster of 1 m; negative inside, at most `REACH`, m.

    Attributes:
        origin: x, y of the first node, whole metres.
        road: Driving lanes, shoulders and junctions.
        walk: Sidewalks.
        drive: Only driving lanes and junctions.
        paved: Road and sidewalk.
        inner: Open ground that streets enclose.
    """

    origin: tuple[float, float]
    road: Grid
    walk: Grid
    drive: Grid
    paved: Grid
    inner: npt.NDArray[np.bool_]

    def open(self) -> Grid:
        """Return the distance from the paved ground; inside it, 0.5 m minus the depth below its edge."""
        inside = self.paved <= 0.05
        depth = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 5).astype(np.float64)
        return np.where(inside, 0.5 - depth, self.paved)

    def at(self, field: Grid, xy: npt.ArrayLike) -> F64:
        """Interpolate a field bilinearly at points [n, 2]; `REACH` outside the raster."""
        points = np.asarray(xy, np.float64).reshape(-1, 2) - np.array(self.origin)
        ny, nx = np.array(field.shape) - 1
        is_inside = (points[:, 0] >= 0) & (points[:, 0] < nx) & (points[:, 1] >= 0) & (points[:, 1] < ny)
        # Points outside read a valid node; their value is replaced below.
        x, y = np.where(is_inside, points[:, 0], 0.0), np.where(is_inside, points[:, 1], 0.0)
        column, row = x.astype(int), y.astype(int)
        x_share, y_share = x - column, y - row
        lower = (1.0 - x_share) * field[row, column] + x_share * field[row, column + 1]
        upper = (1.0 - x_share) * field[row + 1, column] + x_share * field[row + 1, column + 1]
        return np.asarray(np.where(is_inside, (1.0 - y_share) * lower + y_share * upper, REACH))


def survey(graph: LaneGraph) -> Ground:
    """Compute the distance fields of a flat town.

    Raises:
        MapError: The town has bridges or hills, or no drivable lane.
    """
    driving = graph.kind == LaneType.DRIVING
    if not driving.any():
        raise MapError(f"town '{graph.name}': no drivable lane; choose another town")
    if float(np.ptp(graph.z)) > 1.0:
        raise MapError(
            f"town '{graph.name}': it is not flat (heights differ by {np.ptp(graph.z):.1f} m); streets are "
            "built for flat towns only, choose another"
        )
    lower_corner = np.floor(graph.xy.min(axis=0) - MARGIN)
    # Multiples of 32 m divide evenly into the squares of `region_mesh`.
    size = np.ceil((graph.xy.max(axis=0) + MARGIN - lower_corner) / 32.0).astype(int) * 32
    nx, ny = size.tolist()
    if nx * ny > 6e7:
        raise MapError(f"town '{graph.name}': {nx} x {ny} m is too large to be built; cut the map")
    drive = _distance(graph, DRIVE, lower_corner, (nx, ny))
    road = np.minimum(drive, _distance(graph, BESIDE, lower_corner, (nx, ny), inwards=1.0))
    walk = _distance(graph, WALK, lower_corner, (nx, ny))
    # Gaps between the lanes through a junction are road too.
    label_count, labels, stats, _ = cv2.connectedComponentsWithStats(
        (np.minimum(road, walk) > 0.0).astype(np.uint8), connectivity=4
    )
    is_small = np.zeros(label_count, bool)
    is_small[1:] = stats[1:, cv2.CC_STAT_AREA] < HOLE
    is_hole = is_small[labels]
    road[is_hole], drive[is_hole] = -0.5, -0.5
    border_labels = np.unique(np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]]))
    is_inner = (labels > 0) & ~np.isin(labels, border_labels) & ~is_hole
    # Nothing is built on ground without access on foot: islands of roundabouts, ground between carriageways and ramps.
    walkable = np.unique(labels[cv2.dilate((walk < 0.5).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0])
    is_inner &= np.isin(labels, walkable)
    return Ground((float(lower_corner[0]), float(lower_corner[1])), road, walk, drive, np.minimum(road, walk), is_inner)


def _distance(
    graph: LaneGraph, kinds: Sequence[LaneType], low: F64, size: tuple[int, int], *, inwards: float = 0.0
) -> Grid:
    """Signed distance from the strips of lanes at the nodes of the raster."""
    field = np.full((size[1] + 1, size[0] + 1), REACH)
    lane_segments, half_widths, segment_lanes, _ = segments(graph, tuple(int(lane_type) for lane_type in kinds))
    if not len(lane_segments):
        return field
    end_points = lane_segments.reshape(-1, 2, 2).astype(np.float64) - low
    widths = half_widths.astype(np.float64)
    if inwards:
        # Narrow strips reach under the neighbouring lane, so that no ridge of the distance lies along their border.
        directions = end_points[:, 1] - end_points[:, 0]
        normals = (
            np.stack([-directions[:, 1], directions[:, 0]], axis=1) / np.maximum(np.hypot(*directions.T), 1e-9)[:, None]
        )
        has_left = graph.left[segment_lanes] >= 0
        signs = np.where(has_left & (graph.kind[graph.left[segment_lanes]] == LaneType.DRIVING), inwards, -inwards)
        end_points += (signs[:, None] * normals)[:, None, :]
        widths += inwards
    margins = widths.max(axis=1)[:, None] + REACH
    first_node = np.maximum(np.ceil(end_points.min(axis=1) - margins).astype(np.int64), 0)
    last_node = np.minimum(np.floor(end_points.max(axis=1) + margins).astype(np.int64), np.array(size))
    node_counts = last_node - first_node + 1
    # Chunks bound the memory of the node lists.
    for chunk in np.array_split(np.arange(len(lane_segments)), max(1, len(lane_segments) // 1500)):
        count = node_counts[chunk, 0] * node_counts[chunk, 1]
        segment = np.repeat(chunk, count)
        node_in_segment = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
        ix, iy = (
            first_node[segment, 0] + node_in_segment % node_counts[segment, 0],
            first_node[segment, 1] + node_in_segment // node_counts[segment, 0],
        )
        starts, vectors = end_points[segment, 0], end_points[segment, 1] - end_points[segment, 0]
        px, py = ix - starts[:, 0], iy - starts[:, 1]
        dx, dy = vectors[:, 0], vectors[:, 1]
        share = np.clip((px * dx + py * dy) / np.maximum(dx * dx + dy * dy, 1e-12), 0.0, 1.0)
        distances = np.sqrt((px - share * dx) ** 2 + (py - share * dy) ** 2) - (
            widths[segment, 0] + share * (widths[segment, 1] - widths[segment, 0])
        )
        np.minimum.at(field, (iy, ix), distances)
    return field


def region_mesh(field: Grid, *, largest: int = 16) -> tuple[F64, I32]:
    """Triangulate the region where a field at the nodes of a raster is negative.

    Cells inside are joined to squares of up to `largest` cells (a power of two that divides the raster); at the
    edge, the zero line of the field is followed cell by cell. No edge contains a vertex of a neighbour: there
    are no cracks.

    Returns:
        Vertices [V, 2] in cells, and faces [F, 3].
    """
    is_inside = field < 0.0
    ny, nx = field.shape[0] - 1, field.shape[1] - 1
    corners = np.stack([is_inside[:-1, :-1], is_inside[:-1, 1:], is_inside[1:, 1:], is_inside[1:, :-1]])
    is_full, is_touched = corners.all(axis=0), corners.any(axis=0)
    leaves: list[tuple[int, I32]] = []
    uncovered = is_full.copy()
    # Quadtree from coarse to fine: each size takes the squares that larger ones left.
    side = largest
    while side >= 1:
        blocks = uncovered.reshape(ny // side, side, nx // side, side).all(axis=(1, 3))
        positions = np.argwhere(blocks).astype(np.int32) * side
        leaves.append((side, positions))
        uncovered &= ~np.kron(blocks, np.ones((side, side), bool)) if side > 1 else ~blocks
        side //= 2
    is_vertex = np.zeros(field.shape, bool)
    for side, cells in leaves:
        for dy, dx in ((0, 0), (0, side), (side, side), (side, 0)):
            is_vertex[cells[:, 0] + dy, cells[:, 1] + dx] = True
    mixed_cells = np.argwhere(is_touched & ~is_full).astype(np.int32)
    for dy, dx in ((0, 0), (0, 1), (1, 1), (1, 0)):
        node_ids = mixed_cells + np.array([dy, dx], np.int32)
        node_inside = is_inside[node_ids[:, 0], node_ids[:, 1]]
        is_vertex[node_ids[node_inside, 0], node_ids[node_inside, 1]] = True
    faces = [_squares(is_vertex, side, cells) for side, cells in leaves if len(cells)]
    edge_faces, crossing_points = _edges(field, is_inside, mixed_cells)
    if len(mixed_cells):
        faces.append(edge_faces)
    all_faces = np.concatenate(faces) if faces else np.zeros((0, 3), np.int64)
    row_length = nx + 1
    node_ids, inverse = np.unique(all_faces, return_inverse=True)
    is_grid_node = node_ids < field.size
    vertices = np.zeros((len(node_ids), 2))
    vertices[is_grid_node] = np.stack(
        [node_ids[is_grid_node] % row_length, node_ids[is_grid_node] // row_length], axis=1
    )
    vertices[~is_grid_node] = crossing_points[node_ids[~is_grid_node] - field.size]
    return vertices, np.asarray(inverse).reshape(-1, 3).astype(np.int32)


def _squares(is_used: npt.NDArray[np.bool_], k: int, at: I32) -> npt.NDArray[np.int64]:
    """Triangles of squares of k cells with corners at [n, 2] (row, column): two, or a fan by finer neighbours."""
    row_length = is_used.shape[1]
    steps = np.arange(k)
    border = np.concatenate(
        [
            np.stack([0 * steps, steps], 1),
            np.stack([steps, k + 0 * steps], 1),
            np.stack([k + 0 * steps, k - steps], 1),
            np.stack([k - steps, 0 * steps], 1),
        ]
    )
    nodes = at[:, None, :].astype(np.int64) + border[None]
    node_ids = nodes[..., 0] * row_length + nodes[..., 1]
    is_vertex = is_used[nodes[..., 0], nodes[..., 1]]
    is_plain = is_vertex.sum(axis=1) == 4
    corner_ids = node_ids[is_plain][:, [0, k, 2 * k, 3 * k]]
    faces = [corner_ids[:, [0, 1, 2]], corner_ids[:, [0, 2, 3]]]
    if not is_plain.all():
        node_ids, is_vertex = node_ids[~is_plain], is_vertex[~is_plain]
        centre_ids = node_ids[:, 0] + (k // 2) * (row_length + 1)
        next_ids = node_ids[:, 0].copy()  # position 0 is a corner: the first after the last
        # Backwards around the border, so that the next vertex of each position is known.
        for position in range(4 * k - 1, -1, -1):
            has_vertex = is_vertex[:, position]
            faces.append(
                np.stack([node_ids[has_vertex, position], next_ids[has_vertex], centre_ids[has_vertex]], axis=1)
            )
            next_ids[has_vertex] = node_ids[has_vertex, position]
    return np.concatenate(faces)


def _edges(field: Grid, is_inside: npt.NDArray[np.bool_], mixed: I32) -> tuple[npt.NDArray[np.int64], F64]:
    """Triangulate the cells that the zero line crosses.

    Crossing 2 * node lies on the edge to the right of a node, 2 * node + 1 on the edge above it.

    Returns:
        Faces, in which crossings are numbered after the nodes, and the positions of the crossings.
    """
    row_length, node_count = field.shape[1], field.size
    row, column = mixed[:, 0].astype(np.int64), mixed[:, 1].astype(np.int64)
    corners = [
        row * row_length + column,
        row * row_length + column + 1,
        (row + 1) * row_length + column + 1,
        (row + 1) * row_length + column,
    ]
    edge_crossings = [
        node_count + 2 * corners[0],
        node_count + 2 * corners[1] + 1,
        node_count + 2 * corners[3],
        node_count + 2 * corners[0] + 1,
    ]
    values, signs = field.reshape(-1), is_inside.reshape(-1)
    ring_ids = np.stack(
        [
            corners[0],
            edge_crossings[0],
            corners[1],
            edge_crossings[1],
            corners[2],
            edge_crossings[2],
            corners[3],
            edge_crossings[3],
        ],
        axis=1,
    )
    is_present = np.zeros(ring_ids.shape, bool)
    for corner in range(4):
        is_present[:, 2 * corner] = signs[corners[corner]]
        is_present[:, 2 * corner + 1] = signs[corners[corner]] != signs[corners[(corner + 1) % 4]]
    crossing_points = np.zeros((2 * node_count, 2))
    for edge_ids, first_node, second_node in (
        (edge_crossings[0], corners[0], corners[1]),
        (edge_crossings[1], corners[1], corners[2]),
        (edge_crossings[2], corners[3], corners[2]),
        (edge_crossings[3], corners[0], corners[3]),
    ):
        is_crossed = signs[first_node] != signs[second_node]
        from_node, to_node = first_node[is_crossed], second_node[is_crossed]
        # A crossing on a node would give triangles without area.
        share = np.clip(values[from_node] / (values[from_node] - values[to_node]), 0.01, 0.99)
        crossing_points[edge_ids[is_crossed] - node_count, 0] = (1 - share) * (from_node % row_length) + share * (
            to_node % row_length
        )
        crossing_points[edge_ids[is_crossed] - node_count, 1] = (1 - share) * (from_node // row_length) + share * (
            to_node // row_length
        )
    # A stable sort moves the present corners to the front and keeps their order around the cell.
    ring_order = np.argsort(~is_present, axis=1, kind="stable")
    rings = np.take_along_axis(ring_ids, ring_order, axis=1)
    ring_sizes = is_present.sum(axis=1)
    faces = [rings[ring_sizes > corner + 1][:, [0, corner, corner + 1]] for corner in range(1, 5)]
    return np.concatenate(faces), crossing_points
