"""Sensor of the camera in torch: the chain of `ssad.rendering.camera.render` from light to JPEG, with gradients.

`develop` is the chain of `ssad.rendering.camera.sensor` and equals the renderer's images up to the rounding to 8 bits;
`ssad.rendering.camera.torch_jpeg.jpeg` follows it. An attack changes few pixels: `ChangedWindow` develops only those
and the pixels that depend on them. Light above a full photosite or outside the curve has slope zero, as in the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, grid_sample, interpolate, pad, pixel_shuffle

from ssad.core.colours import LINEAR_TOE, LUMINANCE
from ssad.core.errors import ConfigError
from ssad.rendering.camera.glare import (
    GHOST_LEVEL,
    direct_share,
    ghost_lights,
    ghost_source_level,
    glare_weights,
    level_count,
    pyramid_weights,
)
from ssad.rendering.camera.sensor import (
    ACROSS,
    ALONG,
    BRIGHTEST,
    DAY_EXPOSURE,
    DEFAULT_SENSOR,
    GREEN,
    KNEE,
    OPPOSITE,
    SHOULDER,
    SMALLEST,
    SensorModel,
    noise_levels,
    point_spread,
)
from ssad.rendering.camera.texture import Taps
from ssad.rendering.camera.torch_jpeg import ACCURATE, block_of, compress, extend_border, quantisation

TOP = 0.99975 * BRIGHTEST  # light at which the curve is cut off
PART_LEVELS = 4  # halvings of a part of an image, from which on its glare is that of the whole image

# ---------------------------------------------------------------- from light to colour


@lru_cache(maxsize=16)
def _lens_weights(blur: float, device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return the weights of the lens [3, 3], and of lens and mosaic [4, 3, 4, 4].

    The latter map a square of four pixels with a border of one pixel to the photosites of the square. Cached,
    because each copy to a GPU takes long.
    """
    centre, side = point_spread(blur)
    row_weights = np.array([side, centre, side])
    spread = row_weights[:, None] * row_weights
    square_weights = np.zeros((4, 3, 4, 4))
    for site, colour in enumerate((0, 1, 1, 2)):
        y, x = divmod(site, 2)
        square_weights[site, colour, y : y + 3, x : x + 3] = spread
    return _constant_tensor(spread, device, dtype), _constant_tensor(square_weights, device, dtype)


