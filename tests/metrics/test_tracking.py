"""HOTA, MOTA and IDF1: cases that can be counted by hand; TrackEval on random tracks and on those of our tracker."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.optional import import_or_skip

from ssad.core.perception import no_objects
from ssad.drivers.perceiving.tracker import KalmanTracker
from ssad.metrics.tracking import TrackedFrame, similarity_of, track_scores


def frame(*pairs: tuple[int, int]) -> TrackedFrame:
    """Objects with tracks that lie on them; a negative number: nobody."""
    objects = np.array([one for one, _ in pairs if one >= 0])
    tracks = np.array([other for _, other in pairs if other >= 0])
    same = np.array([[float((one, other) in pairs) for other in tracks] for one in objects])
    return TrackedFrame(objects, tracks, same.reshape(len(objects), len(tracks)))


def test_perfect_tracks_have_full_scores_and_nothing_there_has_none() -> None:
    scores = track_scores([frame((4, 0), (7, 1)), frame((7, 1), (4, 0))])
    assert scores is not None
    assert (scores.hota, scores.detection, scores.association, scores.mota, scores.idf1) == (1.0, 1.0, 1.0, 1.0, 1.0)
    assert scores.switches == 0
    assert track_scores([frame(), frame((-1, 3))]) is None


def test_a_switch_a_miss_and_a_false_track_count_as_they_are_defined() -> None:
    switched = track_scores([frame((0, 0)), frame((0, 0)), frame((0, 1)), frame((0, 1))])
    assert switched is not None
    assert switched.switches == 1
    assert switched.mota == 1.0 - 1 / 4
    assert switched.idf1 == 0.5
    assert switched.detection == 1.0
    assert np.isclose(switched.association, 0.5)  # each hit: 2 of 4 frames together
    poor = track_scores([frame((0, 0), (1, -1)), frame((0, 0), (1, -1), (-1, 5))])
    assert poor is not None
    assert poor.mota == (2 - 1) / 4
    assert np.isclose(poor.idf1, 2 / (0.5 * (4 + 3)))
    assert np.isclose(poor.detection, 2 / (2 + 2 + 1))


def random_frames(seed: int) -> list[TrackedFrame]:
    """Objects that wander, and tracks on them that are lost, change and invent."""
    draws = np.random.default_rng(seed)
    place, names = draws.uniform(0, 30, (6, 2)), np.arange(6)
    frames = []
    for _ in range(40):
        place = place + draws.normal(0, 0.4, place.shape)
        there = draws.random(6) < 0.9
        seen = draws.random(6) < 0.7
        names = np.where(draws.random(6) < 0.06, draws.permutation(6) + 6 * draws.integers(0, 4, 6), names)
        tracks, first = np.unique(names[seen], return_index=True)
        at = (place + draws.normal(0, 0.8, place.shape))[seen][first]
        frames.append(TrackedFrame(np.flatnonzero(there), tracks, similarity_of(place[there], at, 4.0)))
    return frames


def tracker_frames() -> list[TrackedFrame]:
    """Our tracker on cars that cross, with misses and false finds."""
    draws, tracker, frames = np.random.default_rng(5), KalmanTracker(None, 1), []
    start, speed = draws.uniform(-20, 20, (8, 2)), draws.uniform(-6, 6, (8, 2))
    for step in range(60):
        time = 0.2 * step
        place = start + speed * time
        found = place[draws.random(8) < 0.75]
        found = np.concatenate([found + draws.normal(0, 0.4, found.shape), draws.uniform(-30, 30, (1, 2))])
        n = len(found)
        objects = replace(
            no_objects(),
            scene=np.zeros(n, np.int64),
            place=found,
            covariance=np.tile(0.2 * np.eye(2), (n, 1, 1)),
            yaw=np.zeros(n),
            size=np.tile([4.5, 1.9], (n, 1)),
            velocity=np.full((n, 2), np.nan),
            kind=np.ones(n, np.int64),
            score=np.full(n, 0.8),
        )
        tracker.update(np.array([0]), np.array([time]), objects)
        tracks = tracker.confirmed(np.array([0]), np.array([time]))
        frames.append(TrackedFrame(np.arange(8), tracks.ident, similarity_of(place, tracks.place, 4.0)))
    return frames


# of TrackEval 1.3.0: HOTA, DetA, AssA, MOTA, IDF1, switches
PUBLISHED = {
    0: (0.32489152, 0.47771962, 0.22247264, 0.51415094, 0.40208877, 14),
    1: (0.31541108, 0.44887013, 0.22238092, 0.46728972, 0.44623656, 16),
    2: (0.28076196, 0.41675289, 0.19109327, 0.42583732, 0.34482759, 14),
}


@pytest.mark.parametrize("seed", PUBLISHED)
def test_scores_are_those_that_trackeval_gave(seed: int) -> None:
    own = track_scores(random_frames(seed))
    assert own is not None
    found = (own.hota, own.detection, own.association, own.mota, own.idf1, own.switches)
    np.testing.assert_allclose(found, PUBLISHED[seed], atol=1e-6)


@pytest.mark.parametrize("seed", [0, 1, 2, None])
def test_scores_are_those_of_trackeval(seed: int | None) -> None:
    metrics = import_or_skip("trackeval.metrics", "uv sync --inexact --group references")

    frames = tracker_frames() if seed is None else random_frames(seed)
    own = track_scores(frames)
    assert own is not None
    names = [np.unique(np.concatenate([getattr(f, part) for f in frames])) for part in ("objects", "tracks")]
    data = {
        "num_timesteps": len(frames),
        "num_gt_ids": len(names[0]),
        "num_tracker_ids": len(names[1]),
        "num_gt_dets": sum(len(f.objects) for f in frames),
        "num_tracker_dets": sum(len(f.tracks) for f in frames),
        "gt_ids": [np.searchsorted(names[0], f.objects) for f in frames],
        "tracker_ids": [np.searchsorted(names[1], f.tracks) for f in frames],
        "similarity_scores": [f.similarity for f in frames],
    }
    hota, clear, identity = (
        made.eval_sequence(data)
        for made in (
            metrics.HOTA(),
            metrics.CLEAR({"PRINT_CONFIG": False}),
            metrics.Identity({"PRINT_CONFIG": False}),
        )
    )
    expected = [np.mean(hota["HOTA"]), np.mean(hota["DetA"]), np.mean(hota["AssA"]), clear["MOTA"], identity["IDF1"]]
    np.testing.assert_allclose([own.hota, own.detection, own.association, own.mota, own.idf1], expected, atol=1e-12)
    assert own.switches == clear["IDSW"]
    assert 0.2 < own.hota < 0.95
    if seed is not None:
        assert own.switches > 5


@pytest.mark.parametrize(("variable", "outcome"), [("1", pytest.fail.Exception), ("0", pytest.skip.Exception)])
def test_in_continuous_integration_nothing_is_compared_with_less(
    variable: str, outcome: type[BaseException], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SSAD_CI", variable)
    with pytest.raises(outcome, match="no module trackeval_of_nobody: install it"):
        import_or_skip("trackeval_of_nobody", "install it")


def test_one_object_in_one_frame_is_enough() -> None:
    scores = track_scores([frame((0, 0), (-1, 4), (-1, 5))])
    assert scores is not None
    assert scores.mota == 1.0 - 2.0
