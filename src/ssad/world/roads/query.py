"""Nearest-lane and off-road queries on a uniform grid; the grid arrays also feed the world's kernels."""

from __future__ import annotations

import weakref
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F32, F64, I32, Bool, LaneType

CELL = 2.0  # m; smaller cells list fewer segments, larger ones need less memory
MARGIN = 3.0  # m outside a lane's edge up to which its cell still answers
_BATCH = 1 << 18  # candidate rows handled at once, keeps them in cache

DRIVABLE = (LaneType.DRIVING, LaneType.PARKING)


@dataclass(frozen=True)
class Nearest:
    """Nearest lanes of n points; unpacks as (lane, s, lateral, inside).

    Attributes:
        lane: Nearest lane [n]; -1 where none is within reach.
        s: Arc length along it [n], m; 0 where lane is -1.
        lateral: Distance from its centre line, left positive [n], m; 0 where lane is -1.
        is_inside: Whether the point is within the lane's strip [n].
    """

    lane: I32
    s: F32
    lateral: F32
    is_inside: Bool

    def __iter__(self) -> Iterator[npt.NDArray[Any]]:
        return iter((self.lane, self.s, self.lateral, self.is_inside))


@dataclass(frozen=True)
class SegmentGrid:
    """Segments of centre lines, and for each cell those that can be the nearest to a point of that cell.

    Nearness is distance from the centre line minus the half width there, so that two lanes of different width meet at
    their common edge. A cell answers exactly for every point up to `MARGIN` outside a lane; it is empty beyond.

    Attributes:
        seg: x0, y0, x1, y1 [M, 4].
        seg_half: Half widths at both ends [M, 2].
        seg_lane: Lane of each segment [M].
        seg_s: Arc length at the first end [M].
        cell_offset: Start of the segments of cell iy*nx+ix, `CELL` m wide, in `cell_seg` [nx*ny+1].
        cell_seg: See `cell_offset`.
        origin: Lower left corner.
        nx: Number of columns.
        ny: Number of rows.
    """

    seg: F32
    seg_half: F32
    seg_lane: I32
    seg_s: F32
    cell_offset: I32
    cell_seg: I32
    origin: tuple[float, float]
    nx: int
    ny: int


class LaneQuery:
    """Batched nearest-lane queries of a town. The grid over lanes of some types is built once and cached."""

    def __init__(self, graph: LaneGraph) -> None:
        self.graph = graph
        self._grids: dict[tuple[int, ...], SegmentGrid] = {}

    def grid(self, types: Sequence[LaneType]) -> SegmentGrid:
        """Return the grid over lanes of the given types."""
        key = tuple(sorted({int(lane_type) for lane_type in types}))
        if key not in self._grids:
            self._grids[key] = grid_of(self.graph, key)
        return self._grids[key]

    def nearest(self, xy: npt.ArrayLike, types: Sequence[LaneType] = DRIVABLE) -> Nearest:
        """Return the nearest lane of the given types to points xy [n, 2], up to `MARGIN` outside a lane's edge."""
        grid = self.grid(types)
        points = np.asarray(xy, np.float32).reshape(-1, 2)
        point_count = len(points)
        lane = np.full(point_count, -1, np.int32)
        arc_length, lateral = np.zeros(point_count, np.float32), np.zeros(point_count, np.float32)
        is_inside = np.zeros(point_count, np.bool_)
        cell_position = np.floor((points - np.array(grid.origin, np.float32)) / np.float32(CELL))
        size = np.array([grid.nx, grid.ny], np.float32)
        in_grid = np.flatnonzero(((cell_position >= 0) & (cell_position < size)).all(axis=1))
        cell = cell_position[in_grid, 1].astype(np.int64) * grid.nx + cell_position[in_grid, 0].astype(np.int64)
        counts = (grid.cell_offset[cell + 1] - grid.cell_offset[cell]).astype(np.int64)
        in_grid, cell, counts = in_grid[counts > 0], cell[counts > 0], counts[counts > 0]
        ends = np.cumsum(counts)
        chunk_start = 0
        while chunk_start < len(in_grid):
            base = ends[chunk_start - 1] if chunk_start else 0
            chunk_stop = max(chunk_start + 1, int(np.searchsorted(ends, base + _BATCH, side="right")))
            chunk = slice(chunk_start, chunk_stop)
            rows, chunk_counts = in_grid[chunk], counts[chunk]
            first = np.concatenate([[0], np.cumsum(chunk_counts)[:-1]])
            entries = np.arange(int(chunk_counts.sum())) - np.repeat(
                first - grid.cell_offset[cell[chunk]], chunk_counts
            )
            segment_index = grid.cell_seg[entries]
            clearance, signed_distance, along = _measure(
                grid, segment_index, np.repeat(points[rows], chunk_counts, axis=0)
            )
            min_gap = np.minimum.reduceat(clearance, first)
            # the first of equally near segments wins: the same on every machine
            winners = np.flatnonzero(clearance == np.repeat(min_gap, chunk_counts))
            owner = np.searchsorted(first, winners, side="right") - 1
            _, unique = np.unique(owner, return_index=True)
            winners = winners[unique]
            within_margin = min_gap <= MARGIN
            rows, winners = rows[within_margin], winners[within_margin]
            lane[rows], arc_length[rows] = grid.seg_lane[segment_index[winners]], along[winners]
            lateral[rows], is_inside[rows] = signed_distance[winners], clearance[winners] <= 0.0
            chunk_start = chunk_stop
        return Nearest(lane, arc_length, lateral, is_inside)

    def off_road(self, xy: npt.ArrayLike) -> Bool:
        """Return whether no driving and no parking lane lies under points xy [n, 2]."""
        return ~self.nearest(xy, DRIVABLE).is_inside


