"""Crops around the target of an image: all that a training step needs to show to a detector."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from ssad.core.detections import Truth
from ssad.core.errors import ConfigError

STEP = 32  # px: sides of crops are multiples of it, the coarsest stride of detectors
ROOM = 1.25  # minimum side of a crop, in longer sides of the target's box


def around_target(image: Tensor, truth: Truth, side: int, generator: torch.Generator) -> tuple[Tensor, Truth]:
    """Crop a square around the target of an image, with the target at a random position in it.

    A crop saves a detector as much time as it is smaller than the image, at the same number of pixels on the target.
    A target that is too large for the crop is cropped with a larger side and reduced to `side`.

    Args:
        image: [1, 3, H, W].
        truth: Ground truth of the image, the target first.
        side: Side of the crop, px.
        generator: Random generator of the target's position in the crop.

    Returns:
        The crop [1, 3, side, side], differentiable, and its truth: the target, and others whose centre lies in it.

    Raises:
        ConfigError: 3D truth, which belongs to the whole image.
    """
    if truth.solid is not None:
        raise ConfigError("a part of a picture has no 3D truth; train on whole pictures")
    height, width = image.shape[2:]
    box = truth.box[0].tolist()
    min_side = max(side, math.ceil(ROOM * max(box[2] - box[0], box[3] - box[1])))
    crop_size = min(min_side, height), min(min_side, width)
    position = torch.rand(2, generator=generator).tolist()
    crop_corner = []
    for crop_length, image_length, box_start, box_end, fraction in zip(
        crop_size, (height, width), (box[1], box[0]), (box[3], box[2]), position, strict=True
    ):
        earliest = max(math.ceil(box_end) - crop_length, 0)  # the end of the target lies in the crop
        latest = max(min(math.floor(box_start), image_length - crop_length), earliest)
        crop_corner.append(min(earliest + round(fraction * (latest - earliest)), image_length - crop_length))
    top, left = crop_corner
    crop = image[..., top : top + crop_size[0], left : left + crop_size[1]]
    if crop_size != (side, side):
        crop = functional.interpolate(crop, size=(side, side), mode="bilinear", antialias=True, align_corners=False)
    box_scale = truth.box.new_tensor([side / crop_size[1], side / crop_size[0]] * 2)
    crop_boxes = (truth.box - truth.box.new_tensor([left, top] * 2)) * box_scale
    centre = 0.5 * (crop_boxes[:, :2] + crop_boxes[:, 2:])
    is_inside = ((centre > 0.0) & (centre < side)).all(1)
    # The target stays first, even where its centre is outside the crop.
    is_inside[0] = True
    crowd = None if truth.crowd is None else truth.crowd[is_inside]
    return crop, Truth(truth.label[is_inside], crop_boxes[is_inside].clamp(0.0, float(side)), crowd=crowd)
