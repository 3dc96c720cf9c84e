"""Detection of the target of a physical attack: AP50, and the share of images in which it is found."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

import numpy as np
import torch
from torch import Tensor

from ssad.core.detections import Detections, Truth
from ssad.core.protocols import Detector
from ssad.core.seeding import generator
from ssad.core.types import F64, I32, Bool
from ssad.metrics.attack_success import SuccessRate, attack_success_rate, event_share
from ssad.metrics.detection2d import Boxes2D, Matched2D, average_precision, match_2d
from ssad.metrics.detection_boxes import I64
from ssad.metrics.intervals import MIN_CLUSTERS, replicate_limits

IOU = 0.5
MIN_COVERED_SHARE = 0.25  # share of the target from which on a box of any class says that something is there
PRECISIONS = {"AP50": (True, 0.0), "AP50_25": (True, 0.25), "AP50_all": (False, 0.0), "AP50_all_25": (False, 0.25)}
THRESHOLD = 0.001  # least score of a box that AP counts
GPU_BATCH = 16  # pictures that a GPU is shown at once; a processor takes one, whose bits depend on nothing else
CONFIDENCES = (0.25, 0.5)  # from which score on a box counts as a detection


@dataclass(frozen=True, slots=True)
class TargetSighting:
    """Detections in one image of the target, as plain arrays.

    Attributes:
        drive: The drive of the image; images of one drive are similar.
        box: Detected boxes of the target's class [N, 4], best first.
        score: Their scores [N].
        real: True boxes of that class [Q, 4], the target first.
        crowd: Which of these count neither as found nor as missed [Q].
        any_class: The best score of a box of any class that covers a quarter of the target or more, and finds no
            other object; 0 without one.
    """

    drive: str
    box: F64
    score: F64
    real: F64
    crowd: Bool
    any_class: float = 0.0

    def confidences(self) -> F64:
        """Return the score with which each true box is found [Q], 0 if it is not.

        From the best box to the worst, each takes the free true box that it covers most, with an IoU of at least
        one half. Hence none is counted twice, and it is found at every confidence below its score.
        """
        confidence_by_truth = np.zeros(len(self.real))
        for overlap, score in zip(_overlaps(self.box, self.real)[0], self.score.tolist(), strict=True):
            free_overlap = np.where(confidence_by_truth > 0.0, 0.0, overlap)
            best_index = int(free_overlap.argmax())
            if free_overlap[best_index] >= IOU:
                confidence_by_truth[best_index] = score
        return confidence_by_truth


def _overlaps(box: F64, truth_boxes: F64) -> tuple[F64, F64]:
    """Return IoU [N, Q] of boxes [N, 4] and [Q, 4], and the share of the latter that the former cover [N, Q]."""
    boxes, truth = box[:, None], truth_boxes[None]
    overlap_sides = np.minimum(boxes[..., 2:], truth[..., 2:]) - np.maximum(boxes[..., :2], truth[..., :2])
    intersection = np.where((overlap_sides > 0.0).all(-1), overlap_sides.prod(-1), 0.0)
    truth_area = (truth[..., 2:] - truth[..., :2]).prod(-1)
    union_area = (boxes[..., 2:] - boxes[..., :2]).prod(-1) + truth_area - intersection
    # The bounds avoid 0 / 0 for boxes without an area.
    return intersection / np.maximum(union_area, 1e-9), intersection / np.maximum(truth_area, 1e-9)


def _on_target(box: F64, score: F64, truth_boxes: F64) -> float:
    """Return the best score of boxes [N, 4] that cover enough of the first true box [Q, 4] and find no other."""
    overlap, covered_share = _overlaps(box, truth_boxes)
    other_overlap = overlap[:, 1:].max(1, initial=0.0)
    is_on_target = (covered_share[:, 0] >= MIN_COVERED_SHARE) & (
        (other_overlap < IOU) | (other_overlap < overlap[:, 0])
    )
    return float(score[is_on_target].max(initial=0.0))


def sighting(drive_name: str, detections: Detections, truth: Truth) -> TargetSighting:
    """Return the detections of the target's class, and the best of any class on the target, the first true object."""
    target_label = int(truth.label[0])
    is_own_class, is_same_class = (detections.label == target_label).cpu(), (truth.label == target_label).cpu()
    box, score = detections.box.cpu().double().numpy(), detections.score.cpu().double().numpy()
    truth_boxes = truth.box.cpu().double().numpy()
    crowd_flags = (
        np.zeros(len(truth.label), np.bool_) if truth.crowd is None else truth.crowd.cpu().numpy().astype(np.bool_)
    )
    return TargetSighting(
        drive_name,
        box[is_own_class.numpy()],
        score[is_own_class.numpy()],
        truth_boxes[is_same_class.numpy()],
        crowd_flags[is_same_class.numpy()],
        _on_target(box, score, truth_boxes),
    )


