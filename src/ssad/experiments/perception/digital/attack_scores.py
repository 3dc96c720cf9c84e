"""Scores under an attack besides mAP and NDS.

They are scores by distance, the success of a targeted attack, and the worst of several attacks at each moment.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np

from ssad.core.nuscenes_names import CLASSES
from ssad.core.types import F64
from ssad.datasets.nuscenes.truth import GroundTruth
from ssad.detectors.on_scenes import SampleBoxes, box_table, match_boxes
from ssad.metrics.attack_success import attack_success_rate
from ssad.metrics.detection import CVPR_2019, Matches, filter_boxes, match
from ssad.metrics.detection_boxes import BoxTable

BANDS: Mapping[str, tuple[float, float]] = {"0-20": (0.0, 20.0), "20-40": (20.0, 40.0), "40+": (40.0, np.inf)}
MATCH_DISTANCE = (
    2.0  # metres within which a box is taken for that of an object, as for the true-positive errors of nuScenes
)
SAME_POSITION = 1e-3  # metres within which two places are one
MIN_SCORE = 0.1  # least score of a box that counts as a detection of an object


class Matched(Protocol):
    """Boxes matched with the truth: `ssad.metrics.detection.Matches`, or `PictureMatches` of 2D detectors."""

    @property
    def samples(self) -> int:
        """Number of samples."""

    @property
    def truth_counts(self) -> Any:
        """True boxes by class and sample [C, S]."""

    def scores(self, weights: Any = None) -> Any:
        """Return scores with `ap` [C, ...] and `mean_ap`, in which samples count as often as their weights."""


Match = Callable[[Sequence[Any]], Matched]
"""From the boxes of all samples under an attack to what they match."""


def by_distance(boxes_by_sample: Sequence[SampleBoxes], truth: GroundTruth) -> dict[str, float]:
    """Scores of objects near and far from the ego: each band by itself, boxes and truth by their own distance.

    Args:
        boxes_by_sample: Boxes of all samples.
        truth: Of the same samples.

    Returns:
        mAP_BAND, the mean over the classes that are there, and recall_BAND, the share of objects with a box of their
        class within 2 m; a band without objects has neither.
    """
    truth_boxes = filter_boxes(truth.boxes, points=truth.points, racks=truth.racks)
    boxes = filter_boxes(box_table(boxes_by_sample, truth), racks=truth.racks)
    scores: dict[str, float] = {}
    for name, (near_limit, far_limit) in BANDS.items():
        band_matches = match(
            _between(truth_boxes, near_limit, far_limit),
            _between(boxes, near_limit, far_limit),
            samples=len(truth.samples),
        )
        has_objects = band_matches.truth_counts.sum(1) > 0
        if has_objects.any():
            scores[f"mAP_{name}"] = round(float(band_matches.scores().ap[has_objects].mean()), 6)
            scores[f"recall_{name}"] = round(_hits(band_matches) / int(band_matches.truth_counts.sum()), 6)
    return scores


def _between(boxes: BoxTable, min_distance: float, max_distance: float) -> BoxTable:
    return boxes.take(np.flatnonzero((boxes.ego_distance >= min_distance) & (boxes.ego_distance < max_distance)))


def _hits(matches: Matches) -> int:
    """Count the objects that are found within 2 m."""
    threshold_index = CVPR_2019.dist_ths.index(MATCH_DISTANCE)
    return sum(len(class_matches.hits[threshold_index]) for class_matches in matches.classes)


def target_success(
    clean_boxes: Sequence[SampleBoxes],
    attacked: Sequence[SampleBoxes],
    truth: GroundTruth,
    classes: Sequence[str] = (),
    *,
    target_classes: Mapping[str, str],
    target_positions: Mapping[str, F64] | None = None,
) -> dict[str, float]:
    """Success rate of a targeted attack, over the objects that are found in the clean pictures.

    An object is found if the best box within 2 m of it, with a score of 0.1 at least, is of its class. The target is
    reached if, under the attack, the best such box is of the wanted class; where no class is wanted, if the object is
    not found any more.

    Args:
        clean_boxes: Boxes in the clean pictures.
        attacked: Boxes under the attack.
        truth: Of the same samples.
        classes: Names of the classes that are attacked; empty: all, or those that `target_classes` names.
        target_classes: Class -> class that its objects should be taken for.
        target_positions: Where the one object of each sample is that is attacked, m, by token; None: all objects are.

    Returns:
        success, absent if no such object is found; targets, the number of objects; kept, the share of the others that
        are found as what they are in both, absent if there are none.
    """
    truth_boxes = filter_boxes(truth.boxes, points=truth.points, racks=truth.racks)
    is_target = np.isin(truth_boxes.label, [CLASSES.index(name) for name in target_classes or classes or CLASSES])
    if target_positions is not None:
        positions = np.array([target_positions.get(token, np.full(3, np.nan)) for token in truth.samples])
        is_target &= np.abs(truth_boxes.centre - positions[truth_boxes.sample]).max(1) < SAME_POSITION
    clean_labels, attacked_labels = (
        _recognised_classes(truth_boxes, box_table(boxes, truth)) for boxes in (clean_boxes, attacked)
    )
    is_found = clean_labels == truth_boxes.label
    is_bystander = is_found & ~is_target
    kept_column = (
        {"kept": round(float((attacked_labels == clean_labels)[is_bystander].mean()), 6)} if is_bystander.any() else {}
    )
    is_found &= is_target
    target_labels = {
        CLASSES.index(source_class): CLASSES.index(target_class)
        for source_class, target_class in target_classes.items()
    }
    # -2 equals no label: -1 already means that there is no box.
    is_reached = (
        attacked_labels == [target_labels.get(int(label), -2) for label in truth_boxes.label]
        if target_classes
        else attacked_labels != truth_boxes.label
    )
    rate = attack_success_rate(is_found, ~is_reached, np.zeros(len(is_found), np.int32))
    return {
        "targets": rate.n0,
        **({} if rate.value is None else {"success": round(rate.value, 6)}),
        **kept_column,
    }


def _recognised_classes(truth_boxes: BoxTable, boxes: BoxTable) -> F64:
    """Label of the best box near each object [N]; -1: there is none."""
    labels = np.full(len(truth_boxes.label), -1)
    boxes = boxes.take(np.flatnonzero(boxes.score >= MIN_SCORE))
    for sample in np.unique(truth_boxes.sample):
        rows, candidate_rows = np.flatnonzero(truth_boxes.sample == sample), np.flatnonzero(boxes.sample == sample)
        if not len(candidate_rows):
            continue
        distances = np.linalg.norm(truth_boxes.centre[rows, None, :2] - boxes.centre[None, candidate_rows, :2], axis=-1)
        nearby_scores = np.where(distances < MATCH_DISTANCE, boxes.score[candidate_rows][None], -1.0)
        best_candidate = nearby_scores.argmax(1)
        labels[rows] = np.where(nearby_scores.max(1) >= MIN_SCORE, boxes.label[candidate_rows][best_candidate], -1)
    return labels


def worst_by_sample(candidates: Sequence[Sequence[Any]], tokens: Sequence[str], match_boxes: Match) -> list[Any]:
    """At each moment the boxes under the attack that leaves the detector least.

    Args:
        candidates: Boxes of all samples under each attack.
        tokens: Of all samples.
        match_boxes: Matches them with the truth.

    Returns:
        For each sample the boxes of the attack with the least mAP over this sample alone; of equal ones those with the
        larger sum of scores, as there is more among them that is false.
    """
    tables = [{sample_boxes.token: sample_boxes for sample_boxes in boxes} for boxes in candidates]
    sample_ap = np.stack([_by_sample(match_boxes(boxes)) for boxes in candidates])
    noise = np.array([[float(np.sum(table[token].boxes.score)) for token in tokens] for table in tables])
    return [
        tables[
            min(
                range(len(candidates)),
                key=lambda attack: (sample_ap[attack, sample_index], -noise[attack, sample_index]),
            )
        ][sample_token]
        for sample_index, sample_token in enumerate(tokens)
    ]


def worst_of(
    candidates: Mapping[str, Sequence[Any]], truth: GroundTruth, match: Match | None = None
) -> tuple[str, list[Any]]:
    """Return the boxes with the lowest score over the whole set: those of one attack, or the worst of each moment.

    The mixture of moments alone guarantees nothing, as mAP over a set is no mean over moments.

    Args:
        candidates: Boxes of all samples under each attack, by its name.
        truth: Ground truth of the same samples.
        match: Matches boxes with the truth; None: as the official evaluation of 3D detectors does.

    Returns:
        A name, "mixture" for the worst of each moment, and its boxes: their mAP is at most that of each attack.
    """
    match_function: Match = match or (lambda boxes: match_boxes(boxes, truth))
    all_candidates = {
        **candidates,
        "mixture": worst_by_sample(list(candidates.values()), truth.samples, match_function),
    }
    mean_ap = {name: match_function(boxes).scores().mean_ap for name, boxes in all_candidates.items()}
    name = min(mean_ap, key=lambda candidate: mean_ap[candidate])
    return name, list(all_candidates[name])


def _by_sample(matches: Matched) -> F64:
    """Return the mean AP of each sample alone [S], over the classes that are in it."""
    mean_ap = np.zeros(matches.samples)
    for sample_index in range(matches.samples):
        has_class = matches.truth_counts[:, sample_index] > 0
        if has_class.any():
            weights = np.zeros(matches.samples, np.int64)
            weights[sample_index] = 1
            mean_ap[sample_index] = matches.scores(weights).ap[has_class].mean()
    return mean_ap
