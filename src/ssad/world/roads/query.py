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
    """Answer for n points; unpacks as (lane, s, lateral, inside).

    Attributes:
        lane: Nearest lane [n]; -1 where none is within reach.
        s: Arc length along it [n], m; 0 where lane is -1.
        lateral: Distance from its centre line, left positive [n], m; 0 where lane is -1.
        inside: Whether the point is within the lane's strip [n].
    """

    lane: I32
    s: F32
    lateral: F32
    inside: Bool

    def __iter__(self) -> Iterator[npt.NDArray[Any]]:
        return iter((self.lane, self.s, self.lateral, self.inside))


@dataclass(frozen=True)
class Grid:
    """Segments of centre lines, and for each cell those that can be the nearest to a point of that cell.

    Nearness is distance from the centre line minus the half width there, so that two lanes of different width meet at
    their common edge. A cell answers exactly for every point up to `MARGIN` outside a lane; it is empty beyond.

    Attributes:
        seg: x0, y0, x1, y1 [M, 4].
        seg_half: Half widths at both ends [M, 2].
        seg_lane: Lane of each segment [M].
        seg_s: Arc length at the first end [M].
        cell_offset: Where the segments of cell iy*nx+ix, `CELL` m wide, begin in `cell_seg` [nx*ny+1].
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
    """Nearest lane of a town, batched. The grid over lanes of some types is built once and kept."""

    def __init__(self, graph: LaneGraph) -> None:
        self.graph = graph
        self._grids: dict[tuple[int, ...], Grid] = {}

    def grid(self, types: Sequence[LaneType]) -> Grid:
        """The grid over lanes of the given types."""
        key = tuple(sorted({int(t) for t in types}))
        if key not in self._grids:
            self._grids[key] = grid_of(self.graph, key)
        return self._grids[key]

    def nearest(self, xy: npt.ArrayLike, types: Sequence[LaneType] = DRIVABLE) -> Nearest:
        """Nearest lane of the given types to points xy [n, 2], up to `MARGIN` outside a lane's edge."""
        grid = self.grid(types)
        points = np.asarray(xy, np.float32).reshape(-1, 2)
        n = len(points)
        lane = np.full(n, -1, np.int32)
        s, lateral = np.zeros(n, np.float32), np.zeros(n, np.float32)
        inside = np.zeros(n, np.bool_)
        where = np.floor((points - np.array(grid.origin, np.float32)) / np.float32(CELL))
        size = np.array([grid.nx, grid.ny], np.float32)
        known = np.flatnonzero(((where >= 0) & (where < size)).all(axis=1))
        cell = where[known, 1].astype(np.int64) * grid.nx + where[known, 0].astype(np.int64)
        count = (grid.cell_offset[cell + 1] - grid.cell_offset[cell]).astype(np.int64)
        known, cell, count = known[count > 0], cell[count > 0], count[count > 0]
        ends = np.cumsum(count)
        start = 0
        while start < len(known):
            base = ends[start - 1] if start else 0
            stop = max(start + 1, int(np.searchsorted(ends, base + _BATCH, side="right")))
            part = slice(start, stop)
            rows, some = known[part], count[part]
            first = np.concatenate([[0], np.cumsum(some)[:-1]])
            item = np.arange(int(some.sum())) - np.repeat(first - grid.cell_offset[cell[part]], some)
            pick = grid.cell_seg[item]
            gap, side, along = _measure(grid, pick, np.repeat(points[rows], some, axis=0))
            best = np.minimum.reduceat(gap, first)
            # the first of equally near segments wins: the same on every machine
            hit = np.flatnonzero(gap == np.repeat(best, some))
            owner = np.searchsorted(first, hit, side="right") - 1
            _, unique = np.unique(owner, return_index=True)
            hit = hit[unique]
            near = best <= MARGIN
            rows, hit = rows[near], hit[near]
            lane[rows], s[rows] = grid.seg_lane[pick[hit]], along[hit]
            lateral[rows], inside[rows] = side[hit], gap[hit] <= 0.0
            start = stop
        return Nearest(lane, s, lateral, inside)

    def off_road(self, xy: npt.ArrayLike) -> Bool:
        """Whether no driving and no parking lane lies under points xy [n, 2]."""
        return ~self.nearest(xy, DRIVABLE).inside


def _measure(grid: Grid, pick: npt.NDArray[np.int32], xy: F32) -> tuple[F32, F32, F32]:
    """For pairs of segment and point: distance outside the strip, signed distance (left +), arc length."""
    seg, half = grid.seg[pick], grid.seg_half[pick]
    ax, ay = seg[:, 0], seg[:, 1]
    dx, dy = seg[:, 2] - ax, seg[:, 3] - ay
    px, py = xy[:, 0] - ax, xy[:, 1] - ay
    square = np.maximum(dx * dx + dy * dy, np.float32(1e-12))
    t = np.clip((px * dx + py * dy) / square, np.float32(0), np.float32(1))
    distance = np.hypot(px - t * dx, py - t * dy)
    gap = distance - (half[:, 0] + t * (half[:, 1] - half[:, 0]))
    side = np.copysign(distance, dx * py - dy * px)
    return gap, side, grid.seg_s[pick] + t * np.sqrt(square)


