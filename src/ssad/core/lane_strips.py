"""Lanes as strips for drawing, shared by the page's replay and the videos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from ssad.core.lane_graph import LaneGraph
from ssad.core.types import F64, LaneType

# drawing order and colour class: sidewalks under shoulders under lanes
LAYERS = {
    LaneType.SIDEWALK: 0,
    LaneType.SHOULDER: 1,
    LaneType.PARKING: 2,
    LaneType.BIKING: 2,
    LaneType.DRIVING: 3,
}


@dataclass(frozen=True)
class Strip:
    """A lane to draw: index, layer, whether it is in a junction, and its left and right edge [N, 2] m."""

    lane: int
    layer: int
    junction: bool
    left: F64
    right: F64

    @property
    def outline(self) -> F64:
        """The outline [N, 2] m."""
        return np.concatenate([self.left, self.right[::-1]])


def make_lane_strips(graph: LaneGraph) -> list[Strip]:
    """Return all lanes that are drawn, bottom layer first."""
    lane_strips = []
    for lane in range(len(graph.kind)):
        layer = LAYERS.get(LaneType(int(graph.kind[lane])))
        if layer is None:
            continue
        lane_points = graph.points(lane)
        xy = graph.xy[lane_points].astype(np.float64)
        normal = np.stack([-np.sin(graph.yaw[lane_points]), np.cos(graph.yaw[lane_points])], 1)
        half_width = 0.5 * graph.width[lane_points, None]
        in_junction = bool(graph.junction[lane] >= 0)
        lane_strips.append(
            Strip(
                lane,
                layer,
                in_junction,
                simplify_polyline(xy + normal * half_width),
                simplify_polyline(xy - normal * half_width),
            )
        )
    return sorted(lane_strips, key=lambda strip: strip.layer)


def junction_areas(graph: LaneGraph, lane_strips: Sequence[Strip], *, scale: float = 5.0) -> list[F64]:
    """Outlines [N, 2] m of the junctions' road surface: connecting lanes together, without the holes between them.

    The union is taken on a raster of `scale` pixels a metre, slits under 1 m closed.
    """
    areas = []
    # An odd size, so that the kernel has a central pixel.
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (int(scale) | 1, int(scale) | 1))
    for junction in np.unique(graph.junction[graph.junction >= 0]):
        outlines = [
            strip.outline
            for strip in lane_strips
            if graph.junction[strip.lane] == junction and strip.layer == LAYERS[LaneType.DRIVING]
        ]
        if not outlines:
            continue
        origin = np.min([outline.min(axis=0) for outline in outlines], axis=0) - 2.0
        size = np.ceil((np.max([outline.max(axis=0) for outline in outlines], axis=0) + 2.0 - origin) * scale).astype(
            int
        )
        mask = np.zeros((size[1], size[0]), np.uint8)
        for ring in outlines:
            cv2.fillPoly(mask, [np.round((ring - origin) * scale).astype(np.int32)], 1)
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, kernel)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        areas += [
            simplify_polyline(contour[:, 0].astype(np.float64) / scale + origin, 0.15)
            for contour in contours
            if len(contour) > 8
        ]
    return areas


def simplify_polyline(xy: F64, tolerance: float = 0.04) -> F64:
    """A polyline without the points that leave its shape within `tolerance` m (Douglas-Peucker)."""
    is_kept = np.zeros(len(xy), bool)
    is_kept[[0, -1]] = True
    stack = [(0, len(xy) - 1)]
    while stack:
        first, last = stack.pop()
        if last - first < 2:
            continue
        chord = xy[last] - xy[first]
        offsets = xy[first + 1 : last] - xy[first]
        deviation = np.abs(offsets[:, 0] * chord[1] - offsets[:, 1] * chord[0]) / max(float(np.hypot(*chord)), 1e-9)
        farthest = int(np.argmax(deviation))
        if deviation[farthest] > tolerance:
            is_kept[first + 1 + farthest] = True
            stack += [(first, first + 1 + farthest), (first + 1 + farthest, last)]
    return xy[is_kept]
