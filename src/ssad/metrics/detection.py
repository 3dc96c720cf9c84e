"""Scores of 3D detections as the official nuScenes evaluation gives them, and their intervals over scenes.

    matches = match(filter_boxes(truth, ...), filter_boxes(predictions, ...), samples=len(tokens))
    matches.scores().nd_score

Matching is done once; scores with other weights of the samples, such as those of a bootstrap, follow from it.
Source: nuscenes-devkit 1.2.0, eval/detection (algo.py, data_classes.py, evaluate.py), whose numbers these are.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from ssad.core.errors import FormatError
from ssad.core.types import F64, I32
from ssad.metrics.detection_boxes import (
    CVPR_2019,
    I64,
    TP_METRICS,
    BikeRacks,
    BoxTable,
    DetectionConfig,
    check_counts,
    filter_boxes,
    keep_boxes,
)
from ssad.metrics.detection_match import ClassMatches, match_class
from ssad.metrics.uncertainty import replicate_estimate

__all__ = [
    "CVPR_2019",
    "TP_METRICS",
    "BikeRacks",
    "BoxTable",
    "DetectionConfig",
    "DetectionScores",
    "Matches",
    "check_counts",
    "filter_boxes",
    "keep_boxes",
    "match",
    "scene_intervals",
]

RECALL = np.linspace(0.0, 1.0, 101)
# errors that have no meaning for a class
UNDEFINED: Mapping[str, tuple[str, ...]] = {
    "traffic_cone": ("attr_err", "vel_err", "orient_err"),
    "barrier": ("attr_err", "vel_err"),
}


@dataclass(frozen=True)
class DetectionScores:
    """The scores of a set.

    Attributes:
        config: Settings of the task.
        ap: AP by class and threshold [C, D].
        errors: TP errors by class and TP_METRICS [C, 5]; NaN where they have no meaning.
        truth: Number of true boxes that count [C].
        predictions: Number of predicted boxes that count [C].
    """

    config: DetectionConfig
    ap: F64
    errors: F64
    truth: I64
    predictions: I64

    @property
    def label_aps(self) -> dict[str, dict[str, float]]:
        """AP by class and threshold: class -> threshold as text -> AP."""
        names = [str(t) for t in self.config.dist_ths]
        return {
            c: dict(zip(names, row, strict=True)) for c, row in zip(self.config.classes, self.ap.tolist(), strict=True)
        }

    @property
    def mean_dist_aps(self) -> dict[str, float]:
        """Mean AP over the thresholds, by class."""
        return {c: float(np.mean(row)) for c, row in zip(self.config.classes, self.ap, strict=True)}

    @property
    def mean_ap(self) -> float:
        """Mean average precision (mAP) over the classes."""
        return float(np.mean(list(self.mean_dist_aps.values())))

    @property
    def label_tp_errors(self) -> dict[str, dict[str, float]]:
        """TP errors by class: class -> error -> value, NaN where it has no meaning."""
        rows = self.errors.tolist()
        return {c: dict(zip(TP_METRICS, row, strict=True)) for c, row in zip(self.config.classes, rows, strict=True)}

    @property
    def tp_errors(self) -> dict[str, float]:
        """TP errors: error -> mean over the classes for which it has a meaning."""
        return {name: float(np.nanmean(column)) for name, column in zip(TP_METRICS, self.errors.T, strict=True)}

    @property
    def tp_scores(self) -> dict[str, float]:
        """TP scores: error -> 1 - error, at least 0."""
        return {name: max(0.0, 1.0 - error) for name, error in self.tp_errors.items()}

    @property
    def nd_score(self) -> float:
        """NDS, the nuScenes detection score."""
        weight = self.config.mean_ap_weight
        total = float(weight * self.mean_ap + np.sum(list(self.tp_scores.values())))
        return total / float(weight + len(TP_METRICS))

    def summary(self, *, eval_time: float | None = None, meta: Mapping[str, Any] | None = None) -> dict[str, Any]:
        """What the devkit writes into metrics_summary.json, with the same keys; eval_time and meta where given.

        Values that have no meaning are NaN, as there.
        """
        result: dict[str, Any] = {
            "label_aps": self.label_aps,
            "mean_dist_aps": self.mean_dist_aps,
            "mean_ap": self.mean_ap,
            "label_tp_errors": self.label_tp_errors,
            "tp_errors": self.tp_errors,
            "tp_scores": self.tp_scores,
            "nd_score": self.nd_score,
        }
        if eval_time is not None:
            result["eval_time"] = eval_time
        result["cfg"] = self.config.serialize()
        if meta is not None:
            result["meta"] = dict(meta)
        return result


@dataclass(frozen=True)
class Matches:
    """Which predictions match which boxes, by class; enough for the scores under any weights of the samples.

    Attributes:
        config: Settings of the task.
        samples: Number of samples.
        classes: Matches of each class.
        truth_counts: True boxes by class and sample [C, S].
    """

    config: DetectionConfig
    samples: int
    classes: tuple[ClassMatches, ...]
    truth_counts: I32

    def scores(self, weights: npt.NDArray[np.integer[Any]] | None = None) -> DetectionScores:
        """The scores.

        Args:
            weights: How often each sample counts, as if it occurred that many times in a row [S]; None: once.
        """
        times = np.ones(self.samples, np.int64) if weights is None else np.asarray(weights, np.int64)
        if times.shape != (self.samples,) or (times < 0).any():
            raise ValueError(f"weights: expected {self.samples} numbers that are not negative")
        ap = np.zeros((len(self.classes), len(self.config.dist_ths)))
        errors = np.ones((len(self.classes), len(TP_METRICS)))
        truth, predictions = np.zeros((2, len(self.classes)), np.int64)
        for c, name in enumerate(self.config.classes):
            truth[c] = self.truth_counts[c] @ times
            ranking = _Ranking.of(self.classes[c], times)
            predictions[c] = ranking.total
            if truth[c]:
                ap[c], errors[c] = _class_scores(self.classes[c], ranking, int(truth[c]), self.config, name)
            for error in UNDEFINED.get(name, ()):
                errors[c, TP_METRICS.index(error)] = np.nan
        return DetectionScores(self.config, ap, errors, truth, predictions)


def match(
    truth: BoxTable,
    predictions: BoxTable,
    *,
    samples: int,
    config: DetectionConfig = CVPR_2019,
    names: Sequence[str] | None = None,
) -> Matches:
    """Match predictions with ground truth, both filtered.

    Args:
        truth: True boxes.
        predictions: Predicted boxes.
        samples: Number of samples.
        config: Settings of the task.
        names: Tokens of the samples, for messages.

    Raises:
        FormatError: A sample has too many predictions, or a matched box has no size.
    """
    check_counts(predictions, config=config, names=names)
    counts = np.bincount(truth.label.astype(np.int64) * samples + truth.sample, minlength=len(config.classes) * samples)
    classes = tuple(
        match_class(truth, predictions, label=c, samples=samples, config=config, names=names)
        for c in range(len(config.classes))
    )
    return Matches(config, samples, classes, counts.reshape(-1, samples).astype(np.int32))


def scene_intervals(
    matches: Matches,
    scene_of_sample: npt.NDArray[np.integer[Any]],
    *,
    generator: np.random.Generator,
    replicates: int = 200,
) -> dict[str, tuple[float, float]]:
    """Limits of mean_ap and nd_score by the bootstrap over scenes, since key frames of a scene are alike.

    Args:
        matches: From `match`.
        scene_of_sample: Index of the scene of each sample [S].
        generator: Source of randomness.
        replicates: Number of replicates.

    Returns:
        Name -> lower and upper limit; with fewer than five scenes there is no interval, and both are NaN.
    """
    scenes, scene = np.unique(scene_of_sample, return_inverse=True)
    draws = generator.multinomial(len(scenes), np.full(len(scenes), 1.0 / len(scenes)), size=replicates)
    own, found = matches.scores(), [matches.scores(draw[scene]) for draw in draws]
    limits = {}
    for name in ("mean_ap", "nd_score"):
        values = [float(getattr(s, name)) for s in found]
        e = replicate_estimate(float(getattr(own, name)), values, n=len(scene), clusters=len(scenes))
        limits[name] = (e.low, e.high)
    return limits


@dataclass(frozen=True)
class _Ranking:
    """The predictions of a class from best to worst, each as often as its sample counts.

    weight, end [n]: how often, and cumulated; runs: as `ClassMatches` has them.
    """

    score: F64
    weight: I64
    end: I64
    runs: tuple[I64, I64] | None

    @staticmethod
    def of(matches: ClassMatches, weights: I64) -> _Ranking:
        """The ranking of a class."""
        weight = weights[matches.sample]
        return _Ranking(matches.score, weight, np.cumsum(weight), matches.runs)

    @property
    def total(self) -> int:
        """How many predictions there are."""
        return int(self.weight.sum())

    def places(self, hits: I64) -> tuple[I64, I64]:
        """Places [T'] of the matched predictions among all, ascending, and which of the hits [T] each one is."""
        weight = self.weight[hits]
        source = np.repeat(np.arange(len(hits)), weight)
        copy = np.arange(len(source)) - np.repeat(np.cumsum(weight) - weight, weight)
        if self.runs is None:
            return (self.end[hits] - weight)[source] + copy, source
        # copies of a sample follow each other, so a run of equal scores comes whole, once for each copy
        first, length = (values[hits] for values in self.runs)
        start = self.end[first] - self.weight[first] + hits - first
        place = start[source] + copy * length[source]
        order = np.argsort(place)
        return place[order], source[order]

    def scores_at(self, places: I64) -> F64:
        """Scores at these places."""
        return self.score[np.searchsorted(self.end, places, side="right")]


def _class_scores(
    matches: ClassMatches, ranking: _Ranking, truth: int, config: DetectionConfig, name: str
) -> tuple[F64, F64]:
    """AP [D] and TP errors [5] of a class that has ground truth."""
    ap = np.zeros(len(config.dist_ths))
    errors = np.ones(len(TP_METRICS))
    negative = bool(len(ranking.score)) and ranking.score[-1] < 0.0
    for i, threshold in enumerate(config.dist_ths):
        hits = matches.hits[i]
        place, source = ranking.places(hits)
        if not len(place):
            continue
        at, true = _turning_points(place, ranking.total)
        recall = true / float(truth)
        ap[i] = _average_precision(np.interp(RECALL, recall, true / (at + 1.0), right=0), config)
        if threshold != config.dist_th_tp and not negative:
            continue
        confidence = np.interp(RECALL, recall, ranking.scores_at(at), right=0)
        if negative and (np.diff(confidence) > 0.0).any():
            raise FormatError(f"class {name}: scores below 0 cannot be evaluated; scale them to 0 .. 1")
        if threshold == config.dist_th_tp:
            errors = _tp_errors(matches.errors[:, source], matches.score[hits][source], confidence, config)
    return ap, errors


def _turning_points(place: I64, total: int) -> tuple[I64, F64]:
    """Places where the curve over all predictions has its corners, and the number of hits up to each.

    np.interp over recall looks only at hits, at the prediction before each, and at both ends.
    """
    hit = np.zeros(total, np.bool_)
    hit[place] = True
    keep = hit.copy()
    keep[:-1] |= hit[1:]
    keep[0] = keep[-1] = True
    at = np.flatnonzero(keep)
    return at, np.cumsum(hit[at]).astype(np.float64)


def _average_precision(precision: F64, config: DetectionConfig) -> float:
    """Mean over the recalls above the least one, of the precision above the least one."""
    above = precision[round(100 * config.min_recall) + 1 :] - config.min_precision
    return float(np.mean(np.maximum(above, 0.0))) / (1.0 - config.min_precision)


def _tp_errors(errors: F64, score: F64, confidence: F64, config: DetectionConfig) -> F64:
    """Mean of each error [5] up to the highest recall reached; errors [5, T] and score [T] of the matches."""
    first = round(100 * config.min_recall) + 1
    reached = np.flatnonzero(confidence)
    last = int(reached[-1]) if len(reached) else 0
    if last < first:
        return np.ones(len(errors))
    known = ~np.isnan(errors)
    count = np.cumsum(known, axis=-1)
    total = np.cumsum(np.where(known, errors, 0.0), axis=-1)
    mean = np.divide(total, count, out=np.zeros_like(total), where=count > 0)
    mean[count[:, -1] == 0] = 1.0
    x, xp = confidence[::-1], np.ascontiguousarray(score[::-1])
    return np.array([float(np.mean(np.interp(x, xp, row[::-1])[::-1][first : last + 1])) for row in mean])
