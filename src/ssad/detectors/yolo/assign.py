"""Target assignment: to the best anchor (YOLOv3), or to all anchors that fit and the neighbouring cells (YOLOv5).

Boxes are in pixels of the network's own input. Nothing here is differentiable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ssad.core.detections import Truth
from ssad.core.errors import ConfigError
from ssad.detectors.yolo.decode import Grid

IGNORE_IOU = 0.5
MAX_RATIO = 4.0
BACKGROUND, IGNORED = -1, -2


@dataclass(frozen=True, slots=True)
class Targets:
    """Objects of all images, filled up to Q: label [B, Q], box [B, Q, 4], real [B, Q] (not filling), crowd [B, Q]."""

    label: Tensor
    box: Tensor
    real: Tensor
    crowd: Tensor
    crowded: bool


def pad_truth(truth: Sequence[Truth], scale: Tensor, *, classes: int) -> Targets:
    """Truth of all images, padded to the same number of objects.

    Args:
        truth: Truth of each image.
        scale: Factor of the boxes [4]; the result has its device and dtype.
        classes: Number of classes.

    Raises:
        ConfigError: A label is out of range, a box is not finite or empty, or the shapes do not match.
    """
    labels, boxes, crowds = [], [], []
    for image, one in enumerate(truth):
        count = len(one.label)
        if one.box.shape != (count, 4) or (one.crowd is not None and one.crowd.shape != (count,)):
            raise ConfigError(f"truth of image {image}: label [Q], box [Q, 4] and crowd [Q] must go together")
        labels.append(one.label.to(scale.device, torch.int64))
        boxes.append(one.box.detach().to(scale.device, scale.dtype))
        crowd = one.crowd if one.crowd is not None else torch.zeros(count, dtype=torch.bool)
        crowds.append(crowd.to(scale.device, torch.bool))
    label, box, crowd, real = _padded(labels, boxes, crowds)
    wrong = (label < 0) | (label >= classes)
    wrong |= ~(box.isfinite().all(-1) & (box[..., 2:] > box[..., :2]).all(-1))
    if bool((wrong & real).any()):
        image, row = (int(index) for index in (wrong & real).nonzero()[0])
        raise ConfigError(
            f"truth of image {image}, object {row}: label {int(label[image, row])}, box {box[image, row].tolist()}; "
            f"labels go from 0 to {classes - 1}, boxes are finite x1 < x2, y1 < y2"
        )
    return Targets(label, box * scale, real, crowd, any(one.crowd is not None for one in truth))


def _padded(*columns: list[Tensor]) -> tuple[Tensor, ...]:
    """Each column, a tensor [Q, ...] an image, as one tensor [B, largest Q, ...] filled with zeros; and what is real.

    Few steps for all images: one for each image is what a GPU would wait for.
    """
    counts = torch.tensor([len(one) for one in columns[0]])
    real = torch.arange(int(counts.max())) < counts[:, None]
    place = real.view(-1).nonzero()[:, 0].to(columns[0][0].device, non_blocking=True)
    found = []
    for column in columns:
        rows = torch.cat(column)
        whole = rows.new_zeros(real.numel(), *rows.shape[1:])
        whole[place] = rows
        found.append(whole.view(*real.shape, *rows.shape[1:]))
    return (*found, real.to(place.device, non_blocking=True))


def match_best(targets: Targets, grid: Grid, places: int) -> Tensor:
    """Target assignment of YOLOv3: each object to the anchor of its shape, at the cell that contains its middle.

    Of all anchors it is the one with the largest IoU when the middles coincide. Of two objects at one place, the one
    with the better shape wins.

    Args:
        targets: Objects of all images.
        grid: Places of the pictures.
        places: Number of places P.

    Returns:
        Owner [B, P]: index of the object, -1 for none.
    """
    size, middle = _size_and_middle(targets.box)
    shape = _shape_iou(size, grid.anchors.flatten(0, 1))
    quality, best = shape.max(-1)
    count = grid.anchors.shape[1]
    level, anchor = best // count, best % count
    rows, columns, start, stride = _levels(grid)
    cell = (middle / stride[level][..., None]).floor().long()
    x = cell[..., 0].clamp(min=0).minimum(columns[level] - 1)
    y = cell[..., 1].clamp(min=0).minimum(rows[level] - 1)
    place = start[level] + (anchor * rows[level] + y) * columns[level] + x
    return _settle(targets, place[..., None], quality[..., None], targets.real[..., None], places)


def match_near(targets: Targets, grid: Grid, places: int) -> Tensor:
    """Target assignment of YOLOv5: each object to all anchors that fit, at its own cell and two neighbouring ones.

    An anchor fits if its width and height are within a factor of four of the object's. The cells are the one that
    contains the middle, the nearest one beside it, and the nearest one above or below it, as far as they are on the
    map. Of several objects at one place, the one closest to the anchor in shape wins.

    Args:
        targets: Objects of all images.
        grid: Places of the pictures.
        places: Number of places P.

    Returns:
        Owner [B, P]: index of the object, -1 for none.
    """
    size, middle = _size_and_middle(targets.box)
    ratio = size[:, :, None, None] / grid.anchors
    fits = torch.maximum(ratio, 1 / ratio).amax(-1) < MAX_RATIO  # [B, Q, L, A]
    quality = _shape_iou(size, grid.anchors.flatten(0, 1)).view_as(fits)
    rows, columns, start, stride = _levels(grid)
    last = torch.stack((columns, rows), -1) - 1
    at = middle[:, :, None] / stride[:, None]  # [B, Q, L, 2]
    cell = at.floor().long().clamp(min=0).minimum(last)
    part = at - cell
    step = (part > 0.5).long() - (part < 0.5).long()
    beside = cell + step
    inside = (step != 0) & (beside >= 0) & (beside <= last)
    x = torch.stack((cell[..., 0], beside[..., 0], cell[..., 0]), -1)  # [B, Q, L, 3]
    y = torch.stack((cell[..., 1], cell[..., 1], beside[..., 1]), -1)
    valid = torch.cat((torch.ones_like(inside[..., :1]), inside), -1)
    anchor = torch.arange(grid.anchors.shape[1], device=size.device)[:, None]
    wide, high = columns[:, None, None], rows[:, None, None]
    place = start[:, None, None] + (anchor * high + y[..., None, :]) * wide + x[..., None, :]  # [B, Q, L, A, 3]
    good = fits[..., None] & valid[..., None, :] & targets.real[:, :, None, None, None]
    return _settle(
        targets, place.flatten(2), quality[..., None].expand(place.shape).flatten(2), good.flatten(2), places
    )


def label_places(
    targets: Targets, owner: Tensor, predicted: Tensor, *, ignore_objects: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Labels and target boxes of all places.

    Places that belong to a crowd object are ignored, and so is background whose predicted box overlaps a crowd object
    by an IoU of more than 0.5.

    Args:
        targets: Objects of all images.
        owner: Index of the object that each place is assigned to [B, P], -1 for none.
        predicted: Predicted boxes [B, P, 4].
        ignore_objects: Whether background is ignored where its predicted box overlaps any object that much (YOLOv3).

    Returns:
        Label [B, P] (-1 background, -2 ignored), owner [B, P] and target box [B, P, 4] (zeros without an owner).
    """
    batch, places = owner.shape
    if targets.label.shape[1] == 0:
        nothing = predicted.new_zeros(batch, places, 4)
        return torch.full_like(owner, BACKGROUND), owner, nothing
    owned, index = owner >= 0, owner.clamp(min=0)
    label = torch.where(owned, targets.label.gather(1, index), BACKGROUND)
    label = torch.where(owned & targets.crowd.gather(1, index), IGNORED, label)
    if ignore_objects or targets.crowded:
        hiding = targets.real if ignore_objects else targets.real & targets.crowd
        first = hiding.long().argsort(dim=1, descending=True, stable=True)[:, : int(hiding.sum(1).max())]
        near = _touches(predicted, targets.box.gather(1, first[..., None].expand(-1, -1, 4)), hiding.gather(1, first))
        label = torch.where((label == BACKGROUND) & near, IGNORED, label)
    owner = torch.where(label >= 0, owner, -1)
    box = targets.box.gather(1, index[..., None].expand(-1, -1, 4))
    return label, owner, torch.where((label >= 0)[..., None], box, torch.zeros_like(box))


