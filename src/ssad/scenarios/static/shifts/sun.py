"""Low sun of the physical calibration: one in the world, visible to the cameras that face it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import count, islice
from typing import Any

import numpy as np
import warp as wp

from ssad.core.frames import Frame, SceneContext, ShiftReport, camera_to_world
from ssad.core.types import F32, F64, U8
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.batch import Batch, to_device
from ssad.scenarios.static.shifts.depth import depth_of, grid_size, lens
from ssad.scenarios.static.shifts.kernels import veil
from ssad.scenarios.static.shifts.spec import ShiftSpec

AT_NIGHT, HIDDEN = "it is night", "the sun is behind something"
NO_SUN = frozenset({AT_NIGHT, HIDDEN})  # reasons for which a whole episode may stay unchanged
SKY = 120.0  # m: surfaces beyond this distance do not hide the sun
NIGHT = 0.35  # brightness of the sky below which there is no sun
FACING = 75.0  # degrees from the optical axis beyond which the sun adds no light


def sun_direction(spec: ShiftSpec, context: SceneContext) -> F64:
    """Return the unit vector towards the sun [3], world.

    It is the context's, or else drawn 2 to 12 degrees high, within 15 degrees of the ego's initial heading.
    """
    return np.array(next(_draw_directions(spec, context)) if context.sun is None else context.sun)


def choose_sun(
    spec: ShiftSpec, context: SceneContext, camera_images: Sequence[tuple[Frame, U8]]
) -> tuple[float, float, float]:
    """Return a sun that is visible in one of the images of a moment.

    Up to 16 directions are tried, each drawn one degree higher than the one before, the first as by `sun_direction`.

    Args:
        spec: The shift.
        context: The scene.
        camera_images: Frame and image [H, W, 3] of each camera.

    Returns:
        Unit vector, world: the first direction in which the sun is visible; the first of all if it is always hidden.
    """
    candidates = list(islice(_draw_directions(spec, context), 16))
    depths: dict[int, F32 | None] = {}
    for candidate in candidates:
        direction = np.array(candidate)
        for camera_index, (frame, image) in enumerate(camera_images):
            if sun_in_image(frame, direction):
                # Depth is costly, so it is computed once, and only for cameras that a candidate falls into.
                if camera_index not in depths:
                    depths[camera_index] = sun_depth(frame, image)
                if visible_sun_share(frame, depths[camera_index], direction) > 0.5:
                    return candidate
    return candidates[0]


def _draw_directions(spec: ShiftSpec, context: SceneContext) -> Iterator[tuple[float, float, float]]:
    """Yield unit vectors towards the sun, world, without end."""
    draws = spec.generator("sun", context.scene)
    for attempt in count():
        heading = context.heading + np.radians(draws.uniform(-15, 15))
        elevation = np.radians(draws.uniform(2, 12) + attempt)
        direction = np.cos(heading) * np.cos(elevation), np.sin(heading) * np.cos(elevation), np.sin(elevation)
        yield float(direction[0]), float(direction[1]), float(direction[2])


def sun_angle(frame: Frame, direction: F64) -> float:
    """Return the angle between a direction [3] in the world and the optical axis, degrees."""
    cosine = camera_to_world(frame)[:3, 2] @ direction
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def _sun_pixel(frame: Frame, direction: F64) -> tuple[float, float]:
    """Return the pixel x, y of a direction [3] in the world that lies in front of the camera."""
    local, intrinsic = camera_to_world(frame)[:3, :3].T @ direction, frame.camera.intrinsic
    return float(intrinsic[0, 0] * local[0] / local[2] + intrinsic[0, 2]), float(
        intrinsic[1, 1] * local[1] / local[2] + intrinsic[1, 2]
    )


def sun_in_image(frame: Frame, direction: F64) -> bool:
    """Return True if the sun stands within the borders of the image, hidden or not."""
    if sun_angle(frame, direction) > FACING:
        return False
    x, y = _sun_pixel(frame, direction)
    return 0 <= x < frame.camera.width and 0 <= y < frame.camera.height


def sun_depth(frame: Frame, image: U8) -> F32 | None:
    """Return the depth of an image [H, W, 3] on the quarter grid, metres; None if it is only assumed."""
    height, width = image.shape[:2]
    grid, source = depth_of(frame, image, -(-height // 4), -(-width // 4))
    return None if source == "assumed" else grid


def visible_sun_share(frame: Frame, depth: F32 | None, direction: F64) -> float:
    """Return the visible share of the sun's disc in an image that contains it.

    Args:
        frame: Frame of the image.
        depth: From `sun_depth`.
        direction: Unit vector towards the sun [3], world.

    Returns:
        Share in [0, 1]; 1 if `depth` is None.
    """
    if depth is None:
        return 1.0
    x, y = _sun_pixel(frame, direction)
    row, column, radius = int(y / 4), int(x / 4), max(2, depth.shape[1] // 65)
    neighbourhood = depth[max(row - radius, 0) : row + radius + 1, max(column - radius, 0) : column + radius + 1]
    return float((neighbourhood > SKY).mean())


def add_sun(
    batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec], contexts: Sequence[SceneContext]
) -> tuple[Batch, list[ShiftReport]]:
    """Apply sunlight: add glare and lower the exposure with it; nothing by night or with a hidden sun."""
    local_directions = np.zeros((batch.count, 3))
    sun_pixels = np.zeros((batch.count, 3))
    strength, gain = np.zeros(batch.count), np.ones(batch.count)
    records: list[ShiftReport] = []

    for index, (frame, spec, context) in enumerate(zip(frames, specs, contexts, strict=True)):
        if context.light < NIGHT:
            records.append(ShiftReport(False, {"light": round(context.light, 2)}, {AT_NIGHT: 1}))
            continue
        direction = sun_direction(spec, context)
        local_directions[index] = camera_to_world(frame)[:3, :3].T @ direction
        angle = sun_angle(frame, direction)
        if angle > FACING:
            records.append(
                ShiftReport(False, {"angle_deg": round(angle, 1)}, {"the sun is not in front of this camera": 1})
            )
            continue
        x, y = _sun_pixel(frame, direction)
        sun_pixels[index] = x, y, 1
        in_image, visible_share = sun_in_image(frame, direction), frame.sun
        if visible_share is None:
            visible_share = (
                visible_sun_share(frame, sun_depth(frame, batch.image(index)), direction) if in_image else 1.0
            )
        details: dict[str, Any] = {"angle_deg": round(angle, 1), "in_view": in_image, "free": round(visible_share, 2)}
        details["direction"] = [round(float(coordinate), 6) for coordinate in direction]
        if not visible_share:
            records.append(ShiftReport(False, details, {HIDDEN: 1}))
            continue
        strength[index] = table.SUN_STRENGTH[spec.severity - 1] * visible_share
        # the camera adapts its exposure: the nearer the sun is to the image, the darker the rest
        outside = max(0.0, -x / batch.width, x / batch.width - 1, -y / batch.height, y / batch.height - 1)
        gain[index] = 1 - 0.06 * spec.severity * visible_share * max(0.0, 1 - 2 * outside)
        records.append(ShiftReport(True, details))
    rows, columns = grid_size(batch)
    glare = wp.empty((batch.count, rows, columns), dtype=float, device=batch.device)
    rays = [
        float(image_spec.generator("star", image_frame.camera.channel).uniform(0, 1))
        for image_spec, image_frame in zip(specs, frames, strict=True)
    ]
    camera_inputs = [
        to_device(batch, local_directions, wp.vec3),
        to_device(batch, sun_pixels, wp.vec3),
        lens(batch, frames),
    ]
    batch.launch(
        veil.glare, (batch.count, rows), [*camera_inputs, to_device(batch, strength), to_device(batch, rays)], glare
    )
    result = batch.empty_like()
    tint = to_device(batch, np.tile([1.0, 0.97, 0.9], (batch.count, 1)), wp.vec3)
    inputs = [batch.words(), glare, tint, to_device(batch, gain), batch.width, batch.stride // 4]
    batch.launch(veil.blend_glare, (batch.count, batch.height), inputs, result.words())
    return result, records
