"""Object shifts: scale, shear, rotation and motion blur of each object inside its projected 3D box.

Physical: drawn once an instance, so that it is the same in all cameras, over time and in the LiDAR; the object stays
on the ground; what hides it goes on hiding it. Paper: one draw a sample for all objects, about the centre of the box,
boxes that leave the picture are skipped, nothing is hidden (3D_Corruptions_AD).
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
from ssad.core.frames import Applied, Frame, camera_to_world
from ssad.core.nuscenes_names import VISIBILITY
from ssad.core.rotations import quaternion_product, quaternion_to_matrix, yaw_to_quaternion
from ssad.core.types import F64
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.batch import Batch, on, structs
from ssad.scenarios.static.shifts.depth import lens
from ssad.scenarios.static.shifts.kernels import objects as kernels
from ssad.scenarios.static.shifts.spec import ShiftSpec

LEAST_VISIBLE = VISIBILITY["2"]  # objects less visible than this have no pixels worth moving
LEAST_PIXELS = 6.0
NEAREST = 0.3  # m before the camera
LONGEST = 200.0  # px of a streak
MARGIN = 8


@lru_cache(maxsize=65536)
def _draw(spec: ShiftSpec, scope: tuple[str, ...], lidar: bool) -> tuple[tuple[float, ...], ...]:
    """Deformation [3, 3] of an object in its own axes (x forward, y left, z up), as nested tuples."""
    if spec.severity == 0 or spec.name == "motion_blur":
        return ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    draws = spec.generator("object", *scope)
    step = spec.severity - 1
    sign = draws.choice([-1.0, 1.0], size=4)
    spread = draws.uniform(-1.0, 1.0, size=4)
    other = lidar and spec.calibration == "paper"  # its LiDAR has figures and draws of its own
    if spec.name == "scale" and other:
        matrix = np.eye(3)
        axis = int(draws.integers(3))
        matrix[axis, axis] += sign[0] * table.PAPER_LIDAR_SCALE[step]
    elif spec.name == "scale":
        matrix = np.eye(3) * (1 + sign[0] * table.SCALE[step])
    elif spec.name == "rotation":
        degrees = table.ROTATION[step] + spread[0] * table.ROTATION_SPREAD
        if other:
            degrees = table.PAPER_LIDAR_ROTATION[step] + spread[0]
        a = np.radians(sign[0] * degrees)
        matrix = np.array([[np.cos(a), -np.sin(a), 0], [np.sin(a), np.cos(a), 0], [0, 0, 1.0]])
    else:
        # 3DC draws from [c - .05, c + .05]; the wheels stay on the ground (f = 0) in the physical calibration
        b, d, e, f = sign * np.maximum(table.SHEAR[step] + spread * table.SHEAR_SPREAD, 0)
        matrix = np.array([[1, 0, b], [d, 1, e], [f if spec.calibration == "paper" else 0.0, 0, 1]])
    return tuple(tuple(float(v) for v in row) for row in matrix)


def deformations(spec: ShiftSpec, boxes: TrackedBoxes, *, scene: str, sample: str, lidar: bool = False) -> F64:
    """[N, 3, 3]: what happens to each object, in its own axes. The paper draws anew for the LiDAR."""
    if spec.calibration == "paper":
        drawn = _draw(spec, ("lidar" if lidar else "sample", sample), lidar)
        return np.broadcast_to(np.array(drawn), (len(boxes), 3, 3))
    found = [_draw(spec, ("instance", scene, name), lidar) for name in boxes.instance]
    return np.array(found).reshape(-1, 3, 3)


def affine(boxes: TrackedBoxes) -> tuple[F64, F64]:
    """Unit cube -> box in the world: matrices [N, 3, 3] and centres [N, 3]; the axes are length, width, height."""
    return boxes.axes() * boxes.size_lwh[:, None], boxes.centre


def deformed(spec: ShiftSpec, boxes: TrackedBoxes, *, scene: str, sample: str, lidar: bool = False) -> tuple[F64, F64]:
    """The same after the shift: about the middle of the base; the paper's cameras, about the centre."""
    if not len(boxes):
        return np.zeros((0, 3, 3)), np.zeros((0, 3))
    d = deformations(spec, boxes, scene=scene, sample=sample, lidar=lidar)
    rotation = boxes.axes()
    matrix = rotation @ (d * boxes.size_lwh[:, None])
    if spec.calibration == "paper" and not lidar:
        return matrix, boxes.centre
    foot = np.zeros((len(boxes), 3))
    foot[:, 2] = -boxes.size_lwh[:, 2] / 2
    moved = foot - np.einsum("nij,nj->ni", d, foot)
    return matrix, boxes.centre + np.einsum("nij,nj->ni", rotation, moved)


