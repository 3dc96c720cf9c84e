"""Fog, rain and snow of the physical calibration.

Each scene has one weather: its key, wind and density depend on the scene alone and positions on the world, so that
all cameras and consecutive images agree. The colour is that of the sky (dark at night).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ssad.core.frames import Frame, SceneContext, ShiftReport, camera_to_world
from ssad.core.types import F64
from ssad.scenarios.static.shifts import parameters as table
from ssad.scenarios.static.shifts.batch import Batch, keys_on, structs, to_device
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
_CELLS = 16  # pixels per node of the fog's patchiness


@dataclass(frozen=True, slots=True)
class WeatherDraw:
    """Random weather of a scene: wind [3] m/s (world), colour of the air [3] in 0..1 relative to the sky's light."""

    wind: F64
    colour: F64
    patches: float


def scene_weather(spec: ShiftSpec, scene: str) -> WeatherDraw:
    """Return the weather of a scene."""
    draws = spec.generator("weather", scene)
    heading = draws.uniform(-np.pi, np.pi)
    speed = draws.uniform(0.5, 4.0) if spec.name != "snow" else draws.uniform(0.2, 2.5)
    warmth = draws.uniform(-0.02, 0.02)
    wind = np.array([np.cos(heading) * speed, np.sin(heading) * speed, 0.0])
    return WeatherDraw(wind, np.array([0.97 + warmth, 0.98, 1.0 - warmth]), float(draws.uniform(0.25, 0.5)))


def _scene_times(frames: Sequence[Frame], contexts: Sequence[SceneContext]) -> list[float]:
    """Return the seconds since the start of the scene."""
    return [(frame.time - context.start) % _CLOCK for frame, context in zip(frames, contexts, strict=True)]


def extinction(spec: ShiftSpec) -> float:
    """Return the extinction of light by the weather, 1/m; the LiDAR twin uses the same.

    In the paper's calibration, rain and snow have the published rates of its LiDAR; its cameras have no extinction.
    """
    if spec.severity == 0:
        return 0.0
    level = spec.severity - 1
    if spec.name == "fog":
        # Contrast of 5 % at the meteorological optical range: ln(20) is about 3.
        return 3.0 / table.FOG_RANGE[level]
    is_paper = spec.calibration == "paper"
    if spec.name == "rain":
        return table.rain_extinction((table.PAPER_LIDAR_RATE if is_paper else table.RAIN_RATE)[level])
    return table.snow_extinction((table.PAPER_LIDAR_RATE if is_paper else table.SNOW_RATE)[level])


