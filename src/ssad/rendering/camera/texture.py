"""Images as a linear function of the textures in them: render once, then change a texture at the cost of a gather.

radiance = base + sum over pieces of light * texture(piece), for textures on bodies, in decals and from lamps. A
texture is looked up bilinearly in two levels of its mip pyramid (Williams 1983), so that each texel gets its share of
the gradient however small it is in the image. Texels that are not on the surface (the gutter between the panels of an
atlas) are excluded at all levels: their values change no pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional
from torch.nn.functional import avg_pool2d

from ssad.core.colours import ENCODED_TOE, LINEAR_TOE
from ssad.core.errors import ConfigError
from ssad.core.types import F64, Bool
from ssad.rendering.meshes.mesh import Mesh, Rectangle

PRINTABLE = (0.02, 0.90)  # linear albedo: the blackest ink and the whitest paper


@dataclass(frozen=True, slots=True)
class Taps:
    """Lookups of one texture by the pixels of a rendering.

    Attributes:
        size: Height and width of the texture, texels.
        mask: Texels [H, W] that count, None for all.
        pixel: Index of each of F pieces into B * H * W pixels [F].
        light: Gain of a pixel for a unit of the texture's colour [F, 3].
        index: Into the rows of all levels of the pyramid, concatenated, the finest first [F, 8].
        weight: Of each of these [F, 8]; they add up to one.
    """

    size: tuple[int, int]
    mask: Tensor | None
    pixel: Tensor
    light: Tensor
    index: Tensor
    weight: Tensor

    def to(self, device: str | torch.device, dtype: torch.dtype | None = None) -> Taps:
        """Return the taps on a device, with another floating type."""
        light, weight = (values.to(device, dtype or values.dtype) for values in (self.light, self.weight))
        mask = None if self.mask is None else self.mask.to(device)
        return Taps(self.size, mask, self.pixel.to(device), light, self.index.to(device), weight)


def levels_of(size: tuple[int, int]) -> list[tuple[int, int]]:
    """Return heights and widths of the pyramid: each half of the previous, rounded up, down to 1 x 1.

    Raises:
        ConfigError: A side is not from 1 to 2^14 texels.
    """
    height, width = size
    if min(height, width) < 1 or max(height, width) > 1 << 14:
        raise ConfigError(f"a texture of {height} x {width} texels: from 1 to {1 << 14} a side")
    sizes = [(height, width)]
    while sizes[-1] != (1, 1):
        sizes.append(((sizes[-1][0] + 1) // 2, (sizes[-1][1] + 1) // 2))
    return sizes


def paint_mask(mesh: Mesh, size: tuple[int, int], rectangle: Rectangle = (0.0, 0.0, 1.0, 1.0)) -> Bool:
    """Return the texels that lie at least partly on a face that can wear a texture.

    Args:
        mesh: The body.
        size: Height and width of the texture, texels.
        rectangle: Part of the atlas that the texture covers: u0, v0, u1, v1.

    Returns:
        True for each texel [H, W] that is somewhere on the body.
    """
    import cv2

    height, width = size
    u0, v0, u1, v1 = rectangle
    panel_uv = mesh.uv[mesh.panel >= 0].astype(np.float64)
    corners = (panel_uv - [u0, v0]) / [u1 - u0, v1 - v0] * [width, height]
    quarter_texels = np.zeros((4 * height, 4 * width), np.uint8)  # in quarters of a texel, drawn with their edges
    # Coordinates with 4 fractional bits; the centre of the first quarter texel is at 0 in OpenCV.
    for face in np.rint(corners * 4 * 16 - 8).astype(np.int32):
        cv2.fillConvexPoly(quarter_texels, face, 1, cv2.LINE_8, 4)
    return np.asarray(quarter_texels.reshape(height, 4, width, 4).max((1, 3)) > 0)


class TexturedRendering(Protocol):
    """Result with fragments of textured surfaces."""

    @property
    def fragments(self) -> Any:
        """As `Rendering.fragments`."""


def texture_taps(
    rendering: TexturedRendering,
    size: int | tuple[int, int],
    *,
    texture: int = 0,
    mask: Bool | None = None,
    dtype: torch.dtype = torch.float32,
) -> Taps:
    """The taps of one texture in a picture.

    Args:
        rendering: A `Rendering`, or a part of one, rendered with things, decals or lamps that show the texture.
        size: Height and width of the texture, or one side of a square, texels.
        texture: Its number.
        mask: Which texels [H, W] are somewhere on the surface (see `paint_mask`); None for all.
        dtype: Of light and weights.

    Raises:
        ConfigError: A size that cannot be, or a mask of another size or without a texel.
    """
    shape = (size, size) if isinstance(size, int) else size
    levels = levels_of(shape)
    if mask is not None and (mask.shape != shape or not mask.any()):
        raise ConfigError(f"a mask of {list(mask.shape)} texels, some of them set, for a texture of {list(shape)}")
    fragments = rendering.fragments[rendering.fragments["texture"] == texture]
    u, v = fragments["u"].astype(np.float64), fragments["v"].astype(np.float64)
    area = fragments["area"].astype(np.float64) * shape[0] * shape[1]
    # The level at which a texel is about as large as the pixel's footprint.
    level = np.clip(0.5 * np.log2(np.maximum(area, 1.0)), 0, len(levels) - 1)
    lower_level = np.minimum(np.floor(level).astype(int), len(levels) - 1)
    upper_level = np.minimum(lower_level + 1, len(levels) - 1)
    coverage = _covered_rows(mask, levels)
    index, weight = np.zeros((len(fragments), 8), np.int64), np.zeros((len(fragments), 8))
    for level_slot, (level_index, share) in enumerate(
        ((lower_level, 1 - (level - lower_level)), (upper_level, level - lower_level))
    ):
        columns = slice(4 * level_slot, 4 * level_slot + 4)
        index[:, columns], part_weights = _corners(u, v, level_index, levels)
        if coverage is not None:
            part_weights *= coverage[index[:, columns]]
            is_uncovered = part_weights.sum(1) == 0  # no texel of the surface is near: use the mean of the texture
            index[is_uncovered, 4 * level_slot], part_weights[is_uncovered, 0] = len(coverage) - 1, 1.0
            part_weights /= part_weights.sum(1, keepdims=True)
        weight[:, columns] = part_weights * share[:, None]
    mask_tensor = None if mask is None else torch.as_tensor(np.ascontiguousarray(mask))
    light = torch.as_tensor(np.ascontiguousarray(fragments["light"]), dtype=dtype)
    pixels = torch.as_tensor(fragments["place"].astype(np.int64))
    return Taps(shape, mask_tensor, pixels, light, torch.as_tensor(index), torch.as_tensor(weight, dtype=dtype))


def _corners(u: F64, v: F64, chosen: F64, levels: list[tuple[int, int]]) -> tuple[F64, F64]:
    """Rows of the pyramid [F, 4] around each place in its level, and their bilinear weights [F, 4]."""
    sizes = np.array(levels)
    starts = np.concatenate([[0], np.cumsum(sizes.prod(1))])[:-1]
    height, width = sizes[chosen].T
    x, y = np.clip(u * width - 0.5, 0, width - 1), np.clip(v * height - 0.5, 0, height - 1)
    x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
    x1, y1 = np.minimum(x0 + 1, width - 1), np.minimum(y0 + 1, height - 1)
    fx, fy = x - x0, y - y0
    index = np.stack([starts[chosen] + row * width + column for row in (y0, y1) for column in (x0, x1)], 1)
    weight = np.stack([(1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy], 1)
    return index, weight


def _covered_rows(mask: Bool | None, levels: list[tuple[int, int]]) -> F64 | None:
    """Return 1 for each row of the pyramid [N] that contains a texel of the mask, else 0; None without a mask."""
    if mask is None:
        return None
    level = torch.as_tensor(np.ascontiguousarray(mask), dtype=torch.float64)[None]
    rows = []
    for _ in levels:
        rows.append(level.flatten().numpy())
        level = functional.max_pool2d(level, 2, ceil_mode=True)
    return np.concatenate(rows)


def pyramid(texture: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return all levels of a texture as rows, the finest first: means over the texels of the mask.

    Args:
        texture: [3, H, W], or [B, 3, H, W].
        mask: Texels [H, W] that count; None for all.

    Returns:
        [N, 3], or those of B textures concatenated [B * N, 3].

    Raises:
        ConfigError: The texture has another shape.
    """
    if texture.ndim not in (3, 4) or texture.shape[-3] != 3:
        raise ConfigError(f"a texture must be [3, H, W], not {list(texture.shape)}")
    sizes = levels_of((texture.shape[-2], texture.shape[-1]))
    # Weights are averaged like colours, so that masked texels do not darken coarse levels.
    level_weight = torch.ones_like(texture[..., :1, :, :]) if mask is None else mask.to(texture.dtype)[None]
    level_sum, sums, weights = texture * level_weight, [], []  # of the texels of the mask below, over four to the level
    for _ in sizes[1:]:
        level_sum, level_weight = (
            avg_pool2d(plane, 2, ceil_mode=True, divisor_override=4) for plane in (level_sum, level_weight)
        )
        sums.append(level_sum.flatten(-2))
        weights.append(level_weight.flatten(-2))
    rows = [texture.flatten(-2)]
    if sums:
        rows.append(torch.cat(sums, -1) / torch.cat(weights, -1).clamp_min(1e-30))
    return torch.cat(rows, -1).mT.reshape(-1, 3)


