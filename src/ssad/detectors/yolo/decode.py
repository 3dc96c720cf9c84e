"""From raw maps to boxes and back, and from scores to detections.

Here boxes are in pixels of the network's own input unless said otherwise. A place is a cell with one of its anchors;
places run over levels (finest first), anchors, rows, columns.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import torch
from torch import Tensor
from torchvision.ops import batched_nms

from ssad.core.detections import Detections

MAX_LOG_SIZE = math.log(1000.0)
MAX_CANDIDATES = 30_000


@dataclass(frozen=True, slots=True)
class Grid:
    """The places of a picture.

    Attributes:
        cell: Column and row [P, 2].
        anchor: Width and height in pixels [P, 2].
        stride: Of each place [P], pixels.
        level: Of each place [P].
        shapes: Rows and columns of each level.
        start: First place of each level.
        anchors: Width and height in pixels [L, A, 2].
        strides: Of each level, pixels.
    """

    cell: Tensor
    anchor: Tensor
    stride: Tensor
    level: Tensor
    shapes: tuple[tuple[int, int], ...]
    start: tuple[int, ...]
    anchors: Tensor
    strides: tuple[int, ...]


def make_grid(shapes: Sequence[tuple[int, int]], strides: Sequence[int], anchors: Tensor) -> Grid:
    """Places of maps with these rows and columns; anchors [L, A, 2] give device and dtype."""
    count = anchors.shape[1]
    device, dtype = anchors.device, anchors.dtype
    cells, sizes, start = [], [], [0]
    for (rows, columns), level in zip(shapes, anchors, strict=True):
        y = torch.arange(rows, device=device, dtype=dtype)[:, None].expand(rows, columns)
        x = torch.arange(columns, device=device, dtype=dtype).expand(rows, columns)
        cells.append(torch.stack((x, y), -1).reshape(1, -1, 2).expand(count, -1, 2).reshape(-1, 2))
        sizes.append(level[:, None].expand(-1, rows * columns, 2).reshape(-1, 2))
        start.append(start[-1] + count * rows * columns)
    many = torch.tensor([end - first for first, end in pairwise(start)], device=device)
    level = torch.arange(len(strides), device=device).repeat_interleave(many, output_size=start[-1])
    stride = torch.tensor(strides, device=device, dtype=dtype)[level]
    return Grid(
        torch.cat(cells), torch.cat(sizes), stride, level, tuple(shapes), tuple(start[:-1]), anchors, tuple(strides)
    )


def flatten(maps: Sequence[Tensor], anchors: int) -> Tensor:
    """Raw maps [B, A * K, h, w] as [B, P, K], in float32 at least."""
    parts = []
    for part in maps:
        full = part.float() if part.dtype in {torch.float16, torch.bfloat16} else part
        batch, channels, rows, columns = full.shape
        split = full.reshape(batch, anchors, channels // anchors, rows * columns)
        parts.append(split.transpose(2, 3).reshape(batch, anchors * rows * columns, channels // anchors))
    return torch.cat(parts, 1)


def to_corners(middle: Tensor, size: Tensor) -> Tensor:
    """Boxes [..., 4] x1, y1, x2, y2 from middle and size [..., 2]."""
    return torch.cat((middle - size / 2, middle + size / 2), -1)


def decode(rule: str, raw: Tensor, grid: Grid) -> Tensor:
    """Boxes [..., P, 4] from the first four raw numbers [..., P, 4].

    v3 (paper, section 2.1): middle (sigmoid(t) + cell) * stride, size anchor * exp(t), with t at most ln 1000.
    v5 (published formulas): middle (2 sigmoid(t) - 0.5 + cell) * stride, size anchor * (2 sigmoid(t))^2.
    """
    stride = grid.stride[:, None]
    if rule == "v3":
        middle = (raw[..., :2].sigmoid() + grid.cell) * stride
        return to_corners(middle, grid.anchor * raw[..., 2:].clamp(max=MAX_LOG_SIZE).exp())
    share = 2 * raw.sigmoid()
    return to_corners((share[..., :2] - 0.5 + grid.cell) * stride, grid.anchor * share[..., 2:] ** 2)


def select(
    score: Tensor, box: Tensor, *, threshold: float, iou: float, limit: int, size: tuple[int, int]
) -> list[Detections]:
    """Detections of each image, by suppression within each class.

    Candidates of all images are brought to the host at once, where suppression, a chain of small steps, runs.

    Args:
        score: Scores [B, P, C]; each class of each place above the threshold is a candidate, up to the 30,000 best of
            an image.
        box: Boxes [B, P, 4]; they are clipped to the picture.
        threshold: Scores must be above it.
        iou: IoU above which the worse of two boxes of a class is dropped.
        limit: Maximum number of detections.
        size: Height and width of the picture.

    Returns:
        The detections, best first.
    """
    # NaN is above nothing, so broken weights give no detections instead of boxes that are none
    usable = (score > threshold) & box.isfinite().all(-1, keepdim=True)
    image, place, label = usable.nonzero(as_tuple=True)
    values, boxes = score[image, place, label].cpu(), box[image, place].cpu()
    count = torch.bincount(image.cpu(), minlength=len(score)).tolist()
    chosen, first = [], 0
    label = label.cpu()
    for many in count:
        own = slice(first, first + many)
        rows = first + values[own].argsort(descending=True, stable=True)[:MAX_CANDIDATES]
        # float64: suppression by class shifts boxes far apart, and float32 would round them there
        if many > 1:
            rows = rows[batched_nms(boxes[rows].double(), values[rows].double(), label[rows], iou)]
        chosen.append(rows[:limit])
        first += many
    keep = torch.cat([torch.zeros(0, dtype=torch.int64), *chosen])
    height, width = size
    edge = torch.tensor([width, height, width, height], dtype=box.dtype)
    columns = values[keep], label[keep], boxes[keep].clamp(min=0).minimum(edge)
    parts = zip(*(torch.split(v.to(box.device), [len(rows) for rows in chosen]) for v in columns), strict=True)
    return [Detections(*part) for part in parts]
