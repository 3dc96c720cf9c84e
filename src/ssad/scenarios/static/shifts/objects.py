"""Object shifts: scale, shear, rotation and motion blur of each object inside its projected 3D box.

Physical: one draw per instance, the same in all cameras, over time and in the LiDAR; the object stays on the ground
and stays hidden behind nearer ones. Paper: one draw per sample for all objects, about the centre of the box; boxes
that leave the image are skipped, and occlusion is ignored (3D_Corruptions_AD).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import warp as wp

from ssad.core.boxes import UNIT_CORNERS, TrackedBoxes
from ssad.core.frames import Frame, ShiftReport, camera_to_world
from ssad.core.nuscenes_names import VISIBILITY
from ssad.core.rotations import quaternion_product, quaternion_to_matrix, yaw_to_quaternion
from ssad.core.types import F64
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.batch import Batch, structs, to_device
from ssad.scenarios.static.shifts.depth import lens
from ssad.scenarios.static.shifts.kernels import objects as kernels
from ssad.scenarios.static.shifts.spec import ShiftSpec

MIN_VISIBILITY = VISIBILITY["2"]  # objects with a lower visibility have too few pixels to move
MIN_PIXELS = 6.0
NEAREST = 0.3  # m before the camera
MAX_STREAK = 200.0  # px of a streak
MARGIN = 8


@lru_cache(maxsize=65536)
def _draw_deformation(spec: ShiftSpec, scope: tuple[str, ...], lidar: bool) -> tuple[tuple[float, ...], ...]:
    """Draw the deformation [3, 3] of an object in its own axes (x forward, y left, z up), as nested tuples."""
    if spec.severity == 0 or spec.name == "motion_blur":
        return ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    random = spec.generator("object", *scope)
    level = spec.severity - 1
    sign = random.choice([-1.0, 1.0], size=4)
    spread = random.uniform(-1.0, 1.0, size=4)
    is_paper_lidar = lidar and spec.calibration == "paper"  # the paper's LiDAR has separate figures and draws
    if spec.name == "scale" and is_paper_lidar:
        matrix = np.eye(3)
        axis = int(random.integers(3))
        matrix[axis, axis] += sign[0] * table.PAPER_LIDAR_SCALE[level]
    elif spec.name == "scale":
        matrix = np.eye(3) * (1 + sign[0] * table.SCALE[level])
    elif spec.name == "rotation":
        degrees = table.ROTATION[level] + spread[0] * table.ROTATION_SPREAD
        if is_paper_lidar:
            degrees = table.PAPER_LIDAR_ROTATION[level] + spread[0]
        angle = np.radians(sign[0] * degrees)
        matrix = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]])
    else:
        # 3DC draws from [c - .05, c + .05]; the wheels stay on the ground (f = 0) in the physical calibration
        shear_xz, shear_yx, shear_yz, shear_zx = sign * np.maximum(table.SHEAR[level] + spread * table.SHEAR_SPREAD, 0)
        matrix = np.array(
            [[1, 0, shear_xz], [shear_yx, 1, shear_yz], [shear_zx if spec.calibration == "paper" else 0.0, 0, 1]]
        )
    return tuple(tuple(float(value) for value in row) for row in matrix)


def deformations(spec: ShiftSpec, boxes: TrackedBoxes, *, scene: str, sample: str, lidar: bool = False) -> F64:
    """Return the deformation [N, 3, 3] of each object in its own axes; the paper's LiDAR has separate draws."""
    if spec.calibration == "paper":
        deformation = _draw_deformation(spec, ("lidar" if lidar else "sample", sample), lidar)
        return np.broadcast_to(np.array(deformation), (len(boxes), 3, 3))
    instance_deformations = [_draw_deformation(spec, ("instance", scene, name), lidar) for name in boxes.instance]
    return np.array(instance_deformations).reshape(-1, 3, 3)


def box_maps(boxes: TrackedBoxes) -> tuple[F64, F64]:
    """Return the maps from the unit cube to each box in the world: matrices [N, 3, 3] and centres [N, 3]."""
    return boxes.axes() * boxes.size_lwh[:, None], boxes.centre