def segments(graph: LaneGraph, types: Sequence[int]) -> tuple[F32, F32, I32, F32]:
    """Segments of the centre lines of all lanes of the given types, lane by lane.

    Args:
        graph: The town.
        types: `LaneType` values.

    Returns:
        seg [M, 4]: x0, y0, x1, y1, m; seg_half [M, 2]: half widths at both ends, m; seg_lane [M]: lane; seg_s [M]: arc
        length at the first end, m.
    """
    lane = np.repeat(np.arange(graph.lanes, dtype=np.int32), np.diff(graph.offset))
    keep = (lane[:-1] == lane[1:]) & np.isin(graph.kind[lane[:-1]], np.asarray(types, np.uint8))
    i = np.flatnonzero(keep)
    seg = np.concatenate([graph.xy[i], graph.xy[i + 1]], axis=1)
    half = 0.5 * np.stack([graph.width[i], graph.width[i + 1]], axis=1)
    return seg, half.astype(np.float32), lane[i], graph.s[i]


_GRIDS: dict[tuple[int, tuple[int, ...]], tuple[weakref.ref[LaneGraph], Grid]] = {}


def grid_of(graph: LaneGraph, types: Sequence[int]) -> Grid:
    """`build_grid`, made once for a town that is kept in memory: worlds of one town are often built by the hundred."""
    key = (id(graph), tuple(int(t) for t in types))
    kept = _GRIDS.get(key)
    if kept is None or kept[0]() is not graph:
        _GRIDS[key] = kept = (weakref.ref(graph, lambda _: _GRIDS.pop(key, None)), build_grid(graph, types))
    return kept[1]


def build_grid(graph: LaneGraph, types: Sequence[int]) -> Grid:
    """List for each cell the segments that can be nearest to some point of it (see `Grid`)."""
    seg, half, lane, s = segments(graph, types)
    if not len(seg):
        empty = np.zeros(0, np.int32)
        return Grid(seg, half, lane, s, np.zeros(2, np.int32), empty, (0.0, 0.0), 1, 1)
    ends = seg.reshape(-1, 2, 2).astype(np.float64)
    wide = half.max(axis=1).astype(np.float64)
    reach = wide + MARGIN
    low = ends.min(axis=1) - reach[:, None]
    high = ends.max(axis=1) + reach[:, None]
    origin = np.floor(low.min(axis=0) / CELL) * CELL
    nx, ny = (np.floor((high.max(axis=0) - origin) / CELL).astype(int) + 1).tolist()
    first = np.floor((low - origin) / CELL).astype(np.int64)
    span = np.floor((high - origin) / CELL).astype(np.int64) - first + 1
    count = span[:, 0] * span[:, 1]
    pick = np.repeat(np.arange(len(seg)), count)
    item = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
    ix = first[pick, 0] + item % span[pick, 0]
    iy = first[pick, 1] + item // span[pick, 0]
    centre = (np.stack([ix, iy], axis=1) + 0.5) * CELL + origin
    a, d = ends[pick, 0], ends[pick, 1] - ends[pick, 0]
    p = centre - a
    t = np.clip((p * d).sum(axis=1) / np.maximum((d * d).sum(axis=1), 1e-12), 0.0, 1.0)
    rest = p - t[:, None] * d
    away: F64 = np.hypot(rest[:, 0], rest[:, 1])
    # a point of the cell is at most `corner` from its centre: bounds on its distance from each strip
    corner = CELL * np.sqrt(0.5) + 1e-3
    narrow = half.min(axis=1).astype(np.float64)
    least, most = away - wide[pick] - corner, away - narrow[pick] + corner
    here = iy * nx + ix
    bound = np.full(nx * ny, np.inf)
    np.minimum.at(bound, here, most)
    keep = (least <= MARGIN) & (least <= bound[here])
    here, pick = here[keep], pick[keep]
    order = np.lexsort((pick, here))
    offset = np.concatenate([[0], np.cumsum(np.bincount(here, minlength=nx * ny))]).astype(np.int32)
    place = (float(origin[0]), float(origin[1]))
    return Grid(seg, half, lane, s, offset, pick[order].astype(np.int32), place, nx, ny)


def nearest_all(graph: LaneGraph, xy: tuple[float, float], types: Sequence[LaneType]) -> tuple[I32, F64, F64]:
    """Distance from one point to every lane of the given types, however far away.

    It looks at every segment, so it is meant for a few points; see `LaneQuery` for many.

    Args:
        graph: The town.
        xy: The point, m.
        types: Types of lanes to look at.

    Returns:
        lane [n]; arc length of the nearest place on each lane [n], m; distance from each lane's strip [n], m, negative
        inside.
    """
    seg, half, lane, s = segments(graph, tuple(int(t) for t in types))
    a, d = seg[:, :2].astype(np.float64), (seg[:, 2:] - seg[:, :2]).astype(np.float64)
    p = np.asarray(xy, np.float64) - a
    square = np.maximum((d * d).sum(axis=1), 1e-12)
    t = np.clip((p * d).sum(axis=1) / square, 0.0, 1.0)
    rest = p - t[:, None] * d
    gap = np.hypot(rest[:, 0], rest[:, 1]) - (half[:, 0] + t * (half[:, 1] - half[:, 0]))
    along = s + t * np.sqrt(square)
    order = np.lexsort((gap, lane))
    first = np.concatenate([[True], np.diff(lane[order]) != 0])
    pick = order[first]
    return lane[pick], along[pick], gap[pick]
