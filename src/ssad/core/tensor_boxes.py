"""Boxes as tensors, with gradients: rectangles in the plane, rectangles in images, 3D boxes in a camera's frame.

NumPy's counterparts are `ssad.core.geometry.corners` and `ssad.core.boxes`. The order of the operations is part of
each function: attacks and trainings repeat to the bit.
"""

from __future__ import annotations

import torch
from torch import Tensor


def rotate(vectors: Tensor, angle: Tensor) -> Tensor:
    """Rotate vectors [..., 2] counter-clockwise by angles [...], rad."""
    cos, sin = torch.cos(angle), torch.sin(angle)
    x, y = vectors.unbind(-1)
    return torch.stack([cos * x - sin * y, sin * x + cos * y], -1)


def rectangle_corners(centre: Tensor, size: Tensor, yaw: Tensor) -> Tensor:
    """Return the corners [..., 4, 2] of rectangles: front left, rear left, rear right, front right.

    Args:
        centre: [..., 2].
        size: Length and width [..., 2].
        yaw: Heading [...], rad.
    """
    forward_offsets = 0.5 * size[..., :1] * size.new_tensor([1.0, -1.0, -1.0, 1.0])
    lateral_offsets = 0.5 * size[..., 1:] * size.new_tensor([1.0, 1.0, -1.0, -1.0])
    return rotate(torch.stack([forward_offsets, lateral_offsets], -1), yaw[..., None]) + centre[..., None, :]


def solid_corners(centre: Tensor, size_lhw: Tensor, yaw: Tensor) -> Tensor:
    """Return the corners [..., 8, 3] of boxes in a camera's frame, in the order of `ssad.core.boxes.UNIT_CORNERS`.

    Args:
        centre: Centre of gravity [..., 3].
        size_lhw: Length, height and width [..., 3].
        yaw: Rotation about the y axis [...], rad.
    """
    signs = torch.tensor(
        [[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)],
        dtype=size_lhw.dtype,
        device=size_lhw.device,
    )
    local_corners = signs * size_lhw[..., None, :]
    cos, sin = yaw.cos()[..., None], yaw.sin()[..., None]
    x = cos * local_corners[..., 0] + sin * local_corners[..., 2]
    z = -sin * local_corners[..., 0] + cos * local_corners[..., 2]
    return torch.stack([x, local_corners[..., 1], z], -1) + centre[..., None, :]


def area(box: Tensor) -> Tensor:
    """Return the areas [...] of boxes x1, y1, x2, y2 [..., 4]; 0 where a side is negative."""
    return (box[..., 2:] - box[..., :2]).clamp_min(0.0).prod(-1)


def intersection(first: Tensor, second: Tensor) -> Tensor:
    """Return the areas [...] that boxes [..., 4], broadcast against each other, have in common."""
    lower, upper = torch.maximum(first[..., :2], second[..., :2]), torch.minimum(first[..., 2:], second[..., 2:])
    return (upper - lower).clamp_min(0.0).prod(-1)


def iou(first: Tensor, second: Tensor, *, min_union: float = 1e-9) -> Tensor:
    """Return the intersection over union [...] of boxes [..., 4], broadcast against each other.

    Args:
        first: x1, y1, x2, y2.
        second: Boxes of the same kind.
        min_union: Lower bound of the union, which avoids 0 / 0 for boxes without an area.
    """
    overlap = intersection(first, second)
    return overlap / (area(first) + area(second) - overlap).clamp_min(min_union)
