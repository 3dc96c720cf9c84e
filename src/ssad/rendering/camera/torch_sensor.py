"""The camera's sensor in torch: what `ssad.rendering.camera.render` does from light to JPEG, with gradients.

`develop` is the chain of `ssad.rendering.camera.sensor` and equals the renderer's pictures to the rounding to 8 bits;
`ssad.rendering.camera.torch_jpeg.jpeg` follows it. An attack changes few pixels: `Window` develops those and what
depends on them alone. Light above a full photosite or outside the curve has slope zero, as in the camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, pad, pixel_shuffle

from ssad.core.errors import ConfigError
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
    Sensor,
    noise_levels,
    point_spread,
)
from ssad.rendering.camera.texture import Taps
from ssad.rendering.camera.torch_jpeg import ACCURATE, block_of, compressed, extended, quantisation

TOP = 0.99975 * BRIGHTEST  # light at which the curve is cut off
TOE = 0.0031308  # light below which sRGB is linear

# ---------------------------------------------------------------- from light to colour


@lru_cache(maxsize=16)
def _lens_weights(blur: float, device: torch.device, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Weights of the lens [3, 3], and of lens and mosaic [4, 3, 4, 4]; kept, since each copy to a GPU takes long.

    The latter lead from a square of four pixels with a border of one pixel to the photosites of the square.
    """
    centre, side = point_spread(blur)
    line = np.array([side, centre, side])
    spread = line[:, None] * line
    square = np.zeros((4, 3, 4, 4))
    for site, colour in enumerate((0, 1, 1, 2)):
        y, x = divmod(site, 2)
        square[site, colour, y : y + 3, x : x + 3] = spread
    return _kept(spread, device, dtype), _kept(square, device, dtype)


def _kept(values: np.ndarray, device: torch.device, dtype: torch.dtype) -> Tensor:
    """Values for any later call, whatever the mode of this one."""
    with torch.inference_mode(mode=False):
        return torch.as_tensor(values, dtype=dtype, device=device)


@lru_cache(maxsize=8)
def _demosaic_weights(device: torch.device, dtype: torch.dtype) -> Tensor:
    """[12, 1, 6, 6]: from a square of four with a border of two px to its colours, those of one colour together."""
    itself = np.zeros((5, 5))
    itself[2, 2] = 8.0
    taps = (
        (itself, ALONG, ACROSS, OPPOSITE),  # red at red's site, at the greens beside and below it, at blue's
        (GREEN, itself, itself, GREEN),
        (OPPOSITE, ACROSS, ALONG, itself),
    )
    square = np.zeros((12, 1, 6, 6))
    for colour, sites in enumerate(taps):
        for site, weights in enumerate(sites):
            y, x = divmod(site, 2)
            square[4 * colour + site, 0, y : y + 5, x : x + 5] = np.array(weights) / 8
    return _kept(square, device, dtype)


def _squares(picture: Tensor, weights: Tensor, border: int) -> Tensor:
    """A picture [B, C, H, W], mirrored at its borders, in squares of four: [B, C', H, W]."""
    height, width = picture.shape[2:]
    wide = pad(picture, (border, border + width % 2, border, border + height % 2), mode="reflect")
    return pixel_shuffle(conv2d(wide, weights, stride=2), 2)[:, :, :height, :width]


def photosites(light: Tensor, sensor: Sensor) -> Tensor:
    """What falls on the photosites: the lens's point spread, and one colour for each where there is a mosaic.

    Args:
        light: Linear, [B, H, W, 3].
        sensor: Whose lens and mosaic.

    Returns:
        Light of each photosite, [B, H, W] with a mosaic, [B, H, W, 3] without.

    Raises:
        ConfigError: The picture is smaller than 4 x 4.
    """
    sensor.check_size(*light.shape[1:3])
    colours = light.permute(0, 3, 1, 2)
    spread, square = _lens_weights(sensor.blur, light.device, light.dtype)
    if sensor.mosaic:
        return _squares(colours, square, 1)[:, 0]
    if sensor.blur == 0:
        return light
    kernel = spread.expand(3, 1, 3, 3)
    return conv2d(pad(colours, (1, 1, 1, 1), mode="reflect"), kernel, groups=3).permute(0, 2, 3, 1)