def sightings(detector: Detector, pictures: Iterable[tuple[str, Tensor, Truth]]) -> Iterator[TargetSighting]:
    """Yield the detections of a detector in images, one image after another.

    Args:
        detector: Of a 3D detector the hulls of its boxes in the picture count.
        pictures: Drive, picture [1, 3, H, W] in 0 to 1, and truth in the classes of the detector, the target first; for
            a 3D detector with the camera matrix.
    """
    remaining = iter(pictures)
    while views_batch := list(islice(remaining, 1)):
        if views_batch[0][1].is_cuda:
            views_batch += islice(remaining, GPU_BATCH - 1)
        drives, image_batch, truths = zip(*views_batch, strict=True)
        batch = torch.cat(image_batch)
        cameras = [truth.intrinsic for truth in truths if truth.intrinsic is not None and detector.task == "3d"]
        intrinsic = torch.stack(cameras).to(batch) if cameras else None
        for drive, detections, truth in zip(
            drives, detector.predict(batch, intrinsic, threshold=THRESHOLD), truths, strict=True
        ):
            yield sighting(drive, detections, truth)


def target_scores(
    sightings: Sequence[TargetSighting],
    clean_sightings: Sequence[TargetSighting] | None = None,
    *,
    floor: float = 0.0,
    replicates: int = 100,
    seed: int = 0,
) -> dict[str, Any]:
    """Scores of a set of pictures.

    AP50 counts the target alone and boxes of any score, AP50_25 boxes above a score of 0.25; AP50_all and AP50_all_25
    count every vehicle of its class. found_25 and found_50 are shares of the pictures in which the target is found with
    that score; ASR_25 and ASR_50 the share of those where it is found without the attack and is not with it; ASR_any_25
    the share of these where no box of any class covers a quarter of it either; ASR_all_25 that of all vehicles (no
    match is counted twice). n0_25, n0_50 and n0_all_25 are the numbers of targets, or vehicles, of which these are
    shares. There is no ASR where the target is found clean in less than `floor` of the pictures, above the score of
    the ASR.

    Args:
        sightings: With the attack.
        clean_sightings: The same pictures without it; None for these themselves.
        floor: Minimum share of the pictures in which the target is found clean, at each ASR's own score.
        replicates: Of the bootstrap over drives, for the intervals of AP.
        seed: Of its draws.

    Returns:
        metrics; intervals (95 %; of drives, absent where there are too few); replicates of each AP (of the bootstrap,
        the same draws for all attacks on the same pictures); n, the number of pictures; drives.
    """
    drives = sorted({entry.drive for entry in sightings})
    drive_indices = np.array([drives.index(entry.drive) for entry in sightings], np.int32)
    metrics: dict[str, float | None] = {}
    intervals: dict[str, list[float] | None] = {}
    ap_replicates: dict[str, list[float]] = {}
    for name, (target_only, min_score) in PRECISIONS.items():
        ap = metrics[name] = precision(sightings, target_only=target_only, min_score=min_score)
        if len(drives) >= MIN_CLUSTERS and replicates and ap is not None:
            rng = generator("target scores", seed, name)
            # Whole drives are drawn: images of one drive are too similar to count as independent.
            drive_draws = [rng.integers(len(drives), size=len(drives)) for _ in range(replicates)]
            values = precision_replicates(
                sightings, drive_indices, drive_draws, target_only=target_only, min_score=min_score
            )
            variance = np.asarray(np.var(values, ddof=1))
            lower_limit, upper_limit = replicate_limits(np.asarray(ap), variance, len(drives), bounded=True)
            intervals[name] = [float(lower_limit), float(upper_limit)]
            ap_replicates[name] = [round(entry, 5) for entry in values]

    def add_rate(name: str, rate: SuccessRate) -> None:
        metrics[name], intervals[name] = rate.value, rate.interval

    scores = [entry.confidences() for entry in sightings]
    scores_before = scores if clean_sightings is None else [entry.confidences() for entry in clean_sightings]
    target_scores_now, target_scores_before = (
        np.array([entry[0] for entry in scores]),
        np.array([entry[0] for entry in scores_before]),
    )
    for confidence in CONFIDENCES:
        percent = round(100 * confidence)
        is_found = target_scores_now > confidence
        metrics[f"found_{percent}"], intervals[f"found_{percent}"] = event_share(
            is_found, np.ones(len(target_scores_now), bool), drive_indices
        )
        if clean_sightings is None:
            continue
        was_found = target_scores_before > confidence
        add_rate(f"ASR_{percent}", attack_success_rate(was_found, is_found, drive_indices, floor=floor))
        metrics[f"n0_{percent}"] = int(was_found.sum())
    if clean_sightings is not None:
        min_score = CONFIDENCES[0]
        was_found = target_scores_before > min_score
        is_detected = np.maximum(target_scores_now, [entry.any_class for entry in sightings]) > min_score
        add_rate("ASR_any_25", attack_success_rate(was_found, is_detected, drive_indices, floor=floor))
        is_counted = np.concatenate([~entry.crowd for entry in sightings])
        all_scores, all_scores_before = np.concatenate(scores)[is_counted], np.concatenate(scores_before)[is_counted]
        drive_per_object = np.repeat(drive_indices, [len(entry.real) for entry in sightings])[is_counted]
        # Distant vehicles are found less often than the target, whose share tells whether the threshold suits.
        all_rate = attack_success_rate(
            all_scores_before > min_score,
            all_scores > min_score,
            drive_per_object,
            floor=floor,
            clean_share=float(was_found.mean()),
        )
        add_rate("ASR_all_25", all_rate)
        metrics["n0_all_25"] = all_rate.n0
    metrics["confidence"] = float(target_scores_now.mean())
    defined_intervals = {name: interval for name, interval in intervals.items() if interval is not None}
    rounded = {name: None if ap is None else round(ap, 6) for name, ap in metrics.items()}
    return {
        "metrics": rounded,
        "intervals": defined_intervals,
        "replicates": ap_replicates,
        "n": len(sightings),
        "drives": len(drives),
    }