def combine_taps(taps: Sequence[Taps], corners: Sequence[tuple[int, int]], width: int, part: tuple[int, int]) -> Taps:
    """Combine the taps of several images into those of a batch of crops, each with a texture of its own.

    Args:
        taps: Of one texture in each image, all of one size and mask.
        corners: Row and column at which the crop of each image begins.
        width: Of the images, px.
        part: Height and width of the crops, which contain all pixels of the taps.
    """
    row_count = sum(height * width for height, width in levels_of(taps[0].size))
    (part_height, part_width), piece_counts = part, [len(entry.pixel) for entry in taps]
    shifts = [
        ((image_index * part_height - y) * part_width - x, image_index * row_count, count)
        for image_index, ((y, x), count) in enumerate(zip(corners, piece_counts, strict=True))
    ]
    shift_table = torch.tensor(shifts).to(taps[0].pixel.device)
    shift = shift_table[:, :2].repeat_interleave(shift_table[:, 2], 0, output_size=sum(piece_counts))
    pixel, index, weight, light = (
        torch.cat([getattr(entry, name) for entry in taps]) for name in ("pixel", "index", "weight", "light")
    )
    pixel = pixel + pixel.div(width, rounding_mode="floor") * (part_width - width) + shift[:, 0]
    return Taps(taps[0].size, taps[0].mask, pixel, light, index + shift[:, 1:], weight)