def fill(light: Tensor, exposure: Tensor | float, sensor: Sensor, noise: Tensor | None = None) -> Tensor:
    """What the photosites hold: light with noise, and no more than fits. Zero slope where they are full.

    Args:
        light: Exposed light on each photosite, [B, H, W] or [B, H, W, 3].
        exposure: [B] or one for all, on which the level of the noise depends.
        sensor: Whose noise and full photosites.
        noise: Independent normal numbers of deviation one, shaped as light; None for none.

    Returns:
        The raw picture, shaped as light. The slope counts that noise grows with light.

    Raises:
        ConfigError: The noise has another shape.
    """
    if noise is not None and sensor.noise > 0:
        if noise.shape != light.shape:
            raise ConfigError(f"noise of shape {list(noise.shape)} for photosites {list(light.shape)}")
        scale = torch.as_tensor(exposure, dtype=light.dtype, device=light.device).reshape(-1, *[1] * (light.ndim - 1))
        gain = (scale / DAY_EXPOSURE).clamp_min(1.0).sqrt()
        photons, dark = noise_levels(sensor.noise, DAY_EXPOSURE)
        light = light + torch.sqrt(photons * gain * light.clamp_min(0.0) + (dark * gain) ** 2) * noise
    return light.clamp_max(sensor.full)


def demosaic(raw: Tensor) -> Tensor:
    """The missing colours of an RGGB mosaic by Malvar, He and Cutler (ICASSP 2004).

    Args:
        raw: What the photosites hold, [B, H, W].

    Returns:
        Linear colours, [B, H, W, 3]; noise and edges can take them a little below zero.
    """
    return _squares(raw[:, None], _demosaic_weights(raw.device, raw.dtype), 2).permute(0, 2, 3, 1)


def curve(light: Tensor) -> Tensor:
    """The camera's curve: linear to 0.8, a soft shoulder above, then sRGB.

    Args:
        light: Linear, of any shape; used in 0..4.

    Returns:
        sRGB in [0, 1]. The slope is finite everywhere.
    """
    found: Tensor = _Curve.apply(light)
    return found


def _soft(light: Tensor) -> tuple[Tensor, Tensor]:
    """Light in 0..4 under the shoulder, and what is left of a change of it."""
    left = torch.exp((KNEE - light.clamp_min(KNEE)) / SHOULDER)
    return light.clamp_max(KNEE) + (1 - KNEE) * (1 - left), left


class _Curve(torch.autograd.Function):
    """The curve with its slope written out: half of the operations, which is what time goes into on a GPU."""

    @staticmethod
    def forward(context: Any, light: Tensor) -> Tensor:
        context.save_for_backward(light)
        soft, _ = _soft(light.clamp(0.0, TOP))
        return torch.where(soft <= TOE, soft * 12.92, 1.055 * soft.clamp_min(TOE) ** (1 / 2.4) - 0.055)

    @staticmethod
    def backward(context: Any, slope: Tensor) -> Tensor:
        (light,) = context.saved_tensors
        soft, left = _soft(light.clamp(0.0, TOP))
        steep = torch.where(soft <= TOE, 12.92, (1.055 / 2.4) * soft.clamp_min(TOE) ** (1 / 2.4 - 1))
        bent = torch.where(light > KNEE, ((1 - KNEE) / SHOULDER) * left, 1.0)
        changed: Tensor = slope * steep * bent * ((light > 0.0) & (light < TOP))
        return changed


def draw_noise(shape: Sequence[int], sensor: Sensor, generator: torch.Generator) -> Tensor:
    """A sample of noise for `develop`: normal numbers of deviation one.

    Args:
        shape: B, H, W.
        sensor: With a mosaic a photosite has one number, else three.
        generator: Where they come from; the sample is on its device.

    Returns:
        [B, H, W] or [B, H, W, 3], float32.
    """
    size = (*shape, 3)[: 3 if sensor.mosaic else 4]
    return torch.randn(size, generator=generator, device=generator.device)


def large_draws(generators: Sequence[torch.Generator], device: torch.device) -> list[torch.Generator]:
    """Where to draw a number for each pixel or texel: on the CPU the same generators, on a GPU others that follow.

    A GPU draws other numbers than the CPU would; to draw there and copy would take longer than all else of a picture.

    Args:
        generators: On the CPU.
        device: Where the numbers are needed.
    """
    if device.type == "cpu":
        return list(generators)
    seeds = [int(torch.randint(1 << 62, (1,), generator=one)) for one in generators]
    return [torch.Generator(device).manual_seed(seed) for seed in seeds]


