"""Training losses of FCOS3D and PGD-Det (mmdetection3d 1.4), over a batch or image by image."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import torch
from torch import Tensor
from torch.nn import functional

from ssad.core.detections import Assignment
from ssad.core.nuscenes_names import ALIKE, MMDET3D_CLASSES
from ssad.detectors.mono3d.config import Mono3DConfig
from ssad.detectors.mono3d.decode import Flat, Places, corners, global_yaw, hull, project, unproject, vectors_of_yaw

BETA = 1.0 / 9.0  # of smooth L1
_ALIKE = tuple(MMDET3D_CLASSES.index(name) for name in ALIKE)
Reduction = Literal["batch", "image"]
Fuse = Callable[[Tensor, Tensor, Tensor | None], Tensor]


def losses(
    config: Mono3DConfig,
    flat: Flat,
    places: Places,
    assignment: Assignment,
    lens: Tensor,
    *,
    factor: Tensor | None,
    fuse: Fuse,
    reduction: Reduction,
) -> dict[str, Tensor]:
    """Training losses; depth is compared as the head predicts it, before the factor.

    Args:
        config: The configuration of the detector.
        flat: Outputs of the head.
        places: Places of the pictures.
        assignment: From `ssad.detectors.mono3d.targets`.
        lens: Intrinsics of the network's input [B, 3, 3].
        factor: Factor of the depth [B] (see `Head.forward`).
        fuse: PGD's fusion of depth.
        reduction: "batch": over all images; "image": each image's own.

    Returns:
        cls, offset, depth, size, rotsin, velo, dir, attr, centerness, and for PGD bbox2d and consistency; where the yaw
        is told by vectors, axis and side in place of rotsin and dir.
    """
    label = assignment.label
    image, place = (label >= 0).nonzero(as_tuple=True)
    total = _Sum(image, len(label), reduction)
    target = assignment.extra["reg"][image, place].to(flat.reg.dtype)
    near = assignment.extra["centreness"][image, place].to(flat.reg.dtype)
    found = {"cls": total.classes(flat.logit, label)}
    reg = flat.reg[image, place]
    stride = places.stride[place]
    weights = reg.new_tensor(config.code_weights)
    unit = factor[image] if factor is not None else torch.ones_like(stride)

    def smooth(value: Tensor, wanted: Tensor, first: int) -> Tensor:
        each = functional.smooth_l1_loss(value, wanted, beta=BETA, reduction="none")
        return total.mean((each * weights[first : first + value.shape[1]]).sum(1))

    depth = reg[:, 2]
    bins = None if flat.bins is None else flat.bins[image, place]
    if bins is not None:
        depth = fuse(depth, bins, unit if factor is not None else None)
    found["offset"] = smooth(reg[:, :2] / stride[:, None], target[:, :2], 0)
    found["depth"] = smooth((depth / unit)[:, None], (target[:, 2] / unit)[:, None], 2)
    found["size"] = smooth(reg[:, 3:6], target[:, 3:6], 3)
    moved, known = target[:, 7:9], target[:, 7:9].isfinite()
    found["velo"] = smooth(torch.where(known, reg[:, 7:9], 0.0), torch.where(known, moved, 0.0), 7)
    true, direction = target[:, 6], flat.direction[image, place]
    if config.heading == "vectors":
        way, axis = torch.split(vectors_of_yaw(true), 2, 1)
        off = functional.smooth_l1_loss(direction[:, 2:], axis, beta=BETA, reduction="none")
        found["axis"] = total.mean(off.sum(1) * weights[6])
        told = (label[image, place][:, None] != label.new_tensor(_ALIKE)).all(1).to(reg.dtype)
        found["side"] = total.mean(functional.softplus(-2.0 * (direction[:, :2] * way).sum(1)) * told)
    else:
        said = reg[:, 6]
        found["rotsin"] = smooth((said.sin() * true.cos())[:, None], (said.cos() * true.sin())[:, None], 6)
        turned = true - config.dir_offset
        turned = turned - (turned / (2 * torch.pi)).floor() * 2 * torch.pi
        side = (turned / torch.pi).floor().long().clamp(0, 1)
        found["dir"] = total.mean(functional.cross_entropy(direction, side, reduction="none"))
    kind = functional.cross_entropy(
        flat.attribute[image, place], assignment.extra["attribute"][image, place], reduction="none"
    )
    found["attr"] = total.mean(kind * near, near)
    centre = functional.binary_cross_entropy_with_logits(flat.centreness[image, place], near, reduction="none")
    found["centerness"] = total.mean(centre)
    if config.pgd:
        found["bbox2d"] = smooth(reg[:, 9:] / stride[:, None], target[:, 9:], 9)
        bin_of = direction.argmax(-1) if config.heading == "bins" else None
        each = _consistency(
            config,
            places.xy[place],
            reg,
            depth=depth,
            direction=bin_of,
            target=target,
            stride=stride,
            lens=lens[image],
        )
        found["consistency"] = total.mean(each * weights[9:].mean())
    return found


def _consistency(
    config: Mono3DConfig,
    xy: Tensor,
    reg: Tensor,
    *,
    depth: Tensor,
    direction: Tensor | None,
    target: Tensor,
    stride: Tensor,
    lens: Tensor,
) -> Tensor:
    """1 - GIoU [M] of the 2D box with the hull of the projected corners of the 3D box.

    The 3D box is the predicted one, its centre unprojected with the predicted depth and then moved to the true depth
    along z, and its corners are projected even from behind the camera, as the source does.
    """
    if not len(reg):
        return reg.sum(1)
    centre2d = xy - reg[:, :2]
    centre = unproject(torch.cat([centre2d, depth[:, None]], 1), lens)
    centre = torch.cat([centre[:, :2], target[:, 2:3]], 1)
    # vectors have a loss that is smooth everywhere; the angle between them is steep where they are short
    local = reg[:, 6] if direction is not None else reg[:, 6].detach()
    yaw = global_yaw(local, direction, centre2d[:, 0], lens, offset=config.dir_offset)
    shown = hull(project(corners(centre, reg[:, 3:6], yaw), lens[:, None], near=None))
    return 1 - _generalised_iou(shown, torch.cat([xy - reg[:, 9:11], xy + reg[:, 11:13]], 1))


def _generalised_iou(a: Tensor, b: Tensor) -> Tensor:
    """GIoU [M] (Rezatofighi et al. 2019) of boxes [M, 4] in pairs."""
    common = (torch.minimum(a[:, 2:], b[:, 2:]) - torch.maximum(a[:, :2], b[:, :2])).clamp_min(0.0).prod(1)
    whole = (torch.maximum(a[:, 2:], b[:, 2:]) - torch.minimum(a[:, :2], b[:, :2])).clamp_min(0.0).prod(1)
    union = (a[:, 2:] - a[:, :2]).prod(1) + (b[:, 2:] - b[:, :2]).prod(1) - common
    union, whole = union.clamp_min(1e-6), whole.clamp_min(1e-6)
    return common / union - (whole - union) / whole


class _Sum:
    """Sums over positives `image` [M] of B images, normalised over the batch or in each image."""

    def __init__(self, image: Tensor, images: int, reduction: Reduction) -> None:
        self.image, self.images, self.whole = image, images, reduction == "batch"

    def total(self, values: Tensor) -> Tensor:
        """Sum of [M], over the batch or each image."""
        if self.whole:
            return values.sum()
        return values.new_zeros(self.images).index_add(0, self.image, values)

    def mean(self, values: Tensor, weight: Tensor | None = None) -> Tensor:
        """Sum of values over the sum of weights (default: how many); 0 without positives."""
        return self.total(values) / self.total(torch.ones_like(values) if weight is None else weight).clamp_min(1e-12)

    def classes(self, logit: Tensor, label: Tensor) -> Tensor:
        """Focal loss (gamma 2, alpha 0.25) over positives and images."""
        wanted = functional.one_hot((label + 1).clamp_min(0), logit.shape[-1] + 1)[..., 1:].to(logit.dtype)
        share = logit.sigmoid()
        wrong = wanted * (1 - share) + (1 - wanted) * share
        alpha = 0.25 * wanted + 0.75 * (1 - wanted)
        each = functional.binary_cross_entropy_with_logits(logit, wanted, reduction="none") * alpha * wrong**2
        each = (each * (label > -2)[..., None]).sum((1, 2))
        positives = torch.bincount(self.image, minlength=self.images)
        if self.whole:
            return each.sum() / (positives.sum() + self.images)
        return each / (positives + 1)
