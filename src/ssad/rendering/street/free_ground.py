"""Which ground is free: a raster of what is built on, and the sides of streets along which things stand."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ssad.core.geometry import in_polygon
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import LaneType
from ssad.rendering.meshes.mesh import F64
from ssad.rendering.street.paving import Edge, lane_edge
from ssad.rendering.street.region import Ground

CELL = 0.5  # m
KEEP = 0.6  # m from driving lanes, junctions and crosswalks to anything that stands


class FreeGround:
    """Free ground of a town; whatever is placed is marked taken."""

    def __init__(self, graph: LaneGraph, ground: Ground) -> None:
        self.graph, self.ground = graph, ground
        self.low = np.array(ground.origin)
        rows, columns = ground.road.shape
        self.taken = np.zeros((int((rows - 1) / CELL), int((columns - 1) / CELL)), bool)
        self.high = self.low + np.array([columns - 1, rows - 1], float)
        corners = [graph.crosswalk(k).astype(np.float64) for k in range(len(graph.crosswalk_offset) - 1)]
        self.crosswalks = np.array([c.mean(axis=0) for c in corners]).reshape(-1, 2)

    def _cells(self, xy: F64) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        cell = np.floor((xy - self.low) / CELL).astype(np.int64)
        ny, nx = self.taken.shape
        return np.clip(cell[:, 1], 0, ny - 1), np.clip(cell[:, 0], 0, nx - 1)

    def free(self, xy: npt.ArrayLike, *, away: float) -> bool:
        """Whether all points [n, 2] lie in the town, `away` m from road and sidewalk, on ground not yet taken."""
        p = np.asarray(xy, np.float64).reshape(-1, 2)
        if (p < self.low + 2.0).any() or (p > self.high - 2.0).any() or self.taken[self._cells(p)].any():
            return False
        return bool((self.ground.at(self.ground.paved, p) >= away).all())

    def take(self, xy: npt.ArrayLike) -> None:
        """Mark ground under points [n, 2]."""
        self.taken[self._cells(np.asarray(xy, np.float64).reshape(-1, 2))] = True

    def clear(self, xy: npt.ArrayLike, *, size: float = 0.3, crossing: float = 1.5) -> bool:
        """Whether a thing may stand here, on a sidewalk or beside it.

        It must be `KEEP` away from driving lanes and junctions, on ground not yet taken.

        Args:
            xy: Points [n, 2], m; all must be clear.
            size: Radius of the thing, m.
            crossing: Distance to keep from crosswalks, m.
        """
        p = np.asarray(xy, np.float64).reshape(-1, 2)
        if (self.ground.at(self.ground.drive, p) < KEEP + size).any() or self.taken[self._cells(p)].any():
            return False
        return bool((self.crossing(p) > crossing + size).all())

    def crossing(self, xy: npt.ArrayLike) -> F64:
        """Distance [n] from the nearest crosswalk, m."""
        p = np.asarray(xy, np.float64).reshape(-1, 2)
        least = np.full(len(p), np.inf)
        for k in range(len(self.crosswalks)):
            near = np.hypot(*(p - self.crosswalks[k]).T) < 20.0
            if near.any():
                gap = polygon_distance(p[near], self.graph.crosswalk(k).astype(np.float64))
                least[near] = np.minimum(least[near], gap)
        return least


def polygon_distance(xy: F64, corners: F64) -> F64:
    """Distance [n] of points from a polygon [m, 2], 0 inside."""
    a, b = corners, np.roll(corners, -1, axis=0)
    d = b - a
    t = np.einsum("nmi,mi->nm", xy[:, None] - a, d) / np.maximum((d * d).sum(axis=1), 1e-12)
    gap = np.hypot(*np.moveaxis(xy[:, None] - a - np.clip(t, 0.0, 1.0)[..., None] * d, -1, 0)).min(axis=1)
    return np.where(in_polygon(xy, corners), 0.0, gap)


@dataclass(frozen=True)
class Side:
    """One side of a street outside junctions: the outer edge of its outermost lane, and where its kerb is.

    Attributes:
        edge: The outer edge.
        kerb: Distance from the outer edge to the kerb, m: the sidewalk's width, 0 without one.
        frontage: Whether buildings face it; not so a motorway and its ramps.
    """

    edge: Edge
    kerb: float
    frontage: bool = True

    @property
    def length(self) -> float:
        """Length of the outer edge, m."""
        return float(self.edge.s[-1])

    def pose(self, s: float, away: float = 0.0) -> tuple[float, float, float]:
        """A pose beside the street; beyond the ends the line goes straight on.

        Args:
            s: Arc length along the edge, m.
            away: Distance outwards from the edge, m; negative: towards the road.

        Returns:
            x, y (m) and the heading of the traffic (rad).
        """
        edge = self.edge
        at = float(np.clip(s, 0.0, self.length))
        yaw = float(np.interp(at, edge.s, np.unwrap(edge.yaw)))
        x, y = (float(np.interp(at, edge.s, edge.xy[:, k])) for k in range(2))
        over, cos, sin = s - at, np.cos(yaw), np.sin(yaw)
        return x + over * cos + away * sin, y + over * sin - away * cos, yaw


def sides(graph: LaneGraph) -> list[Side]:
    """The sides of all streets, in the order of their lanes."""
    found = []
    for lane in np.flatnonzero((graph.junction < 0) & (graph.right < 0)).tolist():
        walk = graph.kind[lane] == LaneType.SIDEWALK
        kerb = float(graph.width[graph.points(lane)].min()) if walk else 0.0
        edge = lane_edge(graph, lane, 0.0)
        if edge.s[-1] > 4.0:
            found.append(Side(edge, kerb, walk or not graph.divided(lane)))
    return found


def footprint(pose: tuple[float, float, float], x: tuple[float, float], y: tuple[float, float]) -> F64:
    """Points [n, 2] about 0.4 m apart over a rectangle in the frame of a pose."""
    u = np.linspace(*x, max(2, int((x[1] - x[0]) / 0.4) + 1))
    v = np.linspace(*y, max(2, int((y[1] - y[0]) / 0.4) + 1))
    local = np.stack(np.meshgrid(u, v), axis=-1).reshape(-1, 2)
    return place(pose, local)


def place(pose: tuple[float, float, float], local: F64) -> F64:
    """Points [..., 2] of the frame of a pose in the world."""
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.asarray(local @ np.array([[c, s], [-s, c]]) + np.array(pose[:2]))