def transformed_boxes(spec: ShiftSpec, boxes: TrackedBoxes, *, scene: str, sample: str) -> TrackedBoxes:
    """The boxes after an object shift (labels "transformed"); other shifts leave boxes unchanged.

    Scale and rotation are exact; for shear, it is the smallest box that keeps the direction of the length and contains
    the sheared corners.

    Args:
        spec: The shift.
        boxes: Boxes of one sample.
        scene: Name of the scene, for the random numbers.
        sample: Token of the sample, for the random numbers.
    """
    if spec.family != "object" or spec.name == "motion_blur" or spec.severity == 0 or not len(boxes):
        return boxes
    matrix, centre = deformed(spec, boxes, scene=scene, sample=sample)
    length = matrix[:, :, 0] / np.linalg.norm(matrix[:, :, 0], axis=1, keepdims=True)
    rotation = boxes.axes()
    forward, aside = (np.einsum("ni,ni->n", length, rotation[:, :, k]) for k in (0, 1))
    turn = np.arctan2(aside, forward)
    quaternion = quaternion_product(boxes.rotation, yaw_to_quaternion(turn))
    axes = quaternion_to_matrix(quaternion)
    corners = np.einsum("nji,nkj->nki", axes, np.einsum("nij,kj->nki", matrix, UNIT_CORNERS))
    low, high = corners.min(1), corners.max(1)
    middle = np.einsum("nij,nj->ni", axes, (low + high) / 2)
    return replace(boxes, centre=centre + middle, size_lwh=high - low, rotation=quaternion)


def _outline(points: F64) -> F64:
    """Convex hull [K, 2] of projected corners [8, 2]."""
    return np.asarray(cv2.convexHull(points.astype(np.float32))[:, 0], np.float64)


class _Plan:
    """Items of all images of a batch, as the kernels want them."""

    def __init__(self) -> None:
        self.items: list[tuple[Any, ...]] = []
        self.points: list[F64] = []
        self.point_count = 0
        self.node_count = 0
        self.first = [0]
        self.lines: list[tuple[int, int, int]] = []  # rank, item, number of lines

    def keep_painted(self) -> None:
        """Drops the items that are not painted: in the paper's calibration nothing hides anything."""
        counts = [sum(1 for row in self.items if row[0] == b and not row[18]) for b in range(len(self.first) - 1)]
        self.items = [row for row in self.items if not row[18]]
        self.first = [0, *np.cumsum(counts).tolist()]

    def outline(self, points: F64) -> tuple[int, int]:
        """Stores an outline."""
        first = self.point_count
        self.points.append(points)
        self.point_count += len(points)
        return first, len(points)


def _pixels(corners: F64, k: F64) -> F64:
    """Pixels [N, 8, 2] of points in the camera frame [N, 8, 3]."""
    z = np.maximum(corners[..., 2], 1e-3)
    return np.stack([k[0, 0] * corners[..., 0] / z + k[0, 2], k[1, 1] * corners[..., 1] / z + k[1, 2]], -1)