def _measure(grid: SegmentGrid, pick: npt.NDArray[np.int32], xy: F32) -> tuple[F32, F32, F32]:
    """For pairs of segment and point: distance outside the strip, signed distance (left +), arc length."""
    endpoints, half_width = grid.seg[pick], grid.seg_half[pick]
    x_start, y_start = endpoints[:, 0], endpoints[:, 1]
    dx, dy = endpoints[:, 2] - x_start, endpoints[:, 3] - y_start
    rel_x, rel_y = xy[:, 0] - x_start, xy[:, 1] - y_start
    squared_length = np.maximum(dx * dx + dy * dy, np.float32(1e-12))
    share = np.clip((rel_x * dx + rel_y * dy) / squared_length, np.float32(0), np.float32(1))
    distance = np.hypot(rel_x - share * dx, rel_y - share * dy)
    clearance = distance - (half_width[:, 0] + share * (half_width[:, 1] - half_width[:, 0]))
    signed_distance = np.copysign(distance, dx * rel_y - dy * rel_x)
    return clearance, signed_distance, grid.seg_s[pick] + share * np.sqrt(squared_length)


def segments(graph: LaneGraph, types: Sequence[int]) -> tuple[F32, F32, I32, F32]:
    """Return the segments of the centre lines of all lanes of the given types, lane by lane.

    Args:
        graph: The town.
        types: `LaneType` values.

    Returns:
        seg [M, 4]: x0, y0, x1, y1, m; seg_half [M, 2]: half widths at both ends, m; seg_lane [M]: lane; seg_s [M]:
            arc
        length at the first end, m.
    """
    lane = np.repeat(np.arange(graph.lane_count, dtype=np.int32), np.diff(graph.offset))
    is_segment = (lane[:-1] == lane[1:]) & np.isin(graph.kind[lane[:-1]], np.asarray(types, np.uint8))
    index = np.flatnonzero(is_segment)
    endpoints = np.concatenate([graph.xy[index], graph.xy[index + 1]], axis=1)
    half_width = 0.5 * np.stack([graph.width[index], graph.width[index + 1]], axis=1)
    return endpoints, half_width.astype(np.float32), lane[index], graph.s[index]


_GRIDS: dict[tuple[int, tuple[int, ...]], tuple[weakref.ref[LaneGraph], SegmentGrid]] = {}


def grid_of(graph: LaneGraph, types: Sequence[int]) -> SegmentGrid:
    """Return `build_grid`, cached while the town is in memory: worlds of one town are often built by the hundred."""
    # An id can be reused after its graph is freed, so the entry also holds a weak reference.
    key = (id(graph), tuple(int(lane_type) for lane_type in types))
    entry = _GRIDS.get(key)
    if entry is None or entry[0]() is not graph:
        _GRIDS[key] = entry = (weakref.ref(graph, lambda _: _GRIDS.pop(key, None)), build_grid(graph, types))
    return entry[1]


