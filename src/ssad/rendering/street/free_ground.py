"""Raster of the free ground of a town, and the sides of streets along which objects stand."""

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
    """Free ground of a town; ground under placed objects is marked as occupied."""

    def __init__(self, graph: LaneGraph, ground: Ground) -> None:
        self.graph, self.ground = graph, ground
        self.low = np.array(ground.origin)
        rows, columns = ground.road.shape
        self.occupied = np.zeros((int((rows - 1) / CELL), int((columns - 1) / CELL)), bool)
        self.high = self.low + np.array([columns - 1, rows - 1], float)
        corners = [graph.crosswalk(index).astype(np.float64) for index in range(len(graph.crosswalk_offset) - 1)]
        self.crosswalks = np.array([polygon.mean(axis=0) for polygon in corners]).reshape(-1, 2)

    def _cells(self, points: F64) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        cell = np.floor((points - self.low) / CELL).astype(np.int64)
        ny, nx = self.occupied.shape
        return np.clip(cell[:, 1], 0, ny - 1), np.clip(cell[:, 0], 0, nx - 1)

    def is_free(self, xy: npt.ArrayLike, *, distance: float) -> bool:
        """Return whether all points [n, 2] are in the town, `distance` m from road and sidewalk, and not occupied."""
        points = np.asarray(xy, np.float64).reshape(-1, 2)
        # 2 m inside the raster: `_cells` clips and would test the wrong cells outside.
        if (
            (points < self.low + 2.0).any()
            or (points > self.high - 2.0).any()
            or self.occupied[self._cells(points)].any()
        ):
            return False
        return bool((self.ground.at(self.ground.paved, points) >= distance).all())

    def is_occupied(self, points: npt.ArrayLike) -> bool:
        """Return whether something stands at one of the points [n, 2]."""
        return bool(self.occupied[self._cells(np.asarray(points, np.float64).reshape(-1, 2))].any())

    def occupy(self, points: npt.ArrayLike) -> None:
        """Mark the ground under points [n, 2] as occupied."""
        self.occupied[self._cells(np.asarray(points, np.float64).reshape(-1, 2))] = True

    def is_clear(self, xy: npt.ArrayLike, *, size: float = 0.3, crossing: float = 1.5) -> bool:
        """Return whether an object may stand at points on a sidewalk or beside it.

        It must be `KEEP` away from driving lanes and junctions, on ground that is not occupied.

        Args:
            xy: Points [n, 2], m; all must be clear.
            size: Radius of the object, m.
            crossing: Distance to keep from crosswalks, m.
        """
        points = np.asarray(xy, np.float64).reshape(-1, 2)
        if (self.ground.at(self.ground.drive, points) < KEEP + size).any() or self.occupied[self._cells(points)].any():
            return False
        return bool((self.crosswalk_distance(points) > crossing + size).all())

    def crosswalk_distance(self, xy: npt.ArrayLike) -> F64:
        """Return the distance [n] from the nearest crosswalk, m."""
        points = np.asarray(xy, np.float64).reshape(-1, 2)
        distances = np.full(len(points), np.inf)
        for index in range(len(self.crosswalks)):
            # The exact distance is only needed near a crosswalk: beyond, any limit is satisfied.
            is_near = np.hypot(*(points - self.crosswalks[index]).T) < 20.0
            if is_near.any():
                crosswalk_distance = polygon_distance(points[is_near], self.graph.crosswalk(index).astype(np.float64))
                distances[is_near] = np.minimum(distances[is_near], crosswalk_distance)
        return distances


def polygon_distance(points: F64, corners: F64) -> F64:
    """Return the distance [n] of points from a polygon [m, 2]; 0 inside."""
    starts, ends = corners, np.roll(corners, -1, axis=0)
    edges = ends - starts
    edge_share = np.einsum("nmi,mi->nm", points[:, None] - starts, edges) / np.maximum(
        (edges * edges).sum(axis=1), 1e-12
    )
    edge_distance = np.hypot(
        *np.moveaxis(points[:, None] - starts - np.clip(edge_share, 0.0, 1.0)[..., None] * edges, -1, 0)
    ).min(axis=1)
    return np.where(in_polygon(points, corners), 0.0, edge_distance)


@dataclass(frozen=True)
class Side:
    """One side of a street outside junctions: the outer edge of its outermost lane, and its kerb.

    Attributes:
        edge: The outer edge.
        kerb: Distance from the outer edge to the kerb, m: the sidewalk's width, 0 without one.
        frontage: Whether buildings face it; False for motorways and their ramps.
    """

    edge: Edge
    kerb: float
    frontage: bool = True

    @property
    def length(self) -> float:
        """Length of the outer edge, m."""
        return float(self.edge.s[-1])

    def pose(self, arc_length: float, distance: float = 0.0) -> tuple[float, float, float]:
        """Return a pose beside the street; beyond the ends the line continues straight.

        Args:
            arc_length: Arc length along the edge, m.
            distance: Distance outwards from the edge, m; negative: towards the road.

        Returns:
            x, y (m) and the heading of the traffic (rad).
        """
        edge = self.edge
        clamped = float(np.clip(arc_length, 0.0, self.length))
        # Unwrapped, so that interpolation does not jump at pi.
        yaw = float(np.interp(clamped, edge.s, np.unwrap(edge.yaw)))
        x, y = (float(np.interp(clamped, edge.s, edge.xy[:, column])) for column in range(2))
        overhang, cos, sin = arc_length - clamped, np.cos(yaw), np.sin(yaw)
        return x + overhang * cos + distance * sin, y + overhang * sin - distance * cos, yaw


def sides(graph: LaneGraph) -> list[Side]:
    """Return the sides of all streets, in the order of their lanes."""
    street_sides = []
    for lane in np.flatnonzero((graph.junction < 0) & (graph.right < 0)).tolist():
        is_sidewalk = graph.kind[lane] == LaneType.SIDEWALK
        kerb = float(graph.width[graph.points(lane)].min()) if is_sidewalk else 0.0
        edge = lane_edge(graph, lane, 0.0)
        if edge.s[-1] > 4.0:
            street_sides.append(Side(edge, kerb, is_sidewalk or not graph.is_divided(lane)))
    return street_sides


def footprint(pose: tuple[float, float, float], x: tuple[float, float], y: tuple[float, float]) -> F64:
    """Return points [n, 2] about 0.4 m apart over a rectangle in the frame of a pose."""
    along = np.linspace(*x, max(2, int((x[1] - x[0]) / 0.4) + 1))
    across = np.linspace(*y, max(2, int((y[1] - y[0]) / 0.4) + 1))
    local = np.stack(np.meshgrid(along, across), axis=-1).reshape(-1, 2)
    return place(pose, local)


def place(pose: tuple[float, float, float], local: F64) -> F64:
    """Transform points [..., 2] from the frame of a pose to the world."""
    cosine, sine = np.cos(pose[2]), np.sin(pose[2])
    return np.asarray(local @ np.array([[cosine, sine], [-sine, cosine]]) + np.array(pose[:2]))
