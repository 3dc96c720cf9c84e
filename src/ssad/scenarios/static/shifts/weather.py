"""Fog, rain and snow of the physical calibration.

One weather a scene: its key, wind and density come from the scene alone, positions from the world, so that all cameras
and consecutive images agree. Colour is that of the sky (dark at night).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ssad.core.frames import Applied, Frame, SceneContext, camera_to_world
from ssad.core.types import F64
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.batch import Batch, keys_on, on, structs
from ssad.scenarios.static.shifts.depth import FARTHEST, depth_grid, grid_size, lens
from ssad.scenarios.static.shifts.kernels import particles, veil
from ssad.scenarios.static.shifts.light import tables, to_linear
from ssad.scenarios.static.shifts.spec import ShiftSpec
from ssad.scenarios.static.shifts.wet import wet_ground

# period of the particle fields, metres; drops per m^3 follow from the size distributions
RAIN_TILE, SNOW_TILE = (6.0, 6.0, 5.0), (8.0, 8.0, 6.0)
RAIN_LEAST, RAIN_LARGEST = 2.0, 6.0  # mm; smaller drops are part of the veil
SNOW_LEAST, SNOW_LARGEST = 1.0, 6.0  # mm of water
SNOW_GROWTH = 3.0  # diameter of a flake over that of its water: a density of 40 kg / m^3
_CLOCK = 4096.0  # s after which the air repeats
_CELLS = 16  # pixels a node of the fog's patchiness


@dataclass(frozen=True, slots=True)
class Weather:
    """What is drawn once a scene: wind [3] m/s (world), colour of the air [3] in 0..1 relative to the sky's light."""

    wind: F64
    colour: F64
    patches: float


def scene_weather(spec: ShiftSpec, scene: str) -> Weather:
    """The weather of a scene."""
    draws = spec.generator("weather", scene)
    heading = draws.uniform(-np.pi, np.pi)
    speed = draws.uniform(0.5, 4.0) if spec.name != "snow" else draws.uniform(0.2, 2.5)
    warm = draws.uniform(-0.02, 0.02)
    wind = np.array([np.cos(heading) * speed, np.sin(heading) * speed, 0.0])
    return Weather(wind, np.array([0.97 + warm, 0.98, 1.0 - warm]), float(draws.uniform(0.25, 0.5)))


def _ages(frames: Sequence[Frame], contexts: Sequence[SceneContext]) -> list[float]:
    """Seconds since the start of the scene."""
    return [(f.time - c.start) % _CLOCK for f, c in zip(frames, contexts, strict=True)]


def extinction(spec: ShiftSpec) -> float:
    """Extinction of light by the weather, 1/m; the LiDAR twin uses the same."""
    if spec.severity == 0:
        return 0.0
    step = spec.severity - 1
    if spec.name == "fog":
        return 3.0 / table.FOG_RANGE[step]
    if spec.name == "rain":
        return table.rain_extinction(table.RAIN_RATE[step])
    return table.snow_extinction(table.SNOW_RATE[step])


