"""Training losses of YOLOv3 (paper, section 2) and YOLOv5 (published hyperparameters), in float32 or finer.

Boxes are in pixels of the network's own input. Sums run in a fixed order, so they are the same in every run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits as cross_entropy

from ssad.core.tensor_boxes import intersection
from ssad.detectors.adapters.common import sum_by_image
from ssad.detectors.yolo.decode import CellGrid

Reduction = Literal["batch", "image"]
BALANCE = (4.0, 1.0, 0.4)


@dataclass(frozen=True, slots=True)
class LossInputs:
    """Predictions and targets that the losses compare.

    Attributes:
        raw: Raw box outputs of the network [B, P, 4].
        box: Predicted boxes [B, P, 4].
        objectness: Logits [B, P].
        logit: Class logits [B, P, C].
        label: Labels of the assignment [B, P].
        target: Target boxes of the assignment [B, P, 4].
        size: Height and width of the network's input.
    """

    raw: Tensor
    box: Tensor
    objectness: Tensor
    logit: Tensor
    label: Tensor
    target: Tensor
    size: tuple[int, int]


def ciou(box: Tensor, target: Tensor) -> Tensor:
    """Complete IoU [N] of pairs of boxes [N, 4] (Zheng et al. 2020): IoU less distance and difference of aspect."""
    eps = 1e-7
    common = intersection(box, target)
    size, target_size = box[:, 2:] - box[:, :2], target[:, 2:] - target[:, :2]
    overlap = common / (size.prod(-1) + target_size.prod(-1) - common + eps)
    enclosing_size = torch.maximum(box[:, 2:], target[:, 2:]) - torch.minimum(box[:, :2], target[:, :2])
    centre_distance = ((box[:, :2] + box[:, 2:] - target[:, :2] - target[:, 2:]) ** 2).sum(-1) / 4
    angle = torch.atan(target_size[:, 0] / (target_size[:, 1] + eps)) - torch.atan(size[:, 0] / (size[:, 1] + eps))
    aspect = 4 / math.pi**2 * angle**2
    # The weight is a constant for the gradient, as in the paper's reference.
    with torch.no_grad():
        weight = aspect / (1 - overlap + aspect + eps)
    return overlap - centre_distance / ((enclosing_size**2).sum(-1) + eps) - weight * aspect


def losses_v3(loss_inputs: LossInputs, grid: CellGrid, *, box_loss: str, reduction: Reduction) -> dict[str, Tensor]:
    """Sums over the places of an image, mean over images ("image": each image's own).

    obj: cross-entropy of objectness at all places that are not ignored; cls: cross-entropy of each class where an
    object is; box: there, weighted by 2 less the object's share of the picture (as darknet does), either "squares"
    (half the squared errors of sigmoid(x), sigmoid(y), w, h: their gradient is the paper's) or "ciou", 1 - CIoU, which
    is not the paper's but trains to tighter boxes.
    """
    image, place = (loss_inputs.label >= 0).nonzero(as_tuple=True)
    target = loss_inputs.target[image, place]
    image_share = (target[:, 2:] - target[:, :2]).prod(-1) / (loss_inputs.size[0] * loss_inputs.size[1])
    if box_loss == "squares":
        raw = loss_inputs.raw[image, place]
        loss_part = (target[:, :2] + target[:, 2:]) / 2 / grid.stride[place, None] - grid.cell[place]
        log_size = ((target[:, 2:] - target[:, :2]) / grid.anchor[place]).log()
        box = 0.5 * (((raw[:, :2].sigmoid() - loss_part) ** 2).sum(-1) + ((raw[:, 2:] - log_size) ** 2).sum(-1))
    else:
        box = 1 - ciou(loss_inputs.box[image, place], target)
    is_object = (loss_inputs.label >= 0).to(loss_inputs.objectness.dtype)
    is_counted = loss_inputs.label != -2
    objectness_loss = cross_entropy(loss_inputs.objectness, is_object, reduction="none")
    loss_parts = {
        "box": sum_by_image(box * (2 - image_share), image, len(is_object)),
        "obj": torch.where(is_counted, objectness_loss, 0.0).sum(1),
        "cls": sum_by_image(_class_loss(loss_inputs, image, place).sum(-1), image, len(is_object)),
    }
    return loss_parts if reduction == "image" else {name: loss_part.mean() for name, loss_part in loss_parts.items()}


def losses_v5(loss_inputs: LossInputs, grid: CellGrid, *, reduction: Reduction) -> dict[str, Tensor]:
    """Means over places, summed over levels (the source multiplies by the size of the batch as well; this does not).

    box: 0.05 * (1 - CIoU) where an object is; obj: cross-entropy of objectness with CIoU as the target (no gradient),
    levels weighted 4, 1, 0.4, in all by the area over 640 x 640; cls: 0.5 * C / 80 * cross-entropy of the classes.
    """
    batch, levels = len(loss_inputs.label), len(grid.strides)
    image, place = (loss_inputs.label >= 0).nonzero(as_tuple=True)
    overlap = ciou(loss_inputs.box[image, place], loss_inputs.target[image, place])
    # the means at a level run over the batch's objects, or over the image's
    level_group = image * levels + grid.level[place]
    class_loss = _class_loss(loss_inputs, image, place).mean(-1)
    object_count = sum_by_image(torch.ones_like(overlap), level_group, batch * levels).view(batch, levels)
    box = sum_by_image(1 - overlap, level_group, batch * levels).view(batch, levels)
    cls = sum_by_image(class_loss, level_group, batch * levels).view(batch, levels)
    target_objectness = torch.zeros_like(loss_inputs.objectness)
    target_objectness[image, place] = overlap.detach().clamp(min=0)
    objectness_loss = cross_entropy(loss_inputs.objectness, target_objectness, reduction="none")
    objectness_loss = torch.where(loss_inputs.label != -2, objectness_loss, 0.0)
    weight = torch.tensor(BALANCE[:levels], device=objectness_loss.device, dtype=objectness_loss.dtype)
    obj = torch.stack([objectness_loss[:, level_places].mean(1) for level_places in _levels(grid)], -1) * weight
    if reduction == "batch":
        object_count, box, cls, obj = object_count.sum(0), box.sum(0), cls.sum(0), obj.mean(0)
    object_count = object_count.clamp(min=1)
    return {
        "box": 0.05 * (box / object_count).sum(-1),
        "obj": loss_inputs.size[0] * loss_inputs.size[1] / 640**2 * obj.sum(-1),
        "cls": 0.5 * loss_inputs.logit.shape[-1] / 80 * (cls / object_count).sum(-1),
    }


def _class_loss(loss_inputs: LossInputs, image: Tensor, place: Tensor) -> Tensor:
    """Cross-entropy [N, C] of the class logits at these places against their labels."""
    logit = loss_inputs.logit[image, place]
    classes = torch.arange(logit.shape[-1], device=logit.device)
    target = (loss_inputs.label[image, place][:, None] == classes).to(logit.dtype)
    return cross_entropy(logit, target, reduction="none")


def _levels(grid: CellGrid) -> list[slice]:
    """Return the places of each level."""
    return [slice(begin, end) for begin, end in pairwise((*grid.start, len(grid.stride)))]
