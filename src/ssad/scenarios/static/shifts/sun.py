"""A low sun of the physical calibration: one in the world, in the pictures of the cameras that face it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import warp as wp

from ssad.frames import Applied, Frame, SceneContext, camera_to_world
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.batch import Batch, on
from ssad.scenarios.static.shifts.depth import depth_grid, grid_size, lens
from ssad.scenarios.static.shifts.kernels import veil
from ssad.scenarios.static.shifts.spec import ShiftSpec
from ssad.types import F64

NIGHT = 0.35  # brightness of the sky below which there is no sun
FACING = 75.0  # degrees from the optical axis beyond which the sun adds no light


def sun_direction(spec: ShiftSpec, context: SceneContext) -> F64:
    """Unit vector towards the sun [3], world: 2 to 12 degrees high, within 15 of where the ego goes at first."""
    draws = spec.generator("sun", context.scene)
    heading = context.heading + np.radians(draws.uniform(-15, 15))
    height = np.radians(draws.uniform(2, 12))
    return np.array([np.cos(heading) * np.cos(height), np.sin(heading) * np.cos(height), np.sin(height)])


def add_sun(
    batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec], contexts: Sequence[SceneContext]
) -> tuple[Batch, list[Applied]]:
    """sunlight: glare is added, the exposure goes down with it; none by night, or where the sun is hidden."""
    toward = np.zeros((batch.count, 3))
    place = np.zeros((batch.count, 3))
    strength, gain = np.zeros(batch.count), np.ones(batch.count)
    done: list[Applied] = []
    depth: F64 | None = None
    sources: list[str] = []
    for b, (frame, spec, context) in enumerate(zip(frames, specs, contexts, strict=True)):
        if context.light < NIGHT:
            done.append(Applied(False, {"light": round(context.light, 2)}, {"it is night": 1}))
            continue
        world = sun_direction(spec, context)
        seen = camera_to_world(frame)[:3, :3].T @ world
        toward[b] = seen
        angle = float(np.degrees(np.arccos(np.clip(seen[2], -1, 1))))
        if angle > FACING:
            done.append(Applied(False, {"angle_deg": round(angle, 1)}, {"the sun is not in front of this camera": 1}))
            continue
        k = frame.camera.intrinsic
        x, y = k[0, 0] * seen[0] / seen[2] + k[0, 2], k[1, 1] * seen[1] / seen[2] + k[1, 2]
        place[b] = x, y, 1
        inside = bool(0 <= x < batch.width and 0 <= y < batch.height)
        free = 1.0
        if inside:
            if depth is None:
                grid, sources = depth_grid(batch, frames)
                depth = grid.numpy()
            row, column, reach = int(y / 4), int(x / 4), max(2, batch.width // 260)
            around = depth[b, max(row - reach, 0) : row + reach + 1, max(column - reach, 0) : column + reach + 1]
            free = 1.0 if sources[b] == "assumed" else float((around > 120).mean())
        details = {
            "angle_deg": round(angle, 1),
            "in_view": inside,
            "free": round(free, 2),
            "direction": [round(float(v), 6) for v in world],
        }
        if not free:
            done.append(Applied(False, details, {"the sun is behind something": 1}))
            continue
        strength[b] = table.SUN_STRENGTH[spec.severity - 1] * free
        # the camera exposes for what it sees: the nearer the sun to the picture, the darker the rest
        outside = max(0.0, -x / batch.width, x / batch.width - 1, -y / batch.height, y / batch.height - 1)
        gain[b] = 1 - 0.06 * spec.severity * free * max(0.0, 1 - 2 * outside)
        done.append(Applied(True, details))
    rows, columns = grid_size(batch)
    light = wp.empty((batch.count, rows, columns), dtype=float, device=batch.device)
    rays = [float(s.generator("star", f.camera.channel).uniform(0, 1)) for s, f in zip(specs, frames, strict=True)]
    wp.launch(
        veil.glare,
        dim=(batch.count, rows),
        inputs=[
            on(batch, toward.astype(np.float32), wp.vec3),
            on(batch, place.astype(np.float32), wp.vec3),
            lens(batch, frames),
            on(batch, strength, wp.float32),
            on(batch, rays, wp.float32),
        ],
        outputs=[light],
        device=batch.device,
    )
    out = batch.like()
    wp.launch(
        veil.blend_glare,
        dim=(batch.count, batch.height),
        inputs=[
            batch.words(),
            light,
            on(batch, np.tile(np.array([1.0, 0.97, 0.9], np.float32), (batch.count, 1)), wp.vec3),
            on(batch, gain, wp.float32),
            batch.width,
            batch.stride // 4,
        ],
        outputs=[out.words()],
        device=batch.device,
    )
    return out, done