def deformed_box_maps(
    spec: ShiftSpec, boxes: TrackedBoxes, *, scene: str, sample: str, lidar: bool = False
) -> tuple[F64, F64]:
    """Return the maps of `box_maps` after the shift.

    The deformation is about the centre of the base; for the paper's cameras, about the centre.
    """
    if not len(boxes):
        return np.zeros((0, 3, 3)), np.zeros((0, 3))
    deformation = deformations(spec, boxes, scene=scene, sample=sample, lidar=lidar)
    rotation = boxes.axes()
    matrix = rotation @ (deformation * boxes.size_lwh[:, None])
    # The paper's cameras deform about the centre, which therefore stays.
    if spec.calibration == "paper" and not lidar:
        return matrix, boxes.centre
    base_centre = np.zeros((len(boxes), 3))
    base_centre[:, 2] = -boxes.size_lwh[:, 2] / 2
    base_shift = base_centre - np.einsum("nij,nj->ni", deformation, base_centre)
    return matrix, boxes.centre + np.einsum("nij,nj->ni", rotation, base_shift)


def transformed_boxes(spec: ShiftSpec, boxes: TrackedBoxes, *, scene: str, sample: str) -> TrackedBoxes:
    """Return the boxes after an object shift (labels "transformed"); other shifts leave boxes unchanged.

    Scale and rotation are exact; for shear, it is the smallest box that keeps the direction of the length and
    contains the sheared corners.

    Args:
        spec: The shift.
        boxes: Boxes of one sample.
        scene: Name of the scene, for the random numbers.
        sample: Token of the sample, for the random numbers.
    """
    if spec.family != "object" or spec.name == "motion_blur" or spec.severity == 0 or not len(boxes):
        return boxes
    matrix, centre = deformed_box_maps(spec, boxes, scene=scene, sample=sample)
    direction = matrix[:, :, 0] / np.linalg.norm(matrix[:, :, 0], axis=1, keepdims=True)
    rotation = boxes.axes()
    forward, lateral = (np.einsum("ni,ni->n", direction, rotation[:, :, axis]) for axis in (0, 1))
    yaw_change = np.arctan2(lateral, forward)
    quaternion = quaternion_product(boxes.rotation, yaw_to_quaternion(yaw_change))
    axes = quaternion_to_matrix(quaternion)
    corners = np.einsum("nji,nkj->nki", axes, np.einsum("nij,kj->nki", matrix, UNIT_CORNERS))
    lowest, highest = corners.min(1), corners.max(1)
    local_centre = np.einsum("nij,nj->ni", axes, (lowest + highest) / 2)
    return replace(boxes, centre=centre + local_centre, size_lwh=highest - lowest, rotation=quaternion)


def _outline(points: F64) -> F64:
    """Return the convex hull [K, 2] of projected corners [8, 2]."""
    return np.asarray(cv2.convexHull(points.astype(np.float32))[:, 0], np.float64)


class _Plan:
    """Items of all images of a batch, in the layout of the kernels."""

    def __init__(self) -> None:
        self.items: list[tuple[Any, ...]] = []
        self.points: list[F64] = []
        self.point_count = 0
        self.node_count = 0
        self.first = [0]
        self.lines: list[tuple[int, int, int]] = []  # rank, item, number of lines

    def keep_painted(self) -> None:
        """Drop the items that are not painted: the paper's calibration ignores occlusion."""
        counts = [
            sum(1 for item in self.items if item[0] == image_index and not item[18])
            for image_index in range(len(self.first) - 1)
        ]
        self.items = [item for item in self.items if not item[18]]
        self.first = [0, *np.cumsum(counts).tolist()]

    def outline(self, points: F64) -> tuple[int, int]:
        """Store an outline; returns its offset and size."""
        offset = self.point_count
        self.points.append(points)
        self.point_count += len(points)
        return offset, len(points)


def _pixels(corners: F64, intrinsic: F64) -> F64:
    """Return the pixels [N, 8, 2] of points in the camera frame [N, 8, 3]."""
    depth = np.maximum(corners[..., 2], 1e-3)
    return np.stack(
        [
            intrinsic[0, 0] * corners[..., 0] / depth + intrinsic[0, 2],
            intrinsic[1, 1] * corners[..., 1] / depth + intrinsic[1, 2],
        ],
        -1,
    )


