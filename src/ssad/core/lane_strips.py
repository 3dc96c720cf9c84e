"""Lanes as strips to draw: what the page's replay and the videos share."""

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
    """A lane to draw: index, layer, whether it lies in a junction, its left and right edge [N, 2] m."""

    lane: int
    layer: int
    junction: bool
    left: F64
    right: F64

    @property
    def ring(self) -> F64:
        """The outline [N, 2] m."""
        return np.concatenate([self.left, self.right[::-1]])


def strips(graph: LaneGraph) -> list[Strip]:
    """All lanes that are drawn, bottom layer first."""
    out = []
    for lane in range(len(graph.kind)):
        layer = LAYERS.get(LaneType(int(graph.kind[lane])))
        if layer is None:
            continue
        span = graph.points(lane)
        xy = graph.xy[span].astype(np.float64)
        normal = np.stack([-np.sin(graph.yaw[span]), np.cos(graph.yaw[span])], 1)
        half = 0.5 * graph.width[span, None]
        inside = bool(graph.junction[lane] >= 0)
        out.append(Strip(lane, layer, inside, thin(xy + normal * half), thin(xy - normal * half)))
    return sorted(out, key=lambda strip: strip.layer)


def junction_areas(graph: LaneGraph, drawn: Sequence[Strip], *, scale: float = 5.0) -> list[F64]:
    """Outlines [N, 2] m of the junctions' road surface: connecting lanes together, without the holes between them.

    The union is taken on a raster of `scale` pixels a metre, slits under 1 m closed.
    """
    out = []
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (int(scale) | 1, int(scale) | 1))
    for junction in np.unique(graph.junction[graph.junction >= 0]):
        rings = [s.ring for s in drawn if graph.junction[s.lane] == junction and s.layer == LAYERS[LaneType.DRIVING]]
        if not rings:
            continue
        low = np.min([r.min(axis=0) for r in rings], axis=0) - 2.0
        size = np.ceil((np.max([r.max(axis=0) for r in rings], axis=0) + 2.0 - low) * scale).astype(int)
        mask = np.zeros((size[1], size[0]), np.uint8)
        for ring in rings:
            cv2.fillPoly(mask, [np.round((ring - low) * scale).astype(np.int32)], 1)
        mask = cv2.morphologyEx(mask, cv2.MORPH_CLOSE, kernel)
        contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        out += [thin(c[:, 0].astype(np.float64) / scale + low, 0.15) for c in contours if len(c) > 8]
    return out


def thin(xy: F64, tolerance: float = 0.04) -> F64:
    """A polyline without the points that leave its shape within `tolerance` m (Douglas-Peucker)."""
    keep = np.zeros(len(xy), bool)
    keep[[0, -1]] = True
    stack = [(0, len(xy) - 1)]
    while stack:
        a, b = stack.pop()
        if b - a < 2:
            continue
        d = xy[b] - xy[a]
        rest = xy[a + 1 : b] - xy[a]
        off = np.abs(rest[:, 0] * d[1] - rest[:, 1] * d[0]) / max(float(np.hypot(*d)), 1e-9)
        k = int(np.argmax(off))
        if off[k] > tolerance:
            keep[a + 1 + k] = True
            stack += [(a, a + 1 + k), (a + 1 + k, b)]
    return xy[keep]
