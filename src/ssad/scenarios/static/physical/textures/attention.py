"""Losses on the attention of a detector (DAS, TPA): Grad-CAM of its feature maps for the scores of the target.

Grad-CAM weights feature maps by how the target's score depends on them. The weights are constants of a step, as in
the sources; the loss moves the maps.
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
    above its mean; each part counts with its attention over the cells outside it, and the loss lowers their mean.
    The source takes the last feature map of a classifier. A detector reads each target from the level of its size, so
    the loss lowers the mean over the levels: the coarsest alone has no slope for a car of 60 px.

    Source: Wang et al., Dual Attention Suppression Attack (CVPR 2021), the distraction loss; the classifier's
    attention in the source is the detector's in this implementation.

    Attributes:
        window: Side of the window, in sides of the target's box.
        name: Name in records.
        needs_objects: Without a target there is no attention to lower.
    """

    window: float = 2.0
    name: str = "distraction"
    needs_objects: bool = True

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """Return the negative mean attention of the parts for each image."""
        maps = attention(dense, situation, dense.features)
        boxes = torch.stack(_target_boxes(situation)).to(maps[0])
        crops = torch.stack([_crop(level, boxes, dense.size, self.window) for level in maps])
        return -_mean_part_attention(crops.flatten(0, 1)).reshape(len(maps), -1).mean(0)


@dataclass(frozen=True, slots=True)
class Redistribution:
    """TPA: attention moved from the target to its surroundings, over all levels of the neck.

    Source: Zhang et al., Boosting transferability of physical attack against detectors by redistributing separable
    attention (Pattern Recognition 138, 2023). No code is public; in our reading, the loss lowers the mean attention
    on the target on each level and raises that around it, weighted by `beta`.

    Attributes:
        beta: Weight of the surroundings.
        name: Name in records.
        needs_objects: Without a target there is no attention to move.
    """

    beta: float = 0.5
    name: str = "redistribution"
    needs_objects: bool = True

    def __call__(self, dense: Dense, situation: Situation) -> Tensor:
        """Return the weighted attention around minus on the target, for each image."""
        boxes = _target_boxes(situation)
        total = torch.zeros(len(boxes), device=dense.logit.device, dtype=dense.logit.dtype)
        for level in attention(dense, situation, dense.features):
            target_mask = _box_mask(level, boxes, dense.size)
            target_attention = (level * target_mask).sum((1, 2)) / target_mask.sum((1, 2)).clamp_min(1.0)
            background_attention = (level * (1 - target_mask)).sum((1, 2)) / (1 - target_mask).sum((1, 2)).clamp_min(
                1.0
            )
            total = total - target_attention + self.beta * background_attention
        return total / len(dense.features)


def attention(dense: Dense, situation: Situation, features: tuple[Tensor, ...]) -> list[Tensor]:
    """Return the Grad-CAM maps [B, h, w] of feature maps for the scores of each image's target, 0 or more.

    The scores are the best of the target's locations on each level; a map that no score depends on is 0. A map is
    scaled so that its maximum would be 1 if the weights stayed and the maps did not move.

    Raises:
        ConfigError: The detector provides no features, or the score does not depend on them.
    """
    if not features:
        raise ConfigError(f"{situation.detector.name} shows no feature maps; choose a loss on its scores (hide)")
    is_target = situation.aim.places(situation.detector, situation.assignment)
    label = situation.assignment.label.clamp_min(0)
    score = log_scores(dense).gather(-1, label[..., None])[..., 0]
    total = score.sum() * 0.0
    for level_index in range(int(dense.level.max()) + 1):
        best_scores = torch.where(is_target & (dense.level == level_index), score, -torch.inf).amax(1)
        total = total + torch.where(best_scores.isfinite(), best_scores, 0.0).sum()
    gradients = torch.autograd.grad(total, features, retain_graph=True, allow_unused=True)
    maps = []
    for feature, gradient in zip(features, gradients, strict=True):
        if gradient is None:
            maps.append(feature.sum(1) * 0.0)
            continue
        weight = gradient.mean((2, 3), keepdim=True)
        attention_map = functional.relu((weight * feature).sum(1))
        maximum = attention_map.detach().amax((1, 2), keepdim=True)
        maps.append(attention_map / maximum.clamp_min(1e-12))
    if all(gradient is None for gradient in gradients):
        raise ConfigError(f"{situation.detector.name}: the scores do not depend on the feature maps that it shows")
    return maps


