"""A low sun of the physical calibration: one in the world, in the pictures of the cameras that face it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import count, islice
from typing import Any

import numpy as np
import warp as wp

from ssad.core.frames import Applied, Frame, SceneContext, camera_to_world
from ssad.core.types import F32, F64, U8
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.batch import Batch, on
from ssad.scenarios.static.shifts.depth import depth_of, grid_size, lens
from ssad.scenarios.static.shifts.kernels import veil
from ssad.scenarios.static.shifts.spec import ShiftSpec

AT_NIGHT, HIDDEN = "it is night", "the sun is behind something"
NO_SUN = frozenset({AT_NIGHT, HIDDEN})  # reasons for which a whole drive may be left as it is
SKY = 120.0  # m from which on nothing hides the sun
NIGHT = 0.35  # brightness of the sky below which there is no sun
FACING = 75.0  # degrees from the optical axis beyond which the sun adds no light


def sun_direction(spec: ShiftSpec, context: SceneContext) -> F64:
    """Unit vector towards the sun [3], world.

    It is the context's, or else drawn 2 to 12 degrees high, within 15 degrees of the ego's initial heading.
    """
    return np.array(next(_draws(spec, context)) if context.sun is None else context.sun)


def choose_sun(
    spec: ShiftSpec, context: SceneContext, pictures: Sequence[tuple[Frame, U8]]
) -> tuple[float, float, float]:
    """A sun that is visible in one of the pictures of a moment.

    Up to 16 directions are tried, each drawn one degree higher than the one before, the first as by `sun_direction`.

    Args:
        spec: The shift.
        context: The scene.
        pictures: Frame and picture [H, W, 3] of each camera.

    Returns:
        Unit vector, world: the first direction in which the sun is visible; the first of all if it is always hidden.
    """
    drawn = list(islice(_draws(spec, context), 16))
    depths: dict[int, F32 | None] = {}
    for toward in drawn:
        direction = np.array(toward)
        for n, (frame, image) in enumerate(pictures):
            if sun_in_picture(frame, direction):
                if n not in depths:
                    depths[n] = sun_depth(frame, image)
                if free_sun(frame, depths[n], direction) > 0.5:
                    return toward
    return drawn[0]


def _draws(spec: ShiftSpec, context: SceneContext) -> Iterator[tuple[float, float, float]]:
    """Unit vectors, world, without end."""
    draws = spec.generator("sun", context.scene)
    for number in count():
        heading = context.heading + np.radians(draws.uniform(-15, 15))
        height = np.radians(draws.uniform(2, 12) + number)
        toward = np.cos(heading) * np.cos(height), np.sin(heading) * np.cos(height), np.sin(height)
        yield float(toward[0]), float(toward[1]), float(toward[2])


def sun_angle(frame: Frame, toward: F64) -> float:
    """Angle between a direction [3] in the world and the optical axis, degrees."""
    seen = camera_to_world(frame)[:3, 2] @ toward
    return float(np.degrees(np.arccos(np.clip(seen, -1, 1))))


def _place(frame: Frame, toward: F64) -> tuple[float, float]:
    """Pixel x, y of a direction [3] in the world that lies in front of the camera."""
    seen, k = camera_to_world(frame)[:3, :3].T @ toward, frame.camera.intrinsic
    return float(k[0, 0] * seen[0] / seen[2] + k[0, 2]), float(k[1, 1] * seen[1] / seen[2] + k[1, 2])


def sun_in_picture(frame: Frame, toward: F64) -> bool:
    """Whether the sun stands within the borders of the picture, whatever is before it."""
    if sun_angle(frame, toward) > FACING:
        return False
    x, y = _place(frame, toward)
    return 0 <= x < frame.camera.width and 0 <= y < frame.camera.height


def sun_depth(frame: Frame, image: U8) -> F32 | None:
    """Depth of a picture [H, W, 3] on the quarter grid, metres, by which the sun is hidden; None: nothing is known."""
    height, width = image.shape[:2]
    grid, source = depth_of(frame, image, -(-height // 4), -(-width // 4))
    return None if source == "assumed" else grid


def free_sun(frame: Frame, depth: F32 | None, toward: F64) -> float:
    """Share of the sun's disc that is visible in a picture that contains it.

    Args:
        frame: The picture's frame.
        depth: From `sun_depth`.
        toward: Unit vector towards the sun [3], world.

    Returns:
        Share in [0, 1]; 1 if `depth` is None.
    """
    if depth is None:
        return 1.0
    x, y = _place(frame, toward)
    row, column, reach = int(y / 4), int(x / 4), max(2, depth.shape[1] // 65)
    around = depth[max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
    return float((around > SKY).mean())


def add_sun(
    batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec], contexts: Sequence[SceneContext]
) -> tuple[Batch, list[Applied]]:
    """sunlight: glare is added, the exposure goes down with it; none by night, or where the sun is hidden."""
    toward = np.zeros((batch.count, 3))
    place = np.zeros((batch.count, 3))
    strength, gain = np.zeros(batch.count), np.ones(batch.count)
    done: list[Applied] = []

    for b, (frame, spec, context) in enumerate(zip(frames, specs, contexts, strict=True)):
        if context.light < NIGHT:
            done.append(Applied(False, {"light": round(context.light, 2)}, {AT_NIGHT: 1}))
            continue
        world = sun_direction(spec, context)
        toward[b] = camera_to_world(frame)[:3, :3].T @ world
        angle = sun_angle(frame, world)
        if angle > FACING:
            done.append(Applied(False, {"angle_deg": round(angle, 1)}, {"the sun is not in front of this camera": 1}))
            continue
        x, y = _place(frame, world)
        place[b] = x, y, 1
        inside, free = sun_in_picture(frame, world), frame.sun
        if free is None:
            free = free_sun(frame, sun_depth(frame, batch.picture(b)), world) if inside else 1.0
        details: dict[str, Any] = {"angle_deg": round(angle, 1), "in_view": inside, "free": round(free, 2)}
        details["direction"] = [round(float(v), 6) for v in world]
        if not free:
            done.append(Applied(False, details, {HIDDEN: 1}))
            continue
        strength[b] = table.SUN_STRENGTH[spec.severity - 1] * free
        # the camera exposes for what it sees: the nearer the sun to the picture, the darker the rest
        outside = max(0.0, -x / batch.width, x / batch.width - 1, -y / batch.height, y / batch.height - 1)
        gain[b] = 1 - 0.06 * spec.severity * free * max(0.0, 1 - 2 * outside)
        done.append(Applied(True, details))
    rows, columns = grid_size(batch)
    light = wp.empty((batch.count, rows, columns), dtype=float, device=batch.device)
    rays = [float(s.generator("star", f.camera.channel).uniform(0, 1)) for s, f in zip(specs, frames, strict=True)]
    sight = [on(batch, toward, wp.vec3), on(batch, place, wp.vec3), lens(batch, frames)]
    batch.launch(veil.glare, (batch.count, rows), [*sight, on(batch, strength), on(batch, rays)], light)
    out = batch.like()
    tint = on(batch, np.tile([1.0, 0.97, 0.9], (batch.count, 1)), wp.vec3)
    inputs = [batch.words(), light, tint, on(batch, gain), batch.width, batch.stride // 4]
    batch.launch(veil.blend_glare, (batch.count, batch.height), inputs, out.words())
    return out, done
