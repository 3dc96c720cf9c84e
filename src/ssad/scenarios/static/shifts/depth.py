"""Depth of every pixel, as far as it is known: given, or filled in from LiDAR returns, the road and the image.

A sweep reaches a few thousand pixels and nothing above its top beam, so the rest is filled by normalised convolution
over a pyramid (Knutsson and Westin 1993), in inverse depth, from the returns, the plane of the road, and a sky that is
far; then a guided filter (He, Sun and Tang 2010) lets edges of the image be edges of the depth. The grid is a quarter
of the image, as the veil needs it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import warp as wp

from ssad.core.frames import Frame, camera_to_world
from ssad.core.types import F32
from ssad.scenarios.static.shifts.batch import Batch, on

FARTHEST = 1000.0
_ROAD_WEIGHT, _SKY_WEIGHT = 0.02, 0.002


def grid_size(batch: Batch) -> tuple[int, int]:
    """Rows and columns of the quarter grid."""
    return -(-batch.height // 4), -(-batch.width // 4)


def depth_grid(batch: Batch, frames: Sequence[Frame]) -> tuple[Any, list[str]]:
    """Depth [B, h, w] on the batch's device, metres along the optical axis, and where each comes from.

    Sources: "given", "lidar" (returns, road, image) or "assumed" (road and image alone).
    """
    rows, columns = grid_size(batch)
    pixels = batch.numpy() if any(frame.depth is None for frame in frames) else None
    found = [depth_of(frame, None if pixels is None else pixels[b], rows, columns) for b, frame in enumerate(frames)]
    grids, sources = zip(*found, strict=True)
    return on(batch, np.stack(grids)), list(sources)


def depth_of(frame: Frame, image: Any, rows: int, columns: int) -> tuple[F32, str]:
    """Depth [rows, columns] of one frame, and its source; image [H, W, 3] is looked at where no depth is given."""
    if frame.depth is not None:
        return _given(np.asarray(frame.depth, np.float32), rows, columns), "given"
    source = "assumed" if frame.points is None or not len(frame.points) else "lidar"
    return fill_depth(frame, image, rows, columns), source


def _given(depth: F32, rows: int, columns: int) -> F32:
    """A depth map on the quarter grid; what is unknown (0, NaN) is filled in from around it."""
    if depth.shape != (rows, columns):
        y = np.minimum(((np.arange(rows) + 0.5) / rows * depth.shape[0]).astype(int), depth.shape[0] - 1)
        x = np.minimum(((np.arange(columns) + 0.5) / columns * depth.shape[1]).astype(int), depth.shape[1] - 1)
        depth = depth[y][:, x]
    known = depth > 0  # False for NaN
    if known.all():
        return np.minimum(depth, FARTHEST)
    inverse = np.where(known, 1.0 / np.where(known, depth, 1), 0).astype(np.float32)
    filled = _pull_push(inverse, known.astype(np.float32))
    return np.where(known, np.minimum(depth, FARTHEST), 1 / np.maximum(filled, 1 / FARTHEST)).astype(np.float32)


def fill_depth(frame: Frame, image: Any, rows: int, columns: int) -> F32:
    """Depth [rows, columns] of one image [H, W, 3] from its LiDAR returns, the road under the ego, and the image."""
    height, width = image.shape[:2]
    k = frame.camera.intrinsic
    scale_x, scale_y = columns / width, rows / height
    fx, fy = k[0, 0] * scale_x, k[1, 1] * scale_y
    cx, cy = k[0, 2] * scale_x, k[1, 2] * scale_y
    small = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
    grey = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255

    # the road: where a ray meets the plane z = 0 of the ego; the height of a ray over the ground is linear in u and v
    rotation, place = frame.camera.to_ego[:3, :3], frame.camera.to_ego[:3, 3]
    u = ((np.arange(columns, dtype=np.float32) + 0.5 - cx) / fx)[None]
    v = ((np.arange(rows, dtype=np.float32) + 0.5 - cy) / fy)[:, None]
    down = (rotation[2, 0] * u + rotation[2, 1] * v + rotation[2, 2]).astype(np.float32)
    inverse = np.maximum(-down / max(float(place[2]), 0.3), 0).astype(np.float32)
    weight = np.where(inverse > 1 / 80, np.float32(_ROAD_WEIGHT), np.float32(0))

    # the sky: above the horizon, smooth, and bright for this image and not red, or blue
    slope = np.abs(cv2.Laplacian(grey, cv2.CV_32F, ksize=3))
    bright = grey > 0.7 * float(np.quantile(grey[::4, ::4], 0.95))
    red, tinge = small[..., 0].astype(np.float32), small[..., 2].astype(np.float32)
    blue = (tinge - red > 40) & (tinge > 130)
    sky = (down > 0.02) & (blue | (bright & (tinge >= red * 0.92))) & (cv2.blur(slope, (5, 5)) < 0.08)
    # clouds leave holes
    sky = (cv2.morphologyEx(sky.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8)) > 0) & (down > 0.02)
    weight[down > 0] = _SKY_WEIGHT
    weight[sky] = 0.5
    inverse[down > 0] = 0

    _boxes(frame, inverse, weight, (fx, fy, cx, cy))
    points = frame.points
    if points is None or not len(points):
        # nothing is known of what stands upright: as far as houses along a street
        upright = (down > 0) & ~sky & (weight < 0.1)
        inverse[upright], weight[upright] = 1 / 45, 0.05
    if points is not None and len(points):
        p = np.asarray(points, np.float32)[:, :3]
        p = p[p[:, 2] > 1.0]
        x = np.floor(p[:, 0] / p[:, 2] * fx + cx).astype(np.int64)
        y = np.floor(p[:, 1] / p[:, 2] * fy + cy).astype(np.int64)
        inside = (x >= 0) & (x < columns) & (y >= 0) & (y < rows)
        far_first = np.argsort(-p[inside, 2], kind="stable")
        y, x, z = y[inside][far_first], x[inside][far_first], p[inside, 2][far_first]
        inverse[y, x] = 1 / z
        weight[y, x] = 1
        _upwards(inverse, weight, (y, x), small, sky)
    filled = _guided(grey, _pull_push(inverse, weight))
    return np.asarray(1 / np.maximum(filled, 1 / FARTHEST), np.float32)


def _boxes(frame: Frame, inverse: F32, weight: F32, lens: tuple[float, float, float, float]) -> None:
    """Annotated objects are as far away as their boxes, the nearest in front. Changes both grids."""
    boxes = frame.boxes
    if not len(boxes):
        return
    fx, fy, cx, cy = lens
    pose = camera_to_world(frame)
    local = (boxes.corners() - pose[:3, 3]) @ pose[:3, :3]
    nearest = local[..., 2].min(1)
    for n in np.argsort(-nearest, kind="stable"):
        if nearest[n] < 1.0 or nearest[n] > 80:
            continue
        pixels = local[n, :, :2] / local[n, :, 2:] * [fx, fy] + [cx, cy]
        hull = np.floor(cv2.convexHull(pixels.astype(np.float32))).astype(np.int32)  # cells that hold the corners
        cv2.fillConvexPoly(inverse, hull, 1 / (0.5 * (nearest[n] + float(local[n, :, 2].mean()))))
        cv2.fillConvexPoly(weight, hull, 0.2)


def _upwards(inverse: F32, weight: F32, hits: tuple[Any, Any], image: Any, sky: Any) -> None:
    """Carries the topmost return of each column up to the sky: walls go on above the top beam.

    What looks like sky is still wall where its colour is that of the return below it.
    """
    y, x = hits
    rows, columns = inverse.shape
    top = np.full(columns, rows)
    np.minimum.at(top, x, y)
    hit = np.flatnonzero(top < rows)
    nearest = hit[np.abs(np.arange(columns)[:, None] - hit[None]).argmin(1)] if len(hit) else hit
    if not len(hit):
        return
    row = top[nearest]
    value = inverse[row, nearest]
    colour = image[row, nearest].astype(np.int16)
    alike = np.abs(image.astype(np.int16) - colour[None]).max(2) < 24
    number = np.arange(rows)[:, None]
    weight[sky & (number >= row[None]) & (weight < 1)] = _SKY_WEIGHT  # there is something: it is no sky
    above = (number < row[None]) & (~sky | (alike & (value > 1 / 60)[None]))
    inverse[above] = np.broadcast_to(value[None], inverse.shape)[above]
    weight[above] = 0.3


def _pull_push(value: F32, weight: F32) -> F32:
    """Fills values of little weight from coarser and coarser neighbourhoods."""
    if min(value.shape) < 4:
        return np.full_like(value, (value * weight).sum() / max(float(weight.sum()), 1e-9))
    sums, weights = cv2.pyrDown(value * weight), cv2.pyrDown(weight)
    coarse = _pull_push(sums / np.maximum(weights, 1e-9), np.minimum(weights * 4, 1))
    near = cv2.resize(coarse, (value.shape[1], value.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(near + (value - near) * np.minimum(weight, 1), np.float32)


def _guided(guide: F32, value: F32) -> F32:
    """Guided filter over 13 x 13 cells: a locally linear function of the guide."""
    size = (13, 13)
    mean_g, mean_v = cv2.blur(guide, size), cv2.blur(value, size)
    slope = (cv2.blur(guide * value, size) - mean_g * mean_v) / (cv2.blur(guide * guide, size) - mean_g**2 + 0.003)
    return np.asarray(cv2.blur(slope, size) * guide + cv2.blur(mean_v - slope * mean_g, size), np.float32)


def lens(batch: Batch, frames: Sequence[Frame]) -> Any:
    """(fx, fy, cx, cy) of each image, pixels, on the device."""
    ks = [f.camera.intrinsic for f in frames]
    return on(batch, np.array([[k[0, 0], k[1, 1], k[0, 2], k[1, 2]] for k in ks]), wp.vec4)
