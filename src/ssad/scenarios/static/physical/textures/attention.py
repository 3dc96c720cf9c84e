"""Losses on where a detector looks (DAS, TPA): attention of its feature maps for the scores of the target.

Attention is Grad-CAM's: feature maps weighted by how the target's score depends on them. The weights are constants of
a step, as in the sources; what is ascended moves the maps.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from ssad.core.detections import Dense
from ssad.core.errors import ConfigError
from ssad.scenarios.static.digital.objectives import Situation, log_scores

GRID = 7  # cells a side of the attention map in which DAS counts connected parts


@dataclass(frozen=True, slots=True)
class Distraction:
    """DAS: attention broken into small, weak, scattered parts.

    The attention for the target in a window around it, on a grid of 7 x 7, is cut into 4-connected parts where it is
    above its mean; each part counts with its attention over the cells that it leaves free, and their mean goes down.
    The source takes the last feature map of a classifier. A detector reads each target from the level of its size, so
    the mean over the levels goes down: the coarsest alone has no slope for a car of 60 px.

    Source: Wang et al., Dual Attention Suppression Attack (CVPR 2021), the distraction loss; the classifier's attention
    there is the detector's here.

    Attributes:
        window: Side of the window, in sides of the target's box.
        name: What records call it.
        needs_objects: There is nothing to look at without a target.
    """

    window: float = 2.0
    name: str = "distraction"
    needs_objects: bool = True

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """See `Objective`."""
        maps = attention(dense, situation, dense.features)
        boxes = torch.stack(_targets(situation)).to(maps[0])
        crops = torch.stack([_crop(level, boxes, dense.size, self.window) for level in maps])
        return -_parts(crops.flatten(0, 1)).reshape(len(maps), -1).mean(0)


@dataclass(frozen=True, slots=True)
class Redistribution:
    """TPA: attention away from the target and onto its surroundings, over all levels of the neck.

    Source: Zhang et al., Boosting transferability of physical attack against detectors by redistributing separable
    attention (Pattern Recognition 138, 2023). No code is public; this is our reading: on each level the mean attention
    on the target goes down and `beta` times that around it goes up.

    Attributes:
        beta: Weight of the surroundings.
        name: What records call it.
        needs_objects: There is nothing to look at without a target.
    """

    beta: float = 0.5
    name: str = "redistribution"
    needs_objects: bool = True

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """See `Objective`."""
        boxes = _targets(situation)
        total = torch.zeros(len(boxes), device=dense.logit.device, dtype=dense.logit.dtype)
        for level in attention(dense, situation, dense.features):
            inside = _inside(level, boxes, dense.size)
            on = (level * inside).sum((1, 2)) / inside.sum((1, 2)).clamp_min(1.0)
            off = (level * (1 - inside)).sum((1, 2)) / (1 - inside).sum((1, 2)).clamp_min(1.0)
            total = total - on + self.beta * off
        return total / len(dense.features)


def attention(dense: Dense, situation: Situation, features: tuple[Tensor, ...]) -> list[Tensor]:
    """Grad-CAM maps [B, h, w] of feature maps for the scores of each image's target, from 0 up.

    The scores are the best of the places that are the target's, on each level: a map of which no score is read is 0.

    A map is scaled so that its greatest value would be 1 if the weights stayed and the maps did not move.

    Raises:
        ConfigError: The detector shows no features, or the score does not depend on them.
    """
    if not features:
        raise ConfigError(f"{situation.detector.name} shows no feature maps; choose a loss on its scores (hide)")
    chosen = situation.aim.places(situation.detector, situation.assignment)
    label = situation.assignment.label.clamp_min(0)
    score = log_scores(dense).gather(-1, label[..., None])[..., 0]
    total = score.sum() * 0.0
    for number in range(int(dense.level.max()) + 1):
        best = torch.where(chosen & (dense.level == number), score, -torch.inf).amax(1)
        total = total + torch.where(best.isfinite(), best, 0.0).sum()
    slopes = torch.autograd.grad(total, features, retain_graph=True, allow_unused=True)
    found = []
    for feature, slope in zip(features, slopes, strict=True):
        if slope is None:
            found.append(feature.sum(1) * 0.0)
            continue
        weight = slope.mean((2, 3), keepdim=True)
        cam = functional.relu((weight * feature).sum(1))
        greatest = cam.detach().amax((1, 2), keepdim=True)
        found.append(cam / greatest.clamp_min(1e-12))
    if all(slope is None for slope in slopes):
        raise ConfigError(f"{situation.detector.name}: the scores do not depend on the feature maps that it shows")
    return found


def _targets(situation: Situation) -> list[Tensor]:
    """The box [4] that holds the objects of the aim in each image."""
    found = []
    for truth in situation.assignment.truth:
        boxes = truth.box if situation.aim.objects is None else truth.box[list(situation.aim.objects)]
        found.append(torch.cat([boxes[:, :2].amin(0), boxes[:, 2:].amax(0)]))
    return found


def _inside(level: Tensor, boxes: list[Tensor], size: tuple[int, int]) -> Tensor:
    """1 for the cells [B, h, w] of a map whose middle lies in the box; at least the cell of the box's middle."""
    _, height, width = level.shape
    y = (torch.arange(height, device=level.device) + 0.5) * (size[0] / height)
    x = (torch.arange(width, device=level.device) + 0.5) * (size[1] / width)
    masks = []
    for given in boxes:
        box = given.to(level)
        middle = 0.5 * (box[:2] + box[2:])
        half = torch.maximum(0.5 * (box[2:] - box[:2]), 0.5 * box.new_tensor([size[1] / width, size[0] / height]))
        masks.append(((y - middle[1]).abs() <= half[1])[:, None] & ((x - middle[0]).abs() <= half[0])[None])
    return torch.stack(masks).to(level.dtype)


def _crop(level: Tensor, box: Tensor, size: tuple[int, int], window: float) -> Tensor:
    """A window [B, 7, 7] of maps [B, h, w] around boxes [B, 4], bilinear; 0 outside the picture."""
    middle, half = 0.5 * (box[:, :2] + box[:, 2:]), 0.5 * window * (box[:, 2:] - box[:, :2]).clamp_min(1.0)
    steps = (torch.arange(GRID, device=level.device, dtype=level.dtype) + 0.5) * (2.0 / GRID) - 1.0
    places = (middle[:, None] + half[:, None] * steps[:, None]) * (2.0 / level.new_tensor([size[1], size[0]])) - 1.0
    x, y = places[:, None, :, 0].expand(-1, GRID, -1), places[:, :, None, 1].expand(-1, -1, GRID)
    return functional.grid_sample(level[:, None], torch.stack([x, y], -1), align_corners=False)[:, 0]


def _parts(local: Tensor) -> Tensor:
    """Mean over the 4-connected parts of maps [M, 7, 7] above their mean: a part's attention over the cells left free.

    A map without a part counts with its mean.
    """
    flat = local.flatten(1)
    above = local.detach() > local.detach().mean((1, 2), keepdim=True)
    labels = [cv2.connectedComponents(one, connectivity=4)[1] for one in above.cpu().numpy().astype(np.uint8)]
    label = torch.from_numpy(np.stack(labels).reshape(len(labels), -1).astype(np.int64)).to(local.device)
    attention, cells = (
        torch.zeros_like(flat).scatter_add(1, label, values)[:, 1:] for values in (flat, torch.ones_like(flat))
    )
    count = (cells > 0).sum(1)
    return torch.where(count > 0, (attention / (GRID * GRID + 1 - cells)).sum(1) / count.clamp_min(1), flat.mean(1))
