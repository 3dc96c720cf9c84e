"""Distances of points from the edge of the road, on a raster around them."""

from __future__ import annotations

import numpy as np

from ssad.core.types import F64
from ssad.world.roads.query import LaneQuery

CELL = 0.5  # m
MARGIN = 20.0  # m that a raster reaches beyond the points it is made for


def edge_raster(query: LaneQuery, points: F64) -> tuple[F64, F64]:
    """Signed distances from the edge of the road, more than 0 off it, at points `CELL` apart.

    Args:
        query: Lanes of the town.
        points: Points [n, 2], m, that the raster holds with a margin of `MARGIN`.

    Returns:
        Distances [rows, columns], m: y and x grow with them; place of the first one [2], m.
    """
    from scipy.ndimage import distance_transform_edt  # every process loads towns, few ask for distances

    origin: F64 = np.floor(points.min(0) - MARGIN)
    shape = np.ceil((points.max(0) + MARGIN - origin) / CELL).astype(int) + 1
    x, y = (origin[axis] + CELL * np.arange(shape[axis]) for axis in (0, 1))
    grid = np.stack(np.meshgrid(x, y, indexing="xy"), -1).reshape(-1, 2)
    off_road = query.off_road(grid).reshape(shape[1], shape[0])
    # the edge lies half-way between a cell on the road and one off it
    outside, inside = (distance_transform_edt(mask) for mask in (off_road, ~off_road))
    return CELL * np.where(off_road, outside - 0.5, 0.5 - inside), origin


def edge_distances(query: LaneQuery, points: F64) -> F64:
    """Return signed distances [n] of points [n, 2] from the road's edge, m, positive off it; linear in between."""
    from scipy.ndimage import map_coordinates

    raster, origin = edge_raster(query, points)
    return np.asarray(map_coordinates(raster, ((points - origin) / CELL).T[::-1], order=1), np.float64)