def retexture(lookups: Taps, texture: Tensor, radiance: Tensor) -> Tensor:
    """A picture with a texture on: base plus what the texture adds; differentiable in both.

    Args:
        lookups: What pixels see of it.
        texture: Linear albedo [3, H, W], 0 to 1 (see `to_printable`); of each of several pictures (see `combine_taps`)
            [B, 3, H, W].
        radiance: Of the picture whose taps these are [B, H, W, 3], without the texture.

    Raises:
        ConfigError: A texture of another size, or with albedo beyond 0 to 1.
    """
    if tuple(texture.shape[-2:]) != lookups.size:
        raise ConfigError(f"these taps are of a texture of {list(lookups.size)} texels, not {list(texture.shape[-2:])}")
    # One transfer from the GPU for both numbers.
    lowest, highest = torch.stack(texture.detach().aminmax()).tolist()
    if not (lowest >= 0.0 and highest <= 1.0):
        raise ConfigError(f"an albedo of {lowest:.3g} to {highest:.3g}: it lies in 0 to 1")
    pyramid_rows = pyramid(texture, lookups.mask)
    samples = pyramid_rows.index_select(0, lookups.index.flatten()).reshape(*lookups.index.shape, 3)
    colour = (samples * lookups.weight[..., None]).sum(1) * lookups.light
    base_pixels = radiance.reshape(-1, 3)
    return base_pixels.index_add(0, lookups.pixel, colour.to(base_pixels.dtype)).reshape(radiance.shape)


def to_printable(colour: Tensor) -> Tensor:
    """Map a colour in 0..1 to the albedo that ink and paper can have, `PRINTABLE`."""
    darkest, brightest = PRINTABLE
    return darkest + (brightest - darkest) * colour.clamp(0.0, 1.0)


def to_linear(colour: Tensor) -> Tensor:
    """Convert sRGB in [0, 1], as in print or a PNG, to the linear RGB of textures."""
    power = ((colour.clamp_min(ENCODED_TOE) + 0.055) / 1.055) ** 2.4
    return torch.where(colour <= ENCODED_TOE, colour / 12.92, power)


def to_srgb(linear: Tensor) -> Tensor:
    """Convert linear RGB in [0, 1] to sRGB: the inverse of `to_linear`."""
    # The clamped root keeps the unused branch of `where` finite.
    power = 1.055 * linear.clamp_min(LINEAR_TOE) ** (1 / 2.4) - 0.055
    return torch.where(linear <= LINEAR_TOE, 12.92 * linear, power)