def _clear(
    batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec], contexts: Sequence[SceneContext]
) -> tuple[list[Weather], Any, Any, list[str]]:
    """Weathers, transmittance of the air and depth [B, h, w] on the quarter grid, and where the depth comes from."""
    weathers = [scene_weather(s, f.scene) for s, f in zip(specs, frames, strict=True)]
    rows, columns = grid_size(batch)
    depth, sources = depth_grid(batch, frames)
    coarse = (batch.count, -(-batch.height // _CELLS), -(-batch.width // _CELLS))
    density = wp.empty(coarse, dtype=float, device=batch.device)
    keys = keys_on(batch, [s.key("air", f.scene) for s, f in zip(specs, frames, strict=True)])
    poses = on(batch, np.stack([camera_to_world(f) for f in frames]), wp.mat44)
    view = lens(batch, frames)
    drift = np.stack([w.wind * age for w, age in zip(weathers, _ages(frames, contexts), strict=True)])
    patches = on(batch, [w.patches if s.name == "fog" else 0.0 for w, s in zip(weathers, specs, strict=True)])
    inputs = [keys, poses, view, depth, on(batch, drift, wp.vec3), patches, float(_CELLS)]
    batch.launch(veil.patchiness, coarse, inputs, density)
    clear = wp.empty((batch.count, rows, columns), dtype=float, device=batch.device)
    inputs = [depth, view, density, on(batch, [extinction(s) for s in specs]), FARTHEST]
    batch.launch(veil.transmittance, (batch.count, rows), inputs, clear)
    return weathers, clear, depth, sources


def add_fog(
    batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec], contexts: Sequence[SceneContext]
) -> tuple[Batch, list[Applied]]:
    """fog: image * exp(-beta * range) + airlight * (1 - exp(-beta * range)) in linear light (Koschmieder 1924)."""
    weathers, clear, _, sources = _clear(batch, frames, specs, contexts)
    air = np.stack([to_linear(w.colour * c.light * 245) for w, c in zip(weathers, contexts, strict=True)])
    out = batch.like()
    inputs = [batch.words(), clear, on(batch, air, wp.vec3), *tables(batch.device), batch.width, batch.stride // 4]
    batch.launch(veil.blend_air, (batch.count, batch.height), inputs, out.words())
    done = [
        Applied(True, {"range_m": table.FOG_RANGE[s.severity - 1], "depth": source})
        for s, source in zip(specs, sources, strict=True)
    ]
    return out, done


def _air(spec: ShiftSpec, frame: Frame, weather: Weather) -> tuple[Any, ...]:
    """What falls, as a row of the kernel's `Air`."""
    snow = spec.name == "snow"
    tile, least, largest = (SNOW_TILE, SNOW_LEAST, SNOW_LARGEST) if snow else (RAIN_TILE, RAIN_LEAST, RAIN_LARGEST)
    rate = (table.SNOW_RATE if snow else table.RAIN_RATE)[spec.severity - 1]
    slope = table.snow_slope(rate) if snow else table.rain_slope(rate)
    density = 2500 * rate**-0.94 if snow else 8000.0
    in_air = density / slope * (np.exp(-slope * least) - np.exp(-slope * largest))
    count = int(in_air * tile[0] * tile[1] * tile[2])
    growth = SNOW_GROWTH if snow else 1.0
    wind = tuple(weather.wind)
    reach, drag = 1 - np.exp(-slope * (largest - least)), 10.3 * np.exp(-0.6 * least)
    return (spec.key("air", frame.scene), tile, wind, slope, least, reach, drag, growth, int(snow), count)


def _count(spec: ShiftSpec) -> int:
    """Drops on the lens."""
    return table.LENS_DROPS[spec.severity - 1] if spec.name == "rain" else 0


def _lens_drops(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> list[tuple[Any, ...]]:
    """Drops of rain that sit on the lens: where, how large; the same for a camera throughout a scene."""
    found = []
    for b, (spec, frame) in enumerate(zip(specs, frames, strict=True)):
        if spec.name != "rain":
            continue
        draws = spec.generator("lens", frame.scene, frame.camera.channel)
        most = table.LENS_DROPS[-1]
        # all are drawn, the first few are used: a heavier rain adds drops and moves none
        place = draws.uniform(0, 1, (most, 2)) * [batch.width, batch.height]
        radius = np.minimum(np.exp(draws.normal(2.3, 0.55, most)), 40) * batch.width / 1600
        oval = draws.uniform(1.0, 1.4, most)
        for n in range(_count(spec)):
            found.append((b, float(place[n, 0]), float(place[n, 1]), max(float(radius[n]), 1.5), float(oval[n])))
    return found


def add_precipitation(
    batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec], contexts: Sequence[SceneContext]
) -> tuple[Batch, list[Applied]]:
    """Rain or snow: a veil over what is far away, and streaks of what is close; rain also wets the ground."""
    weathers, clear, depth, sources = _clear(batch, frames, specs, contexts)
    if specs[0].name == "rain":
        batch = wet_ground(batch, frames, specs, (depth, sources))
    airs = [_air(s, f, w) for s, f, w in zip(specs, frames, weathers, strict=True)]
    most = max(a[-1] for a in airs)
    poses = np.stack([camera_to_world(f) for f in frames])
    layer = wp.zeros((batch.count, -(-batch.height // 2), -(-batch.width // 2)), dtype=int, device=batch.device)
    inputs = [
        structs(batch, airs, particles.Air),
        on(batch, _ages(frames, contexts)),
        on(batch, np.swapaxes(poses[:, :3, :3], 1, 2), wp.mat33),
        on(batch, poses[:, :3, 3] % np.array([a[1] for a in airs]), wp.vec3),
        on(batch, np.stack([f.ego_velocity for f in frames]), wp.vec3),
        lens(batch, frames),
        table.EXPOSURE,
        table.APERTURE,
    ]
    batch.launch(particles.splat, (batch.count, most), inputs, layer)
    sky = np.stack([w.colour * c.light for w, c in zip(weathers, contexts, strict=True)])
    bright = np.array([255.0 if s.name == "snow" else 235.0 for s in specs])[:, None]
    out, dim = batch.like(), (batch.count, batch.height)
    haze, white = on(batch, to_linear(sky * 235), wp.vec3), on(batch, to_linear(sky * bright), wp.vec3)
    inputs = [batch.words(), clear, haze, layer, white, *tables(batch.device), batch.width, batch.stride // 4]
    batch.launch(veil.blend_particles, dim, inputs, out.words())
    drops = _lens_drops(batch, frames, specs)
    if len(drops):
        rows = structs(batch, drops, particles.LensDrop)
        first = on(batch, np.searchsorted([d[0] for d in drops], np.arange(batch.count + 1)), wp.int32)
        batch.launch(particles.refract, dim, [batch.data, rows, first, batch.height, batch.width], out.data)
    rates = [(table.SNOW_RATE if s.name == "snow" else table.RAIN_RATE)[s.severity - 1] for s in specs]
    done = [
        Applied(True, {"rate_mm_h": rate, "particles": air[-1], "lens_drops": _count(s), "depth": source})
        for rate, air, source, s in zip(rates, airs, sources, specs, strict=True)
    ]
    return out, done
