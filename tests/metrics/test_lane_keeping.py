"""Metrics of lane keeping on a drive that is made by hand: one steady deviation, one departure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad import World, build_episode, load_scenarios, load_town, make_system
from ssad.core.lane_graph import LaneGraph
from ssad.core.perception import PerceivedLane
from ssad.core.types import EpisodeTrace
from ssad.metrics.lane_keeping import is_outside, lane_course, lane_metrics, lane_position
from ssad.world.rollout import rollout


@pytest.fixture(scope="module")
def drive() -> tuple[EpisodeTrace, LaneGraph]:
    """Return a drive in the middle of a straight lane."""
    (scenario,) = load_scenarios("lane-keeping/ProvingGround_straight_00")
    town = load_town(scenario.town)
    (trace,) = rollout(World([build_episode(scenario, town, seed=0)], {town.name: town}), make_system("no-action"))
    return trace, town


def moved(trace: EpisodeTrace, left: np.ndarray) -> EpisodeTrace:
    """Return the drive with the ego moved to the left at each step, m."""
    x, y, yaw = trace.x.copy(), trace.y.copy(), trace.yaw[:, 0]
    x[:, 0] -= left * np.sin(yaw)
    y[:, 0] += left * np.cos(yaw)
    return replace(trace, x=x, y=y)


def test_a_shifted_drive_deviates_by_the_shift(drive: tuple[EpisodeTrace, LaneGraph]) -> None:
    trace, town = drive
    steps = len(trace.x)
    assert np.abs(lane_position(trace, town).deviation).max() < 0.02
    for shift in (0.4, -0.7):
        position = lane_position(moved(trace, np.full(steps, shift)), town)
        np.testing.assert_allclose(position.deviation, shift, atol=0.02)
        np.testing.assert_allclose(position.width, 3.5, atol=0.01)
    along = lane_position(trace, town).along
    assert (np.diff(along) >= -1e-6).all()
    assert along[-1] > 140.0


def test_the_time_of_a_departure_counts_from_when_the_place_is_in_view(drive: tuple[EpisodeTrace, LaneGraph]) -> None:
    trace, town = drive
    steps = len(trace.x)
    free = 0.5 * (3.5 - float(trace.width[0]))
    departs = int(0.8 * steps)
    left = np.where(np.arange(steps) < departs, 0.5 * free, free + 0.1)
    changed = moved(trace, left)
    along = lane_position(changed, town).along
    place = 60.0
    in_view = int((along >= place - 30.0).argmax())
    metrics = lane_metrics(changed, town, [], place=place, view=30.0)
    assert metrics["lane_departure"] == 1.0
    assert metrics["departure_time"] == pytest.approx((departs - in_view) * trace.dt)
    assert metrics["lane_deviation_max"] == pytest.approx(free + 0.1, abs=0.02)
    assert np.isnan(lane_metrics(trace, town, [])["departure_time"])
    assert lane_metrics(trace, town, [])["lane_departure"] == 0.0


def test_a_drive_that_never_sees_the_place_departs_from_nothing(drive: tuple[EpisodeTrace, LaneGraph]) -> None:
    trace, town = drive
    changed = moved(trace, np.full(len(trace.x), 2.0))
    assert lane_metrics(changed, town, [], place=60.0, view=30.0)["lane_departure"] == 1.0
    metrics = lane_metrics(changed, town, [], place=1000.0, view=30.0)
    assert metrics["lane_deviation"] == pytest.approx(2.0, abs=0.02)
    assert np.isnan([metrics[name] for name in ("lane_deviation_max", "lane_departure", "departure_time")]).all()


def test_a_body_that_turns_needs_more_room(drive: tuple[EpisodeTrace, LaneGraph]) -> None:
    position = lane_position(*drive)
    assert not is_outside(position, 4.0, 1.9).any()
    turned = replace(position, heading=np.full(len(position.heading), 0.6))
    assert is_outside(turned, 4.0, 1.9).all()


def test_errors_of_the_camera_are_those_of_the_middle_of_the_lane(drive: tuple[EpisodeTrace, LaneGraph]) -> None:
    trace, town = drive
    changed = moved(trace, np.full(len(trace.x), 0.5))
    right = PerceivedLane(-0.5, 0.0, 0.0, 3.5, 0.9)
    wrong = PerceivedLane(-0.1, 0.0, 0.0, 3.5, 0.3)
    assert lane_metrics(changed, town, [(1.0, right)])["lane_error"] == pytest.approx(0.0, abs=0.02)
    metrics = lane_metrics(changed, town, [(1.0, right), (2.0, wrong), (3.0, None), (4.0, None)])
    assert metrics["lane_error"] == pytest.approx(0.2, abs=0.02)
    assert metrics["lane_detection_rate"] == 0.25
    assert np.isnan(lane_metrics(changed, town, [])["lane_error"])


def test_the_course_is_the_deviation_along_the_route(drive: tuple[EpisodeTrace, LaneGraph]) -> None:
    trace, town = drive
    course = lane_course(moved(trace, np.full(len(trace.x), 0.3)), town, spacing=5.0)
    assert course["along"][:3] == [0.0, 5.0, 10.0]
    np.testing.assert_allclose(course["deviation"], 0.3, atol=0.03)
    np.testing.assert_allclose(course["margin"], 0.5 * (3.5 - float(trace.width[0])), atol=0.01)
