"""The camera's response in torch."""

from __future__ import annotations

import torch
from torch import Tensor


def develop(radiance: Tensor, exposure: Tensor | float) -> Tensor:
    """The camera's picture [B, 3, H, W] in [0, 1] of a radiance [B, H, W, 3]: exposure [B] or one for all, linear to
    0.8, a soft shoulder above, then sRGB, as `ssad.camera.render` does before it rounds to 8 bits. The slope is finite
    everywhere."""
    scale = torch.as_tensor(exposure, dtype=radiance.dtype, device=radiance.device).reshape(-1, 1, 1, 1)
    light = (radiance * scale).clamp(0.0, 3.999)
    soft = torch.where(light > 0.8, 0.8 + 0.2 * (1 - torch.exp(-(light - 0.8).clamp_min(0.0) / 0.4)), light)
    srgb = torch.where(soft <= 0.0031308, soft * 12.92, 1.055 * soft.clamp_min(0.0031308) ** (1 / 2.4) - 0.055)
    return srgb.permute(0, 3, 1, 2)
