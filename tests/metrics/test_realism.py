"""Realism: features of known motions, the histogram score, distances."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from helpers.metric_traces import make_trace

from ssad.core.errors import FormatError
from ssad.core.safeio import dump_json
from ssad.metrics.human_driving import published
from ssad.metrics.realism import (
    FEATURES,
    REFERENCE,
    histogram,
    motion_features,
    pool_motions,
    published_limits,
    realism,
    reference_data,
    traffic_reference,
    wasserstein,
    within_published,
)
from ssad.world.world import VERSION

STEP = 0.1 * np.arange(21)
INSIDE = np.full(21, -3.0)


def test_features_of_a_motion_that_is_known() -> None:
    speed = 5.0 + 2.0 * STEP
    other = (50.0, 0.0, 0.0, 0.0)
    agent = (5.0 * STEP + STEP**2, 0.0, 0.3 * STEP**2, speed)
    found = motion_features(make_trace(21, [(-100.0, 0, 0, 0), agent, other]), 1, INSIDE)
    assert found["speed"] == pytest.approx(speed, abs=1e-5)
    assert found["acceleration"] == pytest.approx(2.0, abs=1e-3)
    assert found["yaw_rate"][0] == pytest.approx(0.03, abs=1e-3)
    assert found["yaw_acceleration"] == pytest.approx(0.6, abs=1e-2)
    assert found["nearest"][0] == pytest.approx(46.0)
    assert found["ttc"][0] == 5.0  # 9.2 s away
    assert found["collision"].tolist() == [0.0]
    assert found["off_road"].tolist() == [0.0]
    straight = motion_features(make_trace(21, [(-100.0, 0, 0, 0), (10 * STEP, 0, 0, 10.0), other]), 1, INSIDE)
    assert straight["ttc"][10] == pytest.approx(3.6)
    edge = INSIDE.copy()
    edge[4] = 0.2
    assert motion_features(make_trace(21, [other, agent]), 1, edge)["off_road"].tolist() == [1.0]


def test_touching_the_ego_is_no_collision_and_touching_another_is() -> None:
    still = (0.0, 0.0, 0.0, 0.0)
    assert motion_features(make_trace(21, [still, still]), 1, INSIDE)["collision"].tolist() == [0.0]
    far = (300.0, 0.0, 0.0, 0.0)
    assert motion_features(make_trace(21, [far, still, still]), 1, INSIDE)["collision"].tolist() == [1.0]


def test_the_weights_are_the_challenges_without_red_lights() -> None:
    assert sum(f.weight for f in FEATURES.values()) == pytest.approx(0.95)


def test_a_histogram_counts_what_lies_outside_at_its_ends() -> None:
    found = histogram(np.array([-1.0, 0.1, 99.0]), FEATURES["speed"])
    assert found[0] == pytest.approx(2.1 / 4.0)
    assert found[9] == pytest.approx(1.1 / 4.0)
    assert found[5] == pytest.approx(0.1 / 4.0)
    assert found.sum() == pytest.approx(1.0)


def values(speed: float) -> dict[str, np.ndarray]:
    """Constant values: one bin a feature."""
    return {name: np.full(40, speed if name == "speed" else 0.0) for name in FEATURES}


def test_the_score_is_the_weighted_likelihood() -> None:
    reference = values(6.0)
    full = 40.1 / 41.0  # of 10 bins one holds all 40; of 11 likewise 40.1 / 41.1; of 2 40.1 / 40.2
    same = realism(values(6.0), reference)
    assert same == pytest.approx((0.05 * full + 0.15 * 40.1 / 41.1 + 0.25 * full + 0.5 * 40.1 / 40.2) / 0.95, rel=1e-9)
    other = realism(values(20.0), reference)
    assert same - other == pytest.approx(0.05 * (40.1 - 0.1) / 41.0 / 0.95, rel=1e-9)
    assert math.isnan(realism(pool_motions([]), reference))
    assert wasserstein(values(20.0), reference)["speed"] == pytest.approx(14.0)
    assert wasserstein(values(20.0), reference)["acceleration"] == 0.0
    assert math.isnan(wasserstein(pool_motions([]), reference)["speed"])


def test_the_histograms_are_the_challenges() -> None:
    """WOSAC's configuration of 2024: limits and bins of the kinematic, interactive and map-based features."""
    challenge = {
        "speed": (0.0, 25.0, 10),
        "acceleration": (-12.0, 12.0, 11),
        "yaw_rate": (-0.628, 0.628, 11),
        "yaw_acceleration": (-3.14, 3.14, 11),
        "nearest": (-5.0, 40.0, 10),
        "ttc": (0.0, 5.0, 10),
        "road_edge": (-20.0, 40.0, 10),
        "collision": (0.0, 1.0, 2),
        "off_road": (0.0, 1.0, 2),
    }
    assert {name: (feature.low, feature.high, feature.bins) for name, feature in FEATURES.items()} == challenge