def develop(
    radiance: Tensor,
    exposure: Tensor | float,
    sensor: Sensor = DEFAULT_SENSOR,
    noise: Tensor | torch.Generator | None = None,
) -> Tensor:
    """The camera's picture of a radiance, as `ssad.rendering.camera.render` makes it before it rounds to 8 bits.

    Args:
        radiance: Linear, [B, H, W, 3].
        exposure: What radiance is multiplied by, [B] or one for all.
        sensor: Lens, mosaic, noise and full photosites.
        noise: A sample as `draw_noise` gives, which stays fixed over calls; or where to draw one; None for none.

    Returns:
        sRGB in [0, 1], [B, 3, H, W]; differentiable in the radiance.

    Raises:
        ConfigError: The picture is smaller than 4 x 4, or the noise has another shape.
    """
    scale = torch.as_tensor(exposure, dtype=radiance.dtype, device=radiance.device).reshape(-1, 1, 1, 1)
    if isinstance(noise, torch.Generator):
        noise = draw_noise(radiance.shape[:3], sensor, noise)
    if noise is not None:
        noise = noise.to(radiance)
    raw = fill(photosites(radiance * scale, sensor), exposure, sensor, noise)
    return curve(demosaic(raw) if sensor.mosaic else raw).permute(0, 3, 1, 2)


# ---------------------------------------------------------------- only what is touched


Span = tuple[int, int]  # first, and one after the last
Rectangle = tuple[Span, Span]  # of rows and columns


def _rectangles(pixels: Tensor, shape: tuple[int, int, int]) -> list[Rectangle]:
    """The rectangle around flat pixels of each picture; empty where it has none."""
    count, height, width = shape
    flat = pixels.detach().reshape(-1).cpu()
    if len(flat) and not (int(flat.min()) >= 0 and int(flat.max()) < count * height * width):
        raise ConfigError(f"a pixel outside of {count} pictures of {width} x {height}")
    batch, y, x = flat // (height * width), flat // width % height, flat % width
    spans = []
    for values, most in ((y, height), (x, width)):
        low = torch.full((count,), most).scatter_reduce(0, batch, values, "amin").tolist()
        high = torch.full((count,), -1).scatter_reduce(0, batch, values, "amax").tolist()
        spans.append([(a, b + 1) if a <= b else (0, 0) for a, b in zip(low, high, strict=True)])
    return list(zip(*spans, strict=True))


