"""Average precision of 2D boxes as COCO computes it.

Equal to pycocotools 2.0 (COCOeval, one IoU threshold, all areas): greedy matching by score, crowd regions that take any
number of detections and count for nothing, 101-point interpolation of the precision envelope.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ssad.core.types import F64, I32, Bool
from ssad.metrics.detection_boxes import I64
from ssad.metrics.detection_match import assign, pairs_of

RECALL = np.linspace(0.0, 1.0, 101)


@dataclass(frozen=True)
class Boxes2D:
    """2D boxes of a set, one in each row.

    Attributes:
        image: Index of the image [N].
        label: Index of the class [N].
        box: x1, y1, x2, y2 in pixels [N, 4].
        score: [N]; None for ground truth.
        ignore: Crowd regions of the ground truth, in which detections count neither as right nor as wrong [N].
    """

    image: I32
    label: I32
    box: F64
    score: F64 | None = None
    ignore: Bool | None = None


@dataclass(frozen=True)
class Matched2D:
    """Detections from best to worst: label, hit (took a box), ignored (lies in a crowd region); truth [L].

    `row` is the place of each in the table that was matched; None where nobody asked.
    """

    label: I32
    hit: Bool
    ignored: Bool
    truth: I64
    row: I64 | None = None

    def average_precision(self) -> F64:
        """AP [L] of each label, NaN for one without ground truth."""
        result = np.full(len(self.truth), np.nan)
        for label, count in enumerate(self.truth.tolist()):
            if count:
                own = (self.label == label) & ~self.ignored
                result[label] = _interpolated(self.hit[own], count)
        return result


def match_2d(
    truth: Boxes2D, detections: Boxes2D, *, labels: int, threshold: float = 0.5, max_detections: int = 100
) -> Matched2D:
    """Match detections and ground truth of the same image and label whose IoU reaches the threshold.

    Args:
        truth: True boxes.
        detections: Detected boxes, with scores.
        labels: Number of labels.
        threshold: Least IoU of a match.
        max_detections: How many detections of an image and label are considered, best first.

    Raises:
        ValueError: The detections have no scores.
    """
    if detections.score is None:
        raise ValueError("detections need scores")
    crowd = np.zeros(len(truth.image), np.bool_) if truth.ignore is None else truth.ignore
    images = int(max(truth.image.max(initial=-1), detections.image.max(initial=-1))) + 1
    real_group = truth.label.astype(np.int64) * images + truth.image
    real = np.argsort(real_group, kind="stable")
    group = detections.label.astype(np.int64) * images + detections.image
    rank = _best(group, detections.score, max_detections)
    group, real_group, crowd = group[rank], real_group[real], crowd[real]

    start = np.searchsorted(real_group, group, side="left")
    count = np.searchsorted(real_group, group, side="right") - start
    found: list[tuple[I64, I64, F64]] = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))]
    for pred, box in pairs_of(count, start):
        overlap = _iou(detections.box[rank[pred]], truth.box[real[box]], crowd[box])
        near = np.flatnonzero(overlap >= min(threshold, 1.0 - 1e-10))
        found.append((pred[near], box[near], overlap[near]))
    pred, box, overlap = (np.concatenate([part[k] for part in found]) for k in range(3))
    ignored = np.bincount(pred[crowd[box]], minlength=len(rank)) > 0
    pred, box, overlap = pred[~crowd[box]], box[~crowd[box]], overlap[~crowd[box]]
    # of equal overlaps COCO takes the last
    order = np.lexsort((-box, -overlap, pred))
    ((took, _),) = assign(pred[order], box[order], -overlap[order], boxes=len(real), thresholds=(np.inf,))
    hit = np.zeros(len(rank), np.bool_)
    hit[took] = True
    counts = np.bincount(truth.label[real[~crowd]], minlength=labels)
    return Matched2D(detections.label[rank], hit, ignored & ~hit, counts, rank)


def average_precision(
    truth: Boxes2D, detections: Boxes2D, *, labels: int, threshold: float = 0.5, max_detections: int = 100
) -> F64:
    """AP [labels], NaN for a label without ground truth; their mean (np.nanmean) is COCO's AP at the threshold."""
    matched = match_2d(truth, detections, labels=labels, threshold=threshold, max_detections=max_detections)
    return matched.average_precision()


def _best(group: I64, score: F64, most: int) -> I64:
    """Rows from best to worst score (equal: by group, then as they stand), at most so many of a group."""
    order = np.lexsort((-score, group))
    ordered = group[order]
    place = np.arange(len(order)) - np.searchsorted(ordered, ordered, side="left")
    order = order[place < most]
    return order[np.argsort(-score[order], kind="stable")]


def _iou(box: F64, real: F64, crowd: Bool) -> F64:
    """IoU [K] of pairs, with COCO's arithmetic on x, y, width, height; over the detection's area for a crowd."""
    size, real_size = box[:, 2:] - box[:, :2], real[:, 2:] - real[:, :2]
    side = np.minimum(box[:, :2] + size, real[:, :2] + real_size) - np.maximum(box[:, :2], real[:, :2])
    area = size[:, 0] * size[:, 1]
    both = np.where((side > 0.0).all(axis=1), side[:, 0] * side[:, 1], 0.0)
    union = np.where(crowd, area, area + real_size[:, 0] * real_size[:, 1] - both)
    return np.divide(both, union, out=np.zeros_like(both), where=both > 0.0)


def _interpolated(hit: Bool, count: int) -> float:
    """AP of detections from best to worst, with `count` boxes to be found."""
    right = np.cumsum(hit, dtype=np.float64)
    recall = right / count
    precision = right / (np.arange(1, len(hit) + 1) + np.spacing(1))
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    at = np.searchsorted(recall, RECALL, side="left")
    return float(np.mean(np.append(envelope, 0.0)[np.minimum(at, len(hit))]))