def within(speed: np.ndarray, yaw_rate: float = 0.0) -> np.ndarray:
    """Steps within the published limits of a motion with a speed for each step of 0.1 s."""
    place = np.cumsum(speed) * 0.1
    agent = (place, 0.0, yaw_rate * 0.1 * np.arange(len(speed)), speed)
    return within_published(make_trace(len(speed), [(-100.0, 0, 0, 0), agent]), 1)


def test_the_published_limits_are_those_of_the_sources() -> None:
    limits = published_limits()
    assert limits.acceleration in [v.mean for v in published("acceleration from rest")]
    assert limits.deceleration in [v.high for v in published("largest deceleration of a routine stop")]
    assert limits.lateral in [v.high for v in published("lateral acceleration in turns")]
    assert limits.jerk in [v.high for v in published("jerk")]


def test_steps_count_as_ordinary_up_to_the_published_limits() -> None:
    limits, time = published_limits(), 0.1 * np.arange(21)
    assert len(within(5.0 + time)) == 20
    for value, ordinary in ((0.95 * limits.acceleration, True), (1.05 * limits.acceleration, False)):
        assert within(2.0 + value * time).all() == ordinary
    for value, ordinary in ((0.95 * limits.deceleration, True), (1.05 * limits.deceleration, False)):
        assert within(10.0 - value * time).all() == ordinary
    for value, ordinary in ((0.95 * limits.lateral, True), (1.05 * limits.lateral, False)):
        assert within(np.full(21, 8.0), value / 8.0).all() == ordinary
    # from one acceleration to another at 1 s: over windows of 0.5 s a jerk of twice their difference
    for step, ordinary in ((0.48 * limits.jerk, True), (0.52 * limits.jerk, False)):
        rise = 0.45 * step * np.minimum(time, 1.0) - 0.55 * step * np.maximum(time - 1.0, 0.0)
        assert within(8.0 + rise).all() == ordinary


def test_a_reference_keeps_distributions_and_counts(tmp_path: Path) -> None:
    draws = np.random.default_rng(0)
    motions = [
        {name: draws.normal(5.0, 2.0, 60) if f.bins > 2 else np.array([float(k < 2)]) for name, f in FEATURES.items()}
        for k in range(40)
    ]
    path = tmp_path / "reference.json"
    path.write_text(dump_json(reference_data(motions, world=1)))
    kept, pooled = traffic_reference(path), pool_motions(motions)
    assert json.loads(path.read_text())["about"] == {"world": 1, "motions": 40}
    assert (len(kept["collision"]), kept["collision"].sum()) == (40, 2.0)
    assert all(distance < 0.02 for distance in wasserstein(kept, pooled).values())
    assert realism(motions[5], kept) == pytest.approx(realism(motions[5], pooled), rel=0.01)
    path.write_text("{}")
    with pytest.raises(FormatError, match=r"reference.json: no reference of traffic; make it with python -m"):
        traffic_reference(path)


def test_the_shipped_reference_is_of_this_world_and_tells_ordinary_motions_from_others() -> None:
    about = json.loads(REFERENCE.read_text())["about"]
    assert about["world"] == VERSION, "run python -m benchmarks.traffic_reference"
    assert about["motions"] > 500
    reference = traffic_reference()
    assert 4.0 < np.quantile(reference["speed"], 0.8) < 12.0  # many wait for the ego to come near
    assert np.quantile(np.abs(reference["acceleration"]), 0.99) < 4.0
    fast, swerving = ({**reference, name: values} for name, values in UNLIKELY.items())
    assert max(realism(fast, reference), realism(swerving, reference)) < realism(reference, reference) - 0.01


UNLIKELY = {"speed": np.full(50, 22.0), "yaw_rate": np.full(50, 0.6)}