def _levels(grid: Grid) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Rows, columns, first place and stride of each level, [L] each."""
    device = grid.cell.device
    shape = torch.tensor(grid.shapes, device=device)
    stride = torch.tensor(grid.strides, device=device, dtype=grid.cell.dtype)
    return shape[:, 0], shape[:, 1], torch.tensor(grid.start, device=device), stride


def _size_and_middle(box: Tensor) -> tuple[Tensor, Tensor]:
    return box[..., 2:] - box[..., :2], (box[..., :2] + box[..., 2:]) / 2


def _shape_iou(size: Tensor, anchors: Tensor) -> Tensor:
    """IoU [..., A] of sizes [..., 2] and anchors [A, 2] with the same middle."""
    both = torch.minimum(size[..., None, :], anchors).prod(-1)
    return both / (size.prod(-1, keepdim=True) + anchors.prod(-1) - both).clamp(min=1e-9)


def _settle(targets: Targets, place: Tensor, quality: Tensor, good: Tensor, places: int) -> Tensor:
    """Owner [B, P] of each place from candidates [B, Q, K].

    At each place the best quality wins, then the first object; objects that count win over crowd objects. The result
    does not depend on the order of the batch or on the device.
    """
    batch = len(place)
    image, row, slot = good.nonzero(as_tuple=True)
    key = image * places + place[image, row, slot]
    value = quality[image, row, slot] - 2.0 * targets.crowd[image, row]
    # ranks are unique, so the largest rank at a place names its winner
    order = (-value).argsort(stable=True)
    rank = torch.empty_like(order)
    rank[order] = torch.arange(len(order), 0, -1, device=order.device)
    best = torch.zeros(batch * places, dtype=torch.int64, device=place.device)
    best.scatter_reduce_(0, key, rank, "amax")
    owner = torch.full_like(best, -1)
    won = best > 0
    owner[won] = row[order[len(order) - best[won]]]
    return owner.view(batch, places)


def _touches(predicted: Tensor, box: Tensor, hiding: Tensor) -> Tensor:
    """Whether a predicted box [B, P, 4] overlaps one of the objects [B, Q, 4] that hide [B, Q] by IoU > 0.5. [B, P]."""
    low = torch.maximum(predicted[:, :, None, :2], box[:, None, :, :2])
    high = torch.minimum(predicted[:, :, None, 2:], box[:, None, :, 2:])
    both = (high - low).clamp_(min=0).prod(-1)
    area = (predicted[..., 2:] - predicted[..., :2]).prod(-1)
    real = (box[..., 2:] - box[..., :2]).prod(-1)
    union = area[:, :, None] + real[:, None] - both
    return ((both > IGNORE_IOU * union) & hiding[:, None]).any(-1)
