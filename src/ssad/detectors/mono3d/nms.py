"""Overlap of turned rectangles, and greedy suppression by it."""

from __future__ import annotations

import torch
from torch import Tensor

_UNIT = ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))
BLOCK = 64  # rectangles whose overlaps with all worse ones are found at once
PAIRS = 1 << 16  # pairs that are clipped at once


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
    """Area [N] of the intersection of rectangles a and b [N, 5] (sides not negative), in pairs.

    Green's theorem over the parts of the sides of each that lie in the other.
    """
    a, b = a.double(), b.double()
    middle = 0.5 * (a[:, :2] + b[:, :2])
    a = rectangle_corners(torch.cat([a[:, :2] - middle, a[:, 2:]], 1))
    b = rectangle_corners(torch.cat([b[:, :2] - middle, b[:, 2:]], 1))
    return (0.5 * (_inside(a, b, shared=True) + _inside(b, a, shared=False))).clamp_min(0.0)


def _inside(a: Tensor, b: Tensor, *, shared: bool) -> Tensor:
    """Twice the area [N] swept from the origin along those parts of the sides of a [N, 4, 2] that lie in b.

    shared: whether parts that run along a side of b, the same way, count.
    """
    along, side = a.roll(-1, 1) - a, b.roll(-1, 1) - b
    height = _cross(side[:, None], a[:, :, None] - b[:, None])  # [N, 4, 4]: of the starts of a's sides, over b's
    rise = _cross(side[:, None], along[:, :, None])
    unit = (along.abs().amax((1, 2)) * side.abs().amax((1, 2)))[:, None, None]
    level = rise.abs() <= 1e-12 * unit
    least = torch.full_like(rise, 1e-9) * unit
    if shared:
        least = torch.where((along[:, :, None] * side[:, None]).sum(-1) > 0, -least, least)
    at = -height / torch.where(level, torch.ones_like(rise), rise)
    first = torch.where(~level & (rise > 0), at, 0.0).amax(2).clamp_min(0.0)
    last = torch.where(~level & (rise < 0), at, 1.0).amin(2).clamp_max(1.0)
    part = (last - first).clamp_min(0.0) * (~level | (height > least)).all(2)
    return (part * _cross(a, along)).sum(1)


def rotated_iou(a: Tensor, b: Tensor) -> Tensor:
    """IoU [N] of rectangles a and b [N, 5], in pairs; 0 where both have no area."""
    common = intersection_area(a, b)
    both = (a[:, 2] * a[:, 3]).double() + (b[:, 2] * b[:, 3]).double()
    return common / (both - common).clamp_min(1e-12)


def rotated_nms(boxes: Tensor, score: Tensor, group: Tensor, *, threshold: float) -> Tensor:
    """Greedy suppression of rotated rectangles within groups; of two with the same score, the earlier one is better.

    Args:
        boxes: Rectangles [N, 5].
        score: [N].
        group: [N]; only rectangles of the same group suppress each other.
        threshold: One is dropped if its IoU with a better one that stays is at least this (above 0).

    Returns:
        Indices of those that stay, groups in ascending order and scores descending within each.
    """
    rank = score.argsort(descending=True, stable=True)
    rank = rank[group[rank].argsort(stable=True)]
    boxes, group = boxes[rank].double(), group[rank].contiguous()
    area, corner = boxes[:, 2] * boxes[:, 3], rectangle_corners(boxes)
    limits = torch.cat([corner.amin(1), corner.amax(1)], 1)
    alive = torch.ones(len(boxes), dtype=torch.bool, device=boxes.device)
    ends = torch.searchsorted(group, group, right=True)
    start = 0
    while start < len(boxes):
        rest = start + alive[start:].nonzero()[:, 0]
        rows = rest[:BLOCK]
        if not len(rows):
            break
        stop = int(rows[-1]) + 1
        columns = rest[: torch.searchsorted(rest, ends[stop - 1])]
        first, second = _candidates(rows, columns, limits, area, group, threshold)
        pairs = torch.stack([first, second])
        parts = [pairs[:, k : k + PAIRS] for k in range(0, max(len(first), 1), PAIRS)]
        over = torch.cat([rotated_iou(boxes[i], boxes[j]) >= threshold for i, j in parts])
        first, second = first[over], second[over]
        inside = second < stop
        _settle(alive, first[inside], second[inside])
        alive[second[alive[first]]] = False
        start = stop
    return rank[alive]


def _candidates(  # noqa: PLR0917
    rows: Tensor, columns: Tensor, limits: Tensor, area: Tensor, group: Tensor, threshold: float
) -> tuple[Tensor, Tensor]:
    """Pairs (better, worse) that may overlap enough: by their upright frames and their areas."""
    a, b = limits[rows][:, None], limits[columns]
    sides = (torch.minimum(a[..., 2:], b[:, 2:]) - torch.maximum(a[..., :2], b[:, :2])).clamp_min(0.0)
    most = torch.minimum(torch.minimum(sides[..., 0] * sides[..., 1], area[rows][:, None]), area[columns])
    # IoU is at most `most` / (both - most); a little slack for rounding
    enough = most * (1 + threshold) >= threshold * (area[rows][:, None] + area[columns]) * (1 - 1e-9)
    pair = enough & (group[rows][:, None] == group[columns]) & (rows[:, None] < columns)
    first, second = pair.nonzero(as_tuple=True)
    return rows[first], columns[second]


def _settle(alive: Tensor, first: Tensor, second: Tensor) -> None:
    """Suppress within pairs (better, worse): the one set in which each stays unless a better one that stays hits it."""
    start = alive.clone()
    while len(first):
        after = start.clone()
        after[second[alive[first]]] = False
        if torch.equal(after, alive):
            return
        alive.copy_(after)
