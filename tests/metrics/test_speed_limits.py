"""Metrics of speed limits on a drive that is made by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad import World, build_episode, load_scenarios, load_town, make_system
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import EpisodeTrace
from ssad.metrics.speed_limits import SETTLING, limit_metrics, posted_limits
from ssad.world.rollout import rollout


@pytest.fixture(scope="module")
def drive() -> tuple[EpisodeTrace, LaneGraph]:
    """Return a drive on a road of 60 km/h."""
    (scenario,) = load_scenarios("lane-keeping/ProvingGround_straight_00")
    town = load_town(scenario.town)
    (trace,) = rollout(World([build_episode(scenario, town, seed=0)], {town.name: town}), make_system("no-action"))
    return trace, town


def test_the_posted_limit_is_rounded(drive: tuple[EpisodeTrace, LaneGraph]) -> None:
    trace, town = drive
    assert set(posted_limits(trace, town).tolist()) == {60.0}  # 40 mph


def test_a_wrong_limit_and_its_speed_are_measured(drive: tuple[EpisodeTrace, LaneGraph]) -> None:
    trace, town = drive
    steps = len(trace.x)
    settled = round(SETTLING / trace.dt)
    speed = np.zeros_like(trace.speed)
    speed[settled:, 0] = 80.0 / 3.6
    speed[:settled, 0] = 50.0  # as it came to the sign
    fast = replace(trace, speed=speed)
    limits = [(step * trace.dt, None if step < 10 else 80) for step in range(steps)]
    metrics = limit_metrics(fast, town, limits, first_sign=0.0)
    assert metrics["limit_known"] == 0.0
    assert metrics["limit_error"] == pytest.approx(20.0)
    assert metrics["speeding"] == pytest.approx(20.0, abs=0.01)
    assert metrics["speeding_max"] == pytest.approx(20.0, abs=0.01)
    right = limit_metrics(trace, town, [(time, 60 if limit else None) for time, limit in limits], first_sign=0.0)
    assert right["limit_known"] == pytest.approx(1.0 - 10 / steps)
    assert right["limit_error"] == 0.0


def test_without_a_sign_nothing_is_measured(drive: tuple[EpisodeTrace, LaneGraph]) -> None:
    trace, town = drive
    for first_sign in (None, 1e6):
        assert all(np.isnan(value) for value in limit_metrics(trace, town, [], first_sign=first_sign).values())
