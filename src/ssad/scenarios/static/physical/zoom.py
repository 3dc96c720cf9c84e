"""The part of a picture around its target: all that a training step needs to show to a detector."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn import functional

from ssad.core.detections import Truth
from ssad.core.errors import ConfigError

STEP = 32  # px: sides of parts, the coarsest stride of detectors
ROOM = 1.25  # least side of a part, in longer sides of the target's box


def around_target(image: Tensor, truth: Truth, side: int, generator: torch.Generator) -> tuple[Tensor, Truth]:
    """A square part of a picture with its target somewhere in it.

    A target at the same number of pixels costs a detector as little as the part is smaller than the picture. Where a
    target is too large for the part, a larger one is reduced to its side.

    Args:
        image: [1, 3, H, W].
        truth: What is in it, the target first.
        side: Of the part, px.
        generator: Draws where in the part the target is.

    Returns:
        The part [1, 3, side, side], differentiable, and its truth: the target, and others whose middle lies in it.

    Raises:
        ConfigError: 3D truth, which belongs to the whole picture.
    """
    if truth.solid is not None:
        raise ConfigError("a part of a picture has no 3D truth; train on whole pictures")
    height, width = image.shape[2:]
    box = truth.box[0].tolist()
    least = max(side, math.ceil(ROOM * max(box[2] - box[0], box[3] - box[1])))
    own = min(least, height), min(least, width)
    share = torch.rand(2, generator=generator).tolist()
    corner = []
    for one, most, low, high, part in zip(own, (height, width), (box[1], box[0]), (box[3], box[2]), share, strict=True):
        first = max(math.ceil(high) - one, 0)  # the target ends inside
        last = max(min(math.floor(low), most - one), first)
        corner.append(min(first + round(part * (last - first)), most - one))
    top, left = corner
    cut = image[..., top : top + own[0], left : left + own[1]]
    if own != (side, side):
        cut = functional.interpolate(cut, size=(side, side), mode="bilinear", antialias=True, align_corners=False)
    scale = truth.box.new_tensor([side / own[1], side / own[0]] * 2)
    moved = (truth.box - truth.box.new_tensor([left, top] * 2)) * scale
    middle = 0.5 * (moved[:, :2] + moved[:, 2:])
    inside = ((middle > 0.0) & (middle < side)).all(1)
    inside[0] = True
    crowd = None if truth.crowd is None else truth.crowd[inside]
    return cut, Truth(truth.label[inside], moved[inside].clamp(0.0, float(side)), crowd=crowd)
