"""Which prediction takes which ground-truth box: the devkit's greedy matching, for all boxes at once.

The devkit walks through the predictions of a class from the best score down (of equal scores the later first); each
takes the nearest ground-truth box of its sample that is still free and nearer than the threshold (of equal distances
the first). Only pairs nearer than the largest threshold matter. That is a stable matching in which all ground-truth
boxes rank the predictions alike, so deferred acceptance (Gale and Shapley 1962) finds the same, and it runs in rounds
over arrays: every free prediction proposes to its nearest box, every box keeps the best proposer.
Source: nuscenes-devkit 1.2.0, eval/detection/algo.py (`accumulate`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ssad.core.errors import FormatError
from ssad.core.rotations import quaternion_to_yaw
from ssad.core.types import F64, I32, Bool
from ssad.metrics.detection_boxes import I64, BoxTable, DetectionConfig

PAIRS = 1 << 16  # pairs looked at together: bounds the memory


@dataclass(frozen=True)
class ClassMatches:
    """The predictions of a class from best to worst, and which of them are matched.

    Attributes:
        sample: Sample of each [n].
        score: Score of each [n].
        hits: For each threshold, the ranks [T] of the matched ones, ascending.
        errors: Errors of the matches at the TP threshold [5, T], in the order of TP_METRICS (NaN: unknown).
        runs: For each prediction, where the run of equal scores of one sample that it belongs to begins [n], and the
            length of the run [n]; None if there are no ties.
    """

    sample: I32
    score: F64
    hits: tuple[I64, ...]
    errors: F64
    runs: tuple[I64, I64] | None


def match_class(
    truth: BoxTable,
    predictions: BoxTable,
    *,
    label: int,
    samples: int,
    config: DetectionConfig,
    names: Sequence[str] | None = None,
) -> ClassMatches:
    """Match the boxes of one class.

    Args:
        truth: True boxes.
        predictions: Predicted boxes.
        label: The class.
        samples: Number of samples.
        config: Settings of the task.
        names: Tokens of the samples, for messages.

    Raises:
        FormatError: A matched box has no size.
    """
    own = np.flatnonzero(predictions.label == label)
    rank = own[np.argsort(predictions.score[own], kind="stable")[::-1]]
    real = np.flatnonzero(truth.label == label)
    real = real[np.argsort(truth.sample[real], kind="stable")]
    sample, score = predictions.sample[rank], predictions.score[rank]

    pred, box, distance = _near_pairs(
        sample,
        predictions.centre[rank, :2],
        truth.sample[real],
        truth.centre[real, :2],
        samples=samples,
        limit=max(config.dist_ths),
    )
    pairs = assign(pred, box, distance, boxes=len(real), thresholds=config.dist_ths)
    for hit, taken in pairs:
        _check_sizes(truth, real[taken], predictions, rank[hit], names)
    hit, taken = pairs[config.dist_ths.index(config.dist_th_tp)]
    name = config.classes[label]
    return ClassMatches(
        sample=sample,
        score=score,
        hits=tuple(hit for hit, _ in pairs),
        errors=_errors(truth.take(real[taken]), predictions.take(rank[hit]), np.pi if name == "barrier" else 2 * np.pi),
        runs=_runs(sample, score),
    )


def _runs(sample: I32, score: F64) -> tuple[I64, I64] | None:
    """Begin and length [n] of the runs of equal sample and score."""
    same = (sample[1:] == sample[:-1]) & (score[1:] == score[:-1])
    if not same.any():
        return None
    head = np.flatnonzero(np.r_[True, ~same])
    length = np.diff(np.r_[head, len(score)])
    return np.repeat(head, length), np.repeat(length, length)


def _near_pairs(
    sample: I32, centre: F64, box_sample: I32, box_centre: F64, *, samples: int, limit: float
) -> tuple[I64, I64, F64]:
    """Prediction, box and distance of all pairs of a sample nearer than `limit`, by prediction, distance, box.

    sample [P], centre [P, 2]; box_sample [G] ascending, box_centre [G, 2].
    """
    counts = np.bincount(box_sample, minlength=samples)
    starts = np.cumsum(counts) - counts
    count, start = counts[sample], starts[sample]
    x, y = np.ascontiguousarray(centre[:, 0]), np.ascontiguousarray(centre[:, 1])
    box_x, box_y = np.ascontiguousarray(box_centre[:, 0]), np.ascontiguousarray(box_centre[:, 1])
    found: list[tuple[I64, I64, F64]] = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))]
    for pred, box in pairs_of(count, start):
        dx, dy = x[pred] - box_x[box], y[pred] - box_y[box]
        distance = np.sqrt(dx * dx + dy * dy)
        near = np.flatnonzero(distance < limit)
        found.append((pred[near], box[near], distance[near]))
    pred, box, distance = (np.concatenate([part[k] for part in found]) for k in range(3))
    order = np.lexsort((distance, pred))
    return pred[order], box[order], distance[order]


def pairs_of(count: I64, start: I64) -> Iterator[tuple[I64, I64]]:
    """All pairs of prediction i with the boxes start[i] ... start[i] + count[i] - 1, about PAIRS of them at a time."""
    total = np.cumsum(count)
    low, done = 0, 0
    while low < len(count):
        high = max(int(np.searchsorted(total, done + PAIRS, side="right")), low + 1)
        n = count[low:high]
        pred = np.repeat(np.arange(low, high), n)
        yield pred, np.arange(len(pred)) + np.repeat(start[low:high] - (np.cumsum(n) - n), n)
        low, done = high, int(total[high - 1])


def assign(pred: I64, box: I64, distance: F64, *, boxes: int, thresholds: Sequence[float]) -> list[tuple[I64, I64]]:
    """For each threshold the matched predictions, ascending, and the boxes that they take.

    A proposer is a prediction at a threshold; its choices are the first ones of its pairs, up to the threshold.

    Args:
        pred: Prediction of each near pair [K], sorted as `_near_pairs` gives them.
        box: True box of each pair [K].
        distance: Distance of each pair [K], m.
        boxes: Number of true boxes.
        thresholds: Thresholds of a match, m.
    """
    n = len(thresholds)
    head = np.flatnonzero(np.r_[True, pred[1:] != pred[:-1]]) if len(pred) else np.zeros(0, np.int64)
    who = pred[head]
    end = np.stack([np.add.reduceat(distance < t, head) if len(head) else head for t in thresholds], axis=1)
    end = (end + head[:, None]).ravel()  # proposer i * n + t
    choice = np.repeat(head, n)
    nobody = len(end)
    holder = np.full(boxes * n, nobody, np.int64)
    free = np.flatnonzero(choice < end)
    while len(free):
        target = box[choice[free]] * n + free % n
        before = holder[target]
        # proposers are numbered by rank, so the least of them is the best
        np.minimum.at(holder, target, free)
        after = holder[target]
        won = after == free
        lost = np.concatenate([free[~won], before[won]])
        lost = lost[lost < nobody]
        choice[lost] += 1
        free = lost[choice[lost] < end[lost]]
    result = []
    for t in range(n):
        taken = np.flatnonzero(holder[t::n] < nobody)
        hit = who[holder[t::n][taken] // n]
        order = np.argsort(hit)
        result.append((hit[order], taken[order]))
    return result


def _check_sizes(truth: BoxTable, real: I64, predictions: BoxTable, rank: I64, names: Sequence[str] | None) -> None:
    """The devkit refuses a matched box one of whose sides is not positive."""
    for what, boxes, rows in (("prediction", predictions, rank), ("ground truth", truth, real)):
        flat: Bool = np.asarray(~(boxes.size_lwh[rows] > 0.0).all(axis=1))
        if flat.any():
            row = int(rows[flat.argmax()])
            sample = int(boxes.sample[row])
            raise FormatError(
                f"sample {sample if names is None else names[sample]}: a {what} box has the size "
                f"{boxes.size_wlh[row].tolist()}; all sides must be positive"
            )


def _errors(truth: BoxTable, found: BoxTable, period: float) -> F64:
    """Errors [5, T] of matched pairs: translation m, 1 - IoU of the sizes, yaw rad, velocity m/s, attribute 0 or 1."""
    dx, dy = (found.centre[:, :2] - truth.centre[:, :2]).T
    shared = np.prod(np.minimum(truth.size_lwh, found.size_lwh), axis=1)
    union = np.prod(truth.size_lwh, axis=1) + np.prod(found.size_lwh, axis=1) - shared
    off = quaternion_to_yaw(truth.rotation) - quaternion_to_yaw(found.rotation)
    turn = np.abs((off + period / 2) % period - period / 2)
    vx, vy = (found.velocity - truth.velocity).T
    wrong = np.where(truth.attribute < 0, np.nan, truth.attribute != found.attribute)
    return np.stack([np.sqrt(dx * dx + dy * dy), 1.0 - shared / union, turn, np.sqrt(vx * vx + vy * vy), wrong])
