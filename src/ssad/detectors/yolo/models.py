"""Networks: Darknet-53 with the three heads of YOLOv3, YOLOv3-tiny, and YOLOv5 6.0 with its multiples.

Each takes [B, 3, H, W] with H and W multiples of 32 and returns two tuples of maps, finest first: the raw head maps
[B, A * (5 + C), h, w] (for each anchor: x, y, w, h, objectness, classes) and the neck maps that the heads read.
Modules are registered in the order in which darknet stores its layers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor, nn
from torch.nn import functional

from ssad.core.errors import ConfigError
from ssad.core.seeding import seed32
from ssad.detectors.yolo.layers import C3, SPPF, ConvUnit, Residual, pool_same, upsample

Maps = tuple[Tensor, ...]


@dataclass(frozen=True)
class YoloSpec:
    """Definition of a YOLO detector.

    Attributes:
        name: Name of the detector.
        rule: "v3" or "v5": decoding, assignment and losses.
        network: "darknet53", "tiny" or "csp".
        anchors: Width and height in pixels, a tuple for each level, finest first.
        strides: Stride of each level.
        width: Multiple of the channels in the published table.
        depth: Multiple of the repeats in the published table.
        grey: Value of the padding.
        nms_iou: IoU above which suppression drops the worse of two boxes.
        box_loss: "ciou", or for v3 "squares", the sum of squared errors of its paper.
    """

    name: str
    rule: str
    network: str
    anchors: tuple[tuple[tuple[float, float], ...], ...]
    strides: tuple[int, ...] = (8, 16, 32)
    width: float = 1.0
    depth: float = 1.0
    grey: float = 114 / 255
    nms_iou: float = 0.45
    box_loss: str = "ciou"

    def __post_init__(self) -> None:
        if self.rule not in {"v3", "v5"}:
            raise ConfigError(f"YOLO '{self.name}': unknown rule '{self.rule}'; choose v3 or v5")
        if self.network not in NETWORKS:
            raise ConfigError(f"YOLO '{self.name}': unknown network '{self.network}'; choose of {', '.join(NETWORKS)}")
        if self.box_loss != "ciou" and (self.box_loss, self.rule) != ("squares", "v3"):
            raise ConfigError(
                f"YOLO '{self.name}': unknown box loss '{self.box_loss}'; choose ciou (or squares for v3)"
            )
        if not (0 < self.width <= 4 and 0 < self.depth <= 4):
            raise ConfigError(f"YOLO '{self.name}': width and depth must be in (0, 4]")
        if len(self.anchors) != len(self.strides) or len({len(level) for level in self.anchors}) != 1:
            raise ConfigError(f"YOLO '{self.name}': each level needs its stride and the same number of anchors")
        if self.strides != STRIDES[self.network]:
            raise ConfigError(f"YOLO '{self.name}': network '{self.network}' has the strides {STRIDES[self.network]}")

    def channels(self, count: int) -> int:
        """Scale a channel count of the published table by the width, to a multiple of 8."""
        return max(8, math.ceil(count * self.width / 8) * 8)

    def repeats(self, count: int) -> int:
        """Scale a repeat count of the published table by the depth."""
        return max(1, round(count * self.depth))


class Darknet53(nn.Module):
    """Trunk of YOLOv3 (paper, table 1) without its classifier; returns maps of strides 8, 16, 32."""

    def __init__(self, spec: YoloSpec) -> None:
        super().__init__()
        channels = [spec.channels(32 * 2**level) for level in range(6)]
        self.stem = ConvUnit(3, channels[0], kernel=3, smooth=False)
        self.stages = nn.ModuleList()
        for inputs, outputs, count in zip(channels, channels[1:], (1, 2, 8, 8, 4), strict=False):
            down = ConvUnit(inputs, outputs, kernel=3, stride=2, smooth=False)
            blocks = (Residual(outputs, outputs // 2, smooth=False) for _ in range(spec.repeats(count)))
            self.stages.append(nn.Sequential(down, *blocks))
        self.channels = tuple(channels[3:])

    def forward(self, x: Tensor) -> Maps:
        """Return three maps from [B, 3, H, W]."""
        x = self.stem(x)
        maps = []
        for stage in self.stages:
            x = stage(x)
            maps.append(x)
        return tuple(maps[2:])


class V3Level(nn.Module):
    """One of YOLOv3's three heads: input from the coarser head, five convolutions, one more, the raw map."""

    def __init__(self, inputs: int, coarser: int, width: int, outputs: int) -> None:
        super().__init__()
        self.lateral = ConvUnit(coarser, width, smooth=False) if coarser else None
        joined_channels = inputs + (width if coarser else 0)
        self.body = nn.Sequential(
            ConvUnit(joined_channels, width, smooth=False),
            ConvUnit(width, 2 * width, kernel=3, smooth=False),
            ConvUnit(2 * width, width, smooth=False),
            ConvUnit(width, 2 * width, kernel=3, smooth=False),
            ConvUnit(2 * width, width, smooth=False),
        )
        self.expand = ConvUnit(width, 2 * width, kernel=3, smooth=False)
        self.output = nn.Conv2d(2 * width, outputs, 1)

    def forward(self, x: Tensor, coarser: Tensor | None) -> tuple[Tensor, Tensor, Tensor]:
        """Return the raw map, the map it is computed from, and the input of the next finer head."""
        if self.lateral is not None and coarser is not None:
            x = torch.cat((upsample(self.lateral(coarser)), x), 1)
        body = self.body(x)
        neck = self.expand(body)
        return self.output(neck), neck, body


