"""YOLOv3 and YOLOv5 behind the `Detector` protocol."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import torch
from torch import Tensor

from ssad.core.detections import Assignment, Dense, Detections, Truth
from ssad.core.errors import ConfigError
from ssad.detectors.adapters.common import Adapter, check_images, check_truth, input_scale, resize_and_pad, resized_size
from ssad.detectors.yolo.assign import label_places, match_best, match_near
from ssad.detectors.yolo.classes import COCO
from ssad.detectors.yolo.decode import CellGrid, decode, flatten, make_grid, select
from ssad.detectors.yolo.loss import LossInputs, Reduction, losses_v3, losses_v5
from ssad.detectors.yolo.models import YoloSpec, build_network

MULTIPLE = 32


class Yolo(Adapter):
    """An anchor-based detector with objectness. Starts frozen and in eval mode.

    Pictures are padded with grey at the right and bottom to a multiple of 32. The state dict holds the anchors, so that
    weights bring theirs.

    `Dense`: maps["raw"] holds the head maps [B, A * (5 + C), h, w], finest first; places run over levels, anchors,
    rows, columns; `place` and `stride` are in pixels of the picture passed in; features: what the heads read.

    Args:
        spec: Architecture, anchors and rules.
        classes: Names in the order of the class logits.
        input_width: Width to which pictures are resized (bilinear, aspect kept to the pixel); None: they are not.
        threshold: Default of `predict`.
        nms_iou: IoU of suppression in `predict`; None: the spec's.
        limit: Maximum number of detections in `predict`.
        seed: Of the fresh weights.

    Raises:
        ConfigError: A setting does not fit.
    """

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
        if not classes or len(set(classes)) != len(classes):
            raise ConfigError(f"{spec.name}: classes must be distinct names, at least one; got {list(classes)[:5]}")
        if input_width is not None and input_width < MULTIPLE:
            raise ConfigError(f"{spec.name}: input_width {input_width} is too small; it takes {MULTIPLE} or more")
        super().__init__(spec.name, classes, threshold)
        self.spec = spec
        self.input_width = input_width
        self.nms_iou = spec.nms_iou if nms_iou is None else nms_iou
        self.limit = limit
        self.network = build_network(spec, len(self.classes), seed=seed)
        self.register_buffer("anchors", torch.tensor(spec.anchors, dtype=torch.float32))
        self.requires_grad_(False).eval()

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Raw outputs for images [B, 3, H, W] in [0, 1], differentiable with respect to them.

        Raises:
            ConfigError: The images have another shape or type.
        """
        size = check_images(self.name, images, min_count=0)
        input_size = resized_size(size, self.input_width)
        images = images.to(next(self.network.parameters()).dtype)
        raw, neck = self.network(resize_and_pad(images, input_size, multiple=MULTIPLE, grey=self.spec.grey))
        grid = self._grid([(level_map.shape[2], level_map.shape[3]) for level_map in raw])
        flat_raw = flatten(raw, self.anchors.shape[1])
        scale = self._scale(size, flat_raw)
        box = decode(self.spec.rule, flat_raw[..., :4], grid) / scale
        return Dense(
            logit=flat_raw[..., 5:],
            quality=flat_raw[..., 4],
            box=box,
            place=(grid.cell + 0.5) * grid.stride[:, None] / scale[:2],
            stride=grid.stride / scale[0],
            level=grid.level,
            maps={"raw": list(raw)},
            features=neck,
            size=size,
        )

    def choose(self, dense: Dense, min_score: float) -> list[Detections]:
        """Return the detections by the score sigmoid(objectness) * sigmoid(class), suppressed by class."""
        assert dense.quality is not None
        score = dense.logit.sigmoid() * dense.quality.sigmoid()[..., None]
        return select(score, dense.box, threshold=min_score, iou=self.nms_iou, limit=self.limit, size=dense.size)

    @torch.no_grad()
    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """Assign targets by the rule of the detector.

        extra: box [B, P, 4], the target in pixels of the image, zeros without one.

        Raises:
            ConfigError: The truth does not belong to the images, or is invalid (labels out of range, empty boxes).
        """
        scale = self._scale(dense.size, dense.box)
        targets = check_truth(self.name, truth, len(dense.box), scale=scale, classes=len(self.classes))
        grid = self._grid_of(dense)
        match = match_best if self.spec.rule == "v3" else match_near
        owner = match(targets, grid, dense.box.shape[1])
        label, owner, box = label_places(targets, owner, dense.box * scale, ignore_objects=self.spec.rule == "v3")
        return Assignment(label, owner, tuple(truth), {"box": box / scale})

    def losses(
        self, dense: Dense, assignment: Assignment, *, reduction: Literal["batch", "image"] = "batch"
    ) -> dict[str, Tensor]:
        """Return the training losses box, obj and cls; see `losses_v3` and `losses_v5`.

        Raises:
            ConfigError: The assignment was made for other images.
        """
        if dense.quality is None or assignment.label.shape != dense.quality.shape:
            raise ConfigError(f"{self.name}: the assignment was made for pictures of another number or size")
        grid = self._grid_of(dense)
        scale = self._scale(dense.size, dense.box)
        raw = flatten(dense.maps["raw"], self.anchors.shape[1])
        loss_inputs = LossInputs(
            raw[..., :4],
            dense.box * scale,
            dense.quality,
            dense.logit,
            assignment.label,
            assignment.extra["box"].to(scale) * scale,
            self._padded_size(dense.size),
        )
        loss_reduction: Reduction = reduction
        if self.spec.rule == "v3":
            return losses_v3(loss_inputs, grid, box_loss=self.spec.box_loss, reduction=loss_reduction)
        return losses_v5(loss_inputs, grid, reduction=loss_reduction)

    def _padded_size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return height and width of the network's input."""
        height, width = resized_size(size, self.input_width)
        return -(-height // MULTIPLE) * MULTIPLE, -(-width // MULTIPLE) * MULTIPLE

    def _scale(self, size: tuple[int, int], like: Tensor) -> Tensor:
        return input_scale(resized_size(size, self.input_width), size, like)

    def _grid(self, shapes: list[tuple[int, int]]) -> CellGrid:
        # Half precision would round anchors and cells of large images.
        anchors = self.anchors
        return make_grid(
            shapes, self.spec.strides, anchors.float() if anchors.dtype in {torch.float16, torch.bfloat16} else anchors
        )

    def _grid_of(self, dense: Dense) -> CellGrid:
        return self._grid([(level_map.shape[2], level_map.shape[3]) for level_map in dense.maps["raw"]])