def _target_boxes(situation: Situation) -> list[Tensor]:
    """Return the box [4] that encloses the objects of the aim in each image."""
    target_boxes = []
    for truth in situation.assignment.truth:
        boxes = truth.box if situation.aim.objects is None else truth.box[list(situation.aim.objects)]
        target_boxes.append(torch.cat([boxes[:, :2].amin(0), boxes[:, 2:].amax(0)]))
    return target_boxes


def _box_mask(level: Tensor, boxes: list[Tensor], size: tuple[int, int]) -> Tensor:
    """Return 1 for the cells [B, h, w] of a map whose centre lies in the box, at least for one cell."""
    _, height, width = level.shape
    y = (torch.arange(height, device=level.device) + 0.5) * (size[0] / height)
    x = (torch.arange(width, device=level.device) + 0.5) * (size[1] / width)
    masks = []
    for image_box in boxes:
        box = image_box.to(level)
        centre = 0.5 * (box[:2] + box[2:])
        # At least half a cell, so that a box smaller than a cell still covers one.
        half_size = torch.maximum(0.5 * (box[2:] - box[:2]), 0.5 * box.new_tensor([size[1] / width, size[0] / height]))
        masks.append(((y - centre[1]).abs() <= half_size[1])[:, None] & ((x - centre[0]).abs() <= half_size[0])[None])
    return torch.stack(masks).to(level.dtype)


def _crop(level: Tensor, box: Tensor, size: tuple[int, int], window: float) -> Tensor:
    """Sample windows [B, 7, 7] of maps [B, h, w] around boxes [B, 4], bilinear; 0 outside the image."""
    centre, half_size = 0.5 * (box[:, :2] + box[:, 2:]), 0.5 * window * (box[:, 2:] - box[:, :2]).clamp_min(1.0)
    grid_steps = (torch.arange(GRID, device=level.device, dtype=level.dtype) + 0.5) * (2.0 / GRID) - 1.0
    grid = (centre[:, None] + half_size[:, None] * grid_steps[:, None]) * (
        2.0 / level.new_tensor([size[1], size[0]])
    ) - 1.0
    x, y = grid[:, None, :, 0].expand(-1, GRID, -1), grid[:, :, None, 1].expand(-1, -1, GRID)
    return functional.grid_sample(level[:, None], torch.stack([x, y], -1), align_corners=False)[:, 0]


def _mean_part_attention(maps: Tensor) -> Tensor:
    """Return the mean over the 4-connected parts of maps [M, 7, 7] of a part's attention over the cells outside it.

    A map without a part counts with its mean.
    """
    cell_values = maps.flatten(1)
    is_above_mean = maps.detach() > maps.detach().mean((1, 2), keepdim=True)
    labels = [
        cv2.connectedComponents(binary_map, connectivity=4)[1]
        for binary_map in is_above_mean.cpu().numpy().astype(np.uint8)
    ]
    part_label = torch.from_numpy(np.stack(labels).reshape(len(labels), -1).astype(np.int64)).to(maps.device)
    part_attention, part_cells = (
        torch.zeros_like(cell_values).scatter_add(1, part_label, addends)[:, 1:]
        for addends in (cell_values, torch.ones_like(cell_values))
    )
    part_count = (part_cells > 0).sum(1)
    return torch.where(
        part_count > 0,
        (part_attention / (GRID * GRID + 1 - part_cells)).sum(1) / part_count.clamp_min(1),
        cell_values.mean(1),
    )
