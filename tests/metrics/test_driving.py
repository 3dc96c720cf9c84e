"""Every metric of an episode against a case worked out by hand."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from helpers.metric_traces import make_trace

from ssad.core.types import Contact
from ssad.metrics import EpisodeMetrics, episode_metrics, frea_score, overall_score
from ssad.metrics.driving import (
    DIVISORS,
    PENALTIES,
    WEIGHTS,
    collision_events,
    driving_score,
    in_route_failure,
    mean_yaw_velocity,
    normalise_metric,
    off_road_distance,
)

PAIR = ((0.0, 0.0, 0.0, 0.0), (50.0, 0.0, 0.0, 0.0))
"""The ego and another, as bodies."""


def test_quiet_episode():
    m = episode_metrics(make_trace(11, driven=np.arange(11)))
    assert not m.collision
    assert m.collision_events == 0
    assert m.time == pytest.approx(1.0)
    assert m.driven == 10.0
    assert m.route_completion == 1.0
    assert m.route_following == 1.0
    assert m.driving_score == 100.0
    assert (m.off_road, m.acceleration, m.yaw_velocity) == (0.0, 0.0, 0.0)
    assert (m.min_ttc, m.pet) == (10.0, 10.0)
    assert math.isnan(m.min_distance)


def test_collision_in_the_last_row():
    contact = [0, 0, Contact.VEHICLE | Contact.STATIC]
    m = episode_metrics(
        make_trace(3, PAIR, contact=contact, contact_agent=[-1, -1, 1], end="collision", route_complete=40)
    )
    assert m.collision
    assert m.collision_events == 1
    assert (m.collisions_vehicle, m.collisions_static, m.collisions_walker, m.collisions_cyclist) == (1, 1, 0, 0)
    assert m.driving_score == pytest.approx(40 * 0.60 * 0.65)


def test_collision_flag_stays_set_after_a_contact():
    assert episode_metrics(make_trace(3, PAIR, contact=[0, 4, 0], contact_agent=[-1, 1, -1])).collision


def test_contact_between_rows_leaves_no_margin():
    trace = make_trace(3, [(0, 0, 0, 0), (50, 0, 0, 0)], contact=[0, 0, 1], contact_agent=[-1, -1, 1])
    m = episode_metrics(trace)
    assert (m.min_ttc, m.pet, m.min_distance) == (0.0, 0.0, 0.0)


@pytest.mark.parametrize(
    ("agents", "x", "events"),
    [
        ([1, 1], [0, 20], [True, False]),  # the same agent again, 1 s later
        ([1, 2], [0, 2], [True, False]),  # another agent, 2 m from the first place
        ([1, 2], [0, 4], [True, True]),  # another agent, 4 m away
        ([-2, -2], [0, 20], [True, True]),  # not agents: only the place counts
    ],
)
def test_repeated_contacts_are_one_event(agents, x, events):
    ego_x = np.linspace(x[0], x[1], 11)
    trace = make_trace(
        11, [(ego_x, 0, 0, 0)], contact=[1] + [0] * 9 + [1], contact_agent=[agents[0]] + [-1] * 9 + [agents[1]]
    )
    assert collision_events(trace)[[0, 10]].tolist() == events


def test_same_agent_after_five_seconds_and_place_forgotten():
    ego_x = np.concatenate([np.linspace(0, 6, 31), np.linspace(6, 0, 30)])
    contact = np.zeros(61)
    contact[[0, 60]] = 1
    agent = np.where(contact, 1, -1)
    assert collision_events(make_trace(61, [(ego_x, 0, 0, 0)], contact=contact, contact_agent=agent)).sum() == 2
    near = make_trace(61, [(0.5 * ego_x, 0, 0, 0)], contact=contact, contact_agent=agent)
    assert collision_events(near).sum() == 1


def test_off_road_counts_the_steps_that_begin_or_end_off_road():
    off = [False, False, True, False, False, False]
    trace = make_trace(6, driven=[0, 1, 3, 6, 10, 15], off_road=off)
    assert off_road_distance(trace) == 2 + 3
    assert episode_metrics(trace).off_road_fraction == pytest.approx(5 / 15)
    assert episode_metrics(trace).driving_score == pytest.approx(100 * (1 - 5 / 15))


def test_distance_to_route_leaves_out_the_start():
    m = episode_metrics(make_trace(4, route_distance=[99, 1, 2, 3]))
    assert m.distance_to_route == pytest.approx(2.0)
    assert m.route_following == pytest.approx(1 - 2 / 5)
    assert episode_metrics(make_trace(3, route_distance=[0, 9, 9])).route_following == 0.0


def test_counts():
    trace = make_trace(5, red_light=[0, 1, 0, 1, 0], stop_sign=[0, 0, 1, 0, 0], lane_invasion=[0, 1, 1, 1, 0])
    m = episode_metrics(trace, stop_signs=True)
    assert (m.red_lights, m.stop_signs, m.lane_invasions) == (2, 1, 3)
    assert m.driving_score == pytest.approx(100 * 0.7**2 * 0.8)
    # a world without stop signs measures none, and scores without them
    m = episode_metrics(trace)
    assert m.stop_signs is None
    assert m.driving_score == pytest.approx(100 * 0.7**2)


def test_acceleration_along_and_across():
    m = episode_metrics(make_trace(3, accel=[0, 3, -5]))
    assert m.acceleration == pytest.approx(4.0)
    # 10 m/s at 0.3 rad/s is 3 m/s^2 to the side; with 4 m/s^2 ahead, 5
    turning = make_trace(4, [(0, 0, np.arange(4) * 0.03, 10)], accel=[0, 4, 4, 4])
    assert episode_metrics(turning).acceleration == pytest.approx(5.0, abs=1e-4)


def test_yaw_velocity_wraps():
    yaw = [3.1, -3.1]
    trace = make_trace(2, [(0, 0, yaw, 0)])
    assert mean_yaw_velocity(trace) == pytest.approx((2 * np.pi - 6.2) / 0.1, abs=1e-4)
    assert mean_yaw_velocity(trace, wrap=False) == pytest.approx(62.0, abs=1e-4)


@pytest.mark.parametrize(
    ("distance", "driven", "failure"),
    [
        ([0, 31, 0], [0, 1, 2], True),
        ([0, 29, 0], [0, 29, 30], False),
        ([0, 16, 16], [0, 16, 32], True),  # 32 m of a 100 m route
        ([0, 14, 14], [0, 16, 32], False),
    ],
)
def test_in_route_failure(distance, driven, failure):
    assert episode_metrics(make_trace(3, route_distance=distance, driven=driven)).in_route_failure is failure


def test_driving_score_of_the_leaderboard():
    counts = {"collisions_walker": 1, "collisions_vehicle": 2, "red_lights": 1}
    assert driving_score(0.8, counts, 0.25) == pytest.approx(80 * 0.5 * 0.36 * 0.7 * 0.75)


def test_overall_score_rounds_each_term_and_does_not_clip():
    # OR 1.26 / 10 -> 0.13, DR 0.3 / 5 -> 0.06, 1 - RC 0.25, TS 60 / 30 -> 2 (not clipped)
    means = {"CR": 0.344, "OR": 1.26, "DR": 0.3, "RC": 0.75, "TS": 60.0}
    expected = 0.4 * 0.34 + 0.1 * 0.13 + 0.1 * 0.06 + 0.3 * 0.25 + 0.1 * 2.0
    assert overall_score(means) == pytest.approx(expected)
    assert frea_score(means) == pytest.approx(1 - expected)
    assert overall_score(means, time_out=60.0) == pytest.approx(expected - 0.1)


def test_normalised_is_clipped():
    assert normalise_metric("OR", 5.0) == 0.5
    assert normalise_metric("OR", 50.0) == 1.0


def test_one_row_has_no_means_and_survives_json():
    m = episode_metrics(make_trace(1))
    assert m.time == 0.0
    assert math.isnan(m.acceleration)
    assert math.isnan(m.yaw_velocity)
    assert math.isnan(m.distance_to_route)
    plain = {k: None if isinstance(v, float) and math.isnan(v) else v for k, v in m.as_dict().items()}
    back = EpisodeMetrics.from_dict(json.loads(json.dumps(plain)))
    assert repr(back) == repr(m)


def test_no_rows_is_an_error():
    with pytest.raises(ValueError, match="no rows"):
        episode_metrics(make_trace(0))


def test_dict_round_trip_ignores_other_keys_and_leaves_out_what_is_absent():
    m = episode_metrics(make_trace(5, [(0, 0, 0, 0), (20, 0, 0, 0)], route_complete=55))
    assert EpisodeMetrics.from_dict(m.as_dict() | {"later": 1}) == m
    less = EpisodeMetrics.from_dict({k: v for k, v in m.as_dict().items() if k not in ("driven", "stop_signs")})
    assert math.isnan(less.driven)
    assert less.stop_signs is None
    assert EpisodeMetrics.from_dict(m.as_dict() | {"stop_signs": 2}).stop_signs == 2


def test_the_numbers_of_safebench_frea_and_the_leaderboard():
    # SafeBench's cal_out_of_road_length and final_score; ACC and YV: FREA; leaderboard 1.0: statistics_manager.py
    assert DIVISORS == {"CR": 1.0, "OR": 10.0, "DR": 5.0, "IR": 1.0, "TS": 30.0, "ACC": 8.0, "YV": 1.0}
    assert WEIGHTS == {"CR": 0.4, "OR": 0.1, "DR": 0.1, "IR": 0.3, "TS": 0.1}
    assert PENALTIES == {
        "collisions_walker": 0.5,
        "collisions_cyclist": 0.6,
        "collisions_vehicle": 0.6,
        "collisions_static": 0.65,
        "red_lights": 0.7,
        "stop_signs": 0.8,
    }


@pytest.mark.parametrize(
    ("distance", "driven", "failure"),
    [
        ([0, 30, 0], [0, 1, 2], False),
        ([0, 30.1, 0], [0, 1, 2], True),
        ([99, 0, 0], [0, 1, 2], False),  # the start does not count
        ([0, 15, 15], [0, 50, 100], False),
        ([0, 15.1, 0], [0, 30, 100], False),  # 30 m of 100 m
        ([0, 15.1, 0], [0, 30.5, 100], True),
        ([0], [0], False),
    ],
)
def test_limits_of_the_in_route_test(distance, driven, failure):
    trace = make_trace(len(distance), route_distance=distance, driven=driven)
    assert in_route_failure(trace) is failure


def test_in_route_failure_without_a_route():
    trace = make_trace(3, route_distance=[0, 16, 0], driven=[0, 1, 2])
    assert in_route_failure(replace(trace, route=trace.route[:1])) is True
    assert in_route_failure(replace(make_trace(3), route=trace.route[:0])) is False


@pytest.mark.parametrize(
    ("steps", "x", "agents", "events"),
    [
        (51, 20.0, (1, 1), 1),  # 5.0 s later, far away
        (52, 20.0, (1, 1), 2),  # 5.1 s later
        (11, 3.0, (1, 2), 1),  # 3 m away
        (11, 3.1, (1, 2), 2),
        (52, 2.0, (-2, -2), 1),  # a place has no time
        (52, 2.0, (1, 1), 1),
        (11, 20.0, (0, 0), 1),  # agent 0 is an agent like any other
    ],
)
@pytest.mark.parametrize("start", [0.0, -80.0])
def test_where_an_event_ends(steps, x, agents, events, start):
    contact = np.zeros(steps)
    contact[[0, -1]] = 1
    agent = np.full(steps, -1)
    agent[[0, -1]] = agents
    ego = start + np.linspace(0.0, x, steps)
    assert collision_events(make_trace(steps, [(ego, 0, 0, 0)], contact=contact, contact_agent=agent)).sum() == events


@pytest.mark.parametrize(("away", "events"), [(5.0, 1), (5.1, 2)])
def test_a_place_is_forgotten_beyond_5_m(away, events):
    # away in y and back to 1 m beside the place, past the time of the agent
    y = np.concatenate([np.linspace(0.0, away, 31), np.linspace(away, 1.0, 30)])
    contact = np.zeros(61)
    contact[[0, 60]] = 1
    trace = make_trace(61, [(0, y, 0, 0)], contact=contact, contact_agent=np.where(contact, 1, -1))
    assert collision_events(trace).sum() == events


def test_an_event_is_compared_with_all_before_it():
    # agents 1 and 2 at different places, then each of them again
    contact = np.ones(4)
    trace = make_trace(4, [(np.array([0, 10, 20, 30]), 0, 0, 0)], contact=contact, contact_agent=[1, 2, 1, 2])
    assert collision_events(trace).tolist() == [True, True, False, False]
    kinds = [Contact.WALKER, Contact.CYCLIST, 0, 0]
    m = episode_metrics(make_trace(4, [*PAIR, PAIR[1]], contact=kinds, contact_agent=[1, 2, -1, -1]))
    assert (m.collisions_walker, m.collisions_cyclist) == (1, 0)  # the second at the same place is no event


def test_shares_stay_between_0_and_1():
    m = episode_metrics(make_trace(3, off_road=True, driven=[0, 1, 2], route_complete=130))
    assert (m.off_road_fraction, m.route_completion, m.driving_score) == (1.0, 1.0, 0.0)
    assert episode_metrics(make_trace(3, off_road=True)).off_road_fraction == 0.0  # nothing driven
    assert episode_metrics(make_trace(3, route_complete=-5)).route_completion == 0.0
    assert episode_metrics(make_trace(3, driven=[0, 0.25, 0.5], off_road=[0, 0, 1])).off_road_fraction == 0.5
    assert episode_metrics(make_trace(3, route_distance=[0, 1, 1])).route_following == pytest.approx(0.8)


def test_an_episode_that_ended_in_a_collision_has_one():
    assert episode_metrics(make_trace(3, end="collision")).collision
    assert episode_metrics(make_trace(3, contact=[0, 1, 0])).collision
    assert not episode_metrics(make_trace(3, end="timeout")).collision


def test_two_rows_are_enough_for_means():
    m = episode_metrics(make_trace(2, [(0, 0, [0, 0.05], 10)], accel=[9, 0], route_distance=[9, 3], dt=0.1))
    assert (m.acceleration, m.yaw_velocity) == (pytest.approx(5.0, abs=1e-4), pytest.approx(0.5, abs=1e-5))
    assert (m.distance_to_route, m.time) == (3.0, pytest.approx(0.1))