def _plan_frame(plan: _Plan, index: int, frame: Frame, spec: ShiftSpec) -> ShiftReport:
    """Plan the boxes of one image, the farthest first."""
    boxes, intrinsic = frame.boxes, frame.camera.intrinsic
    width, height = frame.camera.width, frame.camera.height
    skipped: Counter[str] = Counter()
    painted_count = 0
    if len(boxes):
        pose = camera_to_world(frame)
        world_to_camera, camera_position = pose[:3, :3].T, pose[:3, 3]
        old_maps, old_centres = box_maps(boxes)
        new_maps, new_centres = deformed_box_maps(spec, boxes, scene=frame.scene, sample=frame.sample)
        old_maps, new_maps = world_to_camera @ old_maps, world_to_camera @ new_maps
        old_centres, new_centres = (
            (old_centres - camera_position) @ world_to_camera.T,
            (new_centres - camera_position) @ world_to_camera.T,
        )
        old_corners = np.einsum("nij,kj->nki", old_maps, UNIT_CORNERS) + old_centres[:, None]
        new_corners = np.einsum("nij,kj->nki", new_maps, UNIT_CORNERS) + new_centres[:, None]
        pixels, new_pixels = _pixels(old_corners, intrinsic), _pixels(new_corners, intrinsic)
        is_ahead = old_corners[..., 2].max(1) > NEAREST
        is_visible = is_ahead & (pixels.max(1) > 0).all(1) & (pixels.min(1) < [width, height]).all(1)
        is_in_front = (old_corners[..., 2].min(1) > NEAREST) & (new_corners[..., 2].min(1) > NEAREST)
        is_cut = (pixels.min(1) < 0).any(1) | (pixels.max(1) > [width, height]).any(1)
        streaks, still_reasons = _streaks(frame, spec, boxes, old_centres, world_to_camera)
        order = np.argsort(-np.linalg.norm(old_centres, axis=1), kind="stable")
        rank = 0
        for box_index in order:
            if not is_visible[box_index]:
                continue
            if not is_in_front[box_index]:
                skipped["too near the camera"] += 1
                continue
            old_outline, new_outline = _outline(pixels[box_index]), _outline(new_pixels[box_index])
            extent = old_outline.max(0) - old_outline.min(0)
            reason = ""
            if extent.min() < MIN_PIXELS or new_outline.shape[0] < 3 or old_outline.shape[0] < 3:
                reason = "too small in the image"
            elif spec.calibration == "physical" and boxes.visible[box_index] < MIN_VISIBILITY:
                reason = "hidden by others"
            elif spec.calibration == "paper" and is_cut[box_index]:
                reason = "partly outside the image"
            elif spec.name == "motion_blur" and spec.calibration == "physical":
                reason = still_reasons[box_index]
            if reason:
                skipped[reason] += 1
            # Skipped boxes are stored too, since they still hide those behind them.
            if old_outline.shape[0] < 3 or new_outline.shape[0] < 3:
                continue
            rank += 1
            painted_count += not reason
            _add_item(
                plan,
                index,
                maps=(new_maps[box_index], new_centres[box_index], old_maps[box_index], old_centres[box_index]),
                outlines=(old_outline, new_outline),
                rank_and_skip=(rank, bool(reason)),
                streak=streaks[box_index],
                size=(width, height),
            )
    plan.first.append(len(plan.items))
    return ShiftReport(painted_count > 0, {"objects": painted_count}, dict(skipped))


def _streaks(
    frame: Frame, spec: ShiftSpec, boxes: TrackedBoxes, centre: F64, world_to_camera: F64
) -> tuple[F64, list[str]]:
    """Return the displacement [N, 2] of each object's centre in the image over the exposure, or the reason for none."""
    count = len(boxes)
    streaks, reasons = np.zeros((count, 2)), [""] * count
    if spec.name != "motion_blur" or spec.calibration == "paper":
        return streaks, reasons
    intrinsic = frame.camera.intrinsic
    relative = (boxes.velocity - frame.ego_velocity) @ world_to_camera.T * table.BLUR_EXPOSURE[spec.severity - 1]
    end_points = np.stack([centre - relative / 2, centre + relative / 2], 1)
    end_points[..., 2] = np.maximum(end_points[..., 2], NEAREST)
    displacements = np.diff(_pixels(end_points, intrinsic), axis=1)[:, 0]
    for box_index in range(count):
        if not np.isfinite(displacements[box_index]).all():
            reasons[box_index] = "its velocity is unknown"
        elif np.abs(displacements[box_index]).max() < 1:
            reasons[box_index] = "it does not move in the image"
        else:
            streaks[box_index] = displacements[box_index] * min(
                1.0, MAX_STREAK / float(np.abs(displacements[box_index]).max())
            )
    return streaks, reasons