def _view_through_air(
    batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec], contexts: Sequence[SceneContext]
) -> tuple[list[WeatherDraw], Any, Any, list[str]]:
    """Return weathers, transmittance and depth [B, h, w] on the quarter grid, and the sources of depth."""
    weathers = [scene_weather(spec, frame.scene) for spec, frame in zip(specs, frames, strict=True)]
    rows, columns = grid_size(batch)
    depth, sources = depth_grid(batch, frames)
    coarse_shape = (batch.count, -(-batch.height // _CELLS), -(-batch.width // _CELLS))
    density = wp.empty(coarse_shape, dtype=float, device=batch.device)
    keys = keys_on(batch, [spec.key("air", frame.scene) for spec, frame in zip(specs, frames, strict=True)])
    poses = to_device(batch, np.stack([camera_to_world(frame) for frame in frames]), wp.mat44)
    lenses = lens(batch, frames)
    drift = np.stack(
        [weather.wind * age for weather, age in zip(weathers, _scene_times(frames, contexts), strict=True)]
    )
    patches = to_device(
        batch, [weather.patches if spec.name == "fog" else 0.0 for weather, spec in zip(weathers, specs, strict=True)]
    )
    inputs = [keys, poses, lenses, depth, to_device(batch, drift, wp.vec3), patches, float(_CELLS)]
    batch.launch(veil.patchiness, coarse_shape, inputs, density)
    transmittance = wp.empty((batch.count, rows, columns), dtype=float, device=batch.device)
    inputs = [depth, lenses, density, to_device(batch, [extinction(spec) for spec in specs]), FARTHEST]
    batch.launch(veil.transmittance, (batch.count, rows), inputs, transmittance)
    return weathers, transmittance, depth, sources


def add_fog(
    batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec], contexts: Sequence[SceneContext]
) -> tuple[Batch, list[ShiftReport]]:
    """Apply fog in linear light (Koschmieder 1924).

    image * exp(-beta * range) + airlight * (1 - exp(-beta * range))
    """
    weathers, transmittance, _, sources = _view_through_air(batch, frames, specs, contexts)
    airlight = np.stack(
        [to_linear(weather.colour * context.light * 245) for weather, context in zip(weathers, contexts, strict=True)]
    )
    result = batch.empty_like()
    inputs = [
        batch.words(),
        transmittance,
        to_device(batch, airlight, wp.vec3),
        *tables(batch.device),
        batch.width,
        batch.stride // 4,
    ]
    batch.launch(veil.blend_air, (batch.count, batch.height), inputs, result.words())
    records = [
        ShiftReport(True, {"range_m": table.FOG_RANGE[spec.severity - 1], "depth": source})
        for spec, source in zip(specs, sources, strict=True)
    ]
    return result, records


def _air_row(spec: ShiftSpec, frame: Frame, weather: WeatherDraw) -> tuple[Any, ...]:
    """Return the parameters of the particles, as a row of the kernel's `Air`."""
    is_snow = spec.name == "snow"
    tile, min_diameter, max_diameter = (
        (SNOW_TILE, SNOW_LEAST, SNOW_LARGEST) if is_snow else (RAIN_TILE, RAIN_LEAST, RAIN_LARGEST)
    )
    rate = (table.SNOW_RATE if is_snow else table.RAIN_RATE)[spec.severity - 1]
    slope = table.snow_slope(rate) if is_snow else table.rain_slope(rate)
    density = 2500 * rate**-0.94 if is_snow else 8000.0
    number_density = density / slope * (np.exp(-slope * min_diameter) - np.exp(-slope * max_diameter))
    count = int(number_density * tile[0] * tile[1] * tile[2])
    size_ratio = SNOW_GROWTH if is_snow else 1.0
    wind = tuple(weather.wind)
    size_share, drag = 1 - np.exp(-slope * (max_diameter - min_diameter)), 10.3 * np.exp(-0.6 * min_diameter)
    return (
        spec.key("air", frame.scene),
        tile,
        wind,
        slope,
        min_diameter,
        size_share,
        drag,
        size_ratio,
        int(is_snow),
        count,
    )


def _lens_drop_count(spec: ShiftSpec) -> int:
    """Return the number of drops on the lens."""
    return table.LENS_DROPS[spec.severity - 1] if spec.name == "rain" else 0


def _lens_drops(batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec]) -> list[tuple[Any, ...]]:
    """Return the rain drops on each lens with position and size; they stay for a camera throughout a scene."""
    lens_drops = []
    for index, (spec, frame) in enumerate(zip(specs, frames, strict=True)):
        if spec.name != "rain":
            continue
        draws = spec.generator("lens", frame.scene, frame.camera.channel)
        max_drops = table.LENS_DROPS[-1]
        # all are drawn and the first few used, so that a heavier rain adds drops and moves none
        centres = draws.uniform(0, 1, (max_drops, 2)) * [batch.width, batch.height]
        radius = np.minimum(np.exp(draws.normal(2.3, 0.55, max_drops)), 40) * batch.width / 1600
        aspect = draws.uniform(1.0, 1.4, max_drops)
        phases = draws.uniform(0, 2 * np.pi, (max_drops, 2))
        for drop_index in range(_lens_drop_count(spec)):
            lens_drops.append(
                (
                    index,
                    float(centres[drop_index, 0]),
                    float(centres[drop_index, 1]),
                    max(float(radius[drop_index]), 1.5),
                    float(aspect[drop_index]),
                    *phases[drop_index].tolist(),
                )
            )
    return lens_drops


