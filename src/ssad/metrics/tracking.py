"""Tracking metrics: HOTA, MOTA and IDF1.

HOTA: Luiten et al., HOTA: a higher order metric for evaluating multi-object tracking (IJCV 2021). MOTA: Bernardin and
Stiefelhagen, CLEAR MOT (2008). IDF1: Ristani et al., Performance measures and a data set for multi-target,
multi-camera tracking (ECCV workshops 2016). Tests compare all three with TrackEval.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from ssad.core.types import F64, Bool

ENOUGH: Final = 0.5  # similarity from which a track is on its object, for MOTA and IDF1
LEVELS: Final = np.arange(1, 20) * 0.05  # similarities that HOTA is averaged over
_EPS: Final = float(np.finfo(np.float64).eps)
I64 = npt.NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class TrackedFrame:
    """Objects and tracks of a moment.

    Attributes:
        objects: Identities of the objects [n], constant over time, each once.
        tracks: Identities of the tracks [m], likewise.
        similarity: Agreement of each track with each object [n, m], in 0..1.
    """

    objects: I64
    tracks: I64
    similarity: F64


@dataclass(frozen=True, slots=True)
class TrackScores:
    """Scores of the tracks of a sequence.

    Attributes:
        hota: Geometric mean of the next two, over similarities from 0.05 to 0.95.
        detection: Mutual coverage of objects and tracks (DetA), the mean over these.
        association: Consistency of a track with its object (AssA), the mean over these.
        mota: 1 less misses, false tracks and switches, as a share of the objects; may be negative.
        idf1: F1 of identities.
        switches: Number of times that an object gets another track than before.
    """

    hota: float
    detection: float
    association: float
    mota: float
    idf1: float
    switches: int


def similarity_of(positions: F64, tracks: F64, max_distance: float) -> F64:
    """Return the similarity [n, m] of objects [n, 2] and tracks [m, 2]: 1 on the spot, 0 at `max_distance` m."""
    distance = np.linalg.norm(positions[:, None] - tracks[None], axis=-1)
    return np.asarray(np.maximum(1.0 - distance / max_distance, 0.0), np.float64)


def track_scores(frames: Sequence[TrackedFrame]) -> TrackScores | None:
    """Return the scores of a sequence; None if it has no object.

    Args:
        frames: Its moments, in order.
    """
    if not sum(len(frame.objects) for frame in frames):
        return None
    renumbered = _renumber(frames)
    hota, detection, association = _hota(renumbered)
    mota, switches = _clear_mot(renumbered)
    return TrackScores(hota, detection, association, mota, _idf1(renumbered), switches)


def _renumber(frames: Sequence[TrackedFrame]) -> list[TrackedFrame]:
    """Renumber objects and tracks from 0."""
    no_identities = [np.zeros(0, np.int64)]
    objects = np.unique(np.concatenate([*no_identities, *(frame.objects for frame in frames)]))
    tracks = np.unique(np.concatenate([*no_identities, *(frame.tracks for frame in frames)]))
    return [
        TrackedFrame(
            np.searchsorted(objects, source.objects), np.searchsorted(tracks, source.tracks), source.similarity
        )
        for source in frames
    ]


def _counts(frames: Sequence[TrackedFrame]) -> tuple[F64, F64]:
    """Return the number of frames of each object and of each track."""
    counts = []
    for name in ("objects", "tracks"):
        identities = np.concatenate([getattr(frame, name) for frame in frames])
        counts.append(np.bincount(identities, minlength=1).astype(np.float64))
    return counts[0], counts[1]


def _pairs(score: F64) -> tuple[I64, I64]:
    """Return rows and columns of the assignment with the greatest sum."""
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-score)
    return rows, columns


def _hota(frames: Sequence[TrackedFrame]) -> tuple[float, float, float]:
    """Means over `LEVELS` of HOTA, DetA and AssA."""
    objects, tracks = _counts(frames)
    shared_similarity = np.zeros((len(objects), len(tracks)))
    for frame in frames:
        similarity = frame.similarity
        union = similarity.sum(0)[None] + similarity.sum(1)[:, None] - similarity
        share = np.divide(similarity, union, out=np.zeros_like(similarity), where=union > _EPS)
        shared_similarity[np.ix_(frame.objects, frame.tracks)] += share
    alignment = shared_similarity / (objects[:, None] + tracks[None] - shared_similarity)
    matches = np.zeros((len(LEVELS), len(objects), len(tracks)))
    for frame in frames:
        rows, columns = _pairs(alignment[np.ix_(frame.objects, frame.tracks)] * frame.similarity)
        is_match: Bool = frame.similarity[rows, columns] >= LEVELS[:, None] - _EPS
        matches[:, frame.objects[rows], frame.tracks[columns]] += is_match
    hits = matches.sum((1, 2))
    detection = hits / np.maximum(objects.sum() + tracks.sum() - hits, 1.0)
    association_sums = matches * matches / np.maximum(objects[:, None] + tracks[None] - matches, 1.0)
    association = association_sums.sum((1, 2)) / np.maximum(hits, 1.0)
    return float(np.sqrt(detection * association).mean()), float(detection.mean()), float(association.mean())


def _clear_mot(frames: Sequence[TrackedFrame]) -> tuple[float, int]:
    """Return MOTA and switches; pairs of the previous frame take precedence."""
    objects, _ = _counts(frames)
    latest_track, previous_track = (
        np.full(len(objects), -1),
        np.full(len(objects), -1),
    )  # track of each object: so far, a frame ago
    hits = switches = false_tracks = 0
    for frame in frames:
        is_continued = frame.tracks[None] == previous_track[frame.objects][:, None]
        # 1000 outweighs the similarities, so that continued pairs come first.
        score = np.where(frame.similarity < ENOUGH - _EPS, 0.0, 1000.0 * is_continued + frame.similarity)
        rows, columns = _pairs(score)
        is_match = score[rows, columns] > _EPS
        matched_objects, matched_tracks = frame.objects[rows[is_match]], frame.tracks[columns[is_match]]
        switches += int(
            ((latest_track[matched_objects] >= 0) & (latest_track[matched_objects] != matched_tracks)).sum()
        )
        previous_track[:] = -1
        latest_track[matched_objects] = previous_track[matched_objects] = matched_tracks
        hits, false_tracks = hits + len(matched_objects), false_tracks + len(frame.tracks) - len(matched_objects)
    return (hits - false_tracks - switches) / max(float(objects.sum()), 1.0), switches


def _idf1(frames: Sequence[TrackedFrame]) -> float:
    """Return the F1 of identities: each object has at most one track over the whole sequence."""
    objects, tracks = _counts(frames)
    shared_frames = np.zeros((len(objects), len(tracks)))
    for frame in frames:
        shared_frames[np.ix_(frame.objects, frame.tracks)] += frame.similarity >= ENOUGH
    hits = float(shared_frames[_pairs(shared_frames)].sum())
    return hits / max(0.5 * float(objects.sum() + tracks.sum()), 1.0)
