"""Detection models of torchvision (BSD): FCOS, RetinaNet and SSD here, Faster R-CNN in `two_stage`.

Places are the anchors of all levels in torchvision's order; a place lies at its anchor's middle. Losses are the ones
of the source (torchvision.models.detection), over a batch or image by image.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
import torchvision.models.detection as zoo
from torch import Tensor
from torch.nn import functional
from torchvision.ops import box_iou, generalized_box_iou_loss, sigmoid_focal_loss

from ssad.core.detections import Assignment, Dense, Detections, Truth
from ssad.core.errors import ConfigError
from ssad.detectors.adapters.common import (
    Adapter,
    check_images,
    check_truth,
    input_scale,
    log_odds,
    sum_by_image,
    suppress,
)
from ssad.detectors.yolo.assign import Targets


class OneStage(Adapter):
    """An FCOS, RetinaNet or SSD model of torchvision as a detector. Starts frozen and in eval mode.

    `Dense`: logit is the head's, for SSD (softmax with background) the log-odds of each class, so that its sigmoid is
    the source's score; quality is FCOS's centreness (whose score is the square root of the product), else None. maps
    hold cls_logits [B, P, columns], bbox_regression [B, P, 4], FCOS's bbox_ctrness, anchors [P, 4] in the network's
    input, and scale [4] from the picture to it. The model's own resizing happens inside.

    Args:
        model: The network.
        classes: Names of the classes, in the order of `columns`.
        columns: Columns of the head that belong to the classes, without background and columns without a name.
        name: Name in tables.
        threshold: Default of `predict`; None: the model's.

    Raises:
        ConfigError: The model is none of these.
    """

    columns: Tensor

    def __init__(
        self, model: Any, classes: Sequence[str], columns: Sequence[int], *, name: str, threshold: float | None = None
    ) -> None:
        kind_by_class = {zoo.FCOS: "fcos", zoo.RetinaNet: "retinanet", zoo.ssd.SSD: "ssd"}
        kind = next(
            (kind_by_class[model_class] for model_class in kind_by_class if isinstance(model, model_class)), None
        )
        if kind is None:
            raise ConfigError(f"{name}: a {type(model).__name__} is no FCOS, RetinaNet or SSD of torchvision")
        super().__init__(name, classes, model.score_thresh if threshold is None else threshold)
        self.model = model
        self.kind = kind
        self.register_buffer("columns", torch.tensor(list(columns)), persistent=False)
        self.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> OneStage:
        """Set the mode of the modules; the model keeps its resizing of evaluation, which is not random."""
        super().train(mode)
        # In training mode the transform would pick a random size.
        self.model.transform.training = False
        return self

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Raw outputs for images [B, 3, H, W] in [0, 1], differentiable with respect to them.

        Raises:
            ConfigError: The images have another shape or type.
        """
        size = check_images(self.name, images)
        # The model's own transform normalises and resizes, so weights see the input they were trained with.
        batch, _ = self.model.transform(list(images.to(self._dtype())))
        features, outputs = self._outputs(batch.tensors)
        heads = {name: to_full_precision(value) for name, value in outputs.items()}
        anchors = to_full_precision(self.model.anchor_generator(batch, features)[0])
        scale = input_scale(batch.image_sizes[0], size, anchors)
        level, stride = self._levels(features, batch.tensors.shape[2], anchors.device)
        logit = log_odds(heads["cls_logits"]) if self.kind == "ssd" else heads["cls_logits"]
        return Dense(
            logit=logit[..., self.columns],
            quality=heads["bbox_ctrness"][..., 0] if self.kind == "fcos" else None,
            box=self._decode(heads["bbox_regression"], anchors) / scale,
            place=(anchors[:, :2] + anchors[:, 2:]) / 2 / scale[:2],
            stride=stride / scale[1],
            level=level,
            maps={name: [value] for name, value in heads.items()} | {"anchors": [anchors], "scale": [scale]},
            features=tuple(features),
            size=size,
        )

    def _dtype(self) -> torch.dtype:
        """Return the type of the weights."""
        dtype: torch.dtype = next(self.model.parameters()).dtype
        return dtype

    def _outputs(self, tensors: Tensor) -> tuple[list[Tensor], dict[str, Tensor]]:
        """Return the maps before the head, and what the head returns."""
        features = list(self.model.backbone(tensors).values())
        return features, self.model.head(features)

    def choose(self, dense: Dense, min_score: float) -> list[Detections]:
        """Return the detections above a score, selected as in torchvision.

        FCOS and RetinaNet keep the 1,000 best candidates of each level, SSD the 400 best of each class; then follows
        suppression within each class.
        """
        score = dense.logit.sigmoid()
        if dense.quality is not None:
            score = (score * dense.quality.sigmoid()[..., None]).sqrt()
        return [
            self._choose(image_score, box, dense, min_score) for image_score, box in zip(score, dense.box, strict=True)
        ]

    def _choose(self, score: Tensor, box: Tensor, dense: Dense, min_score: float) -> Detections:
        limit = int(self.model.topk_candidates)
        if self.kind == "ssd":
            value, place = score.topk(min(limit, len(score)), 0)
            label = torch.arange(score.shape[1], device=score.device).expand_as(place)
            passes = value > min_score
            value, place, label = value[passes], place[passes], label[passes]
        else:
            values, places, labels = [], [], []
            for start, count in _level_ranges(dense.level):
                level_scores = score[start : start + count].flatten()
                top_scores, top_indices = level_scores.topk(min(limit, len(level_scores)))
                top_indices = top_indices[top_scores > min_score]
                values.append(level_scores[top_indices])
                places.append(top_indices // score.shape[1] + start)
                labels.append(top_indices % score.shape[1])
            value, place, label = torch.cat(values), torch.cat(places), torch.cat(labels)
        # Suppression of boxes with NaN or infinite sides is undefined.
        is_finite = box[place].isfinite().all(-1)
        value, place, label = value[is_finite], place[is_finite], label[is_finite]
        max_detections = int(self.model.detections_per_img)
        return suppress(value, label, box[place], iou=self.model.nms_thresh, limit=max_detections, size=dense.size)

    @torch.no_grad()
    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """Target assignment as in torchvision: FCOS by centre sampling and size, the others by overlap with anchors.

        Places that would be assigned to a crowd object are ignored. extra: box [B, P, 4], the target in pixels of the
        picture.
        """
        scale = dense.maps["scale"][0]
        targets = check_truth(self.name, truth, len(dense.box), scale=scale, classes=len(self.classes))
        owner = torch.stack([self._match(targets, image_index, dense) for image_index in range(len(truth))])
        if targets.label.shape[1] == 0:
            return Assignment(owner, owner.clamp(max=-1), tuple(truth), {"box": torch.zeros_like(dense.box)})
        index = owner.clamp(min=0)
        label = torch.where(owner >= 0, targets.label.gather(1, index), owner)
        label = torch.where((owner >= 0) & targets.crowd.gather(1, index), -2, label)
        owner = torch.where(label >= 0, owner, -1)
        box = targets.box.gather(1, index[..., None].expand(-1, -1, 4)) / scale
        box = torch.where((label >= 0)[..., None], box, torch.zeros_like(box))
        return Assignment(label, owner, tuple(truth), {"box": box})

    def losses(
        self, dense: Dense, assignment: Assignment, *, reduction: Literal["batch", "image"] = "batch"
    ) -> dict[str, Tensor]:
        """Return classification, bbox_regression and FCOS's bbox_ctrness, named and weighted as in the source."""
        if assignment.label.shape != dense.box.shape[:2]:
            raise ConfigError(f"{self.name}: the assignment was made for pictures of another number or size")
        image_count = len(dense.box)
        anchors, scale = dense.maps["anchors"][0], dense.maps["scale"][0]
        image, place = (assignment.label >= 0).nonzero(as_tuple=True)
        target = assignment.extra["box"].to(scale)[image, place] * scale
        regression = dense.maps["bbox_regression"][0][image, place]
        positives = sum_by_image(torch.ones_like(target[:, 0]), image, image_count)
        loss_sums = {
            "classification": self._class_loss(dense.maps["cls_logits"][0], assignment.label),
            "bbox_regression": sum_by_image(self._box_loss(regression, target, anchors[place]), image, image_count),
        }
        if self.kind == "fcos":
            quality = dense.maps["bbox_ctrness"][0][image, place, 0]
            target_quality = _centreness(target, anchors[place])
            quality_loss = functional.binary_cross_entropy_with_logits(quality, target_quality, reduction="none")
            loss_sums["bbox_ctrness"] = sum_by_image(quality_loss, image, image_count)
        if reduction == "image" or self.kind == "retinanet":  # RetinaNet averages the images' normalised losses
            image_losses = {name: loss_sum / positives.clamp(min=1) for name, loss_sum in loss_sums.items()}
            return (
                image_losses
                if reduction == "image"
                else {name: loss_sum.mean() for name, loss_sum in image_losses.items()}
            )
        return {name: loss_sum.sum() / positives.sum().clamp(min=1) for name, loss_sum in loss_sums.items()}

    def _class_loss(self, logit: Tensor, label: Tensor) -> Tensor:
        """Return the sum [B] of the class loss over places."""
        column = self.columns[label.clamp(min=0)]
        if self.kind == "ssd":
            target = torch.where(label >= 0, column, 0)
            place_loss = functional.cross_entropy(logit.transpose(1, 2), target, reduction="none")
            is_object = label >= 0
            # Hard negative mining of SSD: only the background with the largest loss counts.
            negative_loss = place_loss.detach().masked_fill(label != -1, -torch.inf)
            negative_rank = negative_loss.argsort(1, descending=True).argsort(1)
            is_hard_negative = (negative_rank < self.model.neg_to_pos_ratio * is_object.sum(1, keepdim=True)) & (
                label == -1
            )
            return torch.where(is_object | is_hard_negative, place_loss, 0.0).sum(1)
        target = functional.one_hot(column, logit.shape[-1]).to(logit) * (label >= 0)[..., None]
        place_loss = sigmoid_focal_loss(logit, target, reduction="none").sum(-1)
        return torch.where(label != -2, place_loss, 0.0).sum(1)

    def _box_loss(self, regression: Tensor, target: Tensor, anchors: Tensor) -> Tensor:
        """Return the box loss [M] of the places assigned to an object."""
        if self.kind == "ssd":
            encoded_target = self.model.box_coder.encode_single(target, anchors)
            return functional.smooth_l1_loss(regression, encoded_target, reduction="none").sum(-1)
        head = self.model.head.regression_head
        if self.kind == "fcos" or getattr(head, "_loss_type", "l1") == "giou":
            box = self._decode(regression[None], anchors)[0]
            giou_loss: Tensor = generalized_box_iou_loss(box, target, reduction="none")
            return giou_loss
        encoded_target = head.box_coder.encode_single(target, anchors)
        return functional.l1_loss(regression, encoded_target, reduction="none").sum(-1)

    def _decode(self, regression: Tensor, anchors: Tensor) -> Tensor:
        """Return boxes [B, P, 4] in the network's input."""
        if self.kind == "fcos":
            centre, extent = (anchors[:, :2] + anchors[:, 2:]) / 2, anchors[:, 2:] - anchors[:, :2]
            sides = regression * extent.repeat(1, 2)
            return torch.cat((centre - sides[..., :2], centre + sides[..., 2:]), -1)
        coder = self.model.box_coder if self.kind == "ssd" else self.model.head.regression_head.box_coder
        flat_anchors = anchors.expand(len(regression), -1, -1).reshape(-1, 4)
        box: Tensor = coder.decode_single(regression.reshape(-1, 4), flat_anchors)
        return box.view_as(regression)

    def _match(self, targets: Targets, image_index: int, dense: Dense) -> Tensor:
        """Return the owner [P] of each place of an image, -1 none, -2 in between."""
        anchors = dense.maps["anchors"][0]
        box = targets.box[image_index, targets.real[image_index]]
        if not len(box):
            return torch.full((len(anchors),), -1, dtype=torch.int64, device=anchors.device)
        if self.kind != "fcos":
            owner: Tensor = self.model.proposal_matcher(box_iou(box, anchors))
            return owner
        centre, extent = (anchors[:, :2] + anchors[:, 2:]) / 2, anchors[:, 2] - anchors[:, 0]
        centre_distance = (centre[:, None] - (box[:, :2] + box[:, 2:]) / 2).abs().amax(-1)
        sides = torch.cat((centre[:, None] - box[:, :2], box[:, 2:] - centre[:, None]), -1)
        # A level takes objects whose farthest side is 4 to 8 anchor sizes away; the ends are open.
        low = torch.where(dense.level == 0, 0.0, 4 * extent)
        high = torch.where(dense.level == dense.level[-1], torch.inf, 8 * extent)
        widest = sides.amax(-1)
        is_candidate = (centre_distance < self.model.center_sampling_radius * extent[:, None]) & (sides.amin(-1) > 0)
        is_candidate &= (widest > low[:, None]) & (widest < high[:, None])
        area = (box[:, 2:] - box[:, :2]).prod(-1)
        smallest_area, index = torch.where(is_candidate, area, torch.inf).min(1)
        return torch.where(smallest_area.isfinite(), index, -1)

    def _levels(self, features: list[Tensor], height: int, device: torch.device) -> tuple[Tensor, Tensor]:
        """Return level and stride (in the network's input) of each place."""
        anchors_per_cell = self.model.anchor_generator.num_anchors_per_location()
        counts = [
            feature.shape[2] * feature.shape[3] * anchor_count
            for feature, anchor_count in zip(features, anchors_per_cell, strict=True)
        ]
        place_counts = torch.tensor(counts, device=device)
        level = torch.arange(len(counts), device=device).repeat_interleave(place_counts, output_size=sum(counts))
        stride = torch.tensor([height / feature.shape[2] for feature in features], device=device)
        return level, stride[level]


def to_full_precision(value: Tensor) -> Tensor:
    """Return the value in float32 or finer; half precision is too coarse for boxes and losses."""
    return value.float() if value.dtype in (torch.float16, torch.bfloat16) else value


def _level_ranges(level: Tensor) -> list[tuple[int, int]]:
    """Return the first place and the number of places of each level."""
    counts = torch.bincount(level).tolist()
    starts = torch.tensor([0, *counts]).cumsum(0).tolist()
    return list(zip(starts, counts, strict=False))


def _centreness(target: Tensor, anchors: Tensor) -> Tensor:
    """Return FCOS's target [M] for the distance of a place from the centre of its object."""
    centre = (anchors[:, :2] + anchors[:, 2:]) / 2
    low, high = centre - target[:, :2], target[:, 2:] - centre
    share = torch.minimum(low, high) / torch.maximum(low, high)
    return share.prod(-1).sqrt()