def add_precipitation(
    batch: Batch, frames: Sequence[Frame], specs: Sequence[ShiftSpec], contexts: Sequence[SceneContext]
) -> tuple[Batch, list[ShiftReport]]:
    """Apply rain or snow: a veil over the distance and streaks nearby; rain also wets the ground."""
    weathers, transmittance, depth, sources = _view_through_air(batch, frames, specs, contexts)
    if specs[0].name == "rain":
        batch = wet_ground(batch, frames, specs, (depth, sources))
    air_rows = [_air_row(spec, frame, weather) for spec, frame, weather in zip(specs, frames, weathers, strict=True)]
    max_particles = max(air_row[-1] for air_row in air_rows)
    poses = np.stack([camera_to_world(frame) for frame in frames])
    layer = wp.zeros((batch.count, -(-batch.height // 2), -(-batch.width // 2)), dtype=int, device=batch.device)
    inputs = [
        structs(batch, air_rows, particles.Air),
        to_device(batch, _scene_times(frames, contexts)),
        to_device(batch, np.swapaxes(poses[:, :3, :3], 1, 2), wp.mat33),
        to_device(batch, poses[:, :3, 3] % np.array([air_row[1] for air_row in air_rows]), wp.vec3),
        to_device(batch, np.stack([frame.ego_velocity for frame in frames]), wp.vec3),
        lens(batch, frames),
        table.EXPOSURE,
        table.APERTURE,
    ]
    batch.launch(particles.splat, (batch.count, max_particles), inputs, layer)
    sky_colour = np.stack([weather.colour * context.light for weather, context in zip(weathers, contexts, strict=True)])
    grey_levels = np.array([255.0 if spec.name == "snow" else 235.0 for spec in specs])[:, None]
    result, thread_shape = batch.empty_like(), (batch.count, batch.height)
    veil_light, particle_light = (
        to_device(batch, to_linear(sky_colour * 235), wp.vec3),
        to_device(batch, to_linear(sky_colour * grey_levels), wp.vec3),
    )
    inputs = [
        batch.words(),
        transmittance,
        veil_light,
        layer,
        particle_light,
        *tables(batch.device),
        batch.width,
        batch.stride // 4,
    ]
    batch.launch(veil.blend_particles, thread_shape, inputs, result.words())
    lens_drops = _lens_drops(batch, frames, specs)
    if len(lens_drops):
        drop_rows = structs(batch, lens_drops, particles.LensDrop)
        offsets = to_device(
            batch, np.searchsorted([lens_drop[0] for lens_drop in lens_drops], np.arange(batch.count + 1)), wp.int32
        )
        coarse_shape = tuple(-(-size // int(particles.BLOCK)) for size in (batch.height, batch.width))
        coarse = wp.empty((batch.count, *coarse_shape), dtype=wp.vec3, device=batch.device)
        linear, codes = tables(batch.device)
        inputs = [batch.data, linear, batch.height, batch.width]
        batch.launch(particles.blur_coarsely, (batch.count, coarse_shape[0]), inputs, coarse)
        inputs = [coarse, drop_rows, offsets, linear, codes, batch.height, batch.width]
        batch.launch(particles.refract, thread_shape, inputs, result.data)
    rates = [(table.SNOW_RATE if spec.name == "snow" else table.RAIN_RATE)[spec.severity - 1] for spec in specs]
    records = [
        ShiftReport(
            True, {"rate_mm_h": rate, "particles": air[-1], "lens_drops": _lens_drop_count(spec), "depth": source}
        )
        for rate, air, source, spec in zip(rates, air_rows, sources, specs, strict=True)
    ]
    return result, records
