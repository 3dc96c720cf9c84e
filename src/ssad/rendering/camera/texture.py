"""Pictures as a linear function of the textures in them: see once, re-texture for the cost of a gather.

radiance = base + sum over pieces of light * texture(piece), whether a body wears the texture, a decal shows it or a
lamp projects it. A texture is looked up bilinearly in two levels of its mip pyramid (Williams 1983), so that each texel
gets its share of the gradient however small it is in the picture. Texels that are nowhere on the surface (the gutter
between the panels of an atlas) take no part, at any level: what is printed there changes no pixel.
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

from ssad.core.errors import ConfigError
from ssad.core.types import F64, Bool
from ssad.rendering.meshes.mesh import Mesh, Rectangle

PRINTABLE = (0.02, 0.90)  # linear albedo: the blackest ink and the whitest paper


@dataclass(frozen=True, slots=True)
class Taps:
    """What pixels see of one texture.

    Attributes:
        size: Height and width of the texture, texels.
        mask: Which texels [H, W] take part, None for all.
        pixel: Index of each of F pieces into B * H * W pixels [F].
        light: What a pixel gains for a unit of the texture's colour [F, 3].
        index: Into the rows of all levels of the pyramid, one after the other, the finest first [F, 8].
        weight: Of each of these [F, 8]; they add up to one.
    """

    size: tuple[int, int]
    mask: Tensor | None
    pixel: Tensor
    light: Tensor
    index: Tensor
    weight: Tensor

    def to(self, device: str | torch.device, dtype: torch.dtype | None = None) -> Taps:
        """The same on a device, with another floating type."""
        light, weight = (v.to(device, dtype or v.dtype) for v in (self.light, self.weight))
        mask = None if self.mask is None else self.mask.to(device)
        return Taps(self.size, mask, self.pixel.to(device), light, self.index.to(device), weight)


def levels_of(size: tuple[int, int]) -> list[tuple[int, int]]:
    """Heights and widths of the pyramid: each half of the one before, rounded up, down to 1 x 1.

    Raises:
        ConfigError: A side is not from 1 to 2^14 texels.
    """
    height, width = size
    if min(height, width) < 1 or max(height, width) > 1 << 14:
        raise ConfigError(f"a texture of {height} x {width} texels: from 1 to {1 << 14} a side")
    found = [(height, width)]
    while found[-1] != (1, 1):
        found.append(((found[-1][0] + 1) // 2, (found[-1][1] + 1) // 2))
    return found


def paint_mask(mesh: Mesh, size: tuple[int, int], rectangle: Rectangle = (0.0, 0.0, 1.0, 1.0)) -> Bool:
    """Texels that lie, if only in part, on a face that can wear a texture.

    Args:
        mesh: The body.
        size: Height and width of the texture, texels.
        rectangle: What the texture covers of the atlas: u0, v0, u1, v1.

    Returns:
        True for each texel [H, W] that is somewhere on the body.
    """
    import cv2

    height, width = size
    u0, v0, u1, v1 = rectangle
    uv = mesh.uv[mesh.panel >= 0].astype(np.float64)
    corners = (uv - [u0, v0]) / [u1 - u0, v1 - v0] * [width, height]
    fine = np.zeros((4 * height, 4 * width), np.uint8)  # in quarters of a texel, drawn with their edges
    for face in corners:
        cv2.fillConvexPoly(fine, np.rint(face * 4 * 16 - 8).astype(np.int32), 1, cv2.LINE_8, 4)
    return np.asarray(fine.reshape(height, 4, width, 4).max((1, 3)) > 0)


class Seen(Protocol):
    """What has been seen of textures."""

    @property
    def fragments(self) -> Any:
        """As `Picture.fragments`."""


def taps_of(
    picture: Seen,
    size: int | tuple[int, int],
    *,
    texture: int = 0,
    mask: Bool | None = None,
    dtype: torch.dtype = torch.float32,
) -> Taps:
    """The taps of one texture in a picture.

    Args:
        picture: A `Picture`, or a part of one, rendered with things, decals or lamps that show the texture.
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
    pieces = picture.fragments[picture.fragments["texture"] == texture]
    u, v = pieces["u"].astype(np.float64), pieces["v"].astype(np.float64)
    area = pieces["area"].astype(np.float64) * shape[0] * shape[1]
    level = np.clip(0.5 * np.log2(np.maximum(area, 1.0)), 0, len(levels) - 1)
    low = np.minimum(np.floor(level).astype(int), len(levels) - 1)
    high = np.minimum(low + 1, len(levels) - 1)
    covered = _covered(mask, levels)
    index, weight = np.zeros((len(pieces), 8), np.int64), np.zeros((len(pieces), 8))
    for half, (chosen, share) in enumerate(((low, 1 - (level - low)), (high, level - low))):
        columns = slice(4 * half, 4 * half + 4)
        index[:, columns], part = _corners(u, v, chosen, levels)
        if covered is not None:
            part *= covered[index[:, columns]]
            none = part.sum(1) == 0  # nothing of the surface near: its mean
            index[none, 4 * half], part[none, 0] = len(covered) - 1, 1.0
            part /= part.sum(1, keepdims=True)
        weight[:, columns] = part * share[:, None]
    kept = None if mask is None else torch.as_tensor(np.ascontiguousarray(mask))
    light = torch.as_tensor(np.ascontiguousarray(pieces["light"]), dtype=dtype)
    places = torch.as_tensor(pieces["place"].astype(np.int64))
    return Taps(shape, kept, places, light, torch.as_tensor(index), torch.as_tensor(weight, dtype=dtype))


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