def _grown(span: Span, margin: int, most: int, step: int = 1) -> Span:
    """A span with a margin, out to multiples of a step, in 0..most; an empty one stays empty."""
    if span[0] == span[1]:
        return span
    return max((span[0] - margin) // step * step, 0), min(-(-(span[1] + margin) // step) * step, most)


def _alike(spans: Sequence[Span], most: int, step: int) -> list[Span]:
    """Spans of one length that hold given ones, in 0..most, at multiples of a step."""
    length = max(SMALLEST, *(high - low // step * step for low, high in spans))
    length = -(-length // step) * step
    length = min(length + (most - length) % step, most)
    starts = [min(low // step * step, most - length) for low, _ in spans]
    return [(start, start + length) for start in starts]


@dataclass(frozen=True, slots=True)
class Window:
    """The part of pictures that changes when a few pixels do, and what it is developed from.

    All rectangles are spans of rows and of columns, one for each picture; read and coded rectangles have one size.

    Attributes:
        shape: B, H, W of the whole pictures.
        sensor: Whose pictures.
        changed: What changes.
        read: Where the radiance is needed.
        coded: Where the developed picture is needed: whole JPEG blocks, which can stand out of the picture.
        quality: Of JPEG; None for none.
        subsampling: Of JPEG, "420" or "444".
    """

    shape: tuple[int, int, int]
    sensor: Sensor
    changed: tuple[Rectangle, ...]
    read: tuple[Rectangle, ...]
    coded: tuple[Rectangle, ...]
    quality: int | None
    subsampling: str

    @staticmethod
    def around(
        pixels: Tensor,
        shape: Sequence[int],
        sensor: Sensor,
        *,
        quality: int | None = None,
        subsampling: str = "420",
    ) -> Window:
        """The window of what changes when the radiance of pixels does.

        Args:
            pixels: Flat indices into B * H * W, such as `Taps.pixel`.
            shape: B, H, W of the pictures.
            sensor: Whose pictures.
            quality: Of JPEG, 1 to 100; None for pictures that are not compressed.
            subsampling: Of JPEG, "420" or "444".

        Returns:
            The window; it is empty in pictures without such a pixel.

        Raises:
            ConfigError: A pixel outside the pictures, or a quality or subsampling that there is not.
        """
        count, height, width = shape
        block, bleed = 1, 0
        if quality is not None:
            # what is read of the colours next to a block is made of that block
            block, bleed = block_of(subsampling), 1 if subsampling == "420" else 0
        changed = []
        for sides in _rectangles(pixels, (count, height, width)):
            rows, columns = (
                _grown(_grown(span, sensor.reach, most, block), bleed, most)
                for span, most in zip(sides, (height, width), strict=True)
            )
            changed.append((rows, columns))
        return Window.of(changed, shape, sensor, quality=quality, subsampling=subsampling)

    @staticmethod
    def of(
        changed: Sequence[Rectangle],
        shape: Sequence[int],
        sensor: Sensor,
        *,
        quality: int | None = None,
        subsampling: str = "420",
    ) -> Window:
        """The window that gives the developed values of rectangles.

        Args:
            changed: Spans of rows and of columns, one pair for each picture.
            shape: B, H, W of the pictures.
            sensor: Whose pictures.
            quality: Of JPEG, 1 to 100; None for pictures that are not compressed.
            subsampling: Of JPEG, "420" or "444".

        Returns:
            The window.

        Raises:
            ConfigError: A quality or subsampling that there is not.
        """
        count, height, width = shape
        block, bleed = 1, 0
        if quality is not None:
            quantisation(quality)
            block, bleed = block_of(subsampling), 1 if subsampling == "420" else 0
        coded, read = [], []
        for side, most in enumerate((height, width)):
            room = -(-most // block) * block
            blocks = [_grown(_grown(rectangle[side], bleed, most), 0, room, block) for rectangle in changed]
            blocks = _alike(blocks, room, block)
            coded.append(blocks)
            need = [_grown((low, min(high, most)), sensor.reach, most) for low, high in blocks]
            read.append(_alike(need, most, 2 if sensor.mosaic else 1))
        return Window(
            (count, height, width),
            sensor,
            tuple(changed),
            tuple(zip(*read, strict=True)),
            tuple(zip(*coded, strict=True)),
            quality,
            subsampling,
        )

    def crop(self, picture: Tensor) -> Tensor:
        """What the window reads of radiance or noise.

        Args:
            picture: [B, H, W, ...].

        Returns:
            [B, h, w, ...].

        Raises:
            ConfigError: The pictures have another shape.
        """
        if tuple(picture.shape[:3]) != self.shape:
            raise ConfigError(f"a window of pictures {list(self.shape)}, not {list(picture.shape[:3])}")
        return torch.stack([one[slice(*y), slice(*x)] for one, (y, x) in zip(picture, self.read, strict=True)])

    def taps(self, taps: Taps) -> Taps:
        """Taps into the radiance that `crop` gives.

        Args:
            taps: Into whole pictures, all of their pixels inside the window.

        Returns:
            The same with other pixels.

        Raises:
            ConfigError: A pixel outside the window.
        """
        _, height, width = self.shape
        spans = torch.tensor(self.read, device=taps.pixel.device)  # [B, 2, 2]
        size = spans[0, :, 1] - spans[0, :, 0]
        batch = taps.pixel // (height * width)
        y = taps.pixel // width % height - spans[batch, 0, 0]
        x = taps.pixel % width - spans[batch, 1, 0]
        if bool(((y < 0) | (y >= size[0]) | (x < 0) | (x >= size[1])).any()):
            raise ConfigError("a tap outside of the window")
        return replace(taps, pixel=(batch * size[0] + y) * size[1] + x)

    def develop(self, radiance: Tensor, exposure: Tensor | float, noise: Tensor | None = None) -> Tensor:
        """What `develop` and `jpeg` make of the whole pictures, in the coded rectangles; right where it changes.

        Args:
            radiance: Of the window, as `crop` gives it, [B, h, w, 3].
            exposure: [B] or one for all.
            noise: Of the window: `crop` of a sample for whole pictures; None for none.

        Returns:
            [B, 3, h', w'] of the coded rectangles.

        Raises:
            ConfigError: The noise has another shape.
        """
        picture = develop(radiance, exposure, self.sensor, noise)
        _, height, width = self.shape
        parts, sizes, corners = [], [], []
        for (rows, columns), (y, x) in zip(self.coded, self.read, strict=True):
            sizes.append((min(rows[1], height) - rows[0], min(columns[1], width) - columns[0]))
            corners.append((rows[0] - y[0], columns[0] - x[0]))
        whole = _size(self.coded[0])
        if len({*sizes, whole}) == 1 and len(set(corners)) == 1:  # as of all pictures whose border is not near
            (top, left), (high, wide) = corners[0], whole
            image = picture[:, :, top : top + high, left : left + wide]
        else:
            for one, (top, left), (high, wide) in zip(picture, corners, sizes, strict=True):
                parts.append(extended(one[:, top : top + high, left : left + wide], *whole))
            image = torch.stack(parts)
        if self.quality is None:
            return image
        return compressed(image, sizes, self.quality, self.subsampling, fast=self.quality < ACCURATE)

    def paste(self, developed: Tensor, picture: Tensor) -> Tensor:
        """Whole pictures with the window's part renewed.

        Args:
            developed: What `develop` gives.
            picture: The pictures before, [B, 3, H, W]; uint8 as codes.

        Returns:
            [B, 3, H, W]; differentiable in both, but not in codes.
        """
        found: Tensor = _Paste.apply(developed, picture, self.changed, self.coded)
        return found


class _Paste(torch.autograd.Function):
    """`Window.paste`: one copy a picture each way, where slices would copy whole pictures for their gradient."""

    @staticmethod
    def forward(
        context: Any, developed: Tensor, picture: Tensor, changed: Sequence[Rectangle], coded: Sequence[Rectangle]
    ) -> Tensor:
        context.parts = parts = []
        found = picture.float().div_(255) if picture.dtype == torch.uint8 else picture.clone()
        for n, ((y, x), (rows, columns)) in enumerate(zip(changed, coded, strict=True)):
            inside = slice(y[0] - rows[0], y[1] - rows[0]), slice(x[0] - columns[0], x[1] - columns[0])
            parts.append(((n, slice(None), slice(*y), slice(*x)), (n, slice(None), *inside)))
            found[parts[-1][0]] = developed[parts[-1][1]]
        context.size = developed.shape
        return found

    @staticmethod
    def backward(context: Any, slope: Tensor) -> tuple[Tensor, Tensor | None, None, None]:
        renewed, before = slope.new_zeros(context.size), slope.clone() if context.needs_input_grad[1] else None
        for there, here in context.parts:
            renewed[here] = slope[there]
            if before is not None:
                before[there] = 0.0
        return renewed, before, None, None


def _size(rectangle: Rectangle) -> tuple[int, int]:
    return rectangle[0][1] - rectangle[0][0], rectangle[1][1] - rectangle[1][0]


def develop_at(
    radiance: Tensor,
    exposure: Tensor | float,
    sensor: Sensor,
    pixels: Tensor,
    noise: Tensor | None = None,
    *,
    quality: int | None = None,
    subsampling: str = "420",
) -> Tensor:
    """Developed pixels alone: `develop`, then `jpeg` where a quality is given, of the pictures' parts that they need.

    Args:
        radiance: Linear, [B, H, W, 3].
        exposure: What radiance is multiplied by, [B] or one for all.
        sensor: Lens, mosaic, noise and full photosites.
        pixels: Flat indices into B * H * W, [F].
        noise: A sample for the whole pictures, as `draw_noise` gives; None for none.
        quality: Of JPEG, 1 to 100; None for pictures that are not compressed.
        subsampling: Of JPEG, "420" or "444".

    Returns:
        sRGB in [0, 1], [F, 3]: the same as of the whole pictures.

    Raises:
        ConfigError: A pixel outside the pictures, or bad settings.
    """
    count, height, width = radiance.shape[:3]
    wanted = _rectangles(pixels, (count, height, width))
    window = Window.of(wanted, radiance.shape[:3], sensor, quality=quality, subsampling=subsampling)
    developed = window.develop(window.crop(radiance), exposure, None if noise is None else window.crop(noise))
    batch = pixels // (height * width)
    corner = torch.tensor([[rows[0], columns[0]] for rows, columns in window.coded], device=pixels.device)[batch]
    return developed[batch, :, pixels // width % height - corner[:, 0], pixels % width - corner[:, 1]]