def _add_item(
    plan: _Plan,
    index: int,
    *,
    maps: tuple[F64, F64, F64, F64],
    outlines: tuple[F64, F64],
    rank_and_skip: tuple[int, bool],
    streak: F64,
    size: tuple[int, int],
) -> None:
    """Add one row of the kernels' `Item`."""
    new_map, new_centre, old_map, old_centre = maps
    old_outline, new_outline = outlines
    rank, is_skipped = rank_and_skip
    inverse_map = np.linalg.inv(new_map)
    smaller_outline = (
        old_outline if np.ptp(old_outline, axis=0).prod() < np.ptp(new_outline, axis=0).prod() else new_outline
    )
    centre = smaller_outline.mean(0)
    all_points = np.concatenate([old_outline, new_outline])
    if streak.any():
        reach = np.abs(streak) / 2 + 2
        lower, upper = old_outline.min(0) - reach, old_outline.max(0) + reach
    else:
        lower = centre + (all_points.min(0) - centre) * 1.25 - MARGIN
        upper = centre + (all_points.max(0) - centre) * 1.25 + MARGIN
    lower = np.clip(np.floor(lower), 0, [size[0] - 1, size[1] - 1]).astype(int)
    upper = np.clip(np.ceil(upper) + 1, 1, size).astype(int)
    node_columns, node_rows = ((upper - lower + kernels.STEP - 1) // kernels.STEP + 2).tolist()
    plan.items.append(
        (
            index,
            inverse_map,
            -inverse_map @ new_centre,
            old_map,
            old_centre,
            centre,
            *plan.outline(new_outline),
            *plan.outline(old_outline),
            lower[0],
            lower[1],
            upper[0],
            upper[1],
            plan.node_count,
            node_columns,
            node_rows,
            rank,
            int(is_skipped),
            streak,
        )
    )
    if not is_skipped and streak.any():
        plan.lines.append((rank, len(plan.items) - 1, int((upper - lower).sum()) + 4))
    if not is_skipped and not streak.any():
        plan.node_count += node_columns * node_rows


def _stamp(batch: Batch, plan: _Plan) -> tuple[Any, Any, Any, Any]:
    """Return items, outlines and offsets on the device, and the rank of the box that owns each pixel."""
    items = structs(batch, plan.items, kernels.Item)
    points, offsets = to_device(batch, np.concatenate(plan.points), wp.vec2), to_device(batch, plan.first, wp.int32)
    owner_ranks = wp.zeros((batch.count, batch.height, batch.width), dtype=wp.int16, device=batch.device)
    batch.launch(kernels.stamp, (batch.count, batch.height), [items, offsets, points], owner_ranks)
    return items, points, offsets, owner_ranks


def owners(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> tuple[Any, list[ShiftReport]]:
    """Return the rank of the nearest box at each pixel, int16 [B, H, W], 0 for none; boxes of the paper."""
    plan = _Plan()
    records = [
        _plan_frame(plan, index, frame, spec) for index, (frame, spec) in enumerate(zip(frames, specs, strict=True))
    ]
    plan.keep_painted()
    if not plan.items:
        return wp.zeros((batch.count, batch.height, batch.width), dtype=wp.int16, device=batch.device), records
    return _stamp(batch, plan)[3], records


def move_objects(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> tuple[Batch, list[ShiftReport]]:
    """Apply scale, shear or rotation, or the motion blur of the physical calibration."""
    plan = _Plan()
    records = [
        _plan_frame(plan, index, frame, spec) for index, (frame, spec) in enumerate(zip(frames, specs, strict=True))
    ]
    result = batch.copy()
    if not any(record.applied for record in records):
        return result, records
    items, points, offsets, owner_ranks = _stamp(batch, plan)
    respects_occlusion = int(specs[0].calibration == "physical")
    if plan.lines:
        # One launch per rank, far to near, so that a nearer streak is laid over a farther one.
        for rank in sorted({item_rank for item_rank, _, _ in plan.lines}):
            ranked_lines = [(item, line_count) for item_rank, item, line_count in plan.lines if item_rank == rank]
            item_indices = to_device(batch, [item for item, _ in ranked_lines], wp.int32)
            thread_shape = (len(ranked_lines), max(line_count for _, line_count in ranked_lines) * 2)
            batch.launch(
                kernels.smear, thread_shape, [batch.data, items, item_indices, owner_ranks, batch.stride], result.data
            )
        return result, records
    nodes = wp.zeros(plan.node_count, dtype=wp.vec4, device=batch.device)
    tallest = max(item_row[16] for item_row in plan.items)
    batch.launch(kernels.displace, (len(plan.items), tallest), [items, points, lens(batch, frames)], nodes)
    inputs = [batch.words(), items, offsets, owner_ranks, nodes, respects_occlusion, batch.stride]
    batch.launch(kernels.paint, (batch.count, batch.height), inputs, result.data)
    return result, records
