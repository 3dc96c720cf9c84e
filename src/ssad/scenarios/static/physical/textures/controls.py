"""Untrained textures: the controls that every physical attack must beat."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ssad.core.errors import ConfigError, unknown_name
from ssad.core.seeding import generator
from ssad.core.types import U8, Bool

CELL = 8  # texels: side of the squares of a random texture, since a car seen from 20 m has no white noise
CONTROLS = ("random", "noise", "grey", "shuffled")


def control(name: str, size: tuple[int, int], *, seed: int = 0, trained: Tensor | None = None) -> Tensor:
    """Return a texture that is independent of any detector, or shuffled.

    Args:
        name: random: squares of uniform colours; noise: an independent colour for each texel; grey: mid-grey;
            shuffled: the squares of a trained texture in random order.
        size: Height and width, texels.
        seed: Seed of random and shuffled.
        trained: Texture to shuffle, sRGB [3, H, W].

    Returns:
        sRGB [3, H, W] float32 in 0 to 1.

    Raises:
        UnknownNameError: There is no such control.
        ConfigError: Nothing to shuffle, or it has another size.
    """
    if name not in CONTROLS:
        raise unknown_name("control", name, CONTROLS)
    height, width = size
    if name == "grey":
        return torch.full((3, height, width), 0.5)
    draws = generator("physical control", name, seed)
    rows, columns = -(-height // CELL), -(-width // CELL)
    if name == "noise":
        return torch.from_numpy(draws.random((3, height, width), np.float32))
    if name == "random":
        cells = torch.from_numpy(draws.random((3, rows, columns), np.float32))
        return cells.repeat_interleave(CELL, 1).repeat_interleave(CELL, 2)[:, :height, :width].contiguous()
    if trained is None or tuple(trained.shape) != (3, height, width):
        raise ConfigError("a shuffled texture needs the trained one, of the same size")
    # Sides need not be multiples of `CELL`: pad to whole squares, cut off at the end.
    padded = torch.nn.functional.pad(trained[None], (0, columns * CELL - width, 0, rows * CELL - height), "replicate")
    blocks = padded[0].reshape(3, rows, CELL, columns, CELL).permute(1, 3, 0, 2, 4).reshape(-1, 3, CELL, CELL)
    blocks = blocks[torch.from_numpy(draws.permutation(len(blocks)))]
    shuffled = blocks.reshape(rows, columns, 3, CELL, CELL).permute(2, 0, 3, 1, 4)
    return shuffled.reshape(3, rows * CELL, columns * CELL)[:, :height, :width].contiguous()


def texture_picture(colour: Tensor, mask: Bool) -> U8:
    """Return a texture as printed, RGB [H, W, 3]; mid-grey outside the body.

    Args:
        colour: sRGB [3, H, W] in 0 to 1.
        mask: Texels [H, W] that are on the body.
    """
    pixels = np.where(mask[..., None], colour.permute(1, 2, 0).numpy(), 0.5)
    return np.asarray((pixels * 255).round(), np.uint8)
