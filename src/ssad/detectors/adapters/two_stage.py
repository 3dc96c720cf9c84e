"""Faster R-CNN of torchvision as a detector whose places are its proposals.

The two-stage model is adapted to the protocol as follows:
- Places are the proposals of the first stage, best first, K for every image (`Dense.logit` is -30 in places that an
  image does not fill). They differ from image to image, so `Dense.place` is the centre of the image and `stride` its
  larger side. No gradient flows through the choice of proposals, as in the source.
- In training the source samples the anchors and proposals that count (256 and 512 an image), and adds the true boxes
  to the proposals. Here all of them count, weighted so that the loss is the expected value over the samples. True
  boxes are not added, but the proposal that overlaps an object most is always assigned to it.
- Images run one by one: proposals are chosen by rank, and the rounding of a larger batch could change the choice.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import torch
import torchvision.models.detection as zoo
from torch import Tensor
from torch.nn import functional
from torchvision.models.detection.rpn import concat_box_prediction_layers
from torchvision.ops import box_iou

from ssad.core.detections import Assignment, Dense, Detections, Truth
from ssad.core.errors import ConfigError
from ssad.detectors.adapters.common import (
    Adapter,
    check_images,
    check_truth,
    input_scale,
    labels_and_owners,
    log_odds,
    suppress,
)
from ssad.detectors.adapters.torchvision import to_full_precision
from ssad.detectors.yolo.assign import Targets

EMPTY_LOGIT = -30.0  # logit of a place without proposal; its sigmoid is 0 but for 1e-13
MIN_SIDE = 1e-2
BETA = 1 / 9


class TwoStage(Adapter):
    """A Faster R-CNN of torchvision as a detector; see the module. Starts frozen and in eval mode.

    `Dense`: logit is the log-odds of each class in the second stage's softmax, box the one of the likeliest class,
    quality None (the source's score has no other factor). maps: class_logits [B, K, columns], box_regression
    [B, K, 4 * columns], proposals [B, K, 4], filled [B, K], and of the first stage objectness [B, A], rpn_regression
    [B, A, 4], anchors [A, 4], in the network's input; scale [4] leads to it.
    """

    columns: Tensor

    def __init__(
        self, model: Any, classes: Sequence[str], columns: Sequence[int], *, name: str, threshold: float | None = None
    ) -> None:
        if not isinstance(model, zoo.FasterRCNN):
            raise ConfigError(f"{name}: a {type(model).__name__} is no Faster R-CNN of torchvision")
        super().__init__(name, classes, model.roi_heads.score_thresh if threshold is None else threshold)
        self.model = model
        self.register_buffer("columns", torch.tensor(list(columns)), persistent=False)
        self.requires_grad_(False).eval()

    def train(self, mode: bool = True) -> TwoStage:
        """Set the mode of the modules; resizing and number of proposals stay those of evaluation."""
        super().train(mode)
        self.model.transform.training = False
        self.model.rpn.training = False
        return self

    def dense(self, images: Tensor, intrinsic: Tensor | None = None) -> Dense:
        """Raw outputs for images [B, 3, H, W] in [0, 1], differentiable with respect to them.

        Raises:
            ConfigError: The images have another shape or type.
        """
        size = check_images(self.name, images)
        # One by one, see the module: batching could change the choice of proposals.
        image_maps = [
            self._run_stages(image) for image in torch.split(images.to(next(self.model.parameters()).dtype), 1)
        ]
        maps = {
            name: torch.cat([maps_of_image[name] for maps_of_image in image_maps])
            for name in image_maps[0]
            if name not in ("anchors", "inside")
        }
        anchors, network_size = image_maps[0]["anchors"], image_maps[0]["inside"].tolist()
        scale = input_scale((network_size[0], network_size[1]), size, anchors)
        filled = maps["filled"]
        logit = log_odds(maps["class_logits"])[..., self.columns].masked_fill(~filled[..., None], EMPTY_LOGIT)
        column = self.columns[logit.argmax(-1)]
        boxes = self._boxes(maps["box_regression"], maps["proposals"])
        box = boxes.gather(2, column[..., None, None].expand(-1, -1, 1, 4))[:, :, 0]
        count = filled.shape[1]
        centre = torch.tensor([size[1] / 2, size[0] / 2], device=box.device, dtype=box.dtype)
        features = [name for name in maps if name.startswith("feature")]
        return Dense(
            logit=logit,
            quality=None,
            box=torch.where(filled[..., None], box, 0.0) / scale,
            place=centre.expand(count, 2),
            stride=torch.full((count,), float(max(size)), device=box.device),
            level=torch.zeros(count, dtype=torch.int64, device=box.device),
            maps={map_name: [map_value] for map_name, map_value in maps.items() if map_name not in features}
            | {"anchors": [anchors], "scale": [scale]},
            features=tuple(maps[name] for name in features),
            size=size,
        )

    def _run_stages(self, image: Tensor) -> dict[str, Tensor]:
        """Run both stages on one image [1, 3, H, W]: the maps of `dense`, the size inside, the features."""
        rpn, roi = self.model.rpn, self.model.roi_heads
        batch, _ = self.model.transform(list(image))
        features = self.model.backbone(batch.tensors)
        levels = list(features.values())
        scores, regressions = rpn.head(levels)
        anchors = to_full_precision(rpn.anchor_generator(batch, levels)[0])
        counts = [level_scores.shape[1] * level_scores.shape[2] * level_scores.shape[3] for level_scores in scores]
        objectness, regression = concat_box_prediction_layers(scores, regressions)
        objectness, regression = to_full_precision(objectness), to_full_precision(regression)
        with torch.no_grad():
            proposals = rpn.box_coder.decode(regression.detach(), [anchors]).view(1, -1, 4)
            selected, _ = rpn.filter_proposals(proposals, objectness.detach()[None], batch.image_sizes, counts)
        pooled = roi.box_head(
            roi.box_roi_pool(
                features, [proposal_boxes.to(levels[0].dtype) for proposal_boxes in selected], batch.image_sizes
            )
        )
        logit, boxes = roi.box_predictor(pooled)
        empty_count = rpn.post_nms_top_n() - len(selected[0])

        def fill(value: Tensor) -> Tensor:
            return functional.pad(to_full_precision(value), (0, 0, 0, empty_count))[None]

        filled = torch.arange(len(selected[0]) + empty_count, device=image.device) < len(selected[0])
        outputs = {
            "class_logits": fill(logit),
            "box_regression": fill(boxes),
            "proposals": fill(selected[0]),
            "filled": filled[None],
            "objectness": objectness[None, :, 0],
            "rpn_regression": regression[None],
            "anchors": anchors,
            "inside": torch.tensor(batch.image_sizes[0]),
        }
        return outputs | {f"feature{level}": value for level, value in enumerate(levels)}

    def _boxes(self, regression: Tensor, proposals: Tensor) -> Tensor:
        """Return the boxes [B, K, columns, 4] of all classes in the network's input."""
        flat_boxes = self.model.roi_heads.box_coder.decode(regression.flatten(0, 1), [proposals.reshape(-1, 4)])
        box: Tensor = flat_boxes.view(*regression.shape[:2], -1, 4)
        return box

    def choose(self, dense: Dense, min_score: float) -> list[Detections]:
        """Return all classes of all proposals above a score, each with its own box, suppressed within a class."""
        boxes = self._boxes(dense.maps["box_regression"][0], dense.maps["proposals"][0])[:, :, self.columns]
        boxes = boxes / dense.maps["scale"][0]
        roi = self.model.roi_heads
        limit = dense.box.new_tensor([dense.size[1], dense.size[0]] * 2)
        detections = []
        for score, box, filled in zip(dense.logit.sigmoid(), boxes, dense.maps["filled"][0], strict=True):
            clipped = box.clamp(min=0).minimum(limit)
            is_large = ((clipped[..., 2:] - clipped[..., :2]) * dense.maps["scale"][0][:2] >= MIN_SIDE).all(-1)
            place, label = ((score > min_score) & filled[:, None] & is_large).nonzero(as_tuple=True)
            detections.append(
                suppress(
                    score[place, label],
                    label,
                    box[place, label],
                    iou=roi.nms_thresh,
                    limit=roi.detections_per_img,
                    size=dense.size,
                )
            )
        return detections

    @torch.no_grad()
    def assign(self, dense: Dense, truth: Sequence[Truth]) -> Assignment:
        """Target assignment by overlap of the objects with proposals, and with anchors for the first stage.

        extra: box [B, K, 4], the target in pixels of the picture; anchor_label [B, A] (1 object, 0 background, -2
        ignored); anchor_box [B, A, 4]; proposals [B, K, 4] that the assignment was made for.
        """
        scale, anchors = dense.maps["scale"][0], dense.maps["anchors"][0]
        targets = check_truth(self.name, truth, len(dense.box), scale=scale, classes=len(self.classes))
        label, owner, target = self._assign_proposals(dense, targets, targets.label)
        rows = []
        for image_index, image_truth in enumerate(truth):
            object_count = len(image_truth.label)
            if not object_count:
                background = torch.zeros(len(anchors), dtype=torch.int64, device=anchors.device)
                rows.append((background, torch.zeros_like(anchors)))
                continue
            anchor_owner = self.model.rpn.proposal_matcher(box_iou(targets.box[image_index, :object_count], anchors))
            anchor_label, _ = labels_and_owners(
                anchor_owner, torch.ones_like(targets.label[image_index]), targets.crowd[image_index]
            )
            rows.append(
                (
                    torch.where(anchor_label == -1, 0, anchor_label),
                    targets.box[image_index, anchor_owner.clamp(min=0)] / scale,
                )
            )
        anchor_label, anchor_box = (torch.stack(column) for column in zip(*rows, strict=True))
        extra = {
            "box": target / scale,
            "anchor_label": anchor_label,
            "anchor_box": anchor_box,
            "proposals": dense.maps["proposals"][0],
        }
        return Assignment(label, owner, tuple(truth), extra)

    def _assign_proposals(self, dense: Dense, targets: Targets, object_labels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return label, owner [B, K] and target [B, K, 4] (in the network's input) of the proposals."""
        rows = []
        for image_index, object_count in enumerate(targets.real.sum(1).tolist()):
            is_filled, proposals = dense.maps["filled"][0][image_index], dense.maps["proposals"][0][image_index]
            if not object_count:
                no_owner = torch.full_like(is_filled, -1, dtype=torch.int64)
                rows.append((no_owner.masked_fill(~is_filled, -2), no_owner, torch.zeros_like(proposals)))
                continue
            box = targets.box[image_index, :object_count]
            overlap = box_iou(box, proposals).masked_fill(~is_filled, 0.0)
            owner = self.model.roi_heads.proposal_matcher(overlap)
            largest_overlap, best_proposal = overlap.max(1)
            # The source adds true boxes to the proposals instead, so that no object goes unmatched.
            owner[best_proposal[largest_overlap > 0]] = torch.arange(object_count, device=owner.device)[
                largest_overlap > 0
            ]
            label, owner = labels_and_owners(
                owner.masked_fill(~is_filled, -2), object_labels[image_index], targets.crowd[image_index]
            )
            rows.append((label, owner, torch.where((owner >= 0)[:, None], box[owner.clamp(min=0)], 0.0)))
        label, owner, target = (torch.stack(column) for column in zip(*rows, strict=True))
        return label, owner, target

    def losses(
        self, dense: Dense, assignment: Assignment, *, reduction: Literal["batch", "image"] = "batch"
    ) -> dict[str, Tensor]:
        """Return the training losses: expected values over the random choices of the source; see the module.

        If the image has changed and its proposals are not those of the assignment, they are matched again to the same
        objects, with the classes that the assignment gives them.

        Returns:
            loss_classifier, loss_box_reg, loss_objectness and loss_rpn_box_reg.

        Raises:
            ConfigError: The assignment was made for images of another number or size.
        """
        if assignment.label.shape != dense.box.shape[:2]:
            raise ConfigError(f"{self.name}: the assignment was made for pictures of another number or size")
        rpn, roi, maps, scale = self.model.rpn, self.model.roi_heads, dense.maps, dense.maps["scale"][0]
        label, target = assignment.label, assignment.extra["box"].to(scale) * scale
        # An attack changes the image and thereby the proposals, while its assignment stays fixed.
        if not torch.equal(maps["proposals"][0], assignment.extra["proposals"].to(scale)):
            label, target = self._reassign(dense, assignment)
        column = torch.where(label >= 0, self.columns[label.clamp(min=0)], 0)
        class_loss = functional.cross_entropy(maps["class_logits"][0].transpose(1, 2), column, reduction="none")
        regression = maps["box_regression"][0].reshape(*label.shape, -1, 4)
        regression = regression.gather(2, column[..., None, None].expand(-1, -1, 1, 4))[:, :, 0]
        box_loss = _box_losses(roi.box_coder, regression, target, maps["proposals"][0], label >= 0)
        anchor_label = assignment.extra["anchor_label"]
        anchors = maps["anchors"][0].expand(len(label), -1, -1)
        anchor_box = assignment.extra["anchor_box"].to(scale) * scale
        rpn_box_loss = _box_losses(rpn.box_coder, maps["rpn_regression"][0], anchor_box, anchors, anchor_label == 1)
        logit, is_object = maps["objectness"][0], (anchor_label == 1).to(scale)
        objectness_loss = functional.binary_cross_entropy_with_logits(logit, is_object, reduction="none")
        proposal_weights = _sampling_weights(label >= 0, label == -1, roi.fg_bg_sampler)
        anchor_weights = _sampling_weights(anchor_label == 1, anchor_label == 0, rpn.fg_bg_sampler)
        parts = {
            "loss_classifier": (class_loss * proposal_weights[0], proposal_weights[1]),
            "loss_box_reg": (box_loss * proposal_weights[0], proposal_weights[1]),
            "loss_objectness": (objectness_loss * anchor_weights[0], anchor_weights[1]),
            "loss_rpn_box_reg": (rpn_box_loss * anchor_weights[0], anchor_weights[1]),
        }
        if reduction == "image":
            return {
                name: weighted_loss.sum(1) / expected_count.clamp(min=1)
                for name, (weighted_loss, expected_count) in parts.items()
            }
        return {
            name: weighted_loss.sum() / expected_count.sum().clamp(min=1)
            for name, (weighted_loss, expected_count) in parts.items()
        }

    @torch.no_grad()
    def _reassign(self, dense: Dense, assignment: Assignment) -> tuple[Tensor, Tensor]:
        """Return label and target of proposals other than those of the assignment."""
        scale = dense.maps["scale"][0]
        truth = assignment.truth
        targets = check_truth(self.name, truth, len(dense.box), scale=scale, classes=len(self.classes))
        object_labels = targets.label.clone()
        image, place = (assignment.label >= 0).nonzero(as_tuple=True)
        object_labels[image, assignment.owner[image, place]] = assignment.label[image, place]
        label, _, target = self._assign_proposals(dense, targets, object_labels)
        return label, target


def _box_losses(coder: Any, regression: Tensor, target: Tensor, boxes: Tensor, is_object: Tensor) -> Tensor:
    """Return the smooth L1 loss [B, K] of the encoded boxes where `is_object`, 0 elsewhere."""
    image, place = is_object.nonzero(as_tuple=True)
    encoded_target = coder.encode_single(target[image, place], boxes[image, place])
    box_loss = functional.smooth_l1_loss(regression[image, place], encoded_target, beta=BETA, reduction="none").sum(-1)
    return torch.zeros_like(regression[..., 0]).index_put((image, place), box_loss)


def _sampling_weights(is_object: Tensor, background: Tensor, sampler: Any) -> tuple[Tensor, Tensor]:
    """Return the probability [B, K] that a place is sampled, and the number of samples [B]."""
    size, max_objects = sampler.batch_size_per_image, int(sampler.batch_size_per_image * sampler.positive_fraction)
    object_count, background_count = is_object.sum(1), background.sum(1)
    sampled_objects = object_count.clamp(max=max_objects)
    sampled_background = torch.minimum(background_count, size - sampled_objects)
    probability = (
        is_object * (sampled_objects / object_count.clamp(min=1))[:, None]
        + background * (sampled_background / background_count.clamp(min=1))[:, None]
    )
    return probability, sampled_objects + sampled_background
