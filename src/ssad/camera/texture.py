"""Pictures as a linear function of the textures that things wear: see once, re-texture for the cost of a gather.

radiance = base + sum over pieces of light * texture(piece). A texture is looked up bilinearly in two levels of its
mip pyramid (Williams 1983), so that each texel gets its share of the gradient however small it is in the picture.
The gradient is the transpose of the same sum, exact up to rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ssad.camera.render import Picture
from ssad.core.errors import ConfigError
from ssad.core.types import F64, I32


@dataclass(frozen=True, slots=True)
class Taps:
    """What pixels see of one texture of `size` x `size` texels: F pieces.

    pixel [F] into B * H * W; light [F, 3]; index [F, 8] into the pyramid of all levels, one after the other, the
    finest first; weight [F, 8], they add up to one.
    """

    size: int
    pixel: I32
    light: F64
    index: I32
    weight: F64


def levels_of(size: int) -> list[int]:
    """Edge lengths of the pyramid: size, size / 2 ... 1. ConfigError unless the size is a power of two."""
    if size < 1 or size & (size - 1):
        raise ConfigError(f"a texture of {size} x {size} texels: its edge must be a power of two")
    return [size >> k for k in range(size.bit_length())]


def taps_of(picture: Picture, size: int, *, texture: int = 0) -> Taps:
    """The taps of one texture in a picture. ConfigError for a size that is no power of two."""
    edges = levels_of(size)
    pieces = picture.fragments[picture.fragments["texture"] == texture]
    u, v = pieces["u"].astype(np.float64), pieces["v"].astype(np.float64)
    level = np.clip(0.5 * np.log2(np.maximum(pieces["area"].astype(np.float64) * size * size, 1.0)), 0, len(edges) - 1)
    low = np.minimum(np.floor(level).astype(int), len(edges) - 1)
    starts = np.concatenate([[0], np.cumsum(np.array(edges) ** 2)])[:-1]
    index, weight = np.zeros((len(pieces), 8), np.int32), np.zeros((len(pieces), 8))
    for half, (chosen, share) in enumerate(
        ((low, 1 - (level - low)), (np.minimum(low + 1, len(edges) - 1), level - low))
    ):
        edge = np.array(edges)[chosen]
        x, y = np.clip(u * edge - 0.5, 0, edge - 1), np.clip(v * edge - 0.5, 0, edge - 1)
        x0, y0 = np.floor(x).astype(int), np.floor(y).astype(int)
        x1, y1 = np.minimum(x0 + 1, edge - 1), np.minimum(y0 + 1, edge - 1)
        fx, fy = x - x0, y - y0
        corners = ((x0, y0, (1 - fx) * (1 - fy)), (x1, y0, fx * (1 - fy)), (x0, y1, (1 - fx) * fy), (x1, y1, fx * fy))
        for k, (cx, cy, part) in enumerate(corners):
            index[:, 4 * half + k] = starts[chosen] + cy * edge + cx
            weight[:, 4 * half + k] = part * share
    return Taps(size, pieces["place"].astype(np.int32), pieces["light"].astype(np.float64), index, weight)


def pyramid(texture: Any) -> F64:
    """All levels of a texture [S, S, 3], finest first, as rows [N, 3]; each level is the mean of four texels."""
    level = np.asarray(texture, np.float64)
    rows = []
    for edge in levels_of(level.shape[0]):
        if level.shape != (edge, edge, 3):
            raise ConfigError(f"a texture must be square with three colours, not {list(np.shape(texture))}")
        rows.append(level.reshape(-1, 3))
        if edge > 1:
            level = level.reshape(edge // 2, 2, edge // 2, 2, 3).mean((1, 3))
    return np.concatenate(rows)


def pyramid_transpose(rows: F64, size: int) -> F64:
    """The transpose of `pyramid`: gradients of all levels [N, 3] -> of the texture [S, S, 3]."""
    edges = levels_of(size)
    starts = np.concatenate([[0], np.cumsum(np.array(edges) ** 2)])
    total = np.zeros((1, 1, 3))
    for k in range(len(edges) - 1, -1, -1):
        edge = edges[k]
        mine = rows[starts[k] : starts[k + 1]].reshape(edge, edge, 3)
        total = mine if edge == 1 and k == len(edges) - 1 else mine + np.repeat(np.repeat(total, 2, 0), 2, 1) / 4
    return total


def apply_taps(taps: Taps, texture: Any, radiance: Any) -> F64:
    """Radiance [B, H, W, 3] with the texture [S, S, 3] (linear RGB) on: base plus what the texture adds."""
    levels = pyramid(texture)
    colour = (levels[taps.index] * taps.weight[..., None]).sum(1) * taps.light
    out = np.array(radiance, np.float64)
    flat = out.reshape(-1, 3)
    for c in range(3):
        flat[:, c] += np.bincount(taps.pixel, colour[:, c], minlength=len(flat))
    return out


def texture_gradient(taps: Taps, gradient: Any) -> F64:
    """Gradient of a loss with respect to the texture [S, S, 3], from that with respect to the radiance [B, H, W, 3]."""
    flat = np.asarray(gradient, np.float64).reshape(-1, 3)
    pull = flat[taps.pixel] * taps.light
    count = sum(edge * edge for edge in levels_of(taps.size))
    rows = np.empty((count, 3))
    for c in range(3):
        rows[:, c] = np.bincount(taps.index.ravel(), (taps.weight * pull[:, c : c + 1]).ravel(), minlength=count)
    return pyramid_transpose(rows, taps.size)