def _plan_frame(plan: _Plan, index: int, frame: Frame, spec: ShiftSpec) -> Applied:
    """Adds the boxes of one image, the farthest first."""
    boxes, k = frame.boxes, frame.camera.intrinsic
    width, height = frame.camera.width, frame.camera.height
    skipped: Counter[str] = Counter()
    done = 0
    if len(boxes):
        pose = camera_to_world(frame)
        turn, place = pose[:3, :3].T, pose[:3, 3]
        old, old_centre = affine(boxes)
        new, new_centre = deformed(spec, boxes, scene=frame.scene, sample=frame.sample)
        old, new = turn @ old, turn @ new
        old_centre, new_centre = (old_centre - place) @ turn.T, (new_centre - place) @ turn.T
        before = np.einsum("nij,kj->nki", old, UNIT_CORNERS) + old_centre[:, None]
        after = np.einsum("nij,kj->nki", new, UNIT_CORNERS) + new_centre[:, None]
        pixels, moved = _pixels(before, k), _pixels(after, k)
        ahead = before[..., 2].max(1) > NEAREST
        seen = ahead & (pixels.max(1) > 0).all(1) & (pixels.min(1) < [width, height]).all(1)
        whole = (before[..., 2].min(1) > NEAREST) & (after[..., 2].min(1) > NEAREST)
        outside = (pixels.min(1) < 0).any(1) | (pixels.max(1) > [width, height]).any(1)
        streaks, why_still = _streaks(frame, spec, boxes, old_centre, turn)
        order = np.argsort(-np.linalg.norm(old_centre, axis=1), kind="stable")
        rank = 0
        for n in order:
            if not seen[n]:
                continue
            if not whole[n]:
                skipped["too near the camera"] += 1
                continue
            outline, target = _outline(pixels[n]), _outline(moved[n])
            extent = outline.max(0) - outline.min(0)
            reason = ""
            if extent.min() < LEAST_PIXELS or target.shape[0] < 3 or outline.shape[0] < 3:
                reason = "too small in the image"
            elif spec.calibration == "physical" and boxes.visible[n] < LEAST_VISIBLE:
                reason = "hidden by others"
            elif spec.calibration == "paper" and outside[n]:
                reason = "partly outside the image"
            elif spec.name == "motion_blur" and spec.calibration == "physical":
                reason = why_still[n]
            if reason:
                skipped[reason] += 1
            if outline.shape[0] < 3 or target.shape[0] < 3:
                continue
            rank += 1
            done += not reason
            _add_item(
                plan,
                index,
                maps=(new[n], new_centre[n], old[n], old_centre[n]),
                outlines=(outline, target),
                place=(rank, bool(reason)),
                streak=streaks[n],
                size=(width, height),
            )
    plan.first.append(len(plan.items))
    return Applied(done > 0, {"objects": done}, dict(skipped))


def _streaks(frame: Frame, spec: ShiftSpec, boxes: TrackedBoxes, centre: F64, turn: F64) -> tuple[F64, list[str]]:
    """Displacement [N, 2] of each object's centre in the image over the exposure, and why there is none."""
    count = len(boxes)
    streaks, why = np.zeros((count, 2)), [""] * count
    if spec.name != "motion_blur" or spec.calibration == "paper":
        return streaks, why
    k = frame.camera.intrinsic
    relative = (boxes.velocity - frame.ego_velocity) @ turn.T * table.BLUR_EXPOSURE[spec.severity - 1]
    ends = np.stack([centre - relative / 2, centre + relative / 2], 1)
    ends[..., 2] = np.maximum(ends[..., 2], NEAREST)
    found = np.diff(_pixels(ends, k), axis=1)[:, 0]
    for n in range(count):
        if not np.isfinite(found[n]).all():
            why[n] = "its velocity is unknown"
        elif np.abs(found[n]).max() < 1:
            why[n] = "it does not move in the image"
        else:
            streaks[n] = found[n] * min(1.0, LONGEST / float(np.abs(found[n]).max()))
    return streaks, why


