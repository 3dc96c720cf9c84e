"""How well tracks follow objects: HOTA, MOTA and IDF1.

HOTA: Luiten et al., HOTA: a higher order metric for evaluating multi-object tracking (IJCV 2021). MOTA: Bernardin and
Stiefelhagen, CLEAR MOT (2008). IDF1: Ristani et al., Performance measures and a data set for multi-target,
multi-camera tracking (ECCV workshops 2016). Tests hold all three to TrackEval.
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
        objects: Who is there [n], numbers that stay over time, each once.
        tracks: Which tracks there are [m], likewise.
        similarity: How well each track lies on each object [n, m], in 0..1.
    """

    objects: I64
    tracks: I64
    similarity: F64


@dataclass(frozen=True, slots=True)
class TrackScores:
    """Scores of the tracks of a sequence.

    Attributes:
        hota: Geometric mean of the next two, over similarities from 0.05 to 0.95.
        detection: How well objects and tracks cover each other (DetA), the mean over these.
        association: How well a track stays with its object (AssA), the mean over these.
        mota: 1 less misses, false tracks and switches, as a share of the objects; may be negative.
        idf1: F1 of identities.
        switches: How often an object gets another track than before.
    """

    hota: float
    detection: float
    association: float
    mota: float
    idf1: float
    switches: int


def similarity_of(places: F64, tracks: F64, reach: float) -> F64:
    """How well tracks [m, 2] lie on objects [n, 2] on the ground, [n, m]: 1 on the spot, falling to 0 at `reach` m."""
    apart = np.linalg.norm(places[:, None] - tracks[None], axis=-1)
    return np.asarray(np.maximum(1.0 - apart / reach, 0.0), np.float64)


def track_scores(frames: Sequence[TrackedFrame]) -> TrackScores | None:
    """Scores of a sequence; None: nothing was ever there.

    Args:
        frames: Its moments, in order.
    """
    if not sum(len(frame.objects) for frame in frames):
        return None
    dense = _numbered(frames)
    hota, detection, association = _hota(dense)
    mota, switches = _clear(dense)
    return TrackScores(hota, detection, association, mota, _idf1(dense), switches)


def _numbered(frames: Sequence[TrackedFrame]) -> list[TrackedFrame]:
    """The same with objects and tracks numbered from 0."""
    none = [np.zeros(0, np.int64)]
    objects = np.unique(np.concatenate([*none, *(frame.objects for frame in frames)]))
    tracks = np.unique(np.concatenate([*none, *(frame.tracks for frame in frames)]))
    return [
        TrackedFrame(np.searchsorted(objects, f.objects), np.searchsorted(tracks, f.tracks), f.similarity)
        for f in frames
    ]


def _counts(frames: Sequence[TrackedFrame]) -> tuple[F64, F64]:
    """In how many frames each object and each track is."""
    found = []
    for name in ("objects", "tracks"):
        every = np.concatenate([getattr(frame, name) for frame in frames])
        found.append(np.bincount(every, minlength=1).astype(np.float64))
    return found[0], found[1]


def _pairs(score: F64) -> tuple[I64, I64]:
    """Rows and columns of the assignment with the greatest sum."""
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(-score)
    return rows, columns


def _hota(frames: Sequence[TrackedFrame]) -> tuple[float, float, float]:
    """Means over `LEVELS` of HOTA, DetA and AssA."""
    objects, tracks = _counts(frames)
    shared = np.zeros((len(objects), len(tracks)))
    for frame in frames:
        own = frame.similarity
        both = own.sum(0)[None] + own.sum(1)[:, None] - own
        share = np.divide(own, both, out=np.zeros_like(own), where=both > _EPS)
        shared[np.ix_(frame.objects, frame.tracks)] += share
    alignment = shared / (objects[:, None] + tracks[None] - shared)
    matches = np.zeros((len(LEVELS), len(objects), len(tracks)))
    for frame in frames:
        rows, columns = _pairs(alignment[np.ix_(frame.objects, frame.tracks)] * frame.similarity)
        good: Bool = frame.similarity[rows, columns] >= LEVELS[:, None] - _EPS
        matches[:, frame.objects[rows], frame.tracks[columns]] += good
    hits = matches.sum((1, 2))
    detection = hits / np.maximum(objects.sum() + tracks.sum() - hits, 1.0)
    together = matches * matches / np.maximum(objects[:, None] + tracks[None] - matches, 1.0)
    association = together.sum((1, 2)) / np.maximum(hits, 1.0)
    return float(np.sqrt(detection * association).mean()), float(detection.mean()), float(association.mean())


def _clear(frames: Sequence[TrackedFrame]) -> tuple[float, int]:
    """MOTA and switches; a pair of the frame before goes before any other."""
    objects, _ = _counts(frames)
    ever, last = np.full(len(objects), -1), np.full(len(objects), -1)  # track of each object: so far, a frame ago
    hits = switches = false = 0
    for frame in frames:
        stays = frame.tracks[None] == last[frame.objects][:, None]
        score = np.where(frame.similarity < ENOUGH - _EPS, 0.0, 1000.0 * stays + frame.similarity)
        rows, columns = _pairs(score)
        good = score[rows, columns] > _EPS
        who, by = frame.objects[rows[good]], frame.tracks[columns[good]]
        switches += int(((ever[who] >= 0) & (ever[who] != by)).sum())
        last[:] = -1
        ever[who] = last[who] = by
        hits, false = hits + len(who), false + len(frame.tracks) - len(who)
    return (hits - false - switches) / max(float(objects.sum()), 1.0), switches


def _idf1(frames: Sequence[TrackedFrame]) -> float:
    """F1 of identities: each object has one track at the most, over the whole sequence."""
    objects, tracks = _counts(frames)
    shared = np.zeros((len(objects), len(tracks)))
    for frame in frames:
        shared[np.ix_(frame.objects, frame.tracks)] += frame.similarity >= ENOUGH
    hits = float(shared[_pairs(shared)].sum())
    return hits / max(0.5 * float(objects.sum() + tracks.sum()), 1.0)
