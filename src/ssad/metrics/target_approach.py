"""Approach to a target: detection against distance, the first detection, and the stopping distance of a vehicle."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from ssad.core.seeding import generator
from ssad.core.types import F64, I32
from ssad.metrics.detection_boxes import I64
from ssad.metrics.intervals import MIN_CLUSTERS, replicate_limits
from ssad.metrics.target_attacks import CONFIDENCES, TargetSighting, precision, precision_replicates

AXIS_FLOOR: Final = 0.8  # AP50 of the clean target below which the axis of distances ends
FOUND_SHARE: Final = 0.5  # share of the images in which a target counts as detected at a distance
SPEEDS: Final = (30.0, 50.0, 80.0)  # km/h
# UN Regulation 157, Annex 4, Appendix 3, careful and competent human driver: 0.4 s of risk evaluation and 0.75 s until
# the brake acts; 0.774 g, reached after 0.6 s.
REACTION: Final = 0.4 + 0.75  # s
DECELERATION: Final = 0.774 * 9.81  # m/s^2
BUILD_UP: Final = 0.6  # s


def stopping_distance(
    speed: float, *, reaction: float = REACTION, deceleration: float = DECELERATION, build_up: float = BUILD_UP
) -> float:
    """Return the way from the first sight of an obstacle to a standstill, m.

    Args:
        speed: Initial speed, m/s.
        reaction: Time until the braking begins, s.
        deceleration: Full braking, m/s^2.
        build_up: Time in which the braking grows evenly to its full value, s.

    Source: UN Regulation 157 (2021), Annex 4, Appendix 3, for the defaults.
    """
    if 2.0 * speed <= deceleration * build_up:  # at rest before the braking is full
        return speed * reaction + (2.0 / 3.0) * speed * math.sqrt(2.0 * speed * build_up / deceleration)
    return speed * (reaction + build_up / 2) + speed**2 / (2 * deceleration) - deceleration * build_up**2 / 24


def axis_of(distances: Sequence[float], clean_precisions: Sequence[float | None]) -> list[float]:
    """Return the distances at which attacks are scored, from near to far.

    They begin at the nearest at which the clean target has an AP50 of `AXIS_FLOOR` or more, and end before the first
    at which it has less: what a detector does not find clean cannot be hidden.
    """
    axis: list[float] = []
    for distance, clean in sorted(zip(distances, clean_precisions, strict=True)):
        if clean is not None and clean >= AXIS_FLOOR:
            axis.append(distance)
        elif axis:
            break
    return axis


def first_detection(distances: Sequence[float], shares: Sequence[float]) -> float:
    """Return the distance at which an approaching camera first detects the target, m; 0 if it never does.

    Coming from far, it is the first distance at which the target is found in `FOUND_SHARE` of the images, interpolated
    linearly between two distances; the farthest one if it is found there.

    Args:
        distances: From near to far, m.
        shares: Share of the images at each in which the target is found.
    """
    farther: tuple[float, float] | None = None
    for distance, share in reversed(list(zip(distances, shares, strict=True))):
        if math.isnan(share):
            continue
        if share >= FOUND_SHARE:
            if farther is None:
                return distance
            return distance + (farther[0] - distance) * (share - FOUND_SHARE) / (share - farther[1])
        farther = distance, share
    return 0.0


def approach_scores(
    rows: Sequence[Mapping[str, Any]],
    clean_sightings: Sequence[TargetSighting],
    attacked_sightings: Sequence[TargetSighting] | None,
    *,
    replicates: int = 100,
    seed: int = 0,
) -> dict[str, Any]:
    """Return the scores of the target at each distance of an approach, and where it is first detected.

    Args:
        rows: `distance` (m) of each image.
        clean_sightings: Detections in the images without the attack.
        attacked_sightings: Detections with it; None for the clean images alone.
        replicates: Replicates of the bootstrap over drives.
        seed: Seed of its draws, which are the same for all attacks on the same images.

    Returns:
        approach: for each distance `distance`, `n` images, `drives`, `height` (median of the target's box, px), `AP50`,
            `confidence` (mean score) and `found` (share above 0.25); with five drives or more also `intervals` and
            `replicates` of the first two;
        axis: the distances at which attacks are scored (see `axis_of`);
        first_detected: on this axis, m (see `first_detection`), with its 95 % `interval` (percentiles over drives)
            where there are enough; `is_end`: it is the end of the axis, so the target may be detected from farther.
    """
    sightings = clean_sightings if attacked_sightings is None else attacked_sightings
    distance_of_image = np.array([float(row["distance"]) for row in rows])
    distances = sorted(set(distance_of_image.tolist()))
    drives = sorted({entry.drive for entry in sightings})
    drive_of_image: I32 = np.array([drives.index(entry.drive) for entry in sightings], np.int32)
    confidences = np.array([float(entry.confidences()[0]) for entry in sightings])
    groups = [np.flatnonzero(distance_of_image == distance).tolist() for distance in distances]
    axis = axis_of(distances, [precision([clean_sightings[index] for index in group]) for group in groups])
    cells = [
        _cell(distance, [sightings[index] for index in group], confidences[group], replicates=replicates, seed=seed)
        for distance, group in zip(distances, groups, strict=True)
    ]
    is_found = confidences > CONFIDENCES[0]
    shares = _found_shares(is_found, distance_of_image, drive_of_image, axis, [np.arange(len(drives))])[0]
    first = first_detection(axis, shares)
    record: dict[str, Any] = {"distance": round(first, 3), "is_end": bool(axis) and first == axis[-1]}
    if len(drives) >= MIN_CLUSTERS and replicates and axis:
        rng = generator("target approach", seed)
        draws = [rng.integers(len(drives), size=len(drives)) for _ in range(replicates)]
        resampled = _found_shares(is_found, distance_of_image, drive_of_image, axis, draws)
        limits = np.percentile([first_detection(axis, replicate) for replicate in resampled], [2.5, 97.5])
        record["interval"] = [round(float(limit), 3) for limit in limits]
    return {"approach": cells, "axis": axis, "first_detected": record}


def _cell(
    distance: float, sightings: Sequence[TargetSighting], confidences: F64, *, replicates: int, seed: int
) -> dict[str, Any]:
    """Return the scores of the images at one distance."""
    drives = sorted({entry.drive for entry in sightings})
    drive_of_image: I32 = np.array([drives.index(entry.drive) for entry in sightings], np.int32)
    scores = {"AP50": precision(sightings), "confidence": float(confidences.mean())}
    cell: dict[str, Any] = {
        "distance": distance,
        "n": len(sightings),
        "drives": len(drives),
        "height": round(float(np.median([entry.real[0, 3] - entry.real[0, 1] for entry in sightings])), 1),
        **{name: None if score is None else round(score, 6) for name, score in scores.items()},
        "found": round(float((confidences > CONFIDENCES[0]).mean()), 6),
    }
    if len(drives) < MIN_CLUSTERS or not replicates or scores["AP50"] is None:
        return cell
    rng = generator("target approach", seed, distance)
    draws = [rng.integers(len(drives), size=len(drives)) for _ in range(replicates)]
    sums = np.bincount(drive_of_image, weights=confidences, minlength=len(drives))
    counts = np.bincount(drive_of_image, minlength=len(drives))
    resampled = {
        "AP50": precision_replicates(sightings, drive_of_image, draws, target_only=True, min_score=0.0),
        "confidence": [float(sums[draw].sum() / counts[draw].sum()) for draw in draws],
    }
    intervals = {}
    for name, values in resampled.items():
        variance = np.asarray(np.var(values, ddof=1))
        lower, upper = replicate_limits(np.asarray(scores[name]), variance, len(drives), bounded=True)
        intervals[name] = [round(float(lower), 6), round(float(upper), 6)]
    rounded = {name: [round(value, 5) for value in values] for name, values in resampled.items()}
    return cell | {"intervals": intervals, "replicates": rounded}


def _found_shares(
    is_found: Any, distance_of_image: F64, drive_of_image: I32, axis: Sequence[float], draws: Sequence[I64]
) -> list[list[float]]:
    """Return for each draw of drives the share of the images at each distance in which the target is found."""
    drive_count = int(drive_of_image.max()) + 1
    columns = []
    for distance in axis:
        is_there = distance_of_image == distance
        hits = np.bincount(drive_of_image[is_there], weights=is_found[is_there], minlength=drive_count)
        counts = np.bincount(drive_of_image[is_there], minlength=drive_count)
        columns.append(
            [float(hits[draw].sum() / counts[draw].sum()) if counts[draw].sum() else math.nan for draw in draws]
        )
    return [list(row) for row in zip(*columns, strict=True)] if columns else [[] for _ in draws]
