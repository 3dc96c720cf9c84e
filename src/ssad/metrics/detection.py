"""Scores of 3D detections as in the official nuScenes evaluation, and their intervals over scenes.

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
        names = [str(threshold) for threshold in self.config.dist_ths]
        return {
            class_name: dict(zip(names, class_aps, strict=True))
            for class_name, class_aps in zip(self.config.classes, self.ap.tolist(), strict=True)
        }

    @property
    def mean_dist_aps(self) -> dict[str, float]:
        """Mean AP over the thresholds, by class."""
        return {
            class_name: float(np.mean(class_aps))
            for class_name, class_aps in zip(self.config.classes, self.ap, strict=True)
        }

    @property
    def mean_ap(self) -> float:
        """Mean average precision (mAP) over the classes."""
        return float(np.mean(list(self.mean_dist_aps.values())))

    @property
    def label_tp_errors(self) -> dict[str, dict[str, float]]:
        """TP errors by class: class -> error -> value, NaN where it has no meaning."""
        rows = self.errors.tolist()
        return {
            class_name: dict(zip(TP_METRICS, class_errors, strict=True))
            for class_name, class_errors in zip(self.config.classes, rows, strict=True)
        }

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
        """Return the content of the devkit's metrics_summary.json, with the same keys; undefined values are NaN.

        Args:
            eval_time: Duration of the evaluation, s; None to leave it out.
            meta: Metadata; None to leave it out.
        """
        entries: dict[str, Any] = {
            "label_aps": self.label_aps,
            "mean_dist_aps": self.mean_dist_aps,
            "mean_ap": self.mean_ap,
            "label_tp_errors": self.label_tp_errors,
            "tp_errors": self.tp_errors,
            "tp_scores": self.tp_scores,
            "nd_score": self.nd_score,
        }
        if eval_time is not None:
            entries["eval_time"] = eval_time
        entries["cfg"] = self.config.serialize()
        if meta is not None:
            entries["meta"] = dict(meta)
        return entries


@dataclass(frozen=True)
class Matches:
    """Matches of predictions and true boxes by class; enough for the scores under any weights of the samples.

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
        """Return the scores.

        Args:
            weights: Multiplicity of each sample, as if it occurred that many times in a row [S]; None for 1.
        """
        multiplicity = np.ones(self.samples, np.int64) if weights is None else np.asarray(weights, np.int64)
        if multiplicity.shape != (self.samples,) or (multiplicity < 0).any():
            raise ValueError(f"weights: expected {self.samples} numbers that are not negative")
        ap = np.zeros((len(self.classes), len(self.config.dist_ths)))
        errors = np.ones((len(self.classes), len(TP_METRICS)))
        truth, predictions = np.zeros((2, len(self.classes)), np.int64)
        for class_index, class_name in enumerate(self.config.classes):
            truth[class_index] = self.truth_counts[class_index] @ multiplicity
            ranking = _Ranking.of(self.classes[class_index], multiplicity)
            predictions[class_index] = ranking.total
            if truth[class_index]:
                ap[class_index], errors[class_index] = _class_scores(
                    self.classes[class_index], ranking, int(truth[class_index]), self.config, class_name
                )
            for error in UNDEFINED.get(class_name, ()):
                # The devkit averages with nanmean, which leaves these out.
                errors[class_index, TP_METRICS.index(error)] = np.nan
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
        match_class(truth, predictions, label=class_index, samples=samples, config=config, names=names)
        for class_index in range(len(config.classes))
    )
    return Matches(config, samples, classes, counts.reshape(-1, samples).astype(np.int32))


def scene_intervals(
    matches: Matches,
    scene_of_sample: npt.NDArray[np.integer[Any]],
    *,
    generator: np.random.Generator,
    replicates: int = 200,
) -> dict[str, tuple[float, float]]:
    """Return limits of mean_ap and nd_score by a bootstrap over scenes, since key frames of a scene are dependent.

    Args:
        matches: From `match`.
        scene_of_sample: Index of the scene of each sample [S].
        generator: Source of randomness.
        replicates: Number of replicates.

    Returns:
        Name -> lower and upper limit; both NaN with fewer than five scenes.
    """
    scenes, scene = np.unique(scene_of_sample, return_inverse=True)
    # Counts of scenes drawn with replacement; their key frames come with them.
    scene_counts = generator.multinomial(len(scenes), np.full(len(scenes), 1.0 / len(scenes)), size=replicates)
    full_scores, replicate_scores = matches.scores(), [matches.scores(counts[scene]) for counts in scene_counts]
    limits = {}
    for name in ("mean_ap", "nd_score"):
        values = [float(getattr(replicate, name)) for replicate in replicate_scores]
        interval = replicate_estimate(float(getattr(full_scores, name)), values, n=len(scene), clusters=len(scenes))
        limits[name] = (interval.low, interval.high)
    return limits


