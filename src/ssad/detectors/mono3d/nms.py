"""Overlap of rotated rectangles, and greedy suppression by it."""

from __future__ import annotations

import torch
from torch import Tensor

from ssad.core.tensor_boxes import intersection, rectangle_corners

BLOCK = 64  # rectangles compared with all worse ones at once
PAIRS = 1 << 16  # pairs intersected at once; bounds the memory


def _corners(boxes: Tensor) -> Tensor:
    """Return the corners [N, 4, 2], counter-clockwise, of rectangles x, y, dx, dy, angle [N, 5]."""
    # From the rear right: areas are sums over the sides, and their order decides the last bits.
    return rectangle_corners(boxes[:, :2], boxes[:, 2:4], boxes[:, 4]).roll(2, 1)


def _cross(a: Tensor, b: Tensor) -> Tensor:
    return a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]


def intersection_area(a: Tensor, b: Tensor) -> Tensor:
    """Return the area [N] of the intersection of pairs of rectangles a and b [N, 5] (sides not negative).

    Green's theorem over the parts of the sides of each that lie in the other.
    """
    a, b = a.double(), b.double()
    # Coordinates about the common centre: far from the origin, the areas would cancel.
    origin = 0.5 * (a[:, :2] + b[:, :2])
    a = _corners(torch.cat([a[:, :2] - origin, a[:, 2:]], 1))
    b = _corners(torch.cat([b[:, :2] - origin, b[:, 2:]], 1))
    return (0.5 * (_inside(a, b, shared=True) + _inside(b, a, shared=False))).clamp_min(0.0)


def _inside(a: Tensor, b: Tensor, *, shared: bool) -> Tensor:
    """Return twice the area [N] swept from the origin along the parts of the sides of a [N, 4, 2] that lie in b.

    shared: whether parts that run along a side of b, in the same direction, count.
    """
    along, side = a.roll(-1, 1) - a, b.roll(-1, 1) - b
    height = _cross(side[:, None], a[:, :, None] - b[:, None])  # [N, 4, 4]: of the starts of a's sides, over b's
    rise = _cross(side[:, None], along[:, :, None])
    unit_height = (along.abs().amax((1, 2)) * side.abs().amax((1, 2)))[:, None, None]
    is_parallel = rise.abs() <= 1e-12 * unit_height
    min_height = torch.full_like(rise, 1e-9) * unit_height
    if shared:
        min_height = torch.where((along[:, :, None] * side[:, None]).sum(-1) > 0, -min_height, min_height)
    crossing = -height / torch.where(is_parallel, torch.ones_like(rise), rise)
    entry = torch.where(~is_parallel & (rise > 0), crossing, 0.0).amax(2).clamp_min(0.0)
    leaving = torch.where(~is_parallel & (rise < 0), crossing, 1.0).amin(2).clamp_max(1.0)
    inside_share = (leaving - entry).clamp_min(0.0) * (~is_parallel | (height > min_height)).all(2)
    return (inside_share * _cross(a, along)).sum(1)


def rotated_iou(a: Tensor, b: Tensor) -> Tensor:
    """Return the IoU [N] of pairs of rectangles a and b [N, 5]; 0 where both have no area."""
    intersection = intersection_area(a, b)
    total_area = (a[:, 2] * a[:, 3]).double() + (b[:, 2] * b[:, 3]).double()
    return intersection / (total_area - intersection).clamp_min(1e-12)


def rotated_nms(boxes: Tensor, score: Tensor, group: Tensor, *, threshold: float) -> Tensor:
    """Suppress rotated rectangles greedily within groups; of equal scores, the earlier rectangle is better.

    Args:
        boxes: Rectangles [N, 5].
        score: [N].
        group: [N]; only rectangles of the same group suppress each other.
        threshold: IoU (above 0) with a better surviving rectangle from which a rectangle is dropped.

    Returns:
        Indices of the survivors, groups in ascending order and scores descending within each.
    """
    ranking = score.argsort(descending=True, stable=True)
    ranking = ranking[group[ranking].argsort(stable=True)]
    boxes, group = boxes[ranking].double(), group[ranking].contiguous()
    area, corner_points = boxes[:, 2] * boxes[:, 3], _corners(boxes)
    limits = torch.cat([corner_points.amin(1), corner_points.amax(1)], 1)
    alive = torch.ones(len(boxes), dtype=torch.bool, device=boxes.device)
    ends = torch.searchsorted(group, group, right=True)
    start = 0
    while start < len(boxes):
        # Rectangles dropped by earlier blocks need no further comparison.
        remaining = start + alive[start:].nonzero()[:, 0]
        rows = remaining[:BLOCK]
        if not len(rows):
            break
        stop = int(rows[-1]) + 1
        columns = remaining[: torch.searchsorted(remaining, ends[stop - 1])]
        better_rows, worse_rows = _candidates(rows, columns, limits, area, group, threshold)
        pairs = torch.stack([better_rows, worse_rows])
        parts = [pairs[:, start_pair : start_pair + PAIRS] for start_pair in range(0, max(len(better_rows), 1), PAIRS)]
        overlaps = torch.cat([rotated_iou(boxes[i], boxes[j]) >= threshold for i, j in parts])
        better_rows, worse_rows = better_rows[overlaps], worse_rows[overlaps]
        in_block = worse_rows < stop
        _suppress_pairs(alive, better_rows[in_block], worse_rows[in_block])
        alive[worse_rows[alive[better_rows]]] = False
        start = stop
    return ranking[alive]


def _candidates(  # noqa: PLR0917
    rows: Tensor, columns: Tensor, limits: Tensor, area: Tensor, group: Tensor, threshold: float
) -> tuple[Tensor, Tensor]:
    """Return pairs (better, worse) that may overlap enough, by their bounding boxes and areas."""
    row_limits, column_limits = limits[rows][:, None], limits[columns]
    common = intersection(row_limits, column_limits)
    max_intersection = torch.minimum(torch.minimum(common, area[rows][:, None]), area[columns])
    # IoU is at most intersection / (areas - intersection); a little slack for rounding
    may_overlap = max_intersection * (1 + threshold) >= threshold * (area[rows][:, None] + area[columns]) * (1 - 1e-9)
    is_pair = may_overlap & (group[rows][:, None] == group[columns]) & (rows[:, None] < columns)
    row_index, column_index = is_pair.nonzero(as_tuple=True)
    return rows[row_index], columns[column_index]


def _suppress_pairs(alive: Tensor, better_rows: Tensor, worse_rows: Tensor) -> None:
    """Suppress within pairs (better, worse): the one set in which each stays unless a better one that stays hits it."""
    start = alive.clone()
    while len(better_rows):
        after = start.clone()
        after[worse_rows[alive[better_rows]]] = False
        if torch.equal(after, alive):
            return
        alive.copy_(after)
