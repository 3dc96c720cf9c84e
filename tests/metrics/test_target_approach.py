"""Scores on the way to a target: by hand on pictures whose boxes are chosen."""

from __future__ import annotations

import math

import numpy as np
import pytest

from ssad.metrics.target_approach import (
    DECELERATION,
    REACTION,
    approach_scores,
    axis_of,
    first_detection,
    stopping_distance,
)
from ssad.metrics.target_attacks import TargetSighting

BOX = np.array([[10.0, 20.0, 50.0, 44.0]])


def sighting(drive: str, score: float) -> TargetSighting:
    """A picture in which the target is found with a score; 0: not at all."""
    box, scores = (BOX, np.array([score])) if score else (np.zeros((0, 4)), np.zeros(0))
    return TargetSighting(drive, box, scores, BOX, np.zeros(1, np.bool_), score)


def test_a_stop_is_reaction_and_braking() -> None:
    """Without a build-up the textbook formula; with one, the integral of the braking."""
    assert stopping_distance(20.0, reaction=1.5, deceleration=8.0, build_up=0.0) == pytest.approx(30.0 + 25.0)
    for speed in (1.0, 8.0, 22.0):
        current, travelled, step = speed, speed * REACTION, 1e-4
        time = 0.0
        while current > 0.0:
            change = DECELERATION * min((time + step / 2) / 0.6, 1.0) * step
            travelled += (current - change / 2) * step
            current -= change
            time += step
        assert stopping_distance(speed) == pytest.approx(travelled, abs=0.01)
    assert [round(stopping_distance(kmh / 3.6), 1) for kmh in (30, 50, 80)] == [16.5, 32.7, 64.6]


def test_the_axis_ends_where_the_clean_target_is_lost() -> None:
    assert axis_of([80, 5, 10, 20, 40], [0.95, 0.3, 0.8, 0.9, 0.79]) == [10, 20]
    assert axis_of([5, 10], [None, 0.1]) == []


def test_the_first_detection_is_interpolated_from_far() -> None:
    distances = [5.0, 10.0, 20.0, 40.0]
    assert first_detection(distances, [1.0, 1.0, 1.0, 0.5]) == 40.0
    assert first_detection(distances, [1.0, 1.0, 0.75, 0.25]) == pytest.approx(30.0)
    assert first_detection(distances, [0.0, 0.0, 1.0, 0.0]) == pytest.approx(30.0), "lost again nearby, yet detected"
    assert first_detection(distances, [0.4, 0.0, 0.1, 0.2]) == 0.0
    assert first_detection(distances, [1.0, math.nan, 0.0, math.nan]) == pytest.approx(12.5)


def test_scores_by_distance() -> None:
    """Six drives; the attack hides the target from 20 m on, and the clean one is lost at 40 m."""
    drives, distances = [f"d{k}" for k in range(6)], [5.0, 10.0, 20.0, 40.0]
    places = [(drive, distance) for drive in drives for distance in distances]
    rows = [{"distance": distance} for _, distance in places]
    clean = [sighting(drive, 0.0 if distance == 40.0 else 0.9) for drive, distance in places]
    attacked = [
        sighting(drive, {5.0: 0.9, 10.0: 0.1 if drive == "d0" else 0.6, 20.0: 0.0, 40.0: 0.0}[distance])
        for drive, distance in places
    ]
    found = approach_scores(rows, clean, attacked, replicates=50)
    assert found["axis"] == [5.0, 10.0, 20.0]
    near, middle, far, beyond = found["approach"]
    assert (near["AP50"], middle["AP50"], far["AP50"], beyond["AP50"]) == (1.0, 1.0, 0.0, 0.0)
    assert middle["confidence"] == pytest.approx((0.1 + 5 * 0.6) / 6)
    assert middle["found"] == pytest.approx(5 / 6, abs=1e-6)
    assert (near["n"], near["drives"], near["height"]) == (6, 6, 24.0)
    low, high = middle["intervals"]["confidence"]
    assert low < middle["confidence"] < high
    assert found["first_detected"]["distance"] == pytest.approx(10 + 10 * (5 / 6 - 0.5) / (5 / 6), abs=1e-3)
    low, high = found["first_detected"]["interval"]
    assert low < found["first_detected"]["distance"] <= high == 15.0
    unattacked = approach_scores(rows, clean, None, replicates=50)
    assert unattacked["first_detected"] == {"distance": 20.0, "is_end": True, "interval": [20.0, 20.0]}
    assert not found["first_detected"]["is_end"]


def test_attacks_are_resampled_alike_and_few_drives_have_no_interval() -> None:
    """Replicates of two attacks are of the same draws, so their differences are paired."""
    drives = [f"d{k}" for k in range(5)]
    rows = [{"distance": 10.0}] * 5
    clean = [sighting(drive, 0.9) for drive in drives]
    scores = [0.1, 0.2, 0.3, 0.4, 0.5]
    lower = approach_scores(rows, clean, [sighting(d, s) for d, s in zip(drives, scores, strict=True)], replicates=20)
    higher = approach_scores(
        rows, clean, [sighting(d, s + 0.25) for d, s in zip(drives, scores, strict=True)], replicates=20
    )
    pairs = zip(*(one["approach"][0]["replicates"]["confidence"] for one in (higher, lower)), strict=True)
    assert [first - second for first, second in pairs] == pytest.approx([0.25] * 20, abs=2e-5)
    few = approach_scores(rows[:4], clean[:4], None, replicates=20)
    assert "intervals" not in few["approach"][0]
    assert "interval" not in few["first_detected"]
