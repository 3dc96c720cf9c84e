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
    """Matched detections, from best to worst.

    Attributes:
        label: Index of the class [N].
        hit: Whether the detection took a true box [N].
        ignored: Whether it lies in a crowd region [N].
        truth: Number of true boxes of each label [L].
        row: Row of each detection in the matched table [N]; None if not recorded.
    """

    label: I32
    hit: Bool
    ignored: Bool
    truth: I64
    row: I64 | None = None

    def average_precision(self) -> F64:
        """AP [L] of each label, NaN for one without ground truth."""
        precisions = np.full(len(self.truth), np.nan)
        for label, count in enumerate(self.truth.tolist()):
            if count:
                is_counted = (self.label == label) & ~self.ignored
                precisions[label] = _interpolated(self.hit[is_counted], count)
        return precisions


def match_2d(
    truth: Boxes2D, detections: Boxes2D, *, labels: int, threshold: float = 0.5, max_detections: int = 100
) -> Matched2D:
    """Match detections and ground truth of the same image and label whose IoU reaches the threshold.

    Args:
        truth: True boxes.
        detections: Detected boxes, with scores.
        labels: Number of labels.
        threshold: Minimum IoU of a match.
        max_detections: Maximum number of detections of an image and label, best first.

    Raises:
        ValueError: The detections have no scores.
    """
    if detections.score is None:
        raise ValueError("detections need scores")
    is_crowd = np.zeros(len(truth.image), np.bool_) if truth.ignore is None else truth.ignore
    images = int(max(truth.image.max(initial=-1), detections.image.max(initial=-1))) + 1
    truth_group = truth.label.astype(np.int64) * images + truth.image
    truth_rows = np.argsort(truth_group, kind="stable")
    group = detections.label.astype(np.int64) * images + detections.image
    ranking = _best(group, detections.score, max_detections)
    group, truth_group, is_crowd = group[ranking], truth_group[truth_rows], is_crowd[truth_rows]

    start = np.searchsorted(truth_group, group, side="left")
    count = np.searchsorted(truth_group, group, side="right") - start
    near_pairs: list[tuple[I64, I64, F64]] = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))]
    for prediction_indices, box in pairs_of(count, start):
        overlap = _iou(detections.box[ranking[prediction_indices]], truth.box[truth_rows[box]], is_crowd[box])
        near_index = np.flatnonzero(overlap >= min(threshold, 1.0 - 1e-10))
        near_pairs.append((prediction_indices[near_index], box[near_index], overlap[near_index]))
    prediction_indices, box, overlap = (
        np.concatenate([pair_columns[column] for pair_columns in near_pairs]) for column in range(3)
    )
    # A crowd region may take any number of detections, so it needs no matching.
    is_ignored = np.bincount(prediction_indices[is_crowd[box]], minlength=len(ranking)) > 0
    prediction_indices, box, overlap = prediction_indices[~is_crowd[box]], box[~is_crowd[box]], overlap[~is_crowd[box]]
    # COCO resolves equal overlaps in favour of the last box
    pair_order = np.lexsort((-box, -overlap, prediction_indices))
    # Negative overlap as distance: the nearest box is the one of largest overlap.
    ((matched, _),) = assign(
        prediction_indices[pair_order],
        box[pair_order],
        -overlap[pair_order],
        boxes=len(truth_rows),
        thresholds=(np.inf,),
    )
    is_true_positive = np.zeros(len(ranking), np.bool_)
    is_true_positive[matched] = True
    counts = np.bincount(truth.label[truth_rows[~is_crowd]], minlength=labels)
    return Matched2D(detections.label[ranking], is_true_positive, is_ignored & ~is_true_positive, counts, ranking)


def average_precision(
    truth: Boxes2D, detections: Boxes2D, *, labels: int, threshold: float = 0.5, max_detections: int = 100
) -> F64:
    """Return AP [labels], NaN for a label without ground truth; np.nanmean of it is COCO's AP at the threshold."""
    matches = match_2d(truth, detections, labels=labels, threshold=threshold, max_detections=max_detections)
    return matches.average_precision()


def _best(group: I64, score: F64, limit: int) -> I64:
    """Rows from best to worst score (equal: by group, then as they stand), at most so many of a group."""
    by_group = np.lexsort((-score, group))
    ordered = group[by_group]
    place_in_group = np.arange(len(by_group)) - np.searchsorted(ordered, ordered, side="left")
    by_group = by_group[place_in_group < limit]
    return by_group[np.argsort(-score[by_group], kind="stable")]


def _iou(box: F64, truth_box: F64, is_crowd: Bool) -> F64:
    """IoU [K] of pairs, with COCO's arithmetic on x, y, width, height; over the detection's area for a crowd."""
    size, real_size = box[:, 2:] - box[:, :2], truth_box[:, 2:] - truth_box[:, :2]
    sides = np.minimum(box[:, :2] + size, truth_box[:, :2] + real_size) - np.maximum(box[:, :2], truth_box[:, :2])
    area = size[:, 0] * size[:, 1]
    intersection = np.where((sides > 0.0).all(axis=1), sides[:, 0] * sides[:, 1], 0.0)
    union = np.where(is_crowd, area, area + real_size[:, 0] * real_size[:, 1] - intersection)
    return np.divide(intersection, union, out=np.zeros_like(intersection), where=intersection > 0.0)


def _interpolated(is_true_positive: Bool, count: int) -> float:
    """AP of detections from best to worst, with `count` boxes to be found."""
    hit_count = np.cumsum(is_true_positive, dtype=np.float64)
    recall = hit_count / count
    precision = hit_count / (np.arange(1, len(is_true_positive) + 1) + np.spacing(1))
    # Precision is made monotonic: the best at this recall or above.
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    envelope_index = np.searchsorted(recall, RECALL, side="left")
    return float(np.mean(np.append(envelope, 0.0)[np.minimum(envelope_index, len(is_true_positive))]))
