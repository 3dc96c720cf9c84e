"""Decoding of raw maps to boxes, and selection of detections from scores.

Boxes are in pixels of the network's own input unless stated otherwise. A place is a cell with one of its anchors;
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
class CellGrid:
    """The places of an image.

    Attributes:
        cell: Column and row [P, 2].
        anchor: Width and height in pixels [P, 2].
        stride: Stride of each place [P], pixels.
        level: Level of each place [P].
        shapes: Rows and columns of each level.
        start: First place of each level.
        anchors: Width and height in pixels [L, A, 2].
        strides: Stride of each level, pixels.
    """

    cell: Tensor
    anchor: Tensor
    stride: Tensor
    level: Tensor
    shapes: tuple[tuple[int, int], ...]
    start: tuple[int, ...]
    anchors: Tensor
    strides: tuple[int, ...]


def make_grid(shapes: Sequence[tuple[int, int]], strides: Sequence[int], anchors: Tensor) -> CellGrid:
    """Return the places of maps with these rows and columns; anchors [L, A, 2] give device and dtype."""
    count = anchors.shape[1]
    device, dtype = anchors.device, anchors.dtype
    cells, sizes, start = [], [], [0]
    for (rows, columns), level in zip(shapes, anchors, strict=True):
        y = torch.arange(rows, device=device, dtype=dtype)[:, None].expand(rows, columns)
        x = torch.arange(columns, device=device, dtype=dtype).expand(rows, columns)
        cells.append(torch.stack((x, y), -1).reshape(1, -1, 2).expand(count, -1, 2).reshape(-1, 2))
        sizes.append(level[:, None].expand(-1, rows * columns, 2).reshape(-1, 2))
        start.append(start[-1] + count * rows * columns)
    # output_size below spares a GPU from waiting for the counts.
    place_counts = torch.tensor([end - begin for begin, end in pairwise(start)], device=device)
    level = torch.arange(len(strides), device=device).repeat_interleave(place_counts, output_size=start[-1])
    stride = torch.tensor(strides, device=device, dtype=dtype)[level]
    return CellGrid(
        torch.cat(cells), torch.cat(sizes), stride, level, tuple(shapes), tuple(start[:-1]), anchors, tuple(strides)
    )


def flatten(maps: Sequence[Tensor], anchors: int) -> Tensor:
    """Flatten raw maps [B, A * K, h, w] to [B, P, K], in float32 at least."""
    rows_by_level = []
    for level_map in maps:
        float_map = level_map.float() if level_map.dtype in {torch.float16, torch.bfloat16} else level_map
        batch, channels, rows, columns = float_map.shape
        by_anchor = float_map.reshape(batch, anchors, channels // anchors, rows * columns)
        rows_by_level.append(by_anchor.transpose(2, 3).reshape(batch, anchors * rows * columns, channels // anchors))
    return torch.cat(rows_by_level, 1)


def to_corners(middle: Tensor, size: Tensor) -> Tensor:
    """Boxes [..., 4] x1, y1, x2, y2 from middle and size [..., 2]."""
    return torch.cat((middle - size / 2, middle + size / 2), -1)


def decode(rule: str, raw: Tensor, grid: CellGrid) -> Tensor:
    """Return boxes [..., P, 4] from the first four raw numbers [..., P, 4].

    v3 (paper, section 2.1): centre (sigmoid(t) + cell) * stride, size anchor * exp(t), with t at most ln 1000.
    v5 (published formulas): centre (2 sigmoid(t) - 0.5 + cell) * stride, size anchor * (2 sigmoid(t))^2.
    """
    stride = grid.stride[:, None]
    if rule == "v3":
        centre = (raw[..., :2].sigmoid() + grid.cell) * stride
        return to_corners(centre, grid.anchor * raw[..., 2:].clamp(max=MAX_LOG_SIZE).exp())
    doubled = 2 * raw.sigmoid()
    return to_corners((doubled[..., :2] - 0.5 + grid.cell) * stride, grid.anchor * doubled[..., 2:] ** 2)


def select(
    score: Tensor, box: Tensor, *, threshold: float, iou: float, limit: int, size: tuple[int, int]
) -> list[Detections]:
    """Return the detections of each image after suppression within each class.

    Candidates of all images are moved to the host at once, where suppression, a chain of small steps, runs.

    Args:
        score: Scores [B, P, C]; each class of each place above the threshold is a candidate, up to the 30,000
            best of an image.
        box: Boxes [B, P, 4]; they are clipped to the image.
        threshold: Scores must be above it.
        iou: IoU above which the worse of two boxes of a class is dropped.
        limit: Maximum number of detections.
        size: Height and width of the image.

    Returns:
        The detections, best first.
    """
    # NaN compares as false, so broken weights give no detections instead of invalid boxes
    usable = (score > threshold) & box.isfinite().all(-1, keepdim=True)
    image, place, label = usable.nonzero(as_tuple=True)
    values, boxes = score[image, place, label].cpu(), box[image, place].cpu()
    candidate_counts = torch.bincount(image.cpu(), minlength=len(score)).tolist()
    kept_rows, first_row = [], 0
    label = label.cpu()
    for candidate_count in candidate_counts:
        image_rows = slice(first_row, first_row + candidate_count)
        rows = first_row + values[image_rows].argsort(descending=True, stable=True)[:MAX_CANDIDATES]
        # float64: suppression by class shifts boxes far apart, and float32 would round them there
        if candidate_count > 1:
            rows = rows[batched_nms(boxes[rows].double(), values[rows].double(), label[rows], iou)]
        kept_rows.append(rows[:limit])
        first_row += candidate_count
    survivors = torch.cat([torch.zeros(0, dtype=torch.int64), *kept_rows])
    height, width = size
    limit_corner = torch.tensor([width, height, width, height], dtype=box.dtype)
    columns = values[survivors], label[survivors], boxes[survivors].clamp(min=0).minimum(limit_corner)
    columns_by_image = zip(
        *(torch.split(column.to(box.device), [len(rows) for rows in kept_rows]) for column in columns), strict=True
    )
    return [Detections(*image_columns) for image_columns in columns_by_image]
