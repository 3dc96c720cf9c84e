"""Textures that learn nothing: what every physical attack must beat."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from ssad.core.errors import ConfigError, unknown_name
from ssad.core.seeding import generator
from ssad.core.types import U8, Bool

CELL = 8  # texels of a side of the patches of a random texture: a car's colours are not white noise at 20 m
CONTROLS = ("random", "noise", "grey", "shuffled")


def control(name: str, size: tuple[int, int], *, seed: int = 0, trained: Tensor | None = None) -> Tensor:
    """A texture that no gradient has seen.

    Args:
        name: random: squares of uniform colours; noise: a colour of its own for each texel; grey: mid-grey; shuffled:
            the squares of a trained texture in another order.
        size: Height and width, texels.
        seed: Of random and shuffled.
        trained: What is shuffled, sRGB [3, H, W].

    Returns:
        sRGB [3, H, W] float32 in 0 to 1.

    Raises:
        UnknownNameError: There is no such control.
        ConfigError: Nothing to shuffle, or it is of another size.
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
    padded = torch.nn.functional.pad(trained[None], (0, columns * CELL - width, 0, rows * CELL - height), "replicate")
    blocks = padded[0].reshape(3, rows, CELL, columns, CELL).permute(1, 3, 0, 2, 4).reshape(-1, 3, CELL, CELL)
    blocks = blocks[torch.from_numpy(draws.permutation(len(blocks)))]
    whole = blocks.reshape(rows, columns, 3, CELL, CELL).permute(2, 0, 3, 1, 4)
    return whole.reshape(3, rows * CELL, columns * CELL)[:, :height, :width].contiguous()


def texture_picture(colour: Tensor, mask: Bool) -> U8:
    """A texture as it is printed, RGB [H, W, 3]; mid-grey where nothing is on the body.

    Args:
        colour: sRGB [3, H, W] in 0 to 1.
        mask: Texels [H, W] that are on the body.
    """
    whole = np.where(mask[..., None], colour.permute(1, 2, 0).numpy(), 0.5)
    return np.asarray((whole * 255).round(), np.uint8)
