"""Depth of every pixel: given, or filled in from LiDAR returns, the road and the image.

A sweep reaches a few thousand pixels and nothing above its top beam, so the rest is filled by normalised convolution
over a pyramid (Knutsson and Westin 1993), in inverse depth, from the returns, the plane of the road, and a distant
sky; then a guided filter (He, Sun and Tang 2010) aligns edges of the depth with edges of the image. The grid is a
quarter of the image, as the veil needs it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import warp as wp

from ssad.core.frames import Frame, camera_to_world
from ssad.core.types import F32
from ssad.scenarios.static.shifts.batch import Batch, to_device

FARTHEST = 1000.0
_ROAD_WEIGHT, _SKY_WEIGHT = 0.02, 0.002


def grid_size(batch: Batch) -> tuple[int, int]:
    """Return the rows and columns of the quarter grid."""
    return -(-batch.height // 4), -(-batch.width // 4)


def depth_grid(batch: Batch, frames: Sequence[Frame]) -> tuple[Any, list[str]]:
    """Return the depth [B, h, w] on the batch's device, metres along the optical axis, and its sources.

    Sources: "given", "lidar" (returns, road, image) or "assumed" (road and image alone).
    """
    rows, columns = grid_size(batch)
    pixels = batch.numpy() if any(frame.depth is None for frame in frames) else None
    results = [
        depth_of(frame, None if pixels is None else pixels[index], rows, columns) for index, frame in enumerate(frames)
    ]
    grids, sources = zip(*results, strict=True)
    return to_device(batch, np.stack(grids)), list(sources)


def depth_of(frame: Frame, image: Any, rows: int, columns: int) -> tuple[F32, str]:
    """Return the depth [rows, columns] of a frame, and its source; the image [H, W, 3] fills in missing depth."""
    if frame.depth is not None:
        return _resample(np.asarray(frame.depth, np.float32), rows, columns), "given"
    source = "assumed" if frame.points is None or not len(frame.points) else "lidar"
    return fill_depth(frame, image, rows, columns), source


def _resample(depth: F32, rows: int, columns: int) -> F32:
    """Resample a depth map to the quarter grid and fill in unknown cells (0, NaN)."""
    if depth.shape != (rows, columns):
        row_indices = np.minimum(((np.arange(rows) + 0.5) / rows * depth.shape[0]).astype(int), depth.shape[0] - 1)
        column_indices = np.minimum(
            ((np.arange(columns) + 0.5) / columns * depth.shape[1]).astype(int), depth.shape[1] - 1
        )
        depth = depth[row_indices][:, column_indices]
    is_known = depth > 0  # False for NaN
    if is_known.all():
        return np.minimum(depth, FARTHEST)
    inverse = np.where(is_known, 1.0 / np.where(is_known, depth, 1), 0).astype(np.float32)
    filled = _pull_push(inverse, is_known.astype(np.float32))
    return np.where(is_known, np.minimum(depth, FARTHEST), 1 / np.maximum(filled, 1 / FARTHEST)).astype(np.float32)


def fill_depth(frame: Frame, image: Any, rows: int, columns: int) -> F32:
    """Fill in the depth [rows, columns] of an image [H, W, 3] from LiDAR returns, the road plane and the image."""
    height, width = image.shape[:2]
    intrinsic = frame.camera.intrinsic
    scale_x, scale_y = columns / width, rows / height
    fx, fy = intrinsic[0, 0] * scale_x, intrinsic[1, 1] * scale_y
    cx, cy = intrinsic[0, 2] * scale_x, intrinsic[1, 2] * scale_y
    small_image = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA)
    luminance = cv2.cvtColor(small_image, cv2.COLOR_RGB2GRAY).astype(np.float32) / 255

    # the road: where a ray meets the plane z = 0 of the ego; the height of a ray over the ground is linear in u and v
    rotation, camera_position = frame.camera.to_ego[:3, :3], frame.camera.to_ego[:3, 3]
    u = ((np.arange(columns, dtype=np.float32) + 0.5 - cx) / fx)[None]
    v = ((np.arange(rows, dtype=np.float32) + 0.5 - cy) / fy)[:, None]
    ray_height = (rotation[2, 0] * u + rotation[2, 1] * v + rotation[2, 2]).astype(np.float32)
    inverse = np.maximum(-ray_height / max(float(camera_position[2]), 0.3), 0).astype(np.float32)
    weight = np.where(inverse > 1 / 80, np.float32(_ROAD_WEIGHT), np.float32(0))

    # the sky: above the horizon, smooth, and bright for this image and not red, or blue
    texture = np.abs(cv2.Laplacian(luminance, cv2.CV_32F, ksize=3))
    is_bright = luminance > 0.7 * float(np.quantile(luminance[::4, ::4], 0.95))
    red, blue_channel = small_image[..., 0].astype(np.float32), small_image[..., 2].astype(np.float32)
    is_blue = (blue_channel - red > 40) & (blue_channel > 130)
    is_sky = (
        (ray_height > 0.02)
        & (is_blue | (is_bright & (blue_channel >= red * 0.92)))
        & (cv2.blur(texture, (5, 5)) < 0.08)
    )
    # close the holes that clouds leave
    is_sky = (cv2.morphologyEx(is_sky.astype(np.uint8), cv2.MORPH_CLOSE, np.ones((9, 9), np.uint8)) > 0) & (
        ray_height > 0.02
    )
    weight[ray_height > 0] = _SKY_WEIGHT
    weight[is_sky] = 0.5
    inverse[ray_height > 0] = 0

    _write_boxes(frame, inverse, weight, (fx, fy, cx, cy))
    points = frame.points
    if points is None or not len(points):
        # upright surfaces without any return: assume houses along a street
        is_upright = (ray_height > 0) & ~is_sky & (weight < 0.1)
        inverse[is_upright], weight[is_upright] = 1 / 45, 0.05
    if points is not None and len(points):
        camera_points = np.asarray(points, np.float32)[:, :3]
        camera_points = camera_points[camera_points[:, 2] > 1.0]
        columns_hit = np.floor(camera_points[:, 0] / camera_points[:, 2] * fx + cx).astype(np.int64)
        rows_hit = np.floor(camera_points[:, 1] / camera_points[:, 2] * fy + cy).astype(np.int64)
        is_inside = (columns_hit >= 0) & (columns_hit < columns) & (rows_hit >= 0) & (rows_hit < rows)
        # Far to near, so that the nearest return of a cell is written last.
        far_to_near = np.argsort(-camera_points[is_inside, 2], kind="stable")
        rows_hit, columns_hit, depth = (
            rows_hit[is_inside][far_to_near],
            columns_hit[is_inside][far_to_near],
            camera_points[is_inside, 2][far_to_near],
        )
        inverse[rows_hit, columns_hit] = 1 / depth
        weight[rows_hit, columns_hit] = 1
        _extend_walls(inverse, weight, (rows_hit, columns_hit), small_image, is_sky)
    filled = _guided(luminance, _pull_push(inverse, weight))
    return np.asarray(1 / np.maximum(filled, 1 / FARTHEST), np.float32)


def _write_boxes(frame: Frame, inverse: F32, weight: F32, intrinsic: tuple[float, float, float, float]) -> None:
    """Write the depth of annotated boxes into both grids, the nearest last."""
    boxes = frame.boxes
    if not len(boxes):
        return
    fx, fy, cx, cy = intrinsic
    pose = camera_to_world(frame)
    local = (boxes.corners() - pose[:3, 3]) @ pose[:3, :3]
    nearest = local[..., 2].min(1)
    for box_index in np.argsort(-nearest, kind="stable"):
        if nearest[box_index] < 1.0 or nearest[box_index] > 80:
            continue
        pixels = local[box_index, :, :2] / local[box_index, :, 2:] * [fx, fy] + [cx, cy]
        outline = np.floor(cv2.convexHull(pixels.astype(np.float32))).astype(np.int32)  # cells that contain the corners
        cv2.fillConvexPoly(inverse, outline, 1 / (0.5 * (nearest[box_index] + float(local[box_index, :, 2].mean()))))
        cv2.fillConvexPoly(weight, outline, 0.2)


def _extend_walls(inverse: F32, weight: F32, hits: tuple[Any, Any], image: Any, sky: Any) -> None:
    """Extend the topmost return of each column up to the sky, since walls continue above the top beam.

    A cell that looks like sky is still wall if its colour matches that of the return below it.
    """
    hit_rows, hit_columns = hits
    rows, columns = inverse.shape
    top_row = np.full(columns, rows)
    np.minimum.at(top_row, hit_columns, hit_rows)
    columns_with_hit = np.flatnonzero(top_row < rows)
    nearest_column = (
        columns_with_hit[np.abs(np.arange(columns)[:, None] - columns_with_hit[None]).argmin(1)]
        if len(columns_with_hit)
        else columns_with_hit
    )
    if not len(columns_with_hit):
        return
    nearest_row = top_row[nearest_column]
    inverse_depth = inverse[nearest_row, nearest_column]
    hit_colour = image[nearest_row, nearest_column].astype(np.int16)
    similar = np.abs(image.astype(np.int16) - hit_colour[None]).max(2) < 24
    row_numbers = np.arange(rows)[:, None]
    weight[sky & (row_numbers >= nearest_row[None]) & (weight < 1)] = _SKY_WEIGHT  # there is something: it is no sky
    is_wall = (row_numbers < nearest_row[None]) & (~sky | (similar & (inverse_depth > 1 / 60)[None]))
    inverse[is_wall] = np.broadcast_to(inverse_depth[None], inverse.shape)[is_wall]
    weight[is_wall] = 0.3


def _pull_push(value: F32, weight: F32) -> F32:
    """Fill values of low weight from coarser and coarser neighbourhoods."""
    if min(value.shape) < 4:
        return np.full_like(value, (value * weight).sum() / max(float(weight.sum()), 1e-9))
    sums, weights = cv2.pyrDown(value * weight), cv2.pyrDown(weight)
    coarse = _pull_push(sums / np.maximum(weights, 1e-9), np.minimum(weights * 4, 1))
    upsampled = cv2.resize(coarse, (value.shape[1], value.shape[0]), interpolation=cv2.INTER_LINEAR)
    return np.asarray(upsampled + (value - upsampled) * np.minimum(weight, 1), np.float32)


def _guided(guide: F32, value: F32) -> F32:
    """Apply a guided filter over 13 x 13 cells: a locally linear function of the guide."""
    size = (13, 13)
    guide_mean, value_mean = cv2.blur(guide, size), cv2.blur(value, size)
    slope = (cv2.blur(guide * value, size) - guide_mean * value_mean) / (
        cv2.blur(guide * guide, size) - guide_mean**2 + 0.003
    )
    return np.asarray(cv2.blur(slope, size) * guide + cv2.blur(value_mean - slope * guide_mean, size), np.float32)


def lens(batch: Batch, frames: Sequence[Frame]) -> Any:
    """Return (fx, fy, cx, cy) of each image, pixels, on the device."""
    intrinsics = [frame.camera.intrinsic for frame in frames]
    return to_device(
        batch,
        np.array([[intrinsic[0, 0], intrinsic[1, 1], intrinsic[0, 2], intrinsic[1, 2]] for intrinsic in intrinsics]),
        wp.vec4,
    )
