"""Statistics of traffic, on traces whose values follow from their construction."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.traffic_walkers import count_contacts
from ssad.core.types import AgentKind
from ssad.metrics.traffic_statistics import (
    braking_onsets,
    critical_gap,
    distance,
    gap_choices,
    jerk,
    lane_changes,
    lateral_acceleration,
    post_encroachment_times,
    quantiles,
    queue_discharge,
    standstill_gaps,
    time_gaps,
    visits,
)

DT = 0.1


def test_an_onset_counts_once_for_each_time_that_braking_becomes_hard() -> None:
    acceleration = np.array([0.0, -1.0, -3.0, -5.0, -5.0, -1.0, -4.5, 0.0])[:, None]
    present = np.ones((8, 1), bool)
    assert braking_onsets(acceleration, present, 2.0) == 2
    assert braking_onsets(acceleration, present, 4.0) == 2
    assert braking_onsets(acceleration, present, 6.0) == 0
    present[6] = False
    assert braking_onsets(acceleration, present, 4.0) == 1


def test_who_brakes_when_it_appears_has_no_onset() -> None:
    acceleration = np.full((5, 1), -5.0)
    present = np.array([False, False, True, True, True])[:, None]
    assert braking_onsets(acceleration, present, 4.0) == 0


def test_distance_and_jerk_are_those_of_a_ramp() -> None:
    time = DT * np.arange(101)
    acceleration, speed = 2.0 - 0.4 * time[:, None], np.full((101, 1), 12.0)
    present = np.ones((101, 1), bool)
    assert distance(speed, present, DT) == pytest.approx(12.0 * 10.1)
    np.testing.assert_allclose(jerk(acceleration, present, DT), -0.4)


def test_lateral_acceleration_is_that_of_a_circle() -> None:
    speed, radius = 8.0, 20.0
    yaw = 3.0 + speed / radius * DT * np.arange(60)[:, None]  # passes through pi
    wrapped = np.arctan2(np.sin(yaw), np.cos(yaw))
    values = lateral_acceleration(np.full_like(yaw, speed), wrapped, np.ones(yaw.shape, bool), DT)
    np.testing.assert_allclose(values, speed**2 / radius)


def test_time_gaps_are_those_of_followers_that_move() -> None:
    gap = np.array([[20.0, 100.0, 3.0, np.inf]])
    speed = np.array([[10.0, 10.0, 1.0, 10.0]])
    np.testing.assert_allclose(time_gaps(gap, speed, np.ones((1, 4), bool)), [2.0])


def test_a_stop_has_one_standstill_gap() -> None:
    speed = np.array([5.0, 0.1, 0.0, 0.0, 4.0, 0.0, 3.0, 0.0])[:, None]
    gap = np.array([9.0, 2.6, 2.5, 2.4, 6.0, 3.0, 40.0, 30.0])[:, None]
    leader = np.array([0.0, 0.0, 0.0, 0.0, 5.0, 0.0, 0.0, 0.0])[:, None]
    np.testing.assert_allclose(standstill_gaps(gap, speed, leader, np.ones((8, 1), bool)), [2.4, 3.0])


def test_a_lane_change_leads_to_the_lane_beside() -> None:
    left, right = np.array([-1, 0, -1]), np.array([1, -1, -1])
    lane = np.array([[0], [1], [1], [2], [-1], [0], [1], [0]])
    assert lane_changes(lane, left, right, np.ones(lane.shape, bool)) == 3


def test_queues_discharge_with_the_headways_of_their_making() -> None:
    moments = np.array([3.0, 5.5, 7.7, 9.7, 11.7])
    since = np.concatenate([moments, moments[::-1], [9.0]])
    group = np.array([0] * 5 + [1] * 5 + [0])
    queued = np.array([True] * 10 + [False])
    measured = queue_discharge(since, group, queued, min_headways=2)
    # the vehicle that came late ends the first queue, after its third
    np.testing.assert_allclose(measured.headways, [2.0, 2.0])
    np.testing.assert_allclose(measured.first, [3.0, 3.0])
    assert measured.lost == pytest.approx((3.0 - 2.0) + (2.5 - 2.0) + (2.2 - 2.0))

    assert math.isnan(queue_discharge(since, group, queued).lost)


def crossing(delay: float, *, speed: float = 10.0) -> np.ndarray:
    """Two vehicles of 4 m on crossing roads; the second reaches the crossing `delay` s after the first."""
    time = DT * np.arange(150)[:, None]
    first = np.concatenate([speed * time - 60.0, 0.5 + 0.0 * time, 0.0 * time], 1)
    second = np.concatenate([0.5 + 0.0 * time, speed * (time - delay) - 60.0, np.full_like(time, np.pi / 2)], 1)
    return np.stack([first, second], 1)


def test_the_post_encroachment_time_of_a_crossing_is_its_delay_less_the_length_of_a_body() -> None:
    pose = crossing(2.0)
    stays = visits(pose, np.array([4.0, 4.0]), np.array([0, 0]), np.ones(pose.shape[:2], bool))
    times = post_encroachment_times(stays, DT)
    # 4 m of body and 1 m of cell at 10 m/s, to the step
    assert times == pytest.approx([2.0 - 0.5], abs=0.11)
    apart = visits(pose, np.array([4.0, 4.0]), np.array([0, 1]), np.ones(pose.shape[:2], bool))
    assert not len(post_encroachment_times(apart, DT))
    # of a vehicle and a walker, or of two vehicles
    assert len(post_encroachment_times(stays, DT, apart=np.array([False, True]))) == 1
    assert not len(post_encroachment_times(stays, DT, apart=np.array([False, False])))


def test_contacts_are_counted_once_by_who_is_touched() -> None:
    kinds = np.array([[AgentKind.CAR, AgentKind.BUS, AgentKind.WALKER, AgentKind.BICYCLE, AgentKind.WALKER]])
    fresh = np.array([[0b01110, 0b00001, 0b10001, 0b00001, 0b00100]])
    assert count_contacts(fresh, kinds) == {"contacts": 1, "walker contacts": 1, "cyclist contacts": 1}


def test_who_follows_on_the_same_road_encroaches_on_nobody() -> None:
    time = DT * np.arange(100)[:, None]
    lane = [np.concatenate([10.0 * time - ahead, 0.5 + 0.0 * time, 0.0 * time], 1) for ahead in (0.0, 15.0)]
    stays = visits(np.stack(lane, 1), np.array([4.0, 4.0]), np.array([0, 0]), np.ones((100, 2), bool))
    assert not len(post_encroachment_times(stays, DT))


def test_a_waiting_vehicle_rejects_the_gaps_before_it_goes_and_accepts_the_one_after() -> None:
    time = DT * np.arange(400)
    passes = [5.0, 8.0, 12.0, 19.0]  # s at which the stream comes past the crossing
    stream = [np.stack([10.0 * (time - at), np.full(400, 0.5), np.zeros(400)], 1) for at in passes]
    go = 13.0
    minor = np.stack([np.full(400, 0.5), np.maximum(5.0 * (time - go), 0.0) - 8.0, np.full(400, np.pi / 2)], 1)
    pose = np.stack([minor, *stream], 1)
    stays = visits(pose, np.full(5, 4.0), np.zeros(5, np.int64), np.ones((400, 5), bool))
    accepted, rejected = gap_choices(stays, np.array([[0, 20, 130]]), DT)
    # the front is at the crossing 0.2 s before the middle
    np.testing.assert_allclose(rejected, [2.8, 3.0, 4.0], atol=0.11)
    np.testing.assert_allclose(accepted, [7.0], atol=0.11)


def test_the_critical_gap_parts_accepted_from_rejected() -> None:
    assert critical_gap(np.array([5.0, 6.0, 7.0]), np.array([2.0, 3.0, 4.0])) == pytest.approx(4.0)
    assert 3.5 <= critical_gap(np.array([3.0, 5.0, 6.0]), np.array([2.0, 3.5, 4.0])) <= 5.0
    assert math.isnan(critical_gap(np.array([]), np.array([1.0])))


def test_quantiles_of_nothing_are_absent() -> None:
    assert quantiles(np.array([])) == {}
    assert quantiles(np.arange(101.0)) == {
        "count": 101.0,
        "mean": 50.0,
        "sd": pytest.approx(29.1548, abs=1e-4),
        "p5": 5.0,
        "p50": 50.0,
        "p95": 95.0,
        "p99": 99.0,
    }