def build_grid(graph: LaneGraph, types: Sequence[int]) -> SegmentGrid:
    """List for each cell the segments that can be nearest to some point of it (see `SegmentGrid`)."""
    endpoints, half_width, lane, arc_length = segments(graph, types)
    if not len(endpoints):
        empty = np.zeros(0, np.int32)
        return SegmentGrid(endpoints, half_width, lane, arc_length, np.zeros(2, np.int32), empty, (0.0, 0.0), 1, 1)
    ends = endpoints.reshape(-1, 2, 2).astype(np.float64)
    max_half_width = half_width.max(axis=1).astype(np.float64)
    reach = max_half_width + MARGIN
    box_low = ends.min(axis=1) - reach[:, None]
    box_high = ends.max(axis=1) + reach[:, None]
    origin = np.floor(box_low.min(axis=0) / CELL) * CELL
    nx, ny = (np.floor((box_high.max(axis=0) - origin) / CELL).astype(int) + 1).tolist()
    first_cell = np.floor((box_low - origin) / CELL).astype(np.int64)
    cell_span = np.floor((box_high - origin) / CELL).astype(np.int64) - first_cell + 1
    count = cell_span[:, 0] * cell_span[:, 1]
    segment_index = np.repeat(np.arange(len(endpoints)), count)
    entry = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
    ix = first_cell[segment_index, 0] + entry % cell_span[segment_index, 0]
    iy = first_cell[segment_index, 1] + entry // cell_span[segment_index, 0]
    centre = (np.stack([ix, iy], axis=1) + 0.5) * CELL + origin
    start, direction = ends[segment_index, 0], ends[segment_index, 1] - ends[segment_index, 0]
    relative = centre - start
    share = np.clip(
        (relative * direction).sum(axis=1) / np.maximum((direction * direction).sum(axis=1), 1e-12), 0.0, 1.0
    )
    residual = relative - share[:, None] * direction
    distance: F64 = np.hypot(residual[:, 0], residual[:, 1])
    # a point of the cell is at most `corner` from its centre: bounds on its distance from each strip
    corner = CELL * np.sqrt(0.5) + 1e-3
    min_half_width = half_width.min(axis=1).astype(np.float64)
    min_distance, max_distance = (
        distance - max_half_width[segment_index] - corner,
        distance - min_half_width[segment_index] + corner,
    )
    cell = iy * nx + ix
    bound = np.full(nx * ny, np.inf)
    # A segment that is nearer at worst than another at best rules that one out.
    np.minimum.at(bound, cell, max_distance)
    selected = (min_distance <= MARGIN) & (min_distance <= bound[cell])
    cell, segment_index = cell[selected], segment_index[selected]
    order = np.lexsort((segment_index, cell))
    offset = np.concatenate([[0], np.cumsum(np.bincount(cell, minlength=nx * ny))]).astype(np.int32)
    lower_left = (float(origin[0]), float(origin[1]))
    return SegmentGrid(
        endpoints, half_width, lane, arc_length, offset, segment_index[order].astype(np.int32), lower_left, nx, ny
    )


def nearest_all(graph: LaneGraph, xy: tuple[float, float], types: Sequence[LaneType]) -> tuple[I32, F64, F64]:
    """Return the distance from one point to every lane of the given types, however far away.

    Every segment is examined, so it suits a few points; see `LaneQuery` for many.

    Args:
        graph: The town.
        xy: The point, m.
        types: Types of lanes to consider.

    Returns:
        lane [n]; arc length of the nearest place on each lane [n], m; distance from each lane's strip [n], m,
            negative
        inside.
    """
    endpoints, half_width, lane, arc_length = segments(graph, tuple(int(share) for share in types))
    start, direction = endpoints[:, :2].astype(np.float64), (endpoints[:, 2:] - endpoints[:, :2]).astype(np.float64)
    offset = np.asarray(xy, np.float64) - start
    squared_length = np.maximum((direction * direction).sum(axis=1), 1e-12)
    share = np.clip((offset * direction).sum(axis=1) / squared_length, 0.0, 1.0)
    residual = offset - share[:, None] * direction
    clearance = np.hypot(residual[:, 0], residual[:, 1]) - (
        half_width[:, 0] + share * (half_width[:, 1] - half_width[:, 0])
    )
    position = arc_length + share * np.sqrt(squared_length)
    order = np.lexsort((clearance, lane))
    first = np.concatenate([[True], np.diff(lane[order]) != 0])
    nearest = order[first]
    return lane[nearest], position[nearest], clearance[nearest]
