"""Training losses of FCOS3D and PGD-Det (mmdetection3d 1.4), over a batch or image by image."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from ssad.core.detections import Assignment
from ssad.core.nuscenes_names import ALIKE, MMDET3D_CLASSES
from ssad.core.tensor_boxes import intersection, solid_corners
from ssad.detectors.mono3d.config import Mono3DConfig
from ssad.detectors.mono3d.decode import FlatMaps, PlaceGrid, global_yaw, hull, project, unproject, vectors_of_yaw

BETA = 1.0 / 9.0  # of smooth L1
_ALIKE = tuple(MMDET3D_CLASSES.index(name) for name in ALIKE)
Reduction = Literal["batch", "image"]
Fuse = Callable[[Tensor, Tensor, Tensor | None], Tensor]


def losses(
    config: Mono3DConfig,
    flat_maps: FlatMaps,
    places: PlaceGrid,
    assignment: Assignment,
    intrinsic: Tensor,
    *,
    factor: Tensor | None,
    fuse: Fuse,
    reduction: Reduction,
) -> dict[str, Tensor]:
    """Return the training losses; depth is compared as the head predicts it, before the factor.

    Args:
        config: The configuration of the detector.
        flat_maps: Outputs of the head.
        places: Places of the pictures.
        assignment: From `ssad.detectors.mono3d.targets`.
        intrinsic: Intrinsics of the network's input [B, 3, 3].
        factor: Factor of the depth [B] (see `Head.forward`).
        fuse: PGD's fusion of depth.
        reduction: "batch": over all images; "image": each image's own.

    Returns:
        cls, offset, depth, size, rotsin, velo, dir, attr, centerness, and for PGD bbox2d and consistency; where the yaw
        is told by vectors, axis and side in place of rotsin and dir.
    """
    label = assignment.label
    image, place = (label >= 0).nonzero(as_tuple=True)
    total = _LossReducer(image, len(label), reduction)
    target = assignment.extra["reg"][image, place].to(flat_maps.reg.dtype)
    centreness = assignment.extra["centreness"][image, place].to(flat_maps.reg.dtype)
    loss_by_name = {"cls": total.classes(flat_maps.logit, label)}
    regression = flat_maps.reg[image, place]
    stride = places.stride[place]
    code_weights = regression.new_tensor(config.code_weights)
    depth_unit = factor[image] if factor is not None else torch.ones_like(stride)

    def smooth(value: Tensor, target_values: Tensor, first_code: int) -> Tensor:
        elements = functional.smooth_l1_loss(value, target_values, beta=BETA, reduction="none")
        return total.mean((elements * code_weights[first_code : first_code + value.shape[1]]).sum(1))

    depth = regression[:, 2]
    bins = None if flat_maps.bins is None else flat_maps.bins[image, place]
    if bins is not None:
        depth = fuse(depth, bins, depth_unit if factor is not None else None)
    loss_by_name["offset"] = smooth(regression[:, :2] / stride[:, None], target[:, :2], 0)
    loss_by_name["depth"] = smooth((depth / depth_unit)[:, None], (target[:, 2] / depth_unit)[:, None], 2)
    loss_by_name["size"] = smooth(regression[:, 3:6], target[:, 3:6], 3)
    velocity, is_known = target[:, 7:9], target[:, 7:9].isfinite()
    loss_by_name["velo"] = smooth(
        torch.where(is_known, regression[:, 7:9], 0.0), torch.where(is_known, velocity, 0.0), 7
    )
    true_yaw, direction = target[:, 6], flat_maps.direction[image, place]
    if config.heading == "vectors":
        front_vector, axis = torch.split(vectors_of_yaw(true_yaw), 2, 1)
        axis_loss = functional.smooth_l1_loss(direction[:, 2:], axis, beta=BETA, reduction="none")
        loss_by_name["axis"] = total.mean(axis_loss.sum(1) * code_weights[6])
        # Objects that look alike from both ends have an axis, but no front to learn.
        has_front = (label[image, place][:, None] != label.new_tensor(_ALIKE)).all(1).to(regression.dtype)
        loss_by_name["side"] = total.mean(
            functional.softplus(-2.0 * (direction[:, :2] * front_vector).sum(1)) * has_front
        )
    else:
        predicted_yaw = regression[:, 6]
        # The difference of the two is the sine of the angle between the yaws; the bin decides the half-turn.
        loss_by_name["rotsin"] = smooth(
            (predicted_yaw.sin() * true_yaw.cos())[:, None], (predicted_yaw.cos() * true_yaw.sin())[:, None], 6
        )
        wrapped = true_yaw - config.dir_offset
        wrapped = wrapped - (wrapped / (2 * torch.pi)).floor() * 2 * torch.pi
        direction_bin = (wrapped / torch.pi).floor().long().clamp(0, 1)
        loss_by_name["dir"] = total.mean(functional.cross_entropy(direction, direction_bin, reduction="none"))
    attribute_loss = functional.cross_entropy(
        flat_maps.attribute[image, place], assignment.extra["attribute"][image, place], reduction="none"
    )
    loss_by_name["attr"] = total.mean(attribute_loss * centreness, centreness)
    centreness_loss = functional.binary_cross_entropy_with_logits(
        flat_maps.centreness[image, place], centreness, reduction="none"
    )
    loss_by_name["centerness"] = total.mean(centreness_loss)
    if config.pgd:
        loss_by_name["bbox2d"] = smooth(regression[:, 9:] / stride[:, None], target[:, 9:], 9)
        predicted_bin = direction.argmax(-1) if config.heading == "bins" else None
        box_consistency = _consistency(
            config,
            places.xy[place],
            regression,
            depth=depth,
            direction=predicted_bin,
            target=target,
            stride=stride,
            intrinsic=intrinsic[image],
        )
        loss_by_name["consistency"] = total.mean(box_consistency * code_weights[9:].mean())
    return loss_by_name


def _consistency(
    config: Mono3DConfig,
    xy: Tensor,
    reg: Tensor,
    *,
    depth: Tensor,
    direction: Tensor | None,
    target: Tensor,
    stride: Tensor,
    intrinsic: Tensor,
) -> Tensor:
    """Return 1 - GIoU [M] of the 2D box with the hull of the projected corners of the 3D box.

    The 3D box is the predicted one, its centre unprojected with the predicted depth and then moved to the true depth
    along z, and its corners are projected even from behind the camera, as the source does.
    """
    if not len(reg):
        return reg.sum(1)
    centre2d = xy - reg[:, :2]
    centre = unproject(torch.cat([centre2d, depth[:, None]], 1), intrinsic)
    centre = torch.cat([centre[:, :2], target[:, 2:3]], 1)
    # vectors have a loss that is smooth everywhere; the angle between them is steep where they are short
    local = reg[:, 6] if direction is not None else reg[:, 6].detach()
    yaw = global_yaw(local, direction, centre2d[:, 0], intrinsic, offset=config.dir_offset)
    projected_box = hull(project(solid_corners(centre, reg[:, 3:6], yaw), intrinsic[:, None], near=None))
    return 1 - _generalised_iou(projected_box, torch.cat([xy - reg[:, 9:11], xy + reg[:, 11:13]], 1))


def _generalised_iou(a: Tensor, b: Tensor) -> Tensor:
    """Return the Return the GIoU [M] (Rezatofighi et al. 2019) of boxes [M, 4] in pairs."""
    common = intersection(a, b)
    enclosing = (torch.maximum(a[:, 2:], b[:, 2:]) - torch.minimum(a[:, :2], b[:, :2])).clamp_min(0.0).prod(1)
    union = (a[:, 2:] - a[:, :2]).prod(1) + (b[:, 2:] - b[:, :2]).prod(1) - common
    union, enclosing = union.clamp_min(1e-6), enclosing.clamp_min(1e-6)
    return common / union - (enclosing - union) / enclosing


class _LossReducer:
    """Reduces losses of the positives [M] of B images, over the batch or for each image."""

    def __init__(self, image: Tensor, images: int, reduction: Reduction) -> None:
        self.image, self.images, self.is_batch = image, images, reduction == "batch"

    def total(self, values: Tensor) -> Tensor:
        """Sum values [M] over the batch or over each image."""
        if self.is_batch:
            return values.sum()
        return values.new_zeros(self.images).index_add(0, self.image, values)

    def mean(self, values: Tensor, weight: Tensor | None = None) -> Tensor:
        """Divide the sum of values by the sum of weights (default: the number of values); 0 without positives."""
        return self.total(values) / self.total(torch.ones_like(values) if weight is None else weight).clamp_min(1e-12)

    def classes(self, logit: Tensor, label: Tensor) -> Tensor:
        """Return the focal loss (gamma 2, alpha 0.25) over positives and images."""
        target = functional.one_hot((label + 1).clamp_min(0), logit.shape[-1] + 1)[..., 1:].to(logit.dtype)
        probability = logit.sigmoid()
        error = target * (1 - probability) + (1 - target) * probability
        alpha = 0.25 * target + 0.75 * (1 - target)
        focal_loss = functional.binary_cross_entropy_with_logits(logit, target, reduction="none") * alpha * error**2
        # Ignored places (-2) were clamped to background above.
        focal_loss = (focal_loss * (label > -2)[..., None]).sum((1, 2))
        positives = torch.bincount(self.image, minlength=self.images)
        if self.is_batch:
            return focal_loss.sum() / (positives.sum() + self.images)
        return focal_loss / (positives + 1)
