"""Assignment of predictions to ground-truth boxes: the devkit's greedy matching, for all boxes at once.

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

PAIRS = 1 << 16  # pairs compared at once; bounds the memory


@dataclass(frozen=True)
class ClassMatches:
    """The predictions of a class from best to worst, and their matches.

    Attributes:
        sample: Sample of each [n].
        score: Score of each [n].
        hits: For each threshold, the ranks [T] of the matched ones, ascending.
        errors: Errors of the matches at the TP threshold [5, T], in the order of TP_METRICS (NaN: unknown).
        runs: For each prediction, the start [n] of its run of equal scores in one sample, and the length [n] of
            the run; None if there are no ties.
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
    class_rows = np.flatnonzero(predictions.label == label)
    ranking = class_rows[np.argsort(predictions.score[class_rows], kind="stable")[::-1]]
    truth_rows = np.flatnonzero(truth.label == label)
    truth_rows = truth_rows[np.argsort(truth.sample[truth_rows], kind="stable")]
    sample, score = predictions.sample[ranking], predictions.score[ranking]

    prediction_indices, box, distance = _near_pairs(
        sample,
        predictions.centre[ranking, :2],
        truth.sample[truth_rows],
        truth.centre[truth_rows, :2],
        samples=samples,
        limit=max(config.dist_ths),
    )
    pairs = assign(prediction_indices, box, distance, boxes=len(truth_rows), thresholds=config.dist_ths)
    for matched_ranks, matched_boxes in pairs:
        _check_sizes(truth, truth_rows[matched_boxes], predictions, ranking[matched_ranks], names)
    matched_ranks, matched_boxes = pairs[config.dist_ths.index(config.dist_th_tp)]
    name = config.classes[label]
    return ClassMatches(
        sample=sample,
        score=score,
        hits=tuple(matched_ranks for matched_ranks, _ in pairs),
        errors=_errors(
            truth.take(truth_rows[matched_boxes]),
            predictions.take(ranking[matched_ranks]),
            np.pi if name == "barrier" else 2 * np.pi,
        ),
        runs=_runs(sample, score),
    )


def _runs(sample: I32, score: F64) -> tuple[I64, I64] | None:
    """Return start and length [n] of the runs of equal sample and score."""
    is_tie = (sample[1:] == sample[:-1]) & (score[1:] == score[:-1])
    if not is_tie.any():
        return None
    run_start = np.flatnonzero(np.r_[True, ~is_tie])
    length = np.diff(np.r_[run_start, len(score)])
    return np.repeat(run_start, length), np.repeat(length, length)


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
    near_pairs: list[tuple[I64, I64, F64]] = [(np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros(0))]
    for prediction_indices, box in pairs_of(count, start):
        dx, dy = x[prediction_indices] - box_x[box], y[prediction_indices] - box_y[box]
        distance = np.sqrt(dx * dx + dy * dy)
        near_index = np.flatnonzero(distance < limit)
        near_pairs.append((prediction_indices[near_index], box[near_index], distance[near_index]))
    prediction_indices, box, distance = (
        np.concatenate([pair_columns[column] for pair_columns in near_pairs]) for column in range(3)
    )
    pair_order = np.lexsort((distance, prediction_indices))
    return prediction_indices[pair_order], box[pair_order], distance[pair_order]


def pairs_of(count: I64, start: I64) -> Iterator[tuple[I64, I64]]:
    """All pairs of prediction i with the boxes start[i] ... start[i] + count[i] - 1, about PAIRS of them at a time."""
    total = np.cumsum(count)
    chunk_start, pairs_done = 0, 0
    while chunk_start < len(count):
        chunk_end = max(int(np.searchsorted(total, pairs_done + PAIRS, side="right")), chunk_start + 1)
        chunk_counts = count[chunk_start:chunk_end]
        prediction_indices = np.repeat(np.arange(chunk_start, chunk_end), chunk_counts)
        yield (
            prediction_indices,
            np.arange(len(prediction_indices))
            + np.repeat(start[chunk_start:chunk_end] - (np.cumsum(chunk_counts) - chunk_counts), chunk_counts),
        )
        chunk_start, pairs_done = chunk_end, int(total[chunk_end - 1])


