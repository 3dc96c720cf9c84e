"""Where a town is paved: signed distances on a raster, and meshes of such regions without cracks."""

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
        """Distance from the edge of all that is paved; inside it, depth below that edge to half a metre."""
        inside = self.paved <= 0.05
        depth = cv2.distanceTransform(inside.astype(np.uint8), cv2.DIST_L2, 5).astype(np.float64)
        return np.where(inside, 0.5 - depth, self.paved)

    def at(self, field: Grid, xy: npt.ArrayLike) -> F64:
        """Bilinear value of a field at points [n, 2]; `REACH` outside the raster."""
        p = np.asarray(xy, np.float64).reshape(-1, 2) - np.array(self.origin)
        ny, nx = np.array(field.shape) - 1
        inside = (p[:, 0] >= 0) & (p[:, 0] < nx) & (p[:, 1] >= 0) & (p[:, 1] < ny)
        x, y = np.where(inside, p[:, 0], 0.0), np.where(inside, p[:, 1], 0.0)
        i, j = x.astype(int), y.astype(int)
        u, v = x - i, y - j
        low = (1.0 - u) * field[j, i] + u * field[j, i + 1]
        high = (1.0 - u) * field[j + 1, i] + u * field[j + 1, i + 1]
        return np.asarray(np.where(inside, (1.0 - v) * low + v * high, REACH))


def survey(graph: LaneGraph) -> Ground:
    """Distances of a flat town.

    Raises:
        MapError: It has bridges or hills, or no drivable lane.
    """
    driving = graph.kind == LaneType.DRIVING
    if not driving.any():
        raise MapError(f"town '{graph.name}': no drivable lane; choose another town")
    if float(np.ptp(graph.z)) > 1.0:
        raise MapError(
            f"town '{graph.name}': it is not flat (heights differ by {np.ptp(graph.z):.1f} m); streets are "
            "built for flat towns only, choose another"
        )
    low = np.floor(graph.xy.min(axis=0) - MARGIN)
    size = np.ceil((graph.xy.max(axis=0) + MARGIN - low) / 32.0).astype(int) * 32
    nx, ny = size.tolist()
    if nx * ny > 6e7:
        raise MapError(f"town '{graph.name}': {nx} x {ny} m is too large to be built; cut the map")
    drive = _distance(graph, DRIVE, low, (nx, ny))
    road = np.minimum(drive, _distance(graph, BESIDE, low, (nx, ny), inwards=1.0))
    walk = _distance(graph, WALK, low, (nx, ny))
    # gaps between the ways through a junction are road too
    count, label, stats, _ = cv2.connectedComponentsWithStats(
        (np.minimum(road, walk) > 0.0).astype(np.uint8), connectivity=4
    )
    small = np.zeros(count, bool)
    small[1:] = stats[1:, cv2.CC_STAT_AREA] < HOLE
    hole = small[label]
    road[hole], drive[hole] = -0.5, -0.5
    outer = np.unique(np.concatenate([label[0], label[-1], label[:, 0], label[:, -1]]))
    inner = (label > 0) & ~np.isin(label, outer) & ~hole
    # nobody can walk to the island of a roundabout, or to ground between carriageways and ramps: nothing is built there
    walkable = np.unique(label[cv2.dilate((walk < 0.5).astype(np.uint8), np.ones((5, 5), np.uint8)) > 0])
    inner &= np.isin(label, walkable)
    return Ground((float(low[0]), float(low[1])), road, walk, drive, np.minimum(road, walk), inner)


