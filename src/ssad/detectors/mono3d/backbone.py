"""Backbones: ResNet in caffe style with modulated deformable convolutions, and a light one of basic blocks.

Sources: He et al. 2016 (caffe style: the stride sits on the first 1 x 1 convolution); Zhu et al. 2019 (DCNv2).
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional
from torchvision.ops import deform_conv2d

BLOCKS = {50: (3, 4, 6, 3), 101: (3, 4, 23, 3)}


class DeformConv(nn.Module):
    """Modulated deformable 3 x 3 convolution, which starts as an ordinary convolution with half the weights.

    For each place, `conv_offset` predicts 9 vertical and 9 horizontal offsets (interleaved as y, x) and 9 masks.
    """

    def __init__(self, in_channels: int, out_channels: int, *, stride: int = 1, bias: bool = False) -> None:
        super().__init__()
        self.stride = stride
        self.weight = nn.Parameter(torch.empty(out_channels, in_channels, 3, 3))
        self.bias = nn.Parameter(torch.zeros(out_channels)) if bias else None
        self.conv_offset = nn.Conv2d(in_channels, 27, 3, stride, 1)
        nn.init.kaiming_normal_(self.weight, mode="fan_out", nonlinearity="relu")
        # Zero offsets and masks of 0.5 make it an ordinary convolution with half the weights.
        nn.init.zeros_(self.conv_offset.weight)
        nn.init.zeros_(self.conv_offset.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """Return [B, O, H / stride, W / stride] from [B, C, H, W]."""
        # Offsets are positions in pixels; mixed precision would round them.
        with torch.autocast(x.device.type, enabled=False):
            if x.dtype in {torch.float16, torch.bfloat16}:
                x = x.float()
            offsets_and_masks = self.conv_offset(x)
            output: Tensor = deform_conv2d(
                x,
                offsets_and_masks[:, :18].contiguous(),
                self.weight,
                self.bias,
                self.stride,
                1,
                1,
                offsets_and_masks[:, 18:].sigmoid(),
            )
        return output


class Bottleneck(nn.Module):
    """1 x 1 (with the stride), 3 x 3 (deformable or not), 1 x 1."""

    def __init__(self, in_channels: int, width: int, *, stride: int, deformable: bool, is_first_block: bool) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, width, 1, stride, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2: nn.Module = (
            DeformConv(width, width) if deformable else nn.Conv2d(width, width, 3, padding=1, bias=False)
        )
        self.bn2 = nn.BatchNorm2d(width)
        self.conv3 = nn.Conv2d(width, 4 * width, 1, bias=False)
        self.bn3 = nn.BatchNorm2d(4 * width)
        self.downsample: nn.Module | None = None
        if is_first_block:
            self.downsample = nn.Sequential(
                nn.Conv2d(in_channels, 4 * width, 1, stride, bias=False), nn.BatchNorm2d(4 * width)
            )

    def forward(self, x: Tensor) -> Tensor:
        """Return [B, 4 width, H / stride, W / stride] from [B, C, H, W]."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = functional.relu(self.bn1(self.conv1(x)))
        x = functional.relu(self.bn2(self.conv2(x)))
        return functional.relu(self.bn3(self.conv3(x)) + shortcut)