def assign(
    prediction_indices: I64, box: I64, distance: F64, *, boxes: int, thresholds: Sequence[float]
) -> list[tuple[I64, I64]]:
    """Return for each threshold the matched predictions, ascending, and their boxes.

    A proposer is a prediction at a threshold; its choices are the first ones of its pairs, up to the threshold.

    Args:
        prediction_indices: Prediction of each near pair [K], sorted as by `_near_pairs`.
        box: True box of each pair [K].
        distance: Distance of each pair [K], m.
        boxes: Number of true boxes.
        thresholds: Thresholds of a match, m.
    """
    threshold_count = len(thresholds)
    first_pair = (
        np.flatnonzero(np.r_[True, prediction_indices[1:] != prediction_indices[:-1]])
        if len(prediction_indices)
        else np.zeros(0, np.int64)
    )
    proposing_prediction = prediction_indices[first_pair]
    choice_end = np.stack(
        [
            np.add.reduceat(distance < threshold_index, first_pair) if len(first_pair) else first_pair
            for threshold_index in thresholds
        ],
        axis=1,
    )
    choice_end = (choice_end + first_pair[:, None]).ravel()  # proposer i * n + t
    choice = np.repeat(first_pair, threshold_count)
    no_proposer = len(choice_end)
    holders = np.full(boxes * threshold_count, no_proposer, np.int64)
    unmatched = np.flatnonzero(choice < choice_end)
    while len(unmatched):
        target = box[choice[unmatched]] * threshold_count + unmatched % threshold_count
        previous_holder = holders[target]
        # proposers are numbered by rank, so the least of them is the best
        np.minimum.at(holders, target, unmatched)
        new_holder = holders[target]
        is_accepted = new_holder == unmatched
        rejected_predictions = np.concatenate([unmatched[~is_accepted], previous_holder[is_accepted]])
        rejected_predictions = rejected_predictions[rejected_predictions < no_proposer]
        choice[rejected_predictions] += 1
        unmatched = rejected_predictions[choice[rejected_predictions] < choice_end[rejected_predictions]]
    matches = []
    for threshold_index in range(threshold_count):
        taken_boxes = np.flatnonzero(holders[threshold_index::threshold_count] < no_proposer)
        matched_predictions = proposing_prediction[
            holders[threshold_index::threshold_count][taken_boxes] // threshold_count
        ]
        by_prediction = np.argsort(matched_predictions)
        matches.append((matched_predictions[by_prediction], taken_boxes[by_prediction]))
    return matches


def _check_sizes(
    truth: BoxTable, truth_rows: I64, predictions: BoxTable, prediction_rows: I64, names: Sequence[str] | None
) -> None:
    """The devkit refuses a matched box one of whose sides is not positive."""
    for role_name, boxes, rows in (("prediction", predictions, prediction_rows), ("ground truth", truth, truth_rows)):
        # Negated, so that NaN counts as invalid too.
        is_flat: Bool = np.asarray(~(boxes.size_lwh[rows] > 0.0).all(axis=1))
        if is_flat.any():
            row = int(rows[is_flat.argmax()])
            sample = int(boxes.sample[row])
            raise FormatError(
                f"sample {sample if names is None else names[sample]}: a {role_name} box has the size "
                f"{boxes.size_wlh[row].tolist()}; all sides must be positive"
            )


def _errors(truth: BoxTable, detections: BoxTable, period: float) -> F64:
    """Errors [5, T] of matched pairs: translation m, 1 - IoU of the sizes, yaw rad, velocity m/s, attribute 0 or 1."""
    dx, dy = (detections.centre[:, :2] - truth.centre[:, :2]).T
    intersection = np.prod(np.minimum(truth.size_lwh, detections.size_lwh), axis=1)
    union = np.prod(truth.size_lwh, axis=1) + np.prod(detections.size_lwh, axis=1) - intersection
    yaw_difference = quaternion_to_yaw(truth.rotation) - quaternion_to_yaw(detections.rotation)
    # The period is pi for barriers, whose front and rear look alike.
    yaw_error = np.abs((yaw_difference + period / 2) % period - period / 2)
    vx, vy = (detections.velocity - truth.velocity).T
    attribute_error = np.where(truth.attribute < 0, np.nan, truth.attribute != detections.attribute)
    return np.stack(
        [np.sqrt(dx * dx + dy * dy), 1.0 - intersection / union, yaw_error, np.sqrt(vx * vx + vy * vy), attribute_error]
    )
