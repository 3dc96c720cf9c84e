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

from ssad.detectors.adapters.common import sums
from ssad.detectors.yolo.decode import Grid

Reduction = Literal["batch", "image"]
BALANCE = (4.0, 1.0, 0.4)


@dataclass(frozen=True, slots=True)
class Answers:
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
    low, high = torch.maximum(box[:, :2], target[:, :2]), torch.minimum(box[:, 2:], target[:, 2:])
    both = (high - low).clamp(min=0).prod(-1)
    size, real = box[:, 2:] - box[:, :2], target[:, 2:] - target[:, :2]
    overlap = both / (size.prod(-1) + real.prod(-1) - both + eps)
    hull = torch.maximum(box[:, 2:], target[:, 2:]) - torch.minimum(box[:, :2], target[:, :2])
    apart = ((box[:, :2] + box[:, 2:] - target[:, :2] - target[:, 2:]) ** 2).sum(-1) / 4
    angle = torch.atan(real[:, 0] / (real[:, 1] + eps)) - torch.atan(size[:, 0] / (size[:, 1] + eps))
    aspect = 4 / math.pi**2 * angle**2
    with torch.no_grad():
        weight = aspect / (1 - overlap + aspect + eps)
    return overlap - apart / ((hull**2).sum(-1) + eps) - weight * aspect


def losses_v3(answers: Answers, grid: Grid, *, box_loss: str, reduction: Reduction) -> dict[str, Tensor]:
    """Sums over the places of an image, mean over images ("image": each image's own).

    obj: cross-entropy of objectness at all places that are not ignored; cls: cross-entropy of each class where an
    object is; box: there, weighted by 2 less the object's share of the picture (as darknet does), either "squares"
    (half the squared errors of sigmoid(x), sigmoid(y), w, h: their gradient is the paper's) or "ciou", 1 - CIoU, which
    is not the paper's but trains to tighter boxes.
    """
    image, place = (answers.label >= 0).nonzero(as_tuple=True)
    target = answers.target[image, place]
    share = (target[:, 2:] - target[:, :2]).prod(-1) / (answers.size[0] * answers.size[1])
    if box_loss == "squares":
        raw = answers.raw[image, place]
        part = (target[:, :2] + target[:, 2:]) / 2 / grid.stride[place, None] - grid.cell[place]
        size = ((target[:, 2:] - target[:, :2]) / grid.anchor[place]).log()
        box = 0.5 * (((raw[:, :2].sigmoid() - part) ** 2).sum(-1) + ((raw[:, 2:] - size) ** 2).sum(-1))
    else:
        box = 1 - ciou(answers.box[image, place], target)
    found = (answers.label >= 0).to(answers.objectness.dtype)
    counted = answers.label != -2
    every = cross_entropy(answers.objectness, found, reduction="none")
    parts = {
        "box": sums(box * (2 - share), image, len(found)),
        "obj": torch.where(counted, every, 0.0).sum(1),
        "cls": sums(_class_loss(answers, image, place).sum(-1), image, len(found)),
    }
    return parts if reduction == "image" else {name: part.mean() for name, part in parts.items()}


def losses_v5(answers: Answers, grid: Grid, *, reduction: Reduction) -> dict[str, Tensor]:
    """Means over places, summed over levels (the source multiplies by the size of the batch as well; this does not).

    box: 0.05 * (1 - CIoU) where an object is; obj: cross-entropy of objectness with CIoU as the target (no gradient),
    levels weighted 4, 1, 0.4, in all by the area over 640 x 640; cls: 0.5 * C / 80 * cross-entropy of the classes.
    """
    batch, levels = len(answers.label), len(grid.strides)
    image, place = (answers.label >= 0).nonzero(as_tuple=True)
    overlap = ciou(answers.box[image, place], answers.target[image, place])
    # the means at a level run over the batch's objects, or over the image's
    group = image * levels + grid.level[place]
    kind = _class_loss(answers, image, place).mean(-1)
    count = sums(torch.ones_like(overlap), group, batch * levels).view(batch, levels)
    box = sums(1 - overlap, group, batch * levels).view(batch, levels)
    cls = sums(kind, group, batch * levels).view(batch, levels)
    wanted = torch.zeros_like(answers.objectness)
    wanted[image, place] = overlap.detach().clamp(min=0)
    every = cross_entropy(answers.objectness, wanted, reduction="none")
    every = torch.where(answers.label != -2, every, 0.0)
    weight = torch.tensor(BALANCE[:levels], device=every.device, dtype=every.dtype)
    obj = torch.stack([every[:, part].mean(1) for part in _levels(grid)], -1) * weight
    if reduction == "batch":
        count, box, cls, obj = count.sum(0), box.sum(0), cls.sum(0), obj.mean(0)
    count = count.clamp(min=1)
    return {
        "box": 0.05 * (box / count).sum(-1),
        "obj": answers.size[0] * answers.size[1] / 640**2 * obj.sum(-1),
        "cls": 0.5 * answers.logit.shape[-1] / 80 * (cls / count).sum(-1),
    }


def _class_loss(answers: Answers, image: Tensor, place: Tensor) -> Tensor:
    """Cross-entropy [N, C] of the class logits at these places against their labels."""
    logit = answers.logit[image, place]
    classes = torch.arange(logit.shape[-1], device=logit.device)
    wanted = (answers.label[image, place][:, None] == classes).to(logit.dtype)
    return cross_entropy(logit, wanted, reduction="none")


def _levels(grid: Grid) -> list[slice]:
    """The places of each level."""
    return [slice(first, end) for first, end in pairwise((*grid.start, len(grid.stride)))]
