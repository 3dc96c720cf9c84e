"""Target assignment: to the best anchor (YOLOv3), or to all fitting anchors and the neighbouring cells (YOLOv5).

Boxes are in pixels of the network's own input. Nothing here is differentiable.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ssad.core.detections import Truth
from ssad.core.errors import ConfigError
from ssad.core.tensor_boxes import intersection
from ssad.detectors.yolo.decode import CellGrid

IGNORE_IOU = 0.5
MAX_RATIO = 4.0
BACKGROUND, IGNORED = -1, -2


@dataclass(frozen=True, slots=True)
class Targets:
    """Objects of all images, padded to Q.

    Attributes:
        label: [B, Q].
        box: [B, Q, 4].
        real: [B, Q] Whether a row is an object, not padding.
        crowd: [B, Q] Whether an object is a crowd.
        crowded: Whether the truth distinguishes crowds at all.
    """

    label: Tensor
    box: Tensor
    real: Tensor
    crowd: Tensor
    crowded: bool


def pad_truth(truth: Sequence[Truth], scale: Tensor, *, classes: int) -> Targets:
    """Pad the truth of all images to the same number of objects.

    Args:
        truth: Truth of each image.
        scale: Factors of the boxes [4]; the result has its device and dtype.
        classes: Number of classes.

    Raises:
        ConfigError: A label is out of range, a box is not finite or empty, or the shapes do not match.
    """
    labels, boxes, crowds = [], [], []
    for image_index, image_truth in enumerate(truth):
        count = len(image_truth.label)
        if image_truth.box.shape != (count, 4) or (
            image_truth.crowd is not None and image_truth.crowd.shape != (count,)
        ):
            raise ConfigError(f"truth of image {image_index}: label [Q], box [Q, 4] and crowd [Q] must go together")
        labels.append(image_truth.label.to(scale.device, torch.int64))
        boxes.append(image_truth.box.detach().to(scale.device, scale.dtype))
        crowd = image_truth.crowd if image_truth.crowd is not None else torch.zeros(count, dtype=torch.bool)
        crowds.append(crowd.to(scale.device, torch.bool))
    label, box, crowd, real = _pad_columns(labels, boxes, crowds)
    is_invalid = (label < 0) | (label >= classes)
    is_invalid |= ~(box.isfinite().all(-1) & (box[..., 2:] > box[..., :2]).all(-1))
    if bool((is_invalid & real).any()):
        image_index, row = (int(index) for index in (is_invalid & real).nonzero()[0])
        raise ConfigError(
            f"truth of image {image_index}, object {row}: label {int(label[image_index, row])}, "
            f"box {box[image_index, row].tolist()}; "
            f"labels go from 0 to {classes - 1}, boxes are finite x1 < x2, y1 < y2"
        )
    return Targets(label, box * scale, real, crowd, any(image_truth.crowd is not None for image_truth in truth))


def _pad_columns(*columns: list[Tensor]) -> tuple[Tensor, ...]:
    """Pad each column, a tensor [Q, ...] per image, to [B, largest Q, ...]; return these and a mask of the real rows.

    Few steps for all images: one for each image is what a GPU would wait for.
    """
    counts = torch.tensor([len(image_values) for image_values in columns[0]])
    real = torch.arange(int(counts.max())) < counts[:, None]
    place = real.view(-1).nonzero()[:, 0].to(columns[0][0].device, non_blocking=True)
    padded_columns = []
    for column in columns:
        rows = torch.cat(column)
        padded = rows.new_zeros(real.numel(), *rows.shape[1:])
        padded[place] = rows
        padded_columns.append(padded.view(*real.shape, *rows.shape[1:]))
    return (*padded_columns, real.to(place.device, non_blocking=True))


def match_best(targets: Targets, grid: CellGrid, places: int) -> Tensor:
    """Assign each object to the anchor of its shape, at the cell that contains its centre (YOLOv3).

    Of all anchors, the one with the largest IoU at a common centre is taken. Of two objects at one place, the one
    with the better shape wins.

    Args:
        targets: Objects of all images.
        grid: Places of the images.
        places: Number of places P.

    Returns:
        Owner [B, P]: index of the object, -1 for none.
    """
    size, centre = _size_and_centre(targets.box)
    shape_overlap = _shape_iou(size, grid.anchors.flatten(0, 1))
    quality, best_anchor = shape_overlap.max(-1)
    anchor_count = grid.anchors.shape[1]
    level, anchor = best_anchor // anchor_count, best_anchor % anchor_count
    rows, columns, start, stride = _levels(grid)
    cell = (centre / stride[level][..., None]).floor().long()
    column = cell[..., 0].clamp(min=0).minimum(columns[level] - 1)
    row = cell[..., 1].clamp(min=0).minimum(rows[level] - 1)
    place = start[level] + (anchor * rows[level] + row) * columns[level] + column
    return _assign_owners(targets, place[..., None], quality[..., None], targets.real[..., None], places)


def match_near(targets: Targets, grid: CellGrid, places: int) -> Tensor:
    """Assign each object to all fitting anchors, at its own cell and two neighbouring ones (YOLOv5).

    An anchor fits if its width and height are within a factor of four of the object's. The cells are the one that
    contains the centre, the nearest one beside it, and the nearest one above or below it, as far as they are on
    the map. Of several objects at one place, the one closest to the anchor in shape wins.

    Args:
        targets: Objects of all images.
        grid: Places of the images.
        places: Number of places P.

    Returns:
        Owner [B, P]: index of the object, -1 for none.
    """
    size, centre = _size_and_centre(targets.box)
    # [B, Q, L, A, 2]: every object against every anchor of every level.
    ratio = size[:, :, None, None] / grid.anchors
    fits = torch.maximum(ratio, 1 / ratio).amax(-1) < MAX_RATIO  # [B, Q, L, A]
    quality = _shape_iou(size, grid.anchors.flatten(0, 1)).view_as(fits)
    rows, columns, start, stride = _levels(grid)
    last = torch.stack((columns, rows), -1) - 1
    cell_position = centre[:, :, None] / stride[:, None]  # [B, Q, L, 2]
    cell = cell_position.floor().long().clamp(min=0).minimum(last)
    fraction = cell_position - cell
    step = (fraction > 0.5).long() - (fraction < 0.5).long()
    neighbour = cell + step
    on_map = (step != 0) & (neighbour >= 0) & (neighbour <= last)
    x = torch.stack((cell[..., 0], neighbour[..., 0], cell[..., 0]), -1)  # [B, Q, L, 3]
    y = torch.stack((cell[..., 1], cell[..., 1], neighbour[..., 1]), -1)
    valid = torch.cat((torch.ones_like(on_map[..., :1]), on_map), -1)
    anchor = torch.arange(grid.anchors.shape[1], device=size.device)[:, None]
    map_columns, map_rows = columns[:, None, None], rows[:, None, None]
    place = (
        start[:, None, None] + (anchor * map_rows + y[..., None, :]) * map_columns + x[..., None, :]
    )  # [B, Q, L, A, 3]
    is_candidate = fits[..., None] & valid[..., None, :] & targets.real[:, :, None, None, None]
    return _assign_owners(
        targets, place.flatten(2), quality[..., None].expand(place.shape).flatten(2), is_candidate.flatten(2), places
    )


def label_places(
    targets: Targets, owner: Tensor, predicted: Tensor, *, ignore_objects: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Return labels and target boxes of all places.

    Places that belong to a crowd object are ignored, and so is background whose predicted box overlaps a crowd
    object by an IoU of more than 0.5.

    Args:
        targets: Objects of all images.
        owner: Index of the object that each place is assigned to [B, P], -1 for none.
        predicted: Predicted boxes [B, P, 4].
        ignore_objects: Whether background is ignored where its predicted box overlaps any object that much
            (YOLOv3).

    Returns:
        Label [B, P] (-1 background, -2 ignored), owner [B, P] and target box [B, P, 4] (zeros without an owner).
    """
    batch, places = owner.shape
    if targets.label.shape[1] == 0:
        no_boxes = predicted.new_zeros(batch, places, 4)
        return torch.full_like(owner, BACKGROUND), owner, no_boxes
    has_owner, index = owner >= 0, owner.clamp(min=0)
    label = torch.where(has_owner, targets.label.gather(1, index), BACKGROUND)
    label = torch.where(has_owner & targets.crowd.gather(1, index), IGNORED, label)
    if ignore_objects or targets.crowded:
        hides = targets.real if ignore_objects else targets.real & targets.crowd
        hiding_index = hides.long().argsort(dim=1, descending=True, stable=True)[:, : int(hides.sum(1).max())]
        is_hidden = _overlaps_hiding_object(
            predicted, targets.box.gather(1, hiding_index[..., None].expand(-1, -1, 4)), hides.gather(1, hiding_index)
        )
        label = torch.where((label == BACKGROUND) & is_hidden, IGNORED, label)
    owner = torch.where(label >= 0, owner, -1)
    box = targets.box.gather(1, index[..., None].expand(-1, -1, 4))
    return label, owner, torch.where((label >= 0)[..., None], box, torch.zeros_like(box))