@dataclass(frozen=True)
class _Ranking:
    """The predictions of a class from best to worst, repeated by the multiplicity of their samples.

    Attributes:
        weight: Multiplicity of each prediction [n].
        end: Cumulated multiplicity [n].
        runs: As in `ClassMatches`.
    """

    score: F64
    weight: I64
    end: I64
    runs: tuple[I64, I64] | None

    @staticmethod
    def of(matches: ClassMatches, weights: I64) -> _Ranking:
        """Return the ranking of a class."""
        weight = weights[matches.sample]
        return _Ranking(matches.score, weight, np.cumsum(weight), matches.runs)

    @property
    def total(self) -> int:
        """Number of predictions, with repetitions."""
        return int(self.weight.sum())

    def places(self, hits: I64) -> tuple[I64, I64]:
        """Return the ascending ranks [T'] of the matched predictions among all, and the hit [T] behind each."""
        weight = self.weight[hits]
        source = np.repeat(np.arange(len(hits)), weight)
        copy_index = np.arange(len(source)) - np.repeat(np.cumsum(weight) - weight, weight)
        if self.runs is None:
            return (self.end[hits] - weight)[source] + copy_index, source
        # copies of a sample follow each other, so a run of equal scores comes whole, once for each copy
        run_start, run_length = (values[hits] for values in self.runs)
        run_place = self.end[run_start] - self.weight[run_start] + hits - run_start
        place = run_place[source] + copy_index * run_length[source]
        ranking = np.argsort(place)
        return place[ranking], source[ranking]

    def scores_at(self, places: I64) -> F64:
        """Return the scores at these ranks."""
        return self.score[np.searchsorted(self.end, places, side="right")]


def _class_scores(
    matches: ClassMatches, ranking: _Ranking, truth: int, config: DetectionConfig, name: str
) -> tuple[F64, F64]:
    """Return AP [D] and TP errors [5] of a class that has ground truth."""
    ap = np.zeros(len(config.dist_ths))
    errors = np.ones(len(TP_METRICS))
    has_negative = bool(len(ranking.score)) and ranking.score[-1] < 0.0
    for threshold_index, threshold in enumerate(config.dist_ths):
        hits = matches.hits[threshold_index]
        ranks, source = ranking.places(hits)
        if not len(ranks):
            continue
        corner_ranks, hit_counts = _turning_points(ranks, ranking.total)
        recall = hit_counts / float(truth)
        ap[threshold_index] = _average_precision(
            np.interp(RECALL, recall, hit_counts / (corner_ranks + 1.0), right=0), config
        )
        if threshold != config.dist_th_tp and not has_negative:
            continue
        confidence = np.interp(RECALL, recall, ranking.scores_at(corner_ranks), right=0)
        if has_negative and (np.diff(confidence) > 0.0).any():
            raise FormatError(f"class {name}: scores below 0 cannot be evaluated; scale them to 0 .. 1")
        if threshold == config.dist_th_tp:
            errors = _tp_errors(matches.errors[:, source], matches.score[hits][source], confidence, config)
    return ap, errors


def _turning_points(place: I64, total: int) -> tuple[I64, F64]:
    """Return the ranks of the corners of the curve over all predictions, and the number of hits up to each.

    np.interp over recall depends only on hits, on the prediction before each, and on both ends.
    """
    is_hit = np.zeros(total, np.bool_)
    is_hit[place] = True
    is_corner = is_hit.copy()
    is_corner[:-1] |= is_hit[1:]
    is_corner[0] = is_corner[-1] = True
    corner_ranks = np.flatnonzero(is_corner)
    return corner_ranks, np.cumsum(is_hit[corner_ranks]).astype(np.float64)


def _average_precision(precision: F64, config: DetectionConfig) -> float:
    """Return the mean over recalls above the minimum of the precision above the minimum."""
    precision_excess = precision[round(100 * config.min_recall) + 1 :] - config.min_precision
    return float(np.mean(np.maximum(precision_excess, 0.0))) / (1.0 - config.min_precision)


def _tp_errors(errors: F64, score: F64, confidence: F64, config: DetectionConfig) -> F64:
    """Mean of each error [5] up to the highest recall reached; errors [5, T] and score [T] of the matches."""
    first_recall = round(100 * config.min_recall) + 1
    reached_recalls = np.flatnonzero(confidence)
    last_recall = int(reached_recalls[-1]) if len(reached_recalls) else 0
    if last_recall < first_recall:
        return np.ones(len(errors))
    is_known = ~np.isnan(errors)
    count = np.cumsum(is_known, axis=-1)
    total = np.cumsum(np.where(is_known, errors, 0.0), axis=-1)
    mean = np.divide(total, count, out=np.zeros_like(total), where=count > 0)
    mean[count[:, -1] == 0] = 1.0
    descending_confidence, ascending_score = confidence[::-1], np.ascontiguousarray(score[::-1])
    return np.array(
        [
            float(
                np.mean(
                    np.interp(descending_confidence, ascending_score, error_mean[::-1])[::-1][
                        first_recall : last_recall + 1
                    ]
                )
            )
            for error_mean in mean
        ]
    )