def _distance(
    graph: LaneGraph, kinds: Sequence[LaneType], low: F64, size: tuple[int, int], *, inwards: float = 0.0
) -> Grid:
    """Signed distance from the strips of lanes at the nodes of the raster."""
    field = np.full((size[1] + 1, size[0] + 1), REACH)
    seg, half, lane, _ = segments(graph, tuple(int(k) for k in kinds))
    if not len(seg):
        return field
    ends = seg.reshape(-1, 2, 2).astype(np.float64) - low
    wide = half.astype(np.float64)
    if inwards:
        # narrow strips reach under the lane beside them, so that no ridge of the distance lies along their border
        along = ends[:, 1] - ends[:, 0]
        normal = np.stack([-along[:, 1], along[:, 0]], axis=1) / np.maximum(np.hypot(*along.T), 1e-9)[:, None]
        lane_left = graph.left[lane] >= 0
        sign = np.where(lane_left & (graph.kind[graph.left[lane]] == LaneType.DRIVING), inwards, -inwards)
        ends += (sign[:, None] * normal)[:, None, :]
        wide += inwards
    reach = wide.max(axis=1)[:, None] + REACH
    first = np.maximum(np.ceil(ends.min(axis=1) - reach).astype(np.int64), 0)
    last = np.minimum(np.floor(ends.max(axis=1) + reach).astype(np.int64), np.array(size))
    span = last - first + 1
    for rows in np.array_split(np.arange(len(seg)), max(1, len(seg) // 1500)):
        count = span[rows, 0] * span[rows, 1]
        pick = np.repeat(rows, count)
        item = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
        ix, iy = first[pick, 0] + item % span[pick, 0], first[pick, 1] + item // span[pick, 0]
        a, d = ends[pick, 0], ends[pick, 1] - ends[pick, 0]
        px, py = ix - a[:, 0], iy - a[:, 1]
        dx, dy = d[:, 0], d[:, 1]
        t = np.clip((px * dx + py * dy) / np.maximum(dx * dx + dy * dy, 1e-12), 0.0, 1.0)
        gap = np.sqrt((px - t * dx) ** 2 + (py - t * dy) ** 2) - (wide[pick, 0] + t * (wide[pick, 1] - wide[pick, 0]))
        np.minimum.at(field, (iy, ix), gap)
    return field


def region_mesh(field: Grid, *, largest: int = 16) -> tuple[F64, I32]:
    """Triangles of the region where a field at the nodes of a raster is negative: vertices [V, 2] in cells, faces.

    Cells that lie inside are joined to squares of up to `largest` (a power of two that divides the raster); on the
    edge the field's zero is followed cell by cell. No edge has a vertex of a neighbour on it, so there are no cracks.
    """
    inside = field < 0.0
    ny, nx = field.shape[0] - 1, field.shape[1] - 1
    corners = np.stack([inside[:-1, :-1], inside[:-1, 1:], inside[1:, 1:], inside[1:, :-1]])
    full, some = corners.all(axis=0), corners.any(axis=0)
    leaves: list[tuple[int, I32]] = []
    left = full.copy()
    k = largest
    while k >= 1:
        block = left.reshape(ny // k, k, nx // k, k).all(axis=(1, 3))
        where = np.argwhere(block).astype(np.int32) * k
        leaves.append((k, where))
        left &= ~np.kron(block, np.ones((k, k), bool)) if k > 1 else ~block
        k //= 2
    used = np.zeros(field.shape, bool)
    for k, at in leaves:
        for dy, dx in ((0, 0), (0, k), (k, k), (k, 0)):
            used[at[:, 0] + dy, at[:, 1] + dx] = True
    mixed = np.argwhere(some & ~full).astype(np.int32)
    for dy, dx in ((0, 0), (0, 1), (1, 1), (1, 0)):
        node = mixed + np.array([dy, dx], np.int32)
        keep = inside[node[:, 0], node[:, 1]]
        used[node[keep, 0], node[keep, 1]] = True
    faces = [_squares(used, k, at) for k, at in leaves if len(at)]
    edge, crossing = _edges(field, inside, mixed)
    if len(mixed):
        faces.append(edge)
    total = np.concatenate(faces) if faces else np.zeros((0, 3), np.int64)
    wide = nx + 1
    node, inverse = np.unique(total, return_inverse=True)
    grid = node < field.size
    vertices = np.zeros((len(node), 2))
    vertices[grid] = np.stack([node[grid] % wide, node[grid] // wide], axis=1)
    vertices[~grid] = crossing[node[~grid] - field.size]
    return vertices, np.asarray(inverse).reshape(-1, 3).astype(np.int32)


def _squares(used: npt.NDArray[np.bool_], k: int, at: I32) -> npt.NDArray[np.int64]:
    """Triangles of squares of k cells with corners at [n, 2] (row, column): two, or a fan by finer neighbours."""
    wide = used.shape[1]
    step = np.arange(k)
    ring = np.concatenate(
        [
            np.stack([0 * step, step], 1),
            np.stack([step, k + 0 * step], 1),
            np.stack([k + 0 * step, k - step], 1),
            np.stack([k - step, 0 * step], 1),
        ]
    )
    node = at[:, None, :].astype(np.int64) + ring[None]
    flat = node[..., 0] * wide + node[..., 1]
    seen = used[node[..., 0], node[..., 1]]
    plain = seen.sum(axis=1) == 4
    c = flat[plain][:, [0, k, 2 * k, 3 * k]]
    faces = [c[:, [0, 1, 2]], c[:, [0, 2, 3]]]
    if not plain.all():
        flat, seen = flat[~plain], seen[~plain]
        middle = flat[:, 0] + (k // 2) * (wide + 1)
        after = flat[:, 0].copy()  # position 0 is a corner: the first after the last
        for p in range(4 * k - 1, -1, -1):
            mine = seen[:, p]
            faces.append(np.stack([flat[mine, p], after[mine], middle[mine]], axis=1))
            after[mine] = flat[mine, p]
    return np.concatenate(faces)


def _edges(field: Grid, inside: npt.NDArray[np.bool_], mixed: I32) -> tuple[npt.NDArray[np.int64], F64]:
    """Triangles of cells that the zero line crosses, and the places of the crossings (numbered after the nodes).

    Crossing 2 * node lies on the edge to the right of a node, 2 * node + 1 on the edge above it.
    """
    wide, size = field.shape[1], field.size
    j, i = mixed[:, 0].astype(np.int64), mixed[:, 1].astype(np.int64)
    n = [j * wide + i, j * wide + i + 1, (j + 1) * wide + i + 1, (j + 1) * wide + i]
    cut = [size + 2 * n[0], size + 2 * n[1] + 1, size + 2 * n[3], size + 2 * n[0] + 1]
    value, sign = field.reshape(-1), inside.reshape(-1)
    name = np.stack([n[0], cut[0], n[1], cut[1], n[2], cut[2], n[3], cut[3]], axis=1)
    there = np.zeros(name.shape, bool)
    for k in range(4):
        there[:, 2 * k] = sign[n[k]]
        there[:, 2 * k + 1] = sign[n[k]] != sign[n[(k + 1) % 4]]
    crossing = np.zeros((2 * size, 2))
    for which, a, b in ((cut[0], n[0], n[1]), (cut[1], n[1], n[2]), (cut[2], n[3], n[2]), (cut[3], n[0], n[3])):
        hit = sign[a] != sign[b]
        p, q = a[hit], b[hit]
        t = np.clip(value[p] / (value[p] - value[q]), 0.01, 0.99)
        crossing[which[hit] - size, 0] = (1 - t) * (p % wide) + t * (q % wide)
        crossing[which[hit] - size, 1] = (1 - t) * (p // wide) + t * (q // wide)
    order = np.argsort(~there, axis=1, kind="stable")
    ring = np.take_along_axis(name, order, axis=1)
    count = there.sum(axis=1)
    faces = [ring[count > k + 1][:, [0, k, k + 1]] for k in range(1, 5)]
    return np.concatenate(faces), crossing
