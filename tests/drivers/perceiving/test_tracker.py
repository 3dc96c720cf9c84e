"""Tracks: who is who when ways cross, hits to confirm, reserve, two stages, headings, batches, snapshots."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.core.perception import Objects, no_objects
from ssad.core.types import AgentKind
from ssad.drivers.perceiving.tracker import KalmanTracker, KalmanTracks, TrackerSettings
from ssad.drivers.perceiving.tracks import belief_from_tracks

STEP = 0.2


def objects(*places: tuple[float, float], scene: int = 0, score: float = 0.9, yaw: float = 0.0) -> Objects:
    n = len(places)
    return Objects(
        np.full(n, scene),
        np.array(places, float).reshape(n, 2),
        np.tile(0.09 * np.eye(2), (n, 1, 1)),
        np.full(n, yaw),
        np.tile([4.5, 1.9], (n, 1)),
        np.full((n, 2), np.nan),
        np.full(n, int(AgentKind.CAR)),
        np.full(n, score),
    )


def look(tracker: KalmanTracker, k: int, found: Objects) -> None:
    tracker.update(np.array([0]), np.array([k * STEP]), found)


def idents(tracker: KalmanTracker) -> list[int]:
    return tracker.tracks.ident.tolist()


def test_those_whose_ways_cross_keep_their_identities() -> None:
    tracker = KalmanTracker(TrackerSettings(confirm=2))
    rng = np.random.default_rng(1)
    for k in range(30):
        t = k * STEP
        one, other = (8.0 * t, 3.0 * t - 9.0), (8.0 * t, 9.0 - 3.0 * t)  # they meet at 3 s
        spots = np.array([one, other]) + 0.05 * rng.normal(size=(2, 2))
        order = [0, 1] if k % 2 else [1, 0]  # the order of the objects says nothing
        look(tracker, k, objects(*[tuple(spots[i]) for i in order]))
    assert len(tracker.tracks) == 2
    up = tracker.tracks.mean[:, 3] > 0
    first = tracker.tracks.ident[up][0]
    assert tracker.tracks.mean[up][0, 1] > 5.0
    # the first look had the upper one first
    assert first == 1
    np.testing.assert_allclose(tracker.tracks.mean[:, 2], 8.0, atol=0.5)
    np.testing.assert_allclose(np.abs(tracker.tracks.mean[:, 3]), 3.0, atol=0.5)


@pytest.mark.parametrize("hits", [1, 2, 4])
def test_a_track_is_believed_from_its_last_hit_to_confirm(hits: int) -> None:
    tracker = KalmanTracker(TrackerSettings(confirm=hits))
    for k in range(6):
        look(tracker, k, objects((10.0, 0.0)))
        assert len(tracker.confirmed(np.array([0]), np.array([k * STEP]))) == int(k + 1 >= hits)


@pytest.mark.parametrize("reserve", [0, 1, 3])
def test_a_track_outlives_as_many_looks_without_a_hit_as_its_reserve(reserve: int) -> None:
    tracker = KalmanTracker(TrackerSettings(confirm=2, reserve=reserve))
    look(tracker, 0, objects((10.0, 0.0)))
    look(tracker, 1, objects((10.0, 0.0)))
    for miss in range(1, 6):
        look(tracker, 1 + miss, no_objects())
        assert len(tracker.tracks) == int(miss <= reserve)


def test_a_track_that_was_never_confirmed_is_soon_gone() -> None:
    tracker = KalmanTracker(TrackerSettings(confirm=3, reserve=10, patience=1))
    look(tracker, 0, objects((10.0, 0.0)))
    look(tracker, 1, no_objects())
    assert len(tracker.tracks) == 1
    look(tracker, 2, no_objects())
    assert len(tracker.tracks) == 0


def test_a_low_score_keeps_a_track_but_begins_none() -> None:
    tracker = KalmanTracker(TrackerSettings(confirm=2, reserve=0, high=0.3, low=0.1))
    look(tracker, 0, objects((10.0, 0.0), score=0.2))
    assert len(tracker.tracks) == 0
    look(tracker, 1, objects((10.0, 0.0)))
    look(tracker, 2, objects((10.0, 0.0)))
    look(tracker, 3, objects((10.0, 0.0), score=0.2))
    assert tracker.tracks.hits.tolist() == [3]
    look(tracker, 4, objects((10.0, 0.0), score=0.05))
    assert len(tracker.tracks) == 0


def test_a_high_score_is_matched_before_a_nearer_low_one() -> None:
    tracker = KalmanTracker(TrackerSettings(confirm=1))
    look(tracker, 0, objects((10.0, 0.0)))
    both = Objects.cat([objects((10.05, 0.0), score=0.2), objects((10.4, 0.0), score=0.9)])
    look(tracker, 1, both)
    assert tracker.tracks.score.tolist() == [0.9]


def test_what_is_too_far_away_is_somebody_else() -> None:
    tracker = KalmanTracker(TrackerSettings(confirm=1))
    look(tracker, 0, objects((10.0, 0.0)))
    look(tracker, 1, objects((40.0, 0.0)))
    assert idents(tracker) == [0, 1]
    assert tracker.tracks.missed.tolist() == [1, 0]


def test_speed_and_heading_come_from_motion_and_from_the_body_at_rest() -> None:
    moving, resting = KalmanTracker(TrackerSettings(confirm=1)), KalmanTracker(TrackerSettings(confirm=1))
    for k in range(12):
        # the detector takes its front for its back
        look(moving, k, objects((2.0, 6.0 * k * STEP), yaw=-np.pi / 2))
        look(resting, k, objects((2.0, 6.0), yaw=2.5))
    for tracker, yaw, speed in ((moving, np.pi / 2, 6.0), (resting, 2.5, 0.0)):
        belief = belief_from_tracks(tracker.confirmed(np.array([0]), np.array([11 * STEP])), np.array([0]))
        assert np.cos(belief.pose[0, 0, 2] - yaw) > 0.99
        assert belief.speed[0, 0] == pytest.approx(speed, abs=0.3)


def test_between_looks_a_track_moves_on() -> None:
    tracker = KalmanTracker(TrackerSettings(confirm=1))
    for k in range(20):
        look(tracker, k, objects((5.0 * k * STEP, 1.0)))
    later = tracker.confirmed(np.array([0]), np.array([19 * STEP + 0.5]))
    np.testing.assert_allclose(later.place[0], [5.0 * (19 * STEP + 0.5), 1.0], atol=0.2)
    assert tracker.tracks.time[0] == pytest.approx(19 * STEP)


def drive(tracker: KalmanTracker, scenes: list[int], looks: range) -> None:
    """Each scene has its own walk of a few objects, whichever others share its batch."""
    for k in looks:
        parts = [no_objects()]
        for row, name in enumerate(scenes):
            rng = np.random.default_rng([name, k])
            count = int(rng.integers(0, 4))
            spots = np.array([[10.0 * i, 2.0 * k * STEP] for i in range(count)]).reshape(-1, 2)
            parts.append(objects(*map(tuple, spots + 0.2 * rng.normal(size=spots.shape)), scene=row))
        tracker.update(np.arange(len(scenes)), np.full(len(scenes), k * STEP), Objects.cat(parts))


def same(one: KalmanTracks, other: KalmanTracks) -> bool:
    return all(np.array_equal(getattr(one, f.name), getattr(other, f.name)) for f in fields(KalmanTracks))


def test_a_scene_does_not_depend_on_its_batch() -> None:
    together, alone = KalmanTracker(scenes=3), KalmanTracker(scenes=1)
    drive(together, [5, 6, 7], range(15))
    drive(alone, [6], range(15))
    own = together.tracks.take(together.tracks.scene == 1)
    assert len(own) > 0
    assert same(replace(own, scene=np.zeros(len(own), np.int64)), alone.tracks)


def test_a_scene_that_is_not_looked_at_does_not_change() -> None:
    tracker = KalmanTracker(scenes=2)
    drive(tracker, [5, 6], range(6))
    before = tracker.tracks.take(tracker.tracks.scene == 1)
    tracker.update(np.array([0]), np.array([6 * STEP]), no_objects())
    assert same(tracker.tracks.take(tracker.tracks.scene == 1), before)


def test_a_snapshot_goes_on_to_the_bit() -> None:
    tracker = KalmanTracker(scenes=2)
    drive(tracker, [3, 4], range(8))
    kept = tracker.snapshot()
    drive(tracker, [3, 4], range(8, 16))
    end = tracker.tracks
    other = KalmanTracker(scenes=2)
    other.restore(kept)
    drive(other, [3, 4], range(8, 16))
    assert same(other.tracks, end)


def test_a_belief_has_a_row_for_each_scene_asked_for() -> None:
    tracker = KalmanTracker(TrackerSettings(confirm=1), scenes=3)
    found = Objects.cat([objects((1.0, 0.0), scene=0), objects((2.0, 0.0), (30.0, 0.0), scene=2)])
    tracker.update(np.arange(3), np.zeros(3), found)
    belief = belief_from_tracks(tracker.confirmed(np.array([2, 0, 1]), np.zeros(3)), np.array([2, 0, 1]))
    assert (belief.kind != AgentKind.NONE).sum(1).tolist() == [2, 1, 0]
    assert belief.pose[:2, 0, 0].tolist() == [2.0, 1.0]


def test_wrong_settings_are_one_line() -> None:
    with pytest.raises(ConfigError, match="confirm >= 1"):
        TrackerSettings(confirm=0)
    with pytest.raises(ConfigError, match="low <= high"):
        TrackerSettings(low=0.5, high=0.3)