def _covered(mask: Bool | None, levels: list[tuple[int, int]]) -> F64 | None:
    """1 for each row of the pyramid [N] with a texel of the mask in it, else 0; None without a mask."""
    if mask is None:
        return None
    level = torch.as_tensor(np.ascontiguousarray(mask), dtype=torch.float64)[None]
    rows = []
    for _ in levels:
        rows.append(level.flatten().numpy())
        level = functional.max_pool2d(level, 2, ceil_mode=True)
    return np.concatenate(rows)


def pyramid(texture: Tensor, mask: Tensor | None = None) -> Tensor:
    """All levels of a texture as rows, the finest first: means over the texels of the mask.

    Args:
        texture: [3, H, W], or [B, 3, H, W].
        mask: Texels [H, W] that count; None for all.

    Returns:
        [N, 3], or those of B textures one after the other [B * N, 3].
    """
    if texture.ndim not in (3, 4) or texture.shape[-3] != 3:
        raise ConfigError(f"a texture must be [3, H, W], not {list(texture.shape)}")
    sizes = levels_of((texture.shape[-2], texture.shape[-1]))
    weight = torch.ones_like(texture[..., :1, :, :]) if mask is None else mask.to(texture.dtype)[None]
    total, totals, weights = texture * weight, [], []  # of the texels of the mask below, over four to the level
    for _ in sizes[1:]:
        total, weight = (avg_pool2d(one, 2, ceil_mode=True, divisor_override=4) for one in (total, weight))
        totals.append(total.flatten(-2))
        weights.append(weight.flatten(-2))
    rows = [texture.flatten(-2)]
    if totals:
        rows.append(torch.cat(totals, -1) / torch.cat(weights, -1).clamp_min(1e-30))
    return torch.cat(rows, -1).mT.reshape(-1, 3)


def joined(taps: Sequence[Taps], corners: Sequence[tuple[int, int]], width: int, part: tuple[int, int]) -> Taps:
    """The taps of several pictures as those of a batch of parts of them, each with a texture of its own.

    Args:
        taps: Of one texture in each picture, all of one size and mask.
        corners: Row and column at which the part of each picture begins.
        width: Of the pictures, px.
        part: Height and width of the parts, which hold all pixels of the taps.
    """
    rows = sum(height * width for height, width in levels_of(taps[0].size))
    (high, wide), counts = part, [len(one.pixel) for one in taps]
    starts = [
        ((number * high - y) * wide - x, number * rows, count)
        for number, ((y, x), count) in enumerate(zip(corners, counts, strict=True))
    ]
    table = torch.tensor(starts).to(taps[0].pixel.device)
    moved = table[:, :2].repeat_interleave(table[:, 2], 0, output_size=sum(counts))
    pixel, index, weight, light = (
        torch.cat([getattr(one, name) for one in taps]) for name in ("pixel", "index", "weight", "light")
    )
    pixel = pixel + pixel.div(width, rounding_mode="floor") * (wide - width) + moved[:, 0]
    return Taps(taps[0].size, taps[0].mask, pixel, light, index + moved[:, 1:], weight)


def retexture(taps: Taps, texture: Tensor, radiance: Tensor) -> Tensor:
    """A picture with a texture on: base plus what the texture adds; differentiable in both.

    Args:
        taps: What pixels see of it.
        texture: Linear albedo [3, H, W], 0 to 1 (see `printable`); of each of several pictures (see `joined`)
            [B, 3, H, W].
        radiance: Of the picture whose taps these are [B, H, W, 3], without the texture.

    Raises:
        ConfigError: A texture of another size, or with albedo beyond 0 to 1.
    """
    if tuple(texture.shape[-2:]) != taps.size:
        raise ConfigError(f"these taps are of a texture of {list(taps.size)} texels, not {list(texture.shape[-2:])}")
    low, high = torch.stack(texture.detach().aminmax()).tolist()
    if not (low >= 0.0 and high <= 1.0):
        raise ConfigError(f"an albedo of {low:.3g} to {high:.3g}: it lies in 0 to 1")
    rows = pyramid(texture, taps.mask)
    looked_up = rows.index_select(0, taps.index.flatten()).reshape(*taps.index.shape, 3)
    colour = (looked_up * taps.weight[..., None]).sum(1) * taps.light
    flat = radiance.reshape(-1, 3)
    return flat.index_add(0, taps.pixel, colour.to(flat.dtype)).reshape(radiance.shape)


def printable(colour: Tensor) -> Tensor:
    """Albedo that ink and paper can have: a colour in 0..1, scaled into `PRINTABLE`."""
    low, high = PRINTABLE
    return low + (high - low) * colour.clamp(0.0, 1.0)


def to_linear(colour: Tensor) -> Tensor:
    """Convert sRGB in [0, 1], as in print or a PNG, to the linear RGB of textures."""
    return torch.where(colour <= 0.04045, colour / 12.92, ((colour.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)