def _add_item(
    plan: _Plan,
    index: int,
    *,
    maps: tuple[F64, F64, F64, F64],
    outlines: tuple[F64, F64],
    place: tuple[int, bool],
    streak: F64,
    size: tuple[int, int],
) -> None:
    """One row of the kernels' `Item`."""
    new, new_centre, old, old_centre = maps
    outline, target = outlines
    rank, skip = place
    into = np.linalg.inv(new)
    small = outline if np.ptp(outline, axis=0).prod() < np.ptp(target, axis=0).prod() else target
    middle = small.mean(0)
    both = np.concatenate([outline, target])
    if streak.any():
        reach = np.abs(streak) / 2 + 2
        low, high = outline.min(0) - reach, outline.max(0) + reach
    else:
        low = middle + (both.min(0) - middle) * 1.25 - MARGIN
        high = middle + (both.max(0) - middle) * 1.25 + MARGIN
    low = np.clip(np.floor(low), 0, [size[0] - 1, size[1] - 1]).astype(int)
    high = np.clip(np.ceil(high) + 1, 1, size).astype(int)
    wide, tall = ((high - low + kernels.STEP - 1) // kernels.STEP + 2).tolist()
    plan.items.append(
        (
            index,
            into,
            -into @ new_centre,
            old,
            old_centre,
            middle,
            *plan.outline(target),
            *plan.outline(outline),
            low[0],
            low[1],
            high[0],
            high[1],
            plan.node_count,
            wide,
            tall,
            rank,
            int(skip),
            streak,
        )
    )
    if not skip and streak.any():
        plan.lines.append((rank, len(plan.items) - 1, int((high - low).sum()) + 4))
    if not skip and not streak.any():
        plan.node_count += wide * tall


def _stamp(batch: Batch, plan: _Plan) -> tuple[Any, Any, Any, Any]:
    """Items, outlines and where each image's items start, on the device; and whose pixel each pixel is."""
    items = structs(batch, plan.items, kernels.Item)
    points, first = on(batch, np.concatenate(plan.points), wp.vec2), on(batch, plan.first, wp.int32)
    owner = wp.zeros((batch.count, batch.height, batch.width), dtype=wp.int16, device=batch.device)
    batch.launch(kernels.stamp, (batch.count, batch.height), [items, first, points], owner)
    return items, points, first, owner


def owners(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> tuple[Any, list[Applied]]:
    """int16 [B, H, W]: rank of the nearest box whose outline covers a pixel, 0 for none; boxes as the paper has it."""
    plan = _Plan()
    done = [_plan_frame(plan, b, frame, spec) for b, (frame, spec) in enumerate(zip(frames, specs, strict=True))]
    plan.keep_painted()
    if not plan.items:
        return wp.zeros((batch.count, batch.height, batch.width), dtype=wp.int16, device=batch.device), done
    return _stamp(batch, plan)[3], done


def move_objects(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> tuple[Batch, list[Applied]]:
    """scale, shear, rotation; motion_blur of the physical calibration."""
    plan = _Plan()
    done = [_plan_frame(plan, b, frame, spec) for b, (frame, spec) in enumerate(zip(frames, specs, strict=True))]
    out = batch.copy()
    if not any(d.applied for d in done):
        return out, done
    items, points, first, owner = _stamp(batch, plan)
    respect = int(specs[0].calibration == "physical")
    if plan.lines:
        for rank in sorted({r for r, _, _ in plan.lines}):
            chosen = [(item, lines) for r, item, lines in plan.lines if r == rank]
            ranked = on(batch, [item for item, _ in chosen], wp.int32)
            dim = (len(chosen), max(lines for _, lines in chosen) * 2)
            batch.launch(kernels.smear, dim, [batch.data, items, ranked, owner, batch.stride], out.data)
        return out, done
    nodes = wp.zeros(plan.node_count, dtype=wp.vec4, device=batch.device)
    tallest = max(row[16] for row in plan.items)
    batch.launch(kernels.displace, (len(plan.items), tallest), [items, points, lens(batch, frames)], nodes)
    inputs = [batch.words(), items, first, owner, nodes, respect, batch.stride]
    batch.launch(kernels.paint, (batch.count, batch.height), inputs, out.data)
    return out, done
