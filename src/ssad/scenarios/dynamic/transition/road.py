"""How far points are from the road, on a raster around each of several places: quick, batched, with a gradient."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F64
from ssad.world.roads.edge import CELL, edge_raster
from ssad.world.roads.query import LaneQuery


class RoadRaster:
    """Signed distances from the edge of the road, more than 0 off it, linear between points 0.5 m apart.

    `ssad.world.twin.RoadField` is exact, and looks at all lanes of a town for each point.

    Args:
        queries: Lanes of the town of each place.
        points: For each place points [n, 2] m that its raster must hold.
    """

    def __init__(self, queries: Sequence[LaneQuery], points: Sequence[F64]) -> None:
        rasters, origins, shapes = [], [], []
        for query, held in zip(queries, points, strict=True):
            raster, origin = edge_raster(query, held)
            rasters.append(raster.ravel())
            origins.append(origin)
            shapes.append(raster.shape[::-1])
        self._values = torch.from_numpy(np.concatenate(rasters))
        self._first = torch.tensor(np.cumsum([0, *(len(r) for r in rasters[:-1])]))
        self._origin = torch.from_numpy(np.array(origins))
        self._shape = torch.from_numpy(np.array(shapes))

    def __call__(self, points: Tensor, place: Tensor) -> Tensor:
        """Distances [N, ...], m, of points [N, ..., 2] (world frame, m), each row at its place [N]."""
        more = (1,) * (points.ndim - 2)
        shape = self._shape[place].reshape(-1, *more, 2)
        at = (points - self._origin[place].reshape(-1, *more, 2)) / CELL
        # beyond the raster the value at its edge holds
        at = torch.minimum(at.clamp_min(0.0), (shape - 1.001).to(at.dtype))
        low = at.detach().floor()
        share = at - low
        column, row = low.long().unbind(-1)
        first = self._first[place].reshape(-1, *more) + row * shape[..., 0] + column
        values = self._values
        step = shape[..., 0]
        below = values[first] + share[..., 0] * (values[first + 1] - values[first])
        above = values[first + step] + share[..., 0] * (values[first + step + 1] - values[first + step])
        return below + share[..., 1] * (above - below)


def raster_of(graphs: Sequence[LaneGraph], points: Sequence[F64]) -> RoadRaster:
    """The rasters around points of towns; a town's lanes are prepared once."""
    queries = {id(graph): LaneQuery(graph) for graph in {id(g): g for g in graphs}.values()}
    return RoadRaster([queries[id(graph)] for graph in graphs], points)
