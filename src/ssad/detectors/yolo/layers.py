"""Layers of YOLOv3 (Redmon and Farhadi 2018) and of YOLOv5 6.0 (published layer table)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional


class ConvUnit(nn.Module):
    """Convolution without bias, batch norm, activation. [B, i, h, w] -> [B, o, ceil(h / stride), ceil(w / stride)].

    smooth: SiLU and the batch norm of YOLOv5 (eps 1e-3), else leaky ReLU with slope 0.1 and that of darknet (eps 1e-5).
    """

    def __init__(
        self, inputs: int, outputs: int, *, kernel: int = 1, stride: int = 1, padding: int | None = None, smooth: bool
    ) -> None:
        super().__init__()
        padding = kernel // 2 if padding is None else padding
        self.conv = nn.Conv2d(inputs, outputs, kernel, stride, padding, bias=False)
        self.norm = nn.BatchNorm2d(outputs, eps=1e-3 if smooth else 1e-5, momentum=0.03)
        self.activation: nn.Module = nn.SiLU() if smooth else nn.LeakyReLU(0.1)

    def forward(self, x: Tensor) -> Tensor:
        """Return the activated map."""
        output: Tensor = self.activation(self.norm(self.conv(x)))
        return output


class Residual(nn.Module):
    """1x1 to `hidden` channels, 3x3 back to the input's channels; the input is added if `add`."""

    def __init__(self, channels: int, hidden_channels: int, *, smooth: bool, use_shortcut: bool = True) -> None:
        super().__init__()
        self.reduce = ConvUnit(channels, hidden_channels, smooth=smooth)
        self.expand = ConvUnit(hidden_channels, channels, kernel=3, smooth=smooth)
        self.add = use_shortcut

    def forward(self, x: Tensor) -> Tensor:
        """Return a map [B, c, h, w] of the input's shape."""
        residual: Tensor = self.expand(self.reduce(x))
        return x + residual if self.add else residual


class C3(nn.Module):
    """Cross-stage partial block of three convolutions: half the channels pass the residual blocks, half go round."""

    def __init__(self, inputs: int, outputs: int, *, repeats: int, use_shortcut: bool = True) -> None:
        super().__init__()
        half = outputs // 2
        self.through = ConvUnit(inputs, half, smooth=True)
        self.past = ConvUnit(inputs, half, smooth=True)
        self.merge = ConvUnit(2 * half, outputs, smooth=True)
        self.blocks = nn.Sequential(
            *(Residual(half, half, smooth=True, use_shortcut=use_shortcut) for _ in range(repeats))
        )

    def forward(self, x: Tensor) -> Tensor:
        """Return [B, o, h, w] from [B, i, h, w]."""
        output: Tensor = self.merge(torch.cat((self.blocks(self.through(x)), self.past(x)), 1))
        return output


class SPPF(nn.Module):
    """Spatial pyramid pooling as three 5x5 poolings in a row (fields of 5, 9 and 13), joined with their input."""

    def __init__(self, inputs: int, outputs: int) -> None:
        super().__init__()
        half = inputs // 2
        self.reduce = ConvUnit(inputs, half, smooth=True)
        self.merge = ConvUnit(4 * half, outputs, smooth=True)

    def forward(self, x: Tensor) -> Tensor:
        """Return [B, o, h, w] from [B, i, h, w]."""
        maps = [self.reduce(x)]
        # Chained 5x5 poolings equal poolings of 5, 9 and 13, at a lower cost.
        for _ in range(3):
            maps.append(functional.max_pool2d(maps[-1], 5, stride=1, padding=2))
        output: Tensor = self.merge(torch.cat(maps, 1))
        return output


def pool_same(x: Tensor) -> Tensor:
    """Pool 2x2 with stride 1 and keep the size, as darknet does: pads one row and column at the bottom and right."""
    return functional.max_pool2d(functional.pad(x, (0, 1, 0, 1), value=-torch.inf), 2, stride=1)


def upsample(x: Tensor) -> Tensor:
    """Double the size by nearest neighbour."""
    return functional.interpolate(x, scale_factor=2.0, mode="nearest")
