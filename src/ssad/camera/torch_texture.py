"""Textured pictures in torch: radiance linear in the texture, gradients by autograd.

The same sums as `ssad.camera.texture`, on any device and in any floating type. `ssad.camera.torch_sensor` makes
pictures of the radiance.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ssad.camera.texture import Taps, levels_of
from ssad.core.errors import ConfigError


@dataclass(frozen=True, slots=True)
class TorchTaps:
    """`Taps` as tensors: size; pixel [F]; light [F, 3]; index [F, 8]; weight [F, 8]."""

    size: int
    pixel: Tensor
    light: Tensor
    index: Tensor
    weight: Tensor

    @staticmethod
    def of(taps: Taps, *, device: str | torch.device = "cpu", dtype: torch.dtype = torch.float32) -> TorchTaps:
        """Taps on a device."""
        floats = [
            torch.as_tensor(np.ascontiguousarray(v), dtype=dtype, device=device) for v in (taps.light, taps.weight)
        ]
        whole = [torch.as_tensor(np.asarray(v, np.int64), device=device) for v in (taps.pixel, taps.index)]
        return TorchTaps(taps.size, whole[0], floats[0], whole[1], floats[1])


def pyramid(texture: Tensor) -> Tensor:
    """All levels of a texture [3, S, S], finest first, as rows [N, 3]. ConfigError: no square with three colours."""
    if texture.ndim != 3 or texture.shape[0] != 3 or texture.shape[1] != texture.shape[2]:
        raise ConfigError(f"a texture must be [3, S, S], not {list(texture.shape)}")
    levels, level = [], texture[None]
    for edge in levels_of(texture.shape[1]):
        levels.append(level[0].flatten(1).T)
        if edge > 1:
            level = torch.nn.functional.avg_pool2d(level, 2)
    return torch.cat(levels)


def retexture(taps: TorchTaps, texture: Tensor, radiance: Tensor) -> Tensor:
    """Radiance [B, H, W, 3] with the texture [3, S, S] (linear RGB) on; differentiable to both.

    radiance: that of the picture whose taps these are, black where the texture goes. ConfigError: another size.
    """
    if texture.shape[-1] != taps.size:
        raise ConfigError(f"these taps are of a texture of {taps.size} texels, not {texture.shape[-1]}")
    rows = pyramid(texture)
    colour = (rows[taps.index] * taps.weight[..., None]).sum(1) * taps.light
    flat = radiance.reshape(-1, 3)
    return flat.index_add(0, taps.pixel, colour.to(flat.dtype)).reshape(radiance.shape)


def to_linear(colour: Tensor) -> Tensor:
    """sRGB in [0, 1] (what is printed, or a PNG) to the linear RGB that textures are in."""
    return torch.where(colour <= 0.04045, colour / 12.92, ((colour.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4)
