"""Realism: features of known motions, the histogram score, distances."""

from __future__ import annotations

import math

import numpy as np
import pytest
from helpers.metric_traces import make_trace

from ssad.metrics.realism import FEATURES, histogram, motion_features, pool_motions, realism, wasserstein

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
