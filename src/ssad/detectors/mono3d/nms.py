"""Overlap of turned rectangles, and greedy suppression by it."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

_UNIT = ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))


def rectangle_corners(boxes: Tensor) -> Tensor:
    """Corners [N, 4, 2], counter-clockwise, of x, y, dx, dy, angle [N, 5]."""
    unit = torch.tensor(_UNIT, dtype=boxes.dtype, device=boxes.device)
    local = unit * boxes[:, None, 2:4]
    cos, sin = boxes[:, 4].cos()[:, None], boxes[:, 4].sin()[:, None]
    x = cos * local[..., 0] - sin * local[..., 1] + boxes[:, None, 0]
    y = sin * local[..., 0] + cos * local[..., 1] + boxes[:, None, 1]
    return torch.stack([x, y], -1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def intersection_area(a: Tensor, b: Tensor) -> Tensor:
    """Area [N] of the intersection of rectangles a and b [N, 5], in pairs.

    The corners of each inside the other and the crossings of their sides, in order round their middle.
    """
    a, b = a.double(), b.double()
    shift = 0.5 * (a[:, :2] + b[:, :2])
    a = torch.cat([a[:, :2] - shift, a[:, 2:]], 1)
    b = torch.cat([b[:, :2] - shift, b[:, 2:]], 1)
    pa, pb = rectangle_corners(a), rectangle_corners(b)
    ea, eb = pa.roll(-1, 1) - pa, pb.roll(-1, 1) - pb
    scale = torch.maximum(a[:, 2:4].amax(1), b[:, 2:4].amax(1)).clamp_min(1e-9)[:, None, None]
    slack = -1e-9 * scale**2
    inside_b = (_cross(eb[:, None, :], pa[:, :, None] - pb[:, None, :]) >= slack).all(2)
    inside_a = (_cross(ea[:, None, :], pb[:, :, None] - pa[:, None, :]) >= slack).all(2)
    between = pb[:, None, :] - pa[:, :, None]
    base = _cross(ea[:, :, None], eb[:, None, :])
    safe = torch.where(base.abs() < 1e-12 * scale**2, torch.ones_like(base), base)
    t = _cross(between, eb[:, None, :].expand_as(between)) / safe
    u = _cross(between, ea[:, :, None].expand_as(between)) / safe
    crossing = (base.abs() >= 1e-12 * scale**2) & (t >= 0) & (t <= 1) & (u >= 0) & (u <= 1)
    meet = pa[:, :, None] + t[..., None] * ea[:, :, None]
    points = torch.cat([pa, pb, meet.flatten(1, 2)], 1)
    valid = torch.cat([inside_b, inside_a, crossing.flatten(1)], 1)
    count = valid.sum(1)
    middle = (points * valid[..., None]).sum(1) / count.clamp_min(1)[:, None]
    away = points - middle[:, None]
    # those that do not count stand at the first one that does, and add nothing
    angle = torch.where(valid, torch.atan2(away[..., 1], away[..., 0]), 9.0)
    order = angle.argsort(1)
    ring = away.gather(1, order[..., None].expand_as(away))
    kept = valid.gather(1, order)
    ring = torch.where(kept[..., None], ring, ring[:, :1])
    area = 0.5 * _cross(ring, ring.roll(-1, 1)).sum(1)
    return torch.where(count >= 3, area.clamp_min(0.0), torch.zeros_like(area))


def rotated_iou(a: Tensor, b: Tensor) -> Tensor:
    """IoU [N] of rectangles a and b [N, 5], in pairs."""
    common = intersection_area(a, b)
    both = (a[:, 2] * a[:, 3]).double() + (b[:, 2] * b[:, 3]).double()
    return common / (both - common).clamp_min(1e-12)


def rotated_nms(boxes: Tensor, score: Tensor, group: Tensor, *, threshold: float) -> Tensor:
    """Indices of the rectangles [N, 5] that stay, groups in rising order and scores falling in each.

    Greedy within a group: one goes if its IoU with a better one that stays is at least the threshold.
    """
    rank = torch.from_numpy(np.lexsort((-score.detach().cpu().double().numpy(), group.cpu().numpy())))
    rank = rank.to(boxes.device)
    boxes, group = boxes[rank], group[rank]
    reach = 0.5 * torch.hypot(boxes[:, 2], boxes[:, 3])
    apart = torch.cdist(boxes[:, :2].double(), boxes[:, :2].double(), compute_mode="donot_use_mm_for_euclid_dist")
    near = (group[:, None] == group) & (apart <= (reach[:, None] + reach))
    first, second = near.triu(1).nonzero(as_tuple=True)
    over = rotated_iou(boxes[first], boxes[second]) >= threshold
    first, second = first[over].cpu(), second[over].cpu()
    keep = np.ones(len(boxes), bool)
    starts = np.searchsorted(first.numpy(), np.arange(len(boxes) + 1))
    for i in np.unique(first.numpy()).tolist():
        if keep[i]:
            keep[second[starts[i] : starts[i + 1]].numpy()] = False
    return rank[torch.from_numpy(keep).to(rank.device)]
