"""Dense head shared by all levels: towers, branches, and the decoding inside the head."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional

from ssad.core.nuscenes_names import MMDET3D_ATTRIBUTES, MMDET3D_CLASSES
from ssad.detectors.mono3d.backbone import DeformConv
from ssad.detectors.mono3d.config import BASE_DEPTHS, BASE_DIMS, Mono3DConfig
from ssad.detectors.mono3d.decode import yaw_of_vectors

BINS, BIN = 6, 10.0  # depth bins of PGD, their spacing in m
YAW = 3  # index of the yaw among the parts of the regression


class ConvNormUnit(nn.Module):
    """Convolution, group norm, ReLU.

    Attributes:
        compiled: Whether the last two run as one compiled function while training on a GPU.
    """

    compiled = False

    def __init__(self, in_channels: int, out_channels: int, *, deformable: bool = False) -> None:
        super().__init__()
        self.conv: nn.Module
        if deformable:
            self.conv = DeformConv(in_channels, out_channels, bias=True)
            nn.init.normal_(self.conv.weight, std=0.01)
        else:
            self.conv = nn.Conv2d(in_channels, out_channels, 3, padding=1)
            nn.init.normal_(self.conv.weight, std=0.01)
            nn.init.zeros_(self.conv.bias)  # type: ignore[arg-type]
        self.gn = nn.GroupNorm(32, out_channels)

    def forward(self, x: Tensor) -> Tensor:
        """Return [B, O, H, W] from [B, C, H, W]."""
        norm = self.gn  # called by its function, since the module refuses a map of one place
        if self.compiled and self.training and x.is_cuda:
            fused: Tensor = _compiled_norm()(self.conv(x), norm.weight, norm.bias, norm.num_groups, norm.eps)
            return fused
        x = torch.group_norm(self.conv(x), norm.num_groups, norm.weight, norm.bias, norm.eps)
        return functional.relu(x)


def group_norm_relu(x: Tensor, weight: Tensor, bias: Tensor, groups: int, eps: float) -> Tensor:
    """Apply group norm and ReLU to a map [B, C, H, W] in channels-last memory, in a form that a compiler can fuse.

    PyTorch's own group norm copies such a map to another layout and, in mixed precision, to 32 bits. Statistics
    are computed in 32 bits.

    Args:
        x: The map.
        weight: Scale of each channel [C].
        bias: Shift of each channel [C].
        groups: Number of groups, a divisor of C.
        eps: Added to the variance.

    Returns:
        [B, C, H, W], of the type of `x`.

    Source: Wu and He, Group Normalization (ECCV 2018).
    """
    values = x.permute(0, 2, 3, 1).float()
    group_size = x.shape[1] // groups

    def mean_of_groups(channel_means: Tensor) -> Tensor:
        return channel_means.view(len(x), groups, group_size).mean(2)

    mean = mean_of_groups(values.mean((1, 2)))
    variance = (mean_of_groups((values * values).mean((1, 2))) - mean * mean).clamp_min(0.0)
    scale = torch.rsqrt(variance + eps).repeat_interleave(group_size, 1) * weight
    shift = bias - mean.repeat_interleave(group_size, 1) * scale
    values = functional.relu(values * scale[:, None, None] + shift[:, None, None])
    return values.to(x.dtype).permute(0, 3, 1, 2)


@cache
def _compiled_norm() -> Callable[..., Any]:
    """Return `group_norm_relu` compiled for maps of any size; compiled at its first call."""
    return torch.compile(group_norm_relu, dynamic=True)


class Scale(nn.Module):
    """A learned factor."""

    def __init__(self) -> None:
        super().__init__()
        self.scale = nn.Parameter(torch.tensor(1.0))


def _to_float32(x: Tensor) -> Tensor:
    """Return values in at least 32 bits, so that mixed precision does not round what is read off the maps."""
    return x.float() if x.dtype in {torch.float16, torch.bfloat16} else x


def _output_layer(in_channels: int, out_channels: int, *, is_rare: bool = False) -> nn.Conv2d:
    conv = nn.Conv2d(in_channels, out_channels, 1)
    nn.init.normal_(conv.weight, std=0.01)
    # The sigmoid of -ln 99 is 0.01.
    nn.init.constant_(conv.bias, -math.log(99.0) if is_rare else 0.0)  # type: ignore[arg-type]
    return conv


class Head(nn.Module):
    """Class, attribute, direction, centreness and regression maps of each level."""

    base_depths: Tensor
    base_dims: Tensor

    def __init__(self, config: Mono3DConfig) -> None:
        super().__init__()
        self.config = config
        channels = config.channels
        for name, in_channels in (("cls_convs", channels), ("reg_convs", channels + 2 if config.rays else channels)):
            self.add_module(
                name,
                nn.ModuleList(
                    [
                        ConvNormUnit(in_channels, channels),
                        ConvNormUnit(channels, channels, deformable=config.deformable),
                    ]
                ),
            )
        self.conv_cls_prev = nn.ModuleList([ConvNormUnit(channels, channels)])
        self.conv_cls = _output_layer(channels, len(MMDET3D_CLASSES), is_rare=True)
        self.conv_reg_prevs = nn.ModuleList(
            nn.ModuleList([] if part_index == 4 else [ConvNormUnit(channels, channels)])
            for part_index in range(len(config.regression_channels))
        )
        self.conv_regs = nn.ModuleList(_output_layer(channels, size) for size in config.regression_channels)
        if config.heading == "bins":
            self.conv_dir_cls_prev = nn.ModuleList([ConvNormUnit(channels, channels)])
            self.conv_dir_cls = _output_layer(channels, 2, is_rare=True)
        else:
            self.heading_convs = nn.ModuleList(
                [ConvNormUnit(channels + 2 if config.rays else channels, channels), ConvNormUnit(channels, channels)]
            )
        self.conv_attr_prev = nn.ModuleList([ConvNormUnit(channels, channels)])
        self.conv_attr = _output_layer(channels, len(MMDET3D_ATTRIBUTES), is_rare=True)
        centreness_channels = max(channels // 4, 32)
        self.conv_centerness_prev = nn.ModuleList([ConvNormUnit(channels, centreness_channels)])
        self.conv_centerness = _output_layer(centreness_channels, 1)
        self.scales = nn.ModuleList(
            nn.ModuleList(Scale() for _ in range(4 if config.pgd else 3)) for _ in config.strides
        )
        if config.pgd:
            self.conv_depth_cls_prev = nn.ModuleList([ConvNormUnit(channels, channels)])
            self.conv_depth_cls = _output_layer(channels, BINS, is_rare=True)
            self.fuse_lambda = nn.Parameter(torch.tensor(1e-4))
        if config.start is not None:
            with torch.no_grad():
                self.conv_regs[1].get_parameter("bias").copy_(torch.tensor(config.start[:1]).log())
                self.conv_regs[2].get_parameter("bias").copy_(torch.tensor(config.start[1:]).log())
        self.register_buffer("base_depths", torch.tensor(BASE_DEPTHS), persistent=False)
        self.register_buffer("base_dims", torch.tensor(BASE_DIMS), persistent=False)

    def forward(
        self, maps: list[Tensor], depth_factor: Tensor | None, rays: list[Tensor] | None = None
    ) -> dict[str, list[Tensor]]:
        """Return maps by mmdetection3d's names, one for each level.

        Args:
            maps: Maps of the neck, one for each level.
            depth_factor: Factor of the depth [B]; None: 1.
            rays: Viewing direction of each place [B, 2, h, w], one map for each level, if the configuration wants them.

        Returns:
            cls_scores [B, 10, h, w]; bbox_preds [B, 9 or 13, h, w] (offset in pixels, depth m, size m, yaw, velocity,
            2D distances in pixels); dir_cls_preds: logits of the two bins, or with "vectors" the two vectors from which
            bbox_preds has its yaw (see `yaw_of_vectors`) [B, 2 or 4, h, w]; attr_preds; centernesses; and for PGD
            depth_cls_preds.
        """
        maps_by_name: dict[str, list[Tensor]] = {}
        for level, feature in enumerate(maps):
            for name, value in self._level(level, feature, depth_factor, None if rays is None else rays[level]).items():
                maps_by_name.setdefault(name, []).append(value)
        return maps_by_name

    def _level(self, level: int, x: Tensor, depth_factor: Tensor | None, rays: Tensor | None) -> dict[str, Tensor]:
        regression_input = x if rays is None else torch.cat([x, rays.to(x)], 1)
        class_feature, box_feature = x, regression_input
        for unit in self.get_submodule("cls_convs").children():
            class_feature = unit(class_feature)
        for unit in self.get_submodule("reg_convs").children():
            box_feature = unit(box_feature)
        logit = _to_float32(self.conv_cls(self.conv_cls_prev[0](class_feature)))
        heading_feature = box_feature
        if self.config.heading == "vectors":
            heading_feature = regression_input
            for unit in self.heading_convs:
                heading_feature = unit(heading_feature)
        parts = []
        for part_index, (tower, output_conv) in enumerate(zip(self.conv_reg_prevs, self.conv_regs, strict=True)):
            part_feature = heading_feature if part_index == YAW else box_feature
            for unit in tower.children():
                part_feature = unit(part_feature)
            parts.append(_to_float32(output_conv(part_feature)))
        if self.config.heading == "bins":
            direction = _to_float32(self.conv_dir_cls(self.conv_dir_cls_prev[0](box_feature)))
        else:
            direction, parts[YAW] = parts[YAW], yaw_of_vectors(parts[YAW], 1)[:, None]
        level_maps = {
            "cls_scores": logit,
            "bbox_preds": self._decode(level, parts, logit, depth_factor),
            "dir_cls_preds": direction,
            "attr_preds": _to_float32(self.conv_attr(self.conv_attr_prev[0](class_feature))),
            "centernesses": _to_float32(self.conv_centerness(self.conv_centerness_prev[0](box_feature))),
        }
        if self.config.pgd:
            level_maps["depth_cls_preds"] = _to_float32(self.conv_depth_cls(self.conv_depth_cls_prev[0](box_feature)))
        return level_maps

    def _decode(self, level: int, parts: list[Tensor], logit: Tensor, depth_factor: Tensor | None) -> Tensor:
        """Return offsets times stride, depth and size in metres."""
        scales = list(self.scales[level].parameters())
        stride = self.config.strides[level]
        offset = parts[0] * scales[0] * stride
        depth, size = parts[1] * scales[1], (parts[2] * scales[2]).exp()
        if self.config.pgd:
            best_class = logit.argmax(1)
            prior = self.base_depths.to(depth)[best_class]
            depth = prior[..., 0][:, None] + depth * prior[..., 1][:, None]
            size = self.base_dims.to(size)[best_class].permute(0, 3, 1, 2) * size
        else:
            depth = depth.exp()
        if depth_factor is not None:
            depth = depth * depth_factor[:, None, None, None]
        if self.config.pgd:
            parts = [*parts[:5], (parts[5] * scales[3]).relu() * stride]
        return torch.cat([offset, depth, size, *parts[3:]], 1)

    def fuse(self, depth: Tensor, bins: Tensor, depth_factor: Tensor | None = None) -> Tensor:
        """Return PGD's depth [...] from the regressed one and the logits of the bins [..., 6]; see `forward`."""
        bin_depth = bins.softmax(-1) @ (BIN * torch.arange(BINS, dtype=bins.dtype, device=bins.device))
        if depth_factor is not None:
            bin_depth = bin_depth * depth_factor
        weight = self.fuse_lambda.sigmoid()
        return weight * depth + (1 - weight) * bin_depth
