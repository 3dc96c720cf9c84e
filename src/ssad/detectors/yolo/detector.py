"""YOLOv3 and YOLOv5 behind the `Detector` protocol."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from ssad.core.detections import Assignment, Dense, Detections, Truth
from ssad.core.errors import ConfigError
from ssad.detectors.eval_mode import evaluating
from ssad.detectors.yolo.assign import label_places, match_best, match_near, pad_truth
from ssad.detectors.yolo.classes import COCO
from ssad.detectors.yolo.decode import Grid, decode, flatten, make_grid, select
from ssad.detectors.yolo.loss import Answers, Reduction, losses_v3, losses_v5
from ssad.detectors.yolo.models import YoloSpec, build_network

MULTIPLE = 32


class Yolo(nn.Module):
    """An anchor-based detector with objectness.

    classes: names in the order of the class logits; input_width: pictures are resized to so many pixels (bilinear,
    aspect kept to the pixel), default: their own scale; threshold, nms_iou (default: the spec's), limit: for `predict`;
    seed: of the fresh weights. In both cases pictures are padded with grey at the right and bottom to a multiple of 32.
    Starts frozen and in eval mode. Its state dict holds the anchors, so that weights bring theirs.

    `Dense`: maps["raw"] holds the head maps [B, A * (5 + C), h, w], finest first; places run over levels, anchors,
    rows, columns; `place` and `stride` are in pixels of the picture handed in; features: what the heads read.
    """

    task: Literal["2d", "3d"] = "2d"
    anchors: Tensor

    def __init__(
        self,
        spec: YoloSpec,
        classes: Sequence[str] = COCO,
        *,
        input_width: int | None = None,
        threshold: float = 0.25,
        nms_iou: float | None = None,
        limit: int = 300,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if not classes or len(set(classes)) != len(classes):
            raise ConfigError(f"{spec.name}: classes must be distinct names, at least one; got {list(classes)[:5]}")
        if input_width is not None and input_width < MULTIPLE:
            raise ConfigError(f"{spec.name}: input_width {input_width} is too small; it takes {MULTIPLE} or more")
        self.spec = spec
        self.name = spec.name
        self.classes = tuple(classes)
        self.input_width = input_width
        self.threshold = threshold
        self.nms_iou = spec.nms_iou if nms_iou is None else nms_iou
        self.limit = limit
        self.network = build_network(spec, len(self.classes), seed=seed)
        self.register_buffer("anchors", torch.tensor(spec.anchors, dtype=torch.float32))
        self.requires_grad_(False).eval()

    def forward(self, images: Tensor) -> Dense:
        """As `dense`."""
        return self.dense(images)

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Raw outputs for images [B, 3, H, W] in [0, 1], differentiable to them. ConfigError: another shape or type."""
        size = self._check(images)
        raw, neck = self.network(self._prepare(images))
        grid = self._grid([(part.shape[2], part.shape[3]) for part in raw])
        values = flatten(raw, self.anchors.shape[1])
        scale = self._scale(size, values)
        box = decode(self.spec.rule, values[..., :4], grid) / scale
        return Dense(
            logit=values[..., 5:],
            quality=values[..., 4],
            box=box,
            place=(grid.cell + 0.5) * grid.stride[:, None] / scale[:2],
            stride=grid.stride / scale[0],
            level=grid.level,
            maps={"raw": list(raw)},
            features=neck,
            size=size,
        )

    @torch.no_grad()
    def predict(
        self, images: Tensor, intrinsic: Tensor | None = None, *, threshold: float | None = None
    ) -> list[Detections]:
        """Detections of each image, best first: score sigmoid(objectness) * sigmoid(class), suppressed by class."""
        least = self.threshold if threshold is None else threshold
        if not 0 <= least < 1:
            raise ConfigError(f"{self.name}: threshold {least} is not in [0, 1)")
        with evaluating(self):
            dense = self.dense(images)
        assert dense.quality is not None
        score = dense.logit.sigmoid() * dense.quality.sigmoid()[..., None]
        return [
            select(one, box, threshold=least, iou=self.nms_iou, limit=self.limit, size=dense.size)
            for one, box in zip(score, dense.box, strict=True)
        ]

    @torch.no_grad()
    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """The detector's own assignment; extra: box [B, P, 4], the target in pixels of the picture, zeros without one.

        ConfigError: truth that does not belong to the images, or is none (labels out of range, empty boxes).
        """
        if not truth or len(truth) != len(dense.box):
            raise ConfigError(
                f"{self.name}: truth of {len(truth)} images for a batch of {len(dense.box)}; it takes one each"
            )
        grid = self._grid_of(dense)
        scale = self._scale(dense.size, dense.box)
        targets = pad_truth(truth, scale, classes=len(self.classes))
        match = match_best if self.spec.rule == "v3" else match_near
        owner = match(targets, grid, dense.box.shape[1])
        label, owner, box = label_places(targets, owner, dense.box * scale, ignore_objects=self.spec.rule == "v3")
        return Assignment(label, owner, tuple(truth), {"box": box / scale})

    def losses(
        self, dense: Dense, assignment: Assignment, *, reduction: Literal["batch", "image"] = "batch"
    ) -> dict[str, Tensor]:
        """box, obj and cls; see `losses_v3` and `losses_v5`. ConfigError: an assignment made for other pictures."""
        if dense.quality is None or assignment.label.shape != dense.quality.shape:
            raise ConfigError(f"{self.name}: the assignment was made for pictures of another number or size")
        grid = self._grid_of(dense)
        scale = self._scale(dense.size, dense.box)
        raw = flatten(dense.maps["raw"], self.anchors.shape[1])
        answers = Answers(
            raw[..., :4], dense.box * scale, dense.quality, dense.logit, assignment.label,
            assignment.extra["box"].to(scale) * scale, self._padded(dense.size),
        )  # fmt: skip
        kind: Reduction = reduction
        if self.spec.rule == "v3":
            return losses_v3(answers, grid, box_loss=self.spec.box_loss, reduction=kind)
        return losses_v5(answers, grid, reduction=kind)

    def _check(self, images: Tensor) -> tuple[int, int]:
        if images.ndim != 4 or images.shape[1] != 3 or not images.is_floating_point() or 0 in images.shape[2:]:
            raise ConfigError(
                f"{self.name}: images must be [B, 3, H, W] of floats in [0, 1] (RGB); "
                f"got {list(images.shape)} of {str(images.dtype).removeprefix('torch.')}"
            )
        return images.shape[2], images.shape[3]

    def _resized(self, size: tuple[int, int]) -> tuple[int, int]:
        """Height and width of the picture inside the network, before padding."""
        if self.input_width is None:
            return size
        return max(1, round(size[0] * self.input_width / size[1])), self.input_width

    def _padded(self, size: tuple[int, int]) -> tuple[int, int]:
        height, width = self._resized(size)
        return -(-height // MULTIPLE) * MULTIPLE, -(-width // MULTIPLE) * MULTIPLE

    def _scale(self, size: tuple[int, int], like: Tensor) -> Tensor:
        """[4]: what a box of the picture is multiplied by to stand in the network's input."""
        height, width = self._resized(size)
        x, y = width / size[1], height / size[0]
        return torch.tensor([x, y, x, y], device=like.device, dtype=like.dtype)

    def _prepare(self, images: Tensor) -> Tensor:
        size = (images.shape[2], images.shape[3])
        resized, padded = self._resized(size), self._padded(size)
        images = images.to(next(self.network.parameters()).dtype)
        if resized != size:
            images = functional.interpolate(images, resized, mode="bilinear", align_corners=False)
        pad = (0, padded[1] - resized[1], 0, padded[0] - resized[0])
        return functional.pad(images, pad, value=self.spec.grey)

    def _grid(self, shapes: list[tuple[int, int]]) -> Grid:
        anchors = self.anchors
        return make_grid(
            shapes, self.spec.strides, anchors.float() if anchors.dtype in {torch.float16, torch.bfloat16} else anchors
        )

    def _grid_of(self, dense: Dense) -> Grid:
        return self._grid([(part.shape[2], part.shape[3]) for part in dense.maps["raw"]])
