"""Scores of 2D boxes on photographs: recall, precision, AP50 and score margin, by class and by height of the object."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from ssad.core.seeding import generator
from ssad.core.types import F64, I32, Bool
from ssad.metrics.detection2d import Boxes2D, Matched2D, match_2d
from ssad.metrics.detection_boxes import I64
from ssad.metrics.uncertainty import Estimate, replicate_estimate

MEASURES: Final = ("recall", "precision", "AP50", "margin")
DIGITS: Final = 6


@dataclass(frozen=True, slots=True)
class HeightBand:
    """Objects of a range of heights in the image.

    Attributes:
        low: Least height, pixels.
        high: Height that is no longer in the range, pixels.
    """

    low: float
    high: float = np.inf

    @property
    def title(self) -> str:
        """Range in words."""
        return f"{self.low:g} px and more" if np.isinf(self.high) else f"{self.low:g} to {self.high:g} px"

    def holds(self, box: F64) -> Bool:
        """Return which boxes [N, 4] have such a height [N]."""
        height = box[:, 3] - box[:, 1]
        return np.asarray((height >= self.low) & (height < self.high))


@dataclass(frozen=True, slots=True)
class BoxCounts:
    """Counts and scores of some photographs, sufficient for all measures under any weights of the photographs.

    Attributes:
        matched: Detections from best to worst.
        score: Their scores [N].
        image: Their photographs [N].
        truth: True boxes by class and photograph [L, I].
        threshold: Score from which on a box counts.
    """

    matched: Matched2D
    score: F64
    image: I64
    truth: I64
    threshold: float

    def measures(self, weights: I64) -> dict[str, float]:
        """Return `MEASURES`, with each photograph counted as often as its weight [I]; NaN where one is undefined."""
        repetitions = weights[self.image]
        is_found = self.matched.hit
        is_counted = (self.score >= self.threshold) & ~self.matched.ignored
        truth = float((self.truth @ weights).sum())
        hit_count, boxes = (
            float(repetitions[row_indices].sum()) for row_indices in (is_found & is_counted, is_counted)
        )
        total_score = float((self.score * repetitions)[is_found].sum())
        row_indices = np.repeat(np.arange(len(repetitions)), repetitions)
        resampled = Matched2D(
            self.matched.label[row_indices],
            self.matched.hit[row_indices],
            self.matched.ignored[row_indices],
            self.truth @ weights,
        )
        precisions = resampled.average_precision()
        return {
            "recall": hit_count / truth if truth else np.nan,
            "precision": hit_count / boxes if boxes else np.nan,
            "AP50": float(np.nanmean(precisions)) if np.isfinite(precisions).any() else np.nan,
            "margin": total_score / truth - self.threshold if truth else np.nan,
        }

    def of_label(self, label: int) -> BoxCounts:
        """Return the counts of one class alone."""
        row_indices = self.matched.label == label
        truth = np.zeros_like(self.truth)
        truth[label] = self.truth[label]
        matched = Matched2D(
            self.matched.label[row_indices],
            self.matched.hit[row_indices],
            self.matched.ignored[row_indices],
            truth.sum(axis=1),
        )
        return BoxCounts(matched, self.score[row_indices], self.image[row_indices], truth, self.threshold)


def count_boxes(
    truth: Boxes2D, detections: Boxes2D, *, images: int, labels: int, band: HeightBand, threshold: float
) -> BoxCounts:
    """Match boxes with an IoU of at least one half, objects within a range of heights alone.

    As COCO does with areas, objects of another height are ignored, and so are boxes of another height that find
    nothing.

    Args:
        truth: Objects; ignored ones count neither as detected nor as missed.
        detections: Boxes with scores.
        images: Number of photographs.
        labels: Number of classes.
        band: The range.
        threshold: Score from which on a box counts for recall and precision.
    """
    is_outside = ~band.holds(truth.box)
    is_ignored = is_outside if truth.ignore is None else is_outside | truth.ignore
    matched = match_2d(replace(truth, ignore=is_ignored), detections, labels=labels)
    assert matched.row is not None
    assert detections.score is not None
    is_other_height = ~band.holds(detections.box)[matched.row] & ~matched.hit
    matched = replace(matched, ignored=matched.ignored | is_other_height)
    counted = truth.label[~is_ignored].astype(np.int64) * images + truth.image[~is_ignored]
    return BoxCounts(
        matched,
        detections.score[matched.row],
        detections.image[matched.row].astype(np.int64),
        np.bincount(counted, minlength=labels * images).reshape(labels, images),
        threshold,
    )


def photograph_scores(
    truth: Boxes2D,
    detections: Boxes2D,
    *,
    images: int,
    classes: Sequence[str],
    bands: Sequence[HeightBand],
    threshold: float,
    replicates: int,
    seed: int = 0,
) -> dict[str, Any]:
    """Return the scores of boxes on photographs, with intervals by the bootstrap over photographs.

    recall is the share of objects that a box of at least `threshold` finds, precision the share of these boxes that
    find an object, AP50 the mean over the classes that occur, of boxes of any score. margin is the mean over the
    objects of the score with which each is found (0: it is not), less `threshold`. boxes and wrong are numbers of boxes
    of at least `threshold`, and of those that find nothing, in a photograph.

    Args:
        truth: Objects; ignored ones count neither as detected nor as missed.
        detections: Boxes with scores.
        images: Number of photographs.
        classes: Names of the labels.
        bands: Ranges of heights, in order; the least height of all bounds the objects that count at all.
        threshold: Score from which on a box counts.
        replicates: Number of replicates of the bootstrap.
        seed: Seed of its draws.

    Returns:
        metrics, intervals, n (objects), images, and parts: entries with by ("class" or "height"), name, n, metrics and
        intervals.
    """
    draws = generator("photograph scores", seed).integers(images, size=(replicates, images))
    weights = [np.bincount(draw, minlength=images) for draw in draws]
    everything = HeightBand(min((band.low for band in bands), default=0.0))

    def counts_of(band: HeightBand) -> BoxCounts:
        return count_boxes(truth, detections, images=images, labels=len(classes), band=band, threshold=threshold)

    counts = counts_of(everything)
    is_counted = (counts.score >= threshold) & ~counts.matched.ignored
    record = _figures(counts, weights, images)
    record["metrics"] |= {
        "boxes": round(float(is_counted.sum()) / images, DIGITS),
        "wrong": round(float((is_counted & ~counts.matched.hit).sum()) / images, DIGITS),
    }
    parts = [
        {"by": "class", "name": name, **_figures(counts.of_label(label), weights, images)}
        for label, name in enumerate(classes)
        if counts.truth[label].any()
    ]
    parts += [
        {"by": "height", "name": band.title, **_figures(band_counts, weights, images)}
        for band in bands
        if (band_counts := counts_of(band)).truth.any()
    ]
    return record | {"images": images, "parts": parts}


def _figures(counts: BoxCounts, weights: Sequence[I64], images: int) -> dict[str, Any]:
    """Return metrics, intervals and n of some counts."""
    values = counts.measures(np.ones(images, np.int64))
    resampled = [counts.measures(image_weights) for image_weights in weights]
    metrics: dict[str, float | None] = {}
    intervals: dict[str, list[float]] = {}
    for name, value in values.items():
        metrics[name] = None if np.isnan(value) else round(value, DIGITS)
        # A margin is a mean score, which lies in [0, 1], less the threshold.
        offset = counts.threshold if name == "margin" else 0.0
        estimate = replicate_estimate(
            value + offset, [measures[name] + offset for measures in resampled], n=images, clusters=images
        )
        if not np.isnan(estimate.low):
            intervals[name] = [round(estimate.low - offset, DIGITS), round(estimate.high - offset, DIGITS)]
    return {"metrics": metrics, "intervals": intervals, "n": int(counts.truth.sum())}


def worn_scores(
    clean: F64, worn: F64, image: I32, *, threshold: float, replicates: int, seed: int = 0
) -> dict[str, Any]:
    """Return the scores of cars that wear a texture, beside those of the same cars without it.

    Args:
        clean: Score with which each car is found without the texture [N]; 0 if it is not.
        worn: The same with the texture [N].
        image: Photograph of each car [N].
        threshold: Score from which on a box counts.
        replicates: Number of replicates of the bootstrap over photographs.
        seed: Seed of its draws.

    Returns:
        metrics: found (share of the cars), score (mean), change (of the mean score), hidden (share of the cars found
        without the texture that are missed with it); intervals; n.
    """
    values = _worn_measures(clean, worn, threshold)
    groups = [np.flatnonzero(image == number) for number in np.unique(image)]
    random_generator = generator("worn scores", seed)
    resampled: list[Mapping[str, float]] = []
    for _ in range(replicates if len(groups) > 1 else 0):
        row_indices = np.concatenate(
            [groups[index] for index in random_generator.integers(len(groups), size=len(groups))]
        )
        resampled.append(_worn_measures(clean[row_indices], worn[row_indices], threshold))
    metrics: dict[str, float | None] = {}
    intervals: dict[str, list[float]] = {}
    for name, value in values.items():
        metrics[name] = None if np.isnan(value) else round(value, DIGITS)
        # A change lies in [-1, 1]: its half plus one half is a share.
        scale, offset = (0.5, 0.5) if name == "change" else (1.0, 0.0)
        draws = [scale * measures[name] + offset for measures in resampled]
        estimate: Estimate = replicate_estimate(scale * value + offset, draws, n=len(clean), clusters=len(groups))
        if not np.isnan(estimate.low):
            limits = ((estimate.low - offset) / scale, (estimate.high - offset) / scale)
            intervals[name] = [round(limit, DIGITS) for limit in limits]
    return {"metrics": metrics, "intervals": intervals, "n": len(clean)}


def _worn_measures(clean: F64, worn: F64, threshold: float) -> dict[str, float]:
    is_found = clean >= threshold
    return {
        "found": float((worn >= threshold).mean()),
        "score": float(worn.mean()),
        "change": float((worn - clean).mean()),
        "hidden": float((worn[is_found] < threshold).mean()) if is_found.any() else np.nan,
    }
