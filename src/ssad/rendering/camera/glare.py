"""Glare of a lens: the light that it scatters, and the ghosts that reflections between its surfaces make.

A point of light is surrounded by a veil that falls with the angle t (degrees) as 10 / t^3 + 5 / t^2, for each lux at
the lens: the disability glare of the eye of a young person (CIE 146:2002, valid from 0.1 degrees), times the glare of
the sensor. As a power law is a mixture of Gaussians of all widths, a / (t^2 + c^2)^(n/2) is the integral of Gaussians
of standard deviation s, weighted by a k s^(2-n) exp(-c^2 / 2 s^2) over log s, with k = 4 pi / (2^(n/2) Gamma(n/2)).
The levels of a pyramid of images, halved and enlarged again with tent filters, are such Gaussians, an octave apart.

Each level conserves light exactly, also at borders: enlarging after halving is a symmetric matrix whose rows add up
to 1. What a lens scatters out of the image and into it is thereby the same.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, Any, Final

import numpy as np
import warp as wp

from ssad.core.colours import LUMINANCE
from ssad.core.types import F64
from ssad.rendering.camera.kernels import glare as kernels
from ssad.rendering.camera.kernels import lamp_glow, sky
from ssad.rendering.camera.lamps import NIGHT_LUX, struct_array
from ssad.rendering.camera.sensor import SMALLEST, SensorModel

if TYPE_CHECKING:
    from ssad.rendering.camera.render import View
    from ssad.rendering.camera.scene import RenderScene
    from ssad.rendering.camera.visibility import VisibilityPass

CORE: Final = 0.1  # degrees within which the veil does not rise further
VEIL: Final = ((10.0, 3.0), (5.0, 2.0))  # factor and exponent of the terms of the veil
REFLECTION: Final = 0.005  # share of the light that a coated surface of a lens reflects
# size over that of the image (negative: upside down), and tint by the coatings
GHOSTS: Final = (
    (-0.45, (0.75, 1.0, 0.70)),
    (-1.0, (1.0, 0.80, 0.95)),
    (0.35, (0.70, 0.85, 1.0)),
    (-1.7, (1.0, 0.90, 0.60)),
)
GHOST_LEVEL: Final = 2  # level of the pyramid to which ghosts are added
BLOOM: Final = 0.15  # glare of the effect `bloom`: a clean lens behind a clean windscreen
FLARE: Final = 1.0  # flare of the effect `flare`
# cd/m^2 at night towards the traffic. Low beams: 400 cd towards oncoming eyes (UN R112, point B50L) from 0.02 m^2; tail
# lamps: 8 cd (UN R7: 4 to 17) from 0.015 m^2; luminaires: 2,000 cd from 0.1 m^2; signals: 400 cd (EN 12368, level 3)
# from a lens of 0.11 m.
LUMINANCES: Final = {
    "head_lamp": 20_000.0,
    "tail_lamp": 530.0,
    "lamp_light": 20_000.0,
    "street_light": 20_000.0,
    "signal_light": 10_500.0,
}
SUN_RADIUS: Final = math.radians(0.2666)  # rad


def with_lens_effects(sensor: SensorModel, effects: Collection[str]) -> SensorModel:
    """Return a sensor with the glare and flare of the effects `bloom` and `flare`, unless it has its own.

    Args:
        sensor: The sensor.
        effects: Names of effects, see `ssad.rendering.camera.effects`.
    """
    return replace(
        sensor,
        glare=sensor.glare or BLOOM * ("bloom" in effects),
        flare=sensor.flare or FLARE * ("flare" in effects),
    )


@lru_cache(maxsize=64)
def halving_weights(size: int) -> F64:
    """Return the weights of halving an axis, without regard to earlier halvings: the transpose of enlarging.

    Args:
        size: Pixels.

    Returns:
        [ceil(size / 2), 4], of the pixels 2 i - 1 to 2 i + 2; 0 outside the axis.
    """
    half = (size + 1) // 2
    weights = np.tile([0.25, 0.75, 0.75, 0.25], (half, 1))
    # Enlarging repeats the outermost pixel, so it takes part with the whole weight of the pixel next to the border.
    weights[0, :2] = 0.0, 1.0
    if size % 2:
        weights[-1, 2:] = 0.0
    else:
        weights[-1, 2:] = 1.0, 0.0
    return weights


@lru_cache(maxsize=64)
def pyramid_weights(size: int, levels: int) -> tuple[F64, ...]:
    """Return the weights of an axis from each level of the pyramid to the next, [n, 4] each, with rows of sum 1.

    Args:
        size: Pixels of the image along the axis.
        levels: Number of halvings.
    """
    area = np.ones(size)
    weights_by_level = []
    for _ in range(levels):
        weights = halving_weights(len(area))
        taps = 2 * np.arange(len(weights))[:, None] + np.arange(-1, 3)
        weighted = weights * area[np.clip(taps, 0, len(area) - 1)]
        area = weighted.sum(1)
        weights_by_level.append(weighted / area[:, None])
    return tuple(weights_by_level)


def level_count(height: int, width: int) -> int:
    """Return the number of halvings of an image of a size in px, at least 1."""
    return max(1, int(math.log2(min(height, width) / SMALLEST)))


def level_spread(level: int) -> float:
    """Return the standard deviation of the point spread of a level, px of the image."""
    return math.sqrt(0.5 * (4.0**level - 1.0))


def glare_weights(sensor: SensorModel, height: int, width: int) -> F64:
    """Return the share of the light that each level of the pyramid scatters [levels], the finest first.

    Args:
        sensor: Sensor with glare and focal length.
        height: Pixels of the image.
        width: Pixels of the image.
    """
    degrees = math.degrees(1.0 / (sensor.focal * width))  # angle of a pixel
    spreads = np.array([level_spread(level) for level in range(1, level_count(height, width) + 1)]) * degrees
    veil = np.zeros(len(spreads))
    for factor, exponent in VEIL:
        mixture = 4.0 * math.pi / (2.0 ** (0.5 * exponent) * math.gamma(0.5 * exponent))
        veil += factor * mixture * spreads ** (2.0 - exponent)
    # An octave of widths; square degrees to steradians.
    octave = math.log(2.0) * math.radians(1.0) ** 2
    return np.asarray(sensor.glare * octave * veil * np.exp(-0.5 * (CORE / spreads) ** 2))


def direct_share(sensor: SensorModel, weights: F64) -> float:
    """Return the share of the light that is neither scattered nor reflected."""
    return float(1.0 - weights.sum() - len(GHOSTS) * sensor.flare * REFLECTION**2)


def ghost_lights(sensor: SensorModel) -> list[tuple[float, tuple[float, ...]]]:
    """Return the size of each ghost, and its radiance for a radiance of 1, RGB."""
    return [(size, tuple(sensor.flare * REFLECTION**2 * value / size**2 for value in tint)) for size, tint in GHOSTS]


def ghost_source_level(height: int, width: int) -> int:
    """Return the level of the pyramid whose blur ghosts have: a fortieth of the width of the image."""
    # A finer one would fall between the pixels of the level that shows the ghosts.
    return min(level_count(height, width), max(GHOST_LEVEL + 1, round(math.log2(width / 40))))


def scatter(radiance: Any, sensors: list[SensorModel]) -> Any:
    """Return the radiance behind the lenses of sensors.

    Args:
        radiance: Linear [B, H, W], a Warp array of vec3.
        sensors: Sensor of each image.

    Returns:
        The same, in a new array; the array itself if no sensor has glare or flare. Images of other sensors are copied.
    """
    if not any(sensor.scatters for sensor in sensors):
        return radiance
    device, (_, height, width) = radiance.device, radiance.shape
    scattered = _scattered(radiance, sensors)
    direct = _lens_tables(tuple(sensors), height, width, str(device)).direct
    out = wp.empty(radiance.shape, dtype=wp.vec3, device=device)
    wp.launch(kernels.mix, dim=out.shape[:2], inputs=[radiance, scattered, direct], outputs=[out], device=device)
    return out


@dataclass(frozen=True, slots=True)
class LensTables:
    """Arrays of the kernels that follow from the sensors and the size of images.

    Attributes:
        weights: Of each level of the pyramid and each image [levels, B].
        direct: Share of the light that is neither scattered nor reflected [B].
        ghosts: Of each image [B, GHOSTS]; None if no lens has any.
        centres: Of each image, px from its corner [B].
    """

    weights: Any
    direct: Any
    ghosts: Any
    centres: Any


@lru_cache(maxsize=16)
def _lens_tables(sensors: tuple[SensorModel, ...], height: int, width: int, device: str) -> LensTables:
    """Return the arrays of the sensors of B images of a size on a device."""
    weights = np.array([glare_weights(sensor, height, width) for sensor in sensors])
    shares = [
        direct_share(sensor, values) if sensor.scatters else 1.0
        for sensor, values in zip(sensors, weights, strict=True)
    ]
    ghosts = None
    if any(sensor.flare > 0.0 for sensor in sensors):
        rows: Any = np.array([ghost_lights(sensor) for sensor in sensors], kernels.Ghost.numpy_dtype())  # type: ignore[attr-defined]
        ghosts = wp.array(rows, dtype=kernels.Ghost, device=device)
    return LensTables(
        wp.array(np.ascontiguousarray(weights.T, np.float32), dtype=float, device=device),
        wp.array(np.array(shares, np.float32), dtype=float, device=device),
        ghosts,
        wp.array(np.tile([0.5 * width, 0.5 * height], (len(sensors), 1)), dtype=wp.vec2, device=device),
    )


@lru_cache(maxsize=32)
def _pyramid_tables(size: int, levels: int, device: str) -> tuple[Any, ...]:
    """Return the weights of an axis, see `pyramid_weights`, on a device."""
    return tuple(
        wp.array(weights.astype(np.float32), dtype=float, device=device) for weights in pyramid_weights(size, levels)
    )


def _scattered(radiance: Any, sensors: Sequence[SensorModel]) -> Any:
    """Return the light that lenses scatter and mirror, at half the size of the image."""
    device, (count, height, width) = radiance.device, radiance.shape
    levels = level_count(height, width)
    tables = _lens_tables(tuple(sensors), height, width, str(device))
    pyramid = [radiance]
    for row_weights, column_weights in zip(
        _pyramid_tables(height, levels, str(device)), _pyramid_tables(width, levels, str(device)), strict=True
    ):
        half = wp.empty((count, len(row_weights), len(column_weights)), dtype=wp.vec3, device=device)
        inputs = [pyramid[-1], row_weights, column_weights]
        wp.launch(kernels.shrink, dim=half.shape[:2], inputs=inputs, outputs=[half], device=device)
        pyramid.append(half)
    ghost_level, scattered = min(GHOST_LEVEL, levels), pyramid[-1]
    for level in range(levels, 0, -1):
        total = wp.empty(pyramid[level].shape, dtype=wp.vec3, device=device)
        inputs = [pyramid[level], scattered, tables.weights, level - 1, float(level < levels)]
        wp.launch(kernels.gather, dim=total.shape[:2], inputs=inputs, outputs=[total], device=device)
        if level == ghost_level and tables.ghosts is not None:
            source = ghost_source_level(height, width)
            inputs = [pyramid[source], tables.ghosts, tables.centres, float(2**level), float(2**source)]
            wp.launch(kernels.add_ghosts, dim=total.shape[:2], inputs=inputs, outputs=[total], device=device)
        scattered = total
    return scattered


def add_suns(radiance: Any, tag: Any, views: Sequence[View], lens: F64, lights: Sequence[tuple[Any, ...]]) -> None:
    """Add the disc of the sun to the sky of views whose sensor scatters, with all the light that the sun sends.

    Other views stay as they are: in theirs the sun is a bright spot that is wider than the disc and weaker.

    Args:
        radiance: Linear [B, H, W], a Warp array of vec3; changed in place.
        tag: [B, H, W], a Warp array; -1 is the sky.
        views: The views.
        lens: fx, fy, cx, cy of each view, px [B, 4].
        lights: Light of each view, see `ssad.rendering.camera.kernels.sky.Light`.
    """
    height, width = radiance.shape[1:]
    rows: Any = []
    side = 0
    for view, (focal_x, focal_y, centre_x, centre_y), light in zip(views, lens, lights, strict=True):
        right, down, ahead = view.pose[:3, :3].T @ np.asarray(light[0])
        strength = np.asarray(light[1]) * (1.0 - 0.9 * light[6])
        radius = SUN_RADIUS * math.sqrt(focal_x * focal_y)
        column = focal_x * right / max(ahead, 1e-9) + centre_x
        row = focal_y * down / max(ahead, 1e-9) + centre_y
        is_visible = view.sensor.scatters and ahead > 0.0 and strength.max() > 0.0
        is_visible &= -radius < column < width + radius and -radius < row < height + radius
        # The disc sends the irradiance of the sun; it is pi times the colour, and spread over the disc's solid angle.
        disc = strength / math.sin(SUN_RADIUS) ** 2 if is_visible else np.zeros(3)
        side = max(side, 2 * math.ceil(radius) + 3 if is_visible else 0)
        rows.append((column if is_visible else 0.0, row if is_visible else 0.0, radius, tuple(disc)))
    if side:
        table: Any = np.array(rows, kernels.SunDisc.numpy_dtype())  # type: ignore[attr-defined]
        discs = wp.array(table, dtype=kernels.SunDisc, device=radiance.device)
        wp.launch(
            kernels.add_sun, dim=(len(views), side, side), inputs=[discs, tag, side, radiance], device=radiance.device
        )


def lamp_gains(scene: RenderScene) -> F64:
    """Return the light that the lamps of a scene have at night beyond that of an image.

    Args:
        scene: Street and bodies.

    Returns:
        Additional share of the light of each material [materials]; 0 for what is no lamp.
    """
    gains = np.zeros(len(scene.material_names))
    surfaces = scene.surfaces.numpy()
    for row, name in enumerate(scene.material_names):
        if name in LUMINANCES:
            nominal = float(surfaces["colour"][row] @ LUMINANCE) * float(
                surfaces["emission"][row] + surfaces["night"][row]
            )
            if nominal > 0.0:
                # A surface of 1 cd/m^2 is as bright as white under pi lux.
                gains[row] = max(LUMINANCES[name] * math.pi * NIGHT_LUX / nominal - 1.0, 0.0)
    return gains


def add_glow(
    radiance: Any, visible: VisibilityPass, scene: RenderScene, views: Sequence[View], lights: Sequence[tuple[Any, ...]]
) -> None:
    """Add the glow of lamps to the radiance of views at night whose sensor scatters.

    Images show lamps far darker than they are, so that the sensor does not clip their colours. Their glow has the light
    of their luminance.

    Args:
        radiance: Linear [B, H, W], a Warp array of vec3; changed in place.
        visible: Samples of the views.
        scene: Street and bodies.
        views: The views.
        lights: Light of each view, see `ssad.rendering.camera.kernels.sky.Light`.
    """
    device, sensors = scene.device, [view.sensor for view in views]
    gains = scene.compute_once(
        "lamp gains", lambda: wp.array(lamp_gains(scene).astype(np.float32), dtype=float, device=device)
    )
    source = wp.empty_like(radiance)
    lanes = 1 if device == "cpu" else source.shape[2]
    poses = np.array([view.pose for view in views], np.float32)
    inputs = [
        scene.geometry,
        visible.draw_ranges,
        visible.lens,
        wp.array(poses, dtype=wp.mat44, device=device),
        wp.array(struct_array(sky.Light, lights), dtype=sky.Light, device=device),
        gains,
        wp.array(np.array([sensor.scatters for sensor in sensors], np.int32), dtype=int, device=device),
        visible.samples.shape[1] // source.shape[1],
        lanes,
    ]
    wp.launch(lamp_glow.take_lamps, dim=(*source.shape[:2], lanes), inputs=inputs, outputs=[source], device=device)
    scattered = _scattered(source, sensors)
    lamp_shares = np.array([light[8] * sensor.scatters for sensor, light in zip(sensors, lights, strict=True)])
    inputs = [scattered, wp.array(lamp_shares.astype(np.float32), dtype=float, device=device)]
    wp.launch(kernels.add_enlarged, dim=source.shape[:2], inputs=inputs, outputs=[radiance], device=device)


def has_glow(views: Sequence[View], lights: Sequence[tuple[Any, ...]]) -> bool:
    """Return whether lamps glow in one of the views: it is night, and a lens scatters."""
    return any(view.sensor.scatters and light[8] > 0.0 for view, light in zip(views, lights, strict=True))