def _constant_tensor(values: np.ndarray, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Return a constant tensor that is valid in later calls, whatever the mode of this one."""
    # A tensor made in inference mode could not take part in autograd later.
    with torch.inference_mode(mode=False):
        return torch.as_tensor(values, dtype=dtype, device=device)


@lru_cache(maxsize=8)
def _demosaic_weights(device: torch.device, dtype: torch.dtype) -> Tensor:
    """Return the demosaicing weights [12, 1, 6, 6].

    They map a square of four with a border of two px to its colours; the outputs of one colour are adjacent.
    """
    identity_taps = np.zeros((5, 5))
    identity_taps[2, 2] = 8.0
    taps_of_colours = (
        (identity_taps, ALONG, ACROSS, OPPOSITE),  # red at red's site, at the greens beside and below it, at blue's
        (GREEN, identity_taps, identity_taps, GREEN),
        (OPPOSITE, ACROSS, ALONG, identity_taps),
    )
    square = np.zeros((12, 1, 6, 6))
    for colour, sites in enumerate(taps_of_colours):
        for site, weights in enumerate(sites):
            y, x = divmod(site, 2)
            square[4 * colour + site, 0, y : y + 5, x : x + 5] = np.array(weights) / 8
    return _constant_tensor(square, device, dtype)


def _to_squares(image: Tensor, weights: Tensor, border: int) -> Tensor:
    """A picture [B, C, H, W], mirrored at its borders, in squares of four: [B, C', H, W]."""
    height, width = image.shape[2:]
    padded = pad(image, (border, border + width % 2, border, border + height % 2), mode="reflect")
    return pixel_shuffle(conv2d(padded, weights, stride=2), 2)[:, :, :height, :width]


@lru_cache(maxsize=32)
def _halving_matrices(size: int, levels: int, device: torch.device, dtype: torch.dtype) -> list[Tensor]:
    """Return the matrices [n, m] of an axis from each level of the pyramid to the next."""
    matrices = []
    for weights in pyramid_weights(size, levels):
        half = len(weights)
        taps = 2 * np.arange(half)[:, None] + np.arange(-1, 3)
        matrix = np.zeros((half, size))
        # Taps outside of the axis have no weight.
        np.add.at(matrix, (np.arange(half)[:, None], np.clip(taps, 0, size - 1)), weights)
        matrices.append(_constant_tensor(matrix, device, dtype))
        size = half
    return matrices


def _enlarge(image: Tensor, height: int, width: int) -> Tensor:
    """Return images [B, C, h, w] at twice the size, cropped to H x W."""
    return interpolate(image, scale_factor=2, mode="bilinear", align_corners=False)[:, :, :height, :width]


def scatter(light: Tensor, sensor: SensorModel) -> Tensor:
    """Return the light behind the lens: what it scatters and its ghosts, see `ssad.rendering.camera.glare`.

    Args:
        light: Linear, [B, H, W, 3].
        sensor: Sensor with glare, flare and focal length.

    Returns:
        The same shape; the light itself without glare and flare.

    Raises:
        ConfigError: The image is smaller than 4 x 4.
    """
    if not sensor.scatters:
        return light
    height, width = light.shape[1:3]
    sensor.check_size(height, width)
    levels, weights = level_count(height, width), glare_weights(sensor, height, width)
    image = light.permute(0, 3, 1, 2)
    pyramid = _halve([image], (height, width), range(levels))
    ghost_level = min(GHOST_LEVEL, levels)
    scattered = torch.zeros_like(pyramid[-1])
    for level in range(levels, 0, -1):
        scattered = _add_level(scattered, pyramid[level], float(weights[level - 1]))
        if level == ghost_level and sensor.flare > 0:
            source, corner = (
                pyramid[ghost_source_level(height, width)],
                torch.zeros((len(light), 2), device=light.device),
            )
            scattered = scattered + _ghosts(source, sensor, (height, width), scattered.shape[2:], corner)
    behind = image * direct_share(sensor, weights) + _enlarge(scattered, height, width)
    return behind.permute(0, 2, 3, 1)


def scatter_parts(
    light: Tensor, sensor: SensorModel, corners: Sequence[tuple[int, int]], image_size: tuple[int, int]
) -> Tensor:
    """Return the light of parts of images behind the lens, as `scatter` does of images that are dark elsewhere.

    It is the same where the light is 2^`PART_LEVELS` px or more from the border of its part, unless that is the border
    of the image.

    Args:
        light: Linear, [B, h, w, 3].
        sensor: Sensor with glare, flare and focal length.
        corners: First row and column of each part, multiples of 2^`PART_LEVELS`.
        image_size: Height and width of the images, px.

    Returns:
        The same shape; the light itself without glare and flare.
    """
    if not sensor.scatters:
        return light
    levels, weights = level_count(*image_size), glare_weights(sensor, *image_size)
    source_level = ghost_source_level(*image_size)
    part_levels = min(PART_LEVELS, source_level)
    image = light.permute(0, 3, 1, 2)
    pyramid = _halve([image], light.shape[1:3], range(part_levels))
    # From there on the light reaches far, so the levels are those of the whole images.
    sides = [len(pyramid_weights(side, part_levels)[-1]) for side in image_size]
    coarse = pyramid[-1].new_zeros((len(light), *sides, 3))
    first_pixels = torch.tensor(corners).to(light.device)
    first_cells = first_pixels // 2**part_levels
    rows, columns = (
        first_cells[:, axis, None] + torch.arange(pyramid[-1].shape[2 + axis], device=light.device) for axis in (0, 1)
    )
    cells = torch.arange(len(light), device=light.device)[:, None, None], rows[:, :, None], columns[:, None, :]
    coarse = coarse.index_put(cells, pyramid[-1].permute(0, 2, 3, 1)).permute(0, 3, 1, 2)
    coarse_pyramid = _halve([coarse], image_size, range(part_levels, levels))
    scattered = torch.zeros_like(coarse_pyramid[-1])
    for level in range(levels, part_levels - 1, -1):
        scattered = _add_level(scattered, coarse_pyramid[level - part_levels], float(weights[level - 1]))
    scattered = scattered.permute(0, 2, 3, 1)[cells].permute(0, 3, 1, 2)
    for level in range(part_levels - 1, 0, -1):
        scattered = _add_level(scattered, pyramid[level], float(weights[level - 1]))
        if level == GHOST_LEVEL and sensor.flare > 0:
            source = coarse_pyramid[source_level - part_levels]
            scattered = scattered + _ghosts(source, sensor, image_size, scattered.shape[2:], first_pixels)
    behind = image * direct_share(sensor, weights) + _enlarge(scattered, *light.shape[1:3])
    return behind.permute(0, 2, 3, 1)


def _halve(pyramid: list[Tensor], size: Sequence[int], levels: range) -> list[Tensor]:
    """Return a pyramid with further levels of images [B, C, h, w], whose level 0 has a size."""
    height, width = size
    matrices = zip(
        *(_halving_matrices(side, levels.stop, pyramid[0].device, pyramid[0].dtype) for side in (height, width)),
        strict=True,
    )
    for rows, columns in list(matrices)[levels.start :]:
        pyramid.append(rows @ pyramid[-1] @ columns.T)
    return pyramid


def _add_level(scattered: Tensor, level: Tensor, weight: float) -> Tensor:
    """Return the scattered light of a level and of the next, coarser one, enlarged."""
    if scattered.shape != level.shape:
        scattered = _enlarge(scattered, *level.shape[2:])
    return scattered + level * weight


def _ghosts(
    source: Tensor, sensor: SensorModel, image_size: Sequence[int], shown_size: Sequence[int], corners: Tensor
) -> Tensor:
    """Return the ghosts of images in parts of them, [B, 3, h, w], at the level `GHOST_LEVEL` of a pyramid.

    Args:
        source: Level of the pyramid of the images whose blur ghosts have, [B, 3, ...].
        sensor: Sensor with flare.
        image_size: Height and width of the images, px.
        shown_size: h and w, pixels of the level.
        corners: First row and column of each part, px of the image [B, 2].
    """
    level = min(GHOST_LEVEL, level_count(*image_size))
    source_level = ghost_source_level(*image_size)
    sizes, tints = _ghost_constants(sensor, source.device, source.dtype)
    coordinates = []
    for axis in (0, 1):
        places = (torch.arange(shown_size[axis], dtype=source.dtype, device=source.device) + 0.5) * 2**level
        centre = 0.5 * image_size[axis]
        places = ((places + corners[:, axis, None] - centre) / sizes + centre) / 2**source_level
        # From pixels to the -1 to 1 of `grid_sample`.
        coordinates.append(2 * places / source.shape[2 + axis] - 1)
    rows, columns = coordinates
    # All ghosts at once: few operations take little time on a GPU.
    shape = (len(sizes), len(source), *shown_size)
    grid = torch.stack([columns[:, :, None].expand(shape), rows[:, :, :, None].expand(shape)], -1).flatten(0, 1)
    sources = source.expand(len(sizes), *source.shape).flatten(0, 1)
    ghosts = grid_sample(sources, grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    ghosts = ghosts.reshape(*shape[:2], *ghosts.shape[1:])
    return (ghosts * tints).sum(0)


@lru_cache(maxsize=8)
def _ghost_constants(sensor: SensorModel, device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return the sizes of the ghosts of a sensor [G, 1, 1], and their tints [G, 1, 3, 1, 1]."""
    sizes, tints = zip(*ghost_lights(sensor), strict=True)
    return (
        _constant_tensor(np.array(sizes)[:, None, None], device, dtype),
        _constant_tensor(np.array(tints)[:, None, :, None, None], device, dtype),
    )


def photosites(light: Tensor, sensor: SensorModel) -> Tensor:
    """Return the light on the photosites: glare, the lens's point spread, and one colour for each with a mosaic.

    Args:
        light: Linear, [B, H, W, 3].
        sensor: Sensor with lens and mosaic.

    Returns:
        Light of each photosite, [B, H, W] with a mosaic, [B, H, W, 3] without.

    Raises:
        ConfigError: The image is smaller than 4 x 4.
    """
    sensor.check_size(*light.shape[1:3])
    light = scatter(light, sensor)
    colours = light.permute(0, 3, 1, 2)
    spread, square = _lens_weights(sensor.blur, light.device, light.dtype)
    if sensor.mosaic:
        return _to_squares(colours, square, 1)[:, 0]
    if sensor.blur == 0:
        return light
    kernel = spread.expand(3, 1, 3, 3)
    return conv2d(pad(colours, (1, 1, 1, 1), mode="reflect"), kernel, groups=3).permute(0, 2, 3, 1)


def fill(light: Tensor, exposure: Tensor | float, sensor: SensorModel, noise: Tensor | None = None) -> Tensor:
    """Return the content of the photosites: light with noise, clipped where they are full, with slope zero there.

    Args:
        light: Exposed light on each photosite, [B, H, W] or [B, H, W, 3].
        exposure: [B] or one for all; determines the level of the noise.
        sensor: Sensor with noise and full photosites.
        noise: Independent standard normal numbers, shaped as light; None for none.

    Returns:
        The raw image, shaped as light. The slope includes that noise grows with light.

    Raises:
        ConfigError: The noise has another shape.
    """
    if noise is not None and sensor.noise > 0:
        if noise.shape != light.shape:
            raise ConfigError(f"noise of shape {list(noise.shape)} for photosites {list(light.shape)}")
        scale = torch.as_tensor(exposure, dtype=light.dtype, device=light.device).reshape(-1, *[1] * (light.ndim - 1))
        gain = (scale / DAY_EXPOSURE).clamp_min(1.0).sqrt()
        # `noise_levels` takes one exposure; the gain of each image is applied to its result.
        photons, dark = noise_levels(sensor.noise, DAY_EXPOSURE)
        light = light + torch.sqrt(photons * gain * light.clamp_min(0.0) + (dark * gain) ** 2) * noise
    return light.clamp_max(sensor.full)


def demosaic(raw: Tensor) -> Tensor:
    """Interpolate the missing colours of an RGGB mosaic by Malvar, He and Cutler (ICASSP 2004).

    Args:
        raw: Content of the photosites, [B, H, W].

    Returns:
        Linear colours, [B, H, W, 3]; noise and edges can make them slightly negative.
    """
    return _to_squares(raw[:, None], _demosaic_weights(raw.device, raw.dtype), 2).permute(0, 2, 3, 1)


def curve(light: Tensor) -> Tensor:
    """Apply the camera's curve: linear to 0.8, a soft shoulder above, then sRGB.

    Args:
        light: Linear, of any shape; used in 0..4.

    Returns:
        sRGB in [0, 1]. The slope is finite everywhere.
    """
    encoded: Tensor = _Curve.apply(light)
    return encoded


def _shoulder(light: Tensor) -> tuple[Tensor, Tensor]:
    """Return light in 0..4 under the shoulder, and the remaining share of a change of it."""
    remaining_slope = torch.exp((KNEE - light.clamp_min(KNEE)) / SHOULDER)
    return light.clamp_max(KNEE) + (1 - KNEE) * (1 - remaining_slope), remaining_slope


class _Curve(torch.autograd.Function):
    """Curve with an explicit gradient: half of the operations, which dominate the time on a GPU."""

    @staticmethod
    def forward(context: Any, light: Tensor) -> Tensor:
        context.save_for_backward(light)
        shouldered, _ = _shoulder(light.clamp(0.0, TOP))
        return torch.where(
            shouldered <= LINEAR_TOE, shouldered * 12.92, 1.055 * shouldered.clamp_min(LINEAR_TOE) ** (1 / 2.4) - 0.055
        )

    @staticmethod
    def backward(context: Any, slope: Tensor) -> Tensor:
        (light,) = context.saved_tensors
        shouldered, remaining_slope = _shoulder(light.clamp(0.0, TOP))
        encoding_slope = torch.where(
            shouldered <= LINEAR_TOE, 12.92, (1.055 / 2.4) * shouldered.clamp_min(LINEAR_TOE) ** (1 / 2.4 - 1)
        )
        shoulder_slope = torch.where(light > KNEE, ((1 - KNEE) / SHOULDER) * remaining_slope, 1.0)
        gradient: Tensor = slope * encoding_slope * shoulder_slope * ((light > 0.0) & (light < TOP))
        return gradient


def render_colours(light: Tensor, sensor: SensorModel) -> Tensor:
    """Apply the saturation, the curve, the gamma and the contrast of a sensor.

    Args:
        light: Linear, [..., 3].
        sensor: The sensor.

    Returns:
        sRGB in [0, 1].
    """
    if sensor.saturation != 1.0:
        grey = (light * light.new_tensor(LUMINANCE)).sum(-1, keepdim=True)
        light = light * sensor.saturation + grey * (1.0 - sensor.saturation)
    encoded = curve(light)
    if sensor.gamma != 1.0:
        # The slope of a power below 1 has no bound at black.
        encoded = encoded.clamp_min(1e-6) ** sensor.gamma
    if sensor.contrast != 0.0:
        encoded = encoded + sensor.contrast * encoded * (1 - encoded) * (2 * encoded - 1)
    return encoded


def draw_noise(shape: Sequence[int], sensor: SensorModel, generator: torch.Generator) -> Tensor:
    """Draw a sample of noise for `develop`: standard normal numbers.

    Args:
        shape: B, H, W.
        sensor: With a mosaic a photosite has one number, else three.
        generator: Source of the numbers; the sample is on its device.

    Returns:
        [B, H, W] or [B, H, W, 3], float32.
    """
    size = (*shape, 3)[: 3 if sensor.mosaic else 4]
    return torch.randn(size, generator=generator, device=generator.device)


def generators_on_device(generators: Sequence[torch.Generator], device: torch.device) -> list[torch.Generator]:
    """Return generators for one draw per pixel or texel on a device.

    On the CPU they are the given generators, on a GPU new ones seeded by them. A GPU draws other numbers than
    the CPU would; drawing on the CPU and copying would take longer than all other work on an image.

    Args:
        generators: On the CPU.
        device: Device that needs the numbers.

    Returns:
        One generator for each given one.
    """
    if device.type == "cpu":
        return list(generators)
    seeds = [int(torch.randint(1 << 62, (1,), generator=entry)) for entry in generators]
    return [torch.Generator(device).manual_seed(seed) for seed in seeds]


def develop(
    radiance: Tensor,
    exposure: Tensor | float,
    sensor: SensorModel = DEFAULT_SENSOR,
    noise: Tensor | torch.Generator | None = None,
) -> Tensor:
    """Develop radiance into the camera's image, as `ssad.rendering.camera.render` does before it rounds to 8 bits.

    Args:
        radiance: Linear, [B, H, W, 3].
        exposure: Factor of the radiance, [B] or one for all.
        sensor: Lens, mosaic, noise and full photosites.
        noise: A sample from `draw_noise`, which stays fixed over calls; or a generator to draw one; None for
            none.

    Returns:
        sRGB in [0, 1], [B, 3, H, W]; differentiable in the radiance.

    Raises:
        ConfigError: The image is smaller than 4 x 4, or the noise has another shape.
    """
    exposure_factor = torch.as_tensor(exposure, dtype=radiance.dtype, device=radiance.device).reshape(-1, 1, 1, 1)
    if isinstance(noise, torch.Generator):
        noise = draw_noise(radiance.shape[:3], sensor, noise)
    if noise is not None:
        noise = noise.to(radiance)
    light = radiance * exposure_factor
    if sensor.balance != (1.0, 1.0, 1.0):
        light = light * light.new_tensor(sensor.balance)
    raw = fill(photosites(light, sensor), exposure, sensor, noise)
    return render_colours(demosaic(raw) if sensor.mosaic else raw, sensor).permute(0, 3, 1, 2)


# ---------------------------------------------------------------- windows of changed pixels


Span = tuple[int, int]  # first, and one after the last
Rectangle = tuple[Span, Span]  # of rows and columns


def _rectangles(pixels: Tensor, shape: tuple[int, int, int]) -> list[Rectangle]:
    """Return the rectangle around flat pixels of each image; empty where there is none."""
    count, height, width = shape
    flat_pixels = pixels.detach().reshape(-1).cpu()
    if len(flat_pixels) and not (int(flat_pixels.min()) >= 0 and int(flat_pixels.max()) < count * height * width):
        raise ConfigError(f"a pixel outside of {count} pictures of {width} x {height}")
    image_index, y, x = flat_pixels // (height * width), flat_pixels // width % height, flat_pixels % width
    spans = []
    for values, limit in ((y, height), (x, width)):
        firsts = torch.full((count,), limit).scatter_reduce(0, image_index, values, "amin").tolist()
        lasts = torch.full((count,), -1).scatter_reduce(0, image_index, values, "amax").tolist()
        spans.append(
            [(first, last + 1) if first <= last else (0, 0) for first, last in zip(firsts, lasts, strict=True)]
        )
    return list(zip(*spans, strict=True))


def _grow_span(span: Span, margin: int, limit: int, step: int = 1) -> Span:
    """A span with a margin, out to multiples of a step, in 0..most; an empty one stays empty."""
    if span[0] == span[1]:
        return span
    return max((span[0] - margin) // step * step, 0), min(-(-(span[1] + margin) // step) * step, limit)


def _equal_spans(spans: Sequence[Span], limit: int, step: int) -> list[Span]:
    """Spans of one length that hold given ones, in 0..most, at multiples of a step."""
    length = max(SMALLEST, *(last - first // step * step for first, last in spans))
    length = -(-length // step) * step
    length = min(length + (limit - length) % step, limit)
    starts = [min(first // step * step, limit - length) for first, _ in spans]
    return [(start, start + length) for start in starts]


@dataclass(frozen=True, slots=True)
class ChangedWindow:
    """Part of images that changes when a few pixels do, and the part that it is developed from.

    All rectangles are spans of rows and of columns, one for each image; read and coded rectangles have one
    size.

    Attributes:
        shape: B, H, W of the whole images.
        sensor: Sensor of the images.
        changed: Where images change.
        read: Where the radiance is needed.
        coded: Where the developed image is needed: whole JPEG blocks, which can extend beyond the image.
        quality: Of JPEG; None for none.
        subsampling: Of JPEG, "420" or "444".
    """

    shape: tuple[int, int, int]
    sensor: SensorModel
    changed: tuple[Rectangle, ...]
    read: tuple[Rectangle, ...]
    coded: tuple[Rectangle, ...]
    quality: int | None
    subsampling: str

    @staticmethod
    def around(
        pixels: Tensor,
        shape: Sequence[int],
        sensor: SensorModel,
        *,
        quality: int | None = None,
        subsampling: str = "420",
        step: int = 1,
    ) -> ChangedWindow:
        """Return the window that changes when the radiance of pixels does.

        Args:
            pixels: Flat indices into B * H * W, such as `Taps.pixel`.
            shape: B, H, W of the images.
            sensor: Sensor of the images.
            quality: Of JPEG, 1 to 100; None for images that are not compressed.
            subsampling: Of JPEG, "420" or "444".
            step: See `of`.

        Returns:
            The window; it is empty in images without such a pixel.

        Raises:
            ConfigError: A pixel lies outside the images, or quality or subsampling is invalid.
        """
        count, height, width = shape
        block_side, block_margin = 1, 0
        if quality is not None:
            # Upsampling reads the colours next to a block, so a change also reaches the neighbouring blocks.
            block_side, block_margin = block_of(subsampling), 1 if subsampling == "420" else 0
        changed = []
        for spans in _rectangles(pixels, (count, height, width)):
            rows, columns = (
                _grow_span(_grow_span(span, sensor.reach, limit, block_side), block_margin, limit)
                for span, limit in zip(spans, (height, width), strict=True)
            )
            changed.append((rows, columns))
        return ChangedWindow.of(changed, shape, sensor, quality=quality, subsampling=subsampling, step=step)

    @staticmethod
    def of(
        changed: Sequence[Rectangle],
        shape: Sequence[int],
        sensor: SensorModel,
        *,
        quality: int | None = None,
        subsampling: str = "420",
        step: int = 1,
    ) -> ChangedWindow:
        """Return the window that gives the developed values of rectangles.

        Args:
            changed: Spans of rows and of columns, one pair for each image.
            shape: B, H, W of the images.
            sensor: Sensor of the images.
            quality: Of JPEG, 1 to 100; None for images that are not compressed.
            subsampling: Of JPEG, "420" or "444".
            step: Rectangles that are read extend as many px farther than they must, and begin and end at its multiples
                (see `scatter_parts`).

        Returns:
            The window.

        Raises:
            ConfigError: Quality or subsampling is invalid.
        """
        count, height, width = shape
        block_side, block_margin = 1, 0
        if quality is not None:
            quantisation(quality)
            block_side, block_margin = block_of(subsampling), 1 if subsampling == "420" else 0
        coded, read = [], []
        for axis, limit in enumerate((height, width)):
            padded_limit = -(-limit // block_side) * block_side
            blocks = [
                _grow_span(_grow_span(rectangle[axis], block_margin, limit), 0, padded_limit, block_side)
                for rectangle in changed
            ]
            blocks = _equal_spans(blocks, padded_limit, block_side)
            coded.append(blocks)
            margin = sensor.reach + (step if step > 1 else 0)
            needed = [_grow_span((first, min(last, limit)), margin, limit) for first, last in blocks]
            read.append(_equal_spans(needed, limit, max(step, 2 if sensor.mosaic else 1)))
        return ChangedWindow(
            (count, height, width),
            sensor,
            tuple(changed),
            tuple(zip(*read, strict=True)),
            tuple(zip(*coded, strict=True)),
            quality,
            subsampling,
        )

    def crop(self, image: Tensor) -> Tensor:
        """Return the part of radiance or noise that the window reads.

        Args:
            image: [B, H, W, ...].

        Returns:
            [B, h, w, ...].

        Raises:
            ConfigError: The pictures have another shape.
        """
        if tuple(image.shape[:3]) != self.shape:
            raise ConfigError(f"a window of pictures {list(self.shape)}, not {list(image.shape[:3])}")
        return torch.stack([entry[slice(*y), slice(*x)] for entry, (y, x) in zip(image, self.read, strict=True)])

    def relative_taps(self, taps: Taps) -> Taps:
        """Return the taps with pixels relative to the radiance that `crop` returns.

        Args:
            taps: Into whole images, all of their pixels inside the window.

        Returns:
            The same with other pixels.

        Raises:
            ConfigError: A pixel lies outside the window.
        """
        _, height, width = self.shape
        spans = torch.tensor(self.read, device=taps.pixel.device)  # [B, 2, 2]
        size = spans[0, :, 1] - spans[0, :, 0]
        image_index = taps.pixel // (height * width)
        y = taps.pixel // width % height - spans[image_index, 0, 0]
        x = taps.pixel % width - spans[image_index, 1, 0]
        if bool(((y < 0) | (y >= size[0]) | (x < 0) | (x >= size[1])).any()):
            raise ConfigError("a tap outside of the window")
        return replace(taps, pixel=(image_index * size[0] + y) * size[1] + x)

    def develop(self, radiance: Tensor, exposure: Tensor | float, noise: Tensor | None = None) -> Tensor:
        """Return `develop` and `jpeg` of the whole images in the coded rectangles; valid where the images change.

        Args:
            radiance: Of the window, as from `crop`, [B, h, w, 3].
            exposure: [B] or one for all.
            noise: Of the window: `crop` of a sample for whole images; None for none.

        Returns:
            [B, 3, h', w'] of the coded rectangles.

        Raises:
            ConfigError: The noise has another shape.
        """
        developed = develop(radiance, exposure, self.sensor, noise)
        _, height, width = self.shape
        extended_parts, sizes, corners = [], [], []
        for (rows, columns), (y, x) in zip(self.coded, self.read, strict=True):
            sizes.append((min(rows[1], height) - rows[0], min(columns[1], width) - columns[0]))
            corners.append((rows[0] - y[0], columns[0] - x[0]))
        coded_size = _size(self.coded[0])
        if len({*sizes, coded_size}) == 1 and len(set(corners)) == 1:  # the usual case: no border is near
            (top, left), (part_height, part_width) = corners[0], coded_size
            image = developed[:, :, top : top + part_height, left : left + part_width]
        else:
            for single, (top, left), (part_height, part_width) in zip(developed, corners, sizes, strict=True):
                extended_parts.append(
                    extend_border(single[:, top : top + part_height, left : left + part_width], *coded_size)
                )
            image = torch.stack(extended_parts)
        if self.quality is None:
            return image
        return compress(image, sizes, self.quality, self.subsampling, fast=self.quality < ACCURATE)

    def paste(self, developed: Tensor, image: Tensor) -> Tensor:
        """Whole pictures with the window's part renewed.

        Args:
            developed: What `develop` gives.
            image: The pictures before, [B, 3, H, W]; uint8 as codes.

        Returns:
            [B, 3, H, W]; differentiable in both, but not in codes.
        """
        pasted: Tensor = _Paste.apply(developed, image, self.changed, self.coded)
        return pasted


class _Paste(torch.autograd.Function):
    """Autograd function of `ChangedWindow.paste`: one copy an image each way; slices would copy whole images."""

    @staticmethod
    def forward(
        context: Any, developed: Tensor, picture: Tensor, changed: Sequence[Rectangle], coded: Sequence[Rectangle]
    ) -> Tensor:
        context.parts = parts = []
        pasted = picture.float().div_(255) if picture.dtype == torch.uint8 else picture.clone()
        for image_index, ((y, x), (rows, columns)) in enumerate(zip(changed, coded, strict=True)):
            inside = slice(y[0] - rows[0], y[1] - rows[0]), slice(x[0] - columns[0], x[1] - columns[0])
            parts.append(((image_index, slice(None), slice(*y), slice(*x)), (image_index, slice(None), *inside)))
            pasted[parts[-1][0]] = developed[parts[-1][1]]
        context.size = developed.shape
        return pasted

    @staticmethod
    def backward(context: Any, slope: Tensor) -> tuple[Tensor, Tensor | None, None, None]:
        window_gradient, background_gradient = (
            slope.new_zeros(context.size),
            slope.clone() if context.needs_input_grad[1] else None,
        )
        for image_part, window_part in context.parts:
            window_gradient[window_part] = slope[image_part]
            # Replaced pixels of the images before have no influence.
            if background_gradient is not None:
                background_gradient[image_part] = 0.0
        return window_gradient, background_gradient, None, None


def _size(rectangle: Rectangle) -> tuple[int, int]:
    return rectangle[0][1] - rectangle[0][0], rectangle[1][1] - rectangle[1][0]


def develop_at(
    radiance: Tensor,
    exposure: Tensor | float,
    sensor: SensorModel,
    pixels: Tensor,
    noise: Tensor | None = None,
    *,
    quality: int | None = None,
    subsampling: str = "420",
) -> Tensor:
    """Develop single pixels: `develop`, then `jpeg` if a quality is given, of only the parts that they need.

    Args:
        radiance: Linear, [B, H, W, 3].
        exposure: Factor of the radiance, [B] or one for all.
        sensor: Lens, mosaic, noise and full photosites.
        pixels: Flat indices into B * H * W, [F].
        noise: A sample for the whole images, as from `draw_noise`; None for none.
        quality: Of JPEG, 1 to 100; None for images that are not compressed.
        subsampling: Of JPEG, "420" or "444".

    Returns:
        sRGB in [0, 1], [F, 3]: the same as of the whole images.

    Raises:
        ConfigError: A pixel lies outside the images, or a setting is invalid.
    """
    count, height, width = radiance.shape[:3]
    rectangles = _rectangles(pixels, (count, height, width))
    window = ChangedWindow.of(rectangles, radiance.shape[:3], sensor, quality=quality, subsampling=subsampling)
    developed_parts = window.develop(window.crop(radiance), exposure, None if noise is None else window.crop(noise))
    image_index = pixels // (height * width)
    corner = torch.tensor([[rows[0], columns[0]] for rows, columns in window.coded], device=pixels.device)[image_index]
    return developed_parts[image_index, :, pixels // width % height - corner[:, 0], pixels % width - corner[:, 1]]