class V3Network(nn.Module):
    """YOLOv3: Darknet-53 and three heads, coarsest first as in the paper."""

    def __init__(self, spec: YoloSpec, outputs: int) -> None:
        super().__init__()
        self.trunk = Darknet53(spec)
        widths = [spec.channels(count) for count in (128, 256, 512)]
        coarser = [widths[1], widths[2], 0]
        self.levels = nn.ModuleList(
            V3Level(self.trunk.channels[i], coarser[i], widths[i], outputs) for i in reversed(range(3))
        )

    def forward(self, x: Tensor) -> tuple[Maps, Maps]:
        """Return raw maps and neck maps, finest first."""
        raw: list[Tensor] = []
        neck: list[Tensor] = []
        coarser_feature = None
        for level, feature in zip(self.levels, reversed(self.trunk(x)), strict=True):
            output, neck_map, coarser_feature = level(feature, coarser_feature)
            raw.insert(0, output)
            neck.insert(0, neck_map)
        return tuple(raw), tuple(neck)

    def outputs(self) -> list[nn.Conv2d]:
        """Return the convolutions that produce the raw maps, finest first."""
        return [level.output for level in reversed(self.levels)]  # type: ignore[misc]


class TinyNetwork(nn.Module):
    """YOLOv3-tiny (published darknet layer table): seven convolutions with pooling between, heads of stride 16, 32."""

    def __init__(self, spec: YoloSpec, outputs: int) -> None:
        super().__init__()
        channels = [3, *(spec.channels(16 * 2**level) for level in range(7))]
        self.trunk = nn.ModuleList(ConvUnit(i, o, kernel=3, smooth=False) for i, o in pairwise(channels))
        self.reduce = ConvUnit(channels[7], channels[5], smooth=False)
        self.coarse = ConvUnit(channels[5], channels[6], kernel=3, smooth=False)
        self.coarse_output = nn.Conv2d(channels[6], outputs, 1)
        self.lateral = ConvUnit(channels[5], channels[4], smooth=False)
        self.fine = ConvUnit(channels[4] + channels[5], channels[5], kernel=3, smooth=False)
        self.fine_output = nn.Conv2d(channels[5], outputs, 1)

    def forward(self, x: Tensor) -> tuple[Maps, Maps]:
        """Return raw maps and neck maps, finest first."""
        fine = x
        for index, conv in enumerate(self.trunk):
            x = conv(x)
            if index == 4:
                fine = x
            if index < 5:
                x = functional.max_pool2d(x, 2)
            elif index == 5:
                # The sixth pooling has stride 1: the coarse level stays at stride 32.
                x = pool_same(x)
        x = self.reduce(x)
        coarse_neck = self.coarse(x)
        fine_neck = self.fine(torch.cat((upsample(self.lateral(x)), fine), 1))
        return (self.fine_output(fine_neck), self.coarse_output(coarse_neck)), (fine_neck, coarse_neck)

    def outputs(self) -> list[nn.Conv2d]:
        """Return the convolutions that produce the raw maps, finest first."""
        return [self.fine_output, self.coarse_output]


