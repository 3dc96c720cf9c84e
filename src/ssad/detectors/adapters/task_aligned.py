"""Target assignment by task alignment (Feng et al. 2021, TOOD, section 3.2).

Boxes are in pixels of the network's own input. Nothing here is differentiable.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from ssad.detectors.adapters.common import labels_and_owners
from ssad.detectors.yolo.assign import Targets
from ssad.detectors.yolo.loss import ciou

TOP, ALPHA, BETA = 10, 0.5, 6.0  # published hyperparameters of YOLOv8


def assign_by_alignment(
    score: Tensor, box: Tensor, place: Tensor, targets: Targets, *, inside_first: bool = False
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Assign to each object the ten places inside it with the largest score^0.5 * CIoU^6.

    A place that several objects claim goes to the one that its box overlaps most. Places of crowd objects are ignored.

    Args:
        score: Scores of the classes [B, P, C].
        box: Predicted boxes [B, P, 4].
        place: Centres of the cells [P, 2].
        targets: Objects of all images.
        inside_first: Whether places inside an object come first where no box overlaps it, so that it has some; in the
            source, any ten of all places are the best then.

    Returns:
        Label [B, P] (-1 background, -2 ignored), owner [B, P] (-1 none), box of the owner [B, P, 4] (0 without one),
        and target score [B, P].
    """
    rows = [
        _assign_image(image_score, image_box, place, targets, index, inside_first=inside_first)
        for index, (image_score, image_box) in enumerate(zip(score, box, strict=True))
    ]
    label, owner, target_box, weight = (torch.stack(column) for column in zip(*rows, strict=True))
    return label, owner, target_box, weight


def _assign_image(
    score: Tensor, predicted: Tensor, place: Tensor, targets: Targets, image_index: int, *, inside_first: bool
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return label, owner, box and weight of the places of an image."""
    object_count = int(targets.real[image_index].sum())
    no_owner = torch.full(place.shape[:1], -1, dtype=torch.int64, device=place.device)
    if not object_count:
        return no_owner, no_owner, torch.zeros_like(predicted), torch.zeros_like(predicted[:, 0])
    box, object_labels, crowd = (
        targets.box[image_index, :object_count],
        targets.label[image_index, :object_count],
        targets.crowd[image_index, :object_count],
    )
    is_inside = torch.cat((place[:, None] - box[:, :2], box[:, 2:] - place[:, None]), -1).amin(-1) > 1e-9
    pair_shape = (len(place), object_count, 4)
    overlap = (
        ciou(predicted[:, None].expand(pair_shape).reshape(-1, 4), box.expand(pair_shape).reshape(-1, 4))
        .clamp(min=0)
        .view(len(place), object_count)
    )
    overlap = overlap * is_inside
    alignment = score[:, object_labels] ** ALPHA * overlap**BETA
    ranking = alignment.masked_fill(~is_inside, -1.0) if inside_first else alignment
    best_cells = ranking.topk(min(TOP, len(place)), 0).indices
    is_claimed = torch.zeros_like(is_inside).scatter_(0, best_cells, True) & is_inside
    claim_overlap = torch.where(is_claimed, overlap, -1.0)
    claim_overlap[is_claimed.sum(1) > 1] = overlap[is_claimed.sum(1) > 1]  # the most overlap of all, as the source does
    owner = torch.where(is_claimed.any(1), claim_overlap.argmax(1), -1)
    index = owner.clamp(min=0)
    is_owned = functional.one_hot(index, object_count).bool() & (owner >= 0)[:, None]
    owned_alignment = torch.where(is_owned, alignment, 0.0)
    # TOOD: the best place of an object gets its largest overlap as target score.
    normaliser = torch.where(is_owned, overlap, 0.0).amax(0) / (owned_alignment.amax(0) + 1e-9)
    weight = (owned_alignment * normaliser).amax(1)
    label, owner = labels_and_owners(owner, object_labels, crowd)
    is_object = label >= 0
    return label, owner, torch.where(is_object[:, None], box[index], 0.0), torch.where(is_object, weight, 0.0)
