"""Distance of points from the road edge, on rasters around several places: fast, batched and differentiable."""

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
    """Signed distances from the road edge, positive off the road, linear between points 0.5 m apart.

    `ssad.world.twin.RoadField` is exact, but visits all lanes of a town for each point.

    Args:
        queries: Lane query of the town of each place.
        points: For each place, points [n, 2] m that its raster must cover.
    """

    def __init__(self, queries: Sequence[LaneQuery], points: Sequence[F64]) -> None:
        rasters, origins, shapes = [], [], []
        for query, place_points in zip(queries, points, strict=True):
            raster, origin = edge_raster(query, place_points)
            rasters.append(raster.ravel())
            origins.append(origin)
            shapes.append(raster.shape[::-1])
        self._values = torch.from_numpy(np.concatenate(rasters))
        self._first = torch.tensor(np.cumsum([0, *(len(cells) for cells in rasters[:-1])]))
        self._origin = torch.from_numpy(np.array(origins))
        self._shape = torch.from_numpy(np.array(shapes))

    def __call__(self, points: Tensor, place: Tensor) -> Tensor:
        """Return distances [N, ...], m, of points [N, ..., 2] (world frame, m), each row at its place [N]."""
        padding = (1,) * (points.ndim - 2)
        shape = self._shape[place].reshape(-1, *padding, 2)
        position = (points - self._origin[place].reshape(-1, *padding, 2)) / CELL
        # clamp: outside the raster the value at its edge applies
        position = torch.minimum(position.clamp_min(0.0), (shape - 1.001).to(position.dtype))
        # Without detach, the gradient would also flow through the cell index.
        cell = position.detach().floor()
        fraction = position - cell
        column, row = cell.long().unbind(-1)
        flat_index = self._first[place].reshape(-1, *padding) + row * shape[..., 0] + column
        values = self._values
        row_length = shape[..., 0]
        below = values[flat_index] + fraction[..., 0] * (values[flat_index + 1] - values[flat_index])
        above = values[flat_index + row_length] + fraction[..., 0] * (
            values[flat_index + row_length + 1] - values[flat_index + row_length]
        )
        return below + fraction[..., 1] * (above - below)


def raster_of(graphs: Sequence[LaneGraph], points: Sequence[F64]) -> RoadRaster:
    """Build the rasters around points of towns; the lanes of each town are prepared once."""
    queries = {id(graph): LaneQuery(graph) for graph in {id(lane_graph): lane_graph for lane_graph in graphs}.values()}
    return RoadRaster([queries[id(graph)] for graph in graphs], points)