def _levels(grid: CellGrid) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return rows, columns, first place and stride of each level, [L] each."""
    device = grid.cell.device
    shape = torch.tensor(grid.shapes, device=device)
    stride = torch.tensor(grid.strides, device=device, dtype=grid.cell.dtype)
    return shape[:, 0], shape[:, 1], torch.tensor(grid.start, device=device), stride


def _size_and_centre(box: Tensor) -> tuple[Tensor, Tensor]:
    return box[..., 2:] - box[..., :2], (box[..., :2] + box[..., 2:]) / 2


def _shape_iou(size: Tensor, anchors: Tensor) -> Tensor:
    """Return the IoU [..., A] of sizes [..., 2] and anchors [A, 2] about a common centre."""
    intersection = torch.minimum(size[..., None, :], anchors).prod(-1)
    return intersection / (size.prod(-1, keepdim=True) + anchors.prod(-1) - intersection).clamp(min=1e-9)


def _assign_owners(targets: Targets, place: Tensor, quality: Tensor, is_candidate: Tensor, places: int) -> Tensor:
    """Return the owner [B, P] of each place from candidates [B, Q, K].

    At each place the best quality wins, then the first object; objects that count win over crowd objects. The result
    does not depend on the order of the batch or on the device.
    """
    batch = len(place)
    image, row, slot = is_candidate.nonzero(as_tuple=True)
    place_key = image * places + place[image, row, slot]
    # Quality is an IoU of at most 1, so 2 puts every crowd object below all others.
    priority = quality[image, row, slot] - 2.0 * targets.crowd[image, row]
    # ranks are unique, so the largest rank at a place names its winner
    ranking = (-priority).argsort(stable=True)
    rank = torch.empty_like(ranking)
    rank[ranking] = torch.arange(len(ranking), 0, -1, device=ranking.device)
    best_rank = torch.zeros(batch * places, dtype=torch.int64, device=place.device)
    best_rank.scatter_reduce_(0, place_key, rank, "amax")
    owner = torch.full_like(best_rank, -1)
    is_owned = best_rank > 0
    owner[is_owned] = row[ranking[len(ranking) - best_rank[is_owned]]]
    return owner.view(batch, places)


def _overlaps_hiding_object(predicted: Tensor, box: Tensor, is_hiding: Tensor) -> Tensor:
    """Return a mask [B, P] of the predicted boxes [B, P, 4] with IoU > 0.5 with a hiding object [B, Q, 4]."""
    common = intersection(predicted[:, :, None], box[:, None])
    area = (predicted[..., 2:] - predicted[..., :2]).prod(-1)
    object_area = (box[..., 2:] - box[..., :2]).prod(-1)
    union = area[:, :, None] + object_area[:, None] - common
    return ((common > IGNORE_IOU * union) & is_hiding[:, None]).any(-1)