class CSPNetwork(nn.Module):
    """YOLOv5 6.0 (published layer table): C3 trunk, SPPF, a top-down and a bottom-up path, 1x1 heads."""

    def __init__(self, spec: YoloSpec, outputs: int) -> None:
        super().__init__()
        c1, c2, c3, c4, c5 = (spec.channels(count) for count in (64, 128, 256, 512, 1024))
        repeats = spec.repeats(3)
        self.stem = ConvUnit(3, c1, kernel=6, stride=2, padding=2, smooth=True)
        self.down2 = ConvUnit(c1, c2, kernel=3, stride=2, smooth=True)
        self.stage2 = C3(c2, c2, repeats=repeats)
        self.down3 = ConvUnit(c2, c3, kernel=3, stride=2, smooth=True)
        self.stage3 = C3(c3, c3, repeats=spec.repeats(6))
        self.down4 = ConvUnit(c3, c4, kernel=3, stride=2, smooth=True)
        self.stage4 = C3(c4, c4, repeats=spec.repeats(9))
        self.down5 = ConvUnit(c4, c5, kernel=3, stride=2, smooth=True)
        self.stage5 = C3(c5, c5, repeats=repeats)
        self.pool = SPPF(c5, c5)
        self.lateral5 = ConvUnit(c5, c4, smooth=True)
        self.top4 = C3(2 * c4, c4, repeats=repeats, use_shortcut=False)
        self.lateral4 = ConvUnit(c4, c3, smooth=True)
        self.neck3 = C3(2 * c3, c3, repeats=repeats, use_shortcut=False)
        self.up4 = ConvUnit(c3, c3, kernel=3, stride=2, smooth=True)
        self.neck4 = C3(2 * c3, c4, repeats=repeats, use_shortcut=False)
        self.up5 = ConvUnit(c4, c4, kernel=3, stride=2, smooth=True)
        self.neck5 = C3(2 * c4, c5, repeats=repeats, use_shortcut=False)
        self.heads = nn.ModuleList(nn.Conv2d(channels, outputs, 1) for channels in (c3, c4, c5))

    def forward(self, x: Tensor) -> tuple[Maps, Maps]:
        """Return raw maps and neck maps, finest first."""
        map3 = self.stage3(self.down3(self.stage2(self.down2(self.stem(x)))))
        map4 = self.stage4(self.down4(map3))
        lateral5 = self.lateral5(self.pool(self.stage5(self.down5(map4))))
        lateral4 = self.lateral4(self.top4(torch.cat((upsample(lateral5), map4), 1)))
        neck3 = self.neck3(torch.cat((upsample(lateral4), map3), 1))
        neck4 = self.neck4(torch.cat((self.up4(neck3), lateral4), 1))
        neck5 = self.neck5(torch.cat((self.up5(neck4), lateral5), 1))
        neck = (neck3, neck4, neck5)
        return tuple(head(neck_map) for head, neck_map in zip(self.heads, neck, strict=True)), neck

    def outputs(self) -> list[nn.Conv2d]:
        """Return the convolutions that produce the raw maps, finest first."""
        return list(self.heads)  # type: ignore[arg-type]


Network = V3Network | TinyNetwork | CSPNetwork
NETWORKS: dict[str, type[V3Network] | type[TinyNetwork] | type[CSPNetwork]] = {
    "darknet53": V3Network,
    "tiny": TinyNetwork,
    "csp": CSPNetwork,
}
STRIDES = {"darknet53": (8, 16, 32), "tiny": (16, 32), "csp": (8, 16, 32)}


def build_network(spec: YoloSpec, classes: int, *, seed: int = 0) -> Network:
    """Return a network with fresh weights that depend on the seed alone; the global generator is left unchanged.

    Convolutions: He's normal by fan-out; heads: small, with biases that expect 8 objects in an image of 640 x 640
    (objectness) and one class among all (class logits), so that training from scratch starts without a burst.
    """
    # On the meta device the constructors draw no numbers from the global generator.
    with torch.device("meta"):
        network = NETWORKS[spec.network](spec, len(spec.anchors[0]) * (5 + classes))
    network.to_empty(device="cpu")
    generator = torch.Generator().manual_seed(seed32("yolo", spec.name, seed))
    for module in network.modules():
        if isinstance(module, nn.Conv2d):
            nn.init.kaiming_normal_(module.weight, a=0.1, mode="fan_out", generator=generator)
        elif isinstance(module, nn.BatchNorm2d):
            module.reset_parameters()
    for head, stride in zip(network.outputs(), spec.strides, strict=True):
        nn.init.normal_(head.weight, std=0.01, generator=generator)
        if head.bias is not None:
            bias = torch.zeros(len(spec.anchors[0]), 5 + classes)
            bias[:, 4] = math.log(8 / (640 / stride) ** 2)
            # The published initialisation; 0.99 keeps a single class finite.
            bias[:, 5:] = math.log(0.6 / (classes - 0.99))
            head.bias.data.copy_(bias.flatten())
    return network