class BasicBlock(nn.Module):
    """Two 3 x 3 convolutions."""

    def __init__(self, in_channels: int, width: int, *, stride: int) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(in_channels, width, 3, stride, 1, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        self.conv2 = nn.Conv2d(width, width, 3, padding=1, bias=False)
        self.bn2 = nn.BatchNorm2d(width)
        self.downsample: nn.Module | None = None
        if stride > 1 or in_channels != width:
            self.downsample = nn.Sequential(nn.Conv2d(in_channels, width, 1, stride, bias=False), nn.BatchNorm2d(width))

    def forward(self, x: Tensor) -> Tensor:
        """Return [B, width, H / stride, W / stride] from [B, C, H, W]."""
        shortcut = x if self.downsample is None else self.downsample(x)
        x = functional.relu(self.bn1(self.conv1(x)))
        return functional.relu(self.bn2(self.conv2(x)) + shortcut)


class Backbone(nn.Module):
    """Maps at strides 8, 16 and 32 from images [B, 3, H, W]; `out_channels` holds the channels of each."""

    def __init__(self, depth: int, *, width: int = 64) -> None:
        super().__init__()
        self.conv1 = nn.Conv2d(3, width, 7, 2, 3, bias=False)
        self.bn1 = nn.BatchNorm2d(width)
        in_channels = width
        for stage in range(4):
            stage_width = width << stage
            blocks: list[nn.Module] = []
            for block_index in range(BLOCKS[depth][stage] if depth in BLOCKS else 2):
                stride = 2 if stage and not block_index else 1
                if depth in BLOCKS:
                    blocks.append(
                        Bottleneck(
                            in_channels,
                            stage_width,
                            stride=stride,
                            deformable=stage >= 2,
                            is_first_block=not block_index,
                        )
                    )
                    in_channels = 4 * stage_width
                else:
                    blocks.append(BasicBlock(in_channels, stage_width, stride=stride))
                    in_channels = stage_width
            self.add_module(f"layer{stage + 1}", nn.Sequential(*blocks))
        expansion = 4 if depth in BLOCKS else 1
        self.out_channels = tuple(expansion * (width << stage) for stage in (1, 2, 3))
        for submodule in self.modules():
            if isinstance(submodule, nn.Conv2d) and submodule.bias is None:
                nn.init.kaiming_normal_(submodule.weight, mode="fan_out", nonlinearity="relu")

    def forward(self, x: Tensor) -> list[Tensor]:
        """Return the maps of the last three stages."""
        x = functional.max_pool2d(functional.relu(self.bn1(self.conv1(x))), 3, 2, 1)
        maps = []
        for stage in range(1, 5):
            x = self.get_submodule(f"layer{stage}")(x)
            maps.append(x)
        return maps[1:]


class Conv(nn.Module):
    """A convolution under the name `conv`, which the published weights of the neck use."""

    def __init__(self, in_channels: int, out_channels: int, size: int, stride: int = 1) -> None:
        super().__init__()
        self.conv = nn.Conv2d(in_channels, out_channels, size, stride, size // 2)
        nn.init.xavier_uniform_(self.conv.weight)
        nn.init.zeros_(self.conv.bias)  # type: ignore[arg-type]

    def forward(self, x: Tensor) -> Tensor:
        """Return [B, O, H / stride, W / stride] from [B, C, H, W]."""
        output: Tensor = self.conv(x)
        return output


class Neck(nn.Module):
    """Feature pyramid (Lin et al. 2017) over three maps; further levels follow from the last output, with a ReLU."""

    def __init__(self, in_channels: tuple[int, ...], channels: int, levels: int) -> None:
        super().__init__()
        self.lateral_convs = nn.ModuleList(Conv(input_channels, channels, 1) for input_channels in in_channels)
        self.fpn_convs = nn.ModuleList(Conv(channels, channels, 3, 1 if level < 3 else 2) for level in range(levels))

    def forward(self, maps: list[Tensor]) -> list[Tensor]:
        """Return one map a level, finest first."""
        laterals = [lateral_conv(x) for lateral_conv, x in zip(self.lateral_convs, maps, strict=True)]
        # Top-down: each map receives the coarser one before the next finer map reads it.
        for level in (1, 0):
            laterals[level] = laterals[level] + functional.interpolate(
                laterals[level + 1], laterals[level].shape[2:], mode="nearest"
            )
        outputs = [conv(x) for conv, x in zip(self.fpn_convs, laterals, strict=False)]
        for level in range(3, len(self.fpn_convs)):
            outputs.append(self.fpn_convs[level](outputs[-1] if level == 3 else functional.relu(outputs[-1])))
        return outputs