def precision(sightings: Sequence[TargetSighting], *, target_only: bool = True, min_score: float = 0.0) -> float | None:
    """AP50 of boxes above a score: of the target alone (others count neither way), or of all vehicles of its class."""
    truth, boxes = _tables(sightings, target_only=target_only, min_score=min_score)
    average_precision_value = average_precision(truth, boxes, labels=1, threshold=IOU)[0]
    return None if np.isnan(average_precision_value) else float(average_precision_value)


def precision_replicates(
    sightings: Sequence[TargetSighting],
    selected_images: I32,
    drive_draws: Iterable[I64],
    *,
    target_only: bool,
    min_score: float,
) -> list[float]:
    """`precision` of several draws of drives; what a box hits in its picture does not depend on the draw.

    Args:
        sightings: All pictures.
        selected_images: The drive of each [N].
        drive_draws: Drives of each draw, some of them several times.
        target_only: See `precision`.
        min_score: See `precision`.
    """
    truth, detected = _tables(sightings, target_only=target_only, min_score=min_score)
    matched = match_2d(truth, detected, labels=1, threshold=IOU)
    assert matched.row is not None
    assert detected.score is not None
    assert truth.ignore is not None
    rows, hits = matched.row[~matched.ignored], matched.hit[~matched.ignored]
    order = np.argsort(detected.image[rows], kind="stable")  # picture after picture, in each the best box first
    rows, hits = rows[order], hits[order]
    drive_of_row = selected_images[detected.image[rows]]
    truth_counts = np.bincount(selected_images[truth.image[~truth.ignore]], minlength=int(selected_images.max()) + 1)
    rows_by_drive = [np.flatnonzero(drive_of_row == drive_index) for drive_index in range(len(truth_counts))]
    values = []
    for drive_draw in drive_draws:
        drawn_rows = np.concatenate([rows_by_drive[drive_index] for drive_index in drive_draw])
        drawn_rows = drawn_rows[np.argsort(-detected.score[rows[drawn_rows]], kind="stable")]
        no_flags = np.zeros(len(drawn_rows), np.bool_)
        resampled = Matched2D(
            no_flags.astype(np.int32), hits[drawn_rows], no_flags, np.array([truth_counts[drive_draw].sum()])
        )
        values.append(float(resampled.average_precision()[0]))
    return [value for value in values if not np.isnan(value)]


def _tables(sightings: Sequence[TargetSighting], *, target_only: bool, min_score: float) -> tuple[Boxes2D, Boxes2D]:
    """True and found boxes of pictures, for their AP."""
    ignored = []
    own_boxes = [(entry.box[entry.score > min_score], entry.score[entry.score > min_score]) for entry in sightings]
    for entry in sightings:
        ignore_flags = entry.crowd.copy()
        # The target always counts, even if the recording marks it as crowd.
        ignore_flags[0] = False
        if target_only:
            ignore_flags[1:] = True
        ignored.append(ignore_flags)
    return (
        _boxes([image_entry.real for image_entry in sightings], ignore=ignored),
        _boxes([box for box, _ in own_boxes], score=[score for _, score in own_boxes]),
    )


def _boxes(
    boxes: Sequence[F64], *, score: Sequence[F64] | None = None, ignore: Sequence[Bool] | None = None
) -> Boxes2D:
    image: I32 = np.repeat(np.arange(len(boxes), dtype=np.int32), [len(image_boxes) for image_boxes in boxes])
    return Boxes2D(
        image,
        np.zeros(len(image), np.int32),
        np.concatenate(boxes),
        None if score is None else np.concatenate(score),
        None if ignore is None else np.concatenate(ignore),
    )
