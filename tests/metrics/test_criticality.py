"""Time to collision, post-encroachment time and distance: closed forms, brute force and invariants."""

import math

import numpy as np
import pytest
from helpers.metric_traces import make_trace, straight
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from ssad.core.geometry import obb_distance, rotate
from ssad.metrics.criticality import min_distance, min_ttc, post_encroachment_time, time_to_collision, ttc

number = st.floats(-20, 20)
angle = st.floats(-math.pi, math.pi)
size = st.floats(0.3, 6)
box = st.tuples(number, number, angle, size, size).map(np.array)
velocity = st.tuples(number, number).map(np.array)


def test_head_on():
    # 30 m between the centres, 26 m between the bumpers, 20 m/s
    trace = make_trace(1, [(0, 0, 0, 12), (30, 0, math.pi, 8)])
    assert min_ttc(trace) == pytest.approx(26 / 20)


def test_following_and_never():
    assert min_ttc(make_trace(1, [(0, 0, 0, 10), (24, 0, 0, 6)])) == pytest.approx(5.0)
    assert np.isinf(ttc(make_trace(1, [(0, 0, 0, 6), (24, 0, 0, 10)]))).all()
    assert np.isinf(ttc(make_trace(1, [(0, 0, 0, 10), (24, 2.1, 0, 0)]))).all()
    assert min_ttc(make_trace(1, [(0, 0, 0, 10), (24, 1.9, 0, 0)])) == pytest.approx(2.0)


def test_crossing():
    # the other reaches y = 1 + 2 = 3 after 7/7 s and leaves y = -3 after 13/7 s; the ego fills x = 20 +- 3 from 17/v
    cross = (20, 10, -math.pi / 2, 7)
    assert min_ttc(make_trace(1, [(0, 0, 0, 10), cross])) == pytest.approx(1.7)
    assert min_ttc(make_trace(1, [(0, 0, 0, 20), cross])) == pytest.approx(1.0)
    assert np.isinf(ttc(make_trace(1, [(0, 0, 0, 25), cross]))).all()  # gone at 23/25 s


def test_cap_and_absence():
    assert min_ttc(make_trace(1, [(0, 0, 0, 1), (50, 0, 0, 0)])) == 10.0
    pair = [(0, 0, 0, 10), (24, 0, 0, 0)]
    assert min_ttc(make_trace(1, pair, active=[[True, False]])) == 10.0
    assert math.isnan(min_distance(make_trace(1, pair, active=[[True, False]])))
    assert post_encroachment_time(make_trace(1, pair, active=[[True, False]])) == 10.0


def test_overlap_is_zero():
    trace = make_trace(1, [(0, 0, 0, 10), (1, 1, 1, 0)])
    assert (min_ttc(trace), min_distance(trace), post_encroachment_time(trace)) == (0.0, 0.0, 0.0)


@settings(max_examples=60, deadline=None)
@given(box, box, velocity)
def test_ttc_agrees_with_small_time_steps(a, b, v):
    exact = float(time_to_collision(a, b, v))
    step = 0.002
    time = np.arange(0.0, 4.0, step)
    moved = np.tile(a, (len(time), 1))
    moved[:, :2] += time[:, None] * v
    hit = np.flatnonzero(obb_distance(moved, b) <= 0.0)
    if len(hit):
        # a corner may be cut for less than a step, so the search can only be late
        assert exact <= time[hit[0]] + 1e-9
        before = moved[0].copy()
        before[:2] = a[:2] + exact * v
        assert float(obb_distance(before, b)) <= 1e-6
    elif exact < 4.0 - step:
        touching = a.copy()
        touching[:2] += exact * v
        assert float(obb_distance(touching, b)) <= 1e-6


@settings(max_examples=60, deadline=None)
@given(box, box, velocity)
def test_no_overlap_before_the_time_to_collision(a, b, v):
    exact = float(time_to_collision(a, b, v))
    assume(exact > 1e-3)
    time = np.linspace(0.0, min(exact, 10.0), 200)[:-1]
    moved = np.tile(a, (len(time), 1))
    moved[:, :2] += time[:, None] * v
    assert (obb_distance(moved[:-1], b) > 0.0).all()


@settings(max_examples=60, deadline=None)
@given(box, box, velocity, angle, velocity)
def test_ttc_does_not_depend_on_the_frame_or_the_order(a, b, v, turn, shift):
    def moved(box):
        return np.concatenate([rotate(box[:2], turn) + shift, [box[2] + turn], box[3:]])

    exact = time_to_collision(a, b, v)
    grown = np.array([0, 0, 0, 1e-6, 1e-6])
    # a graze may be lost to rounding: compare only where a hair more or less makes no difference
    assume(np.isfinite(time_to_collision(a + grown, b, v)) == np.isfinite(time_to_collision(a - grown, b, v)))
    assume(np.isinf(exact) or float(np.hypot(*v)) > 0.1 or exact == 0)
    assert float(time_to_collision(moved(a), moved(b), rotate(v, turn))) == pytest.approx(float(exact), abs=1e-3)
    assert float(time_to_collision(b, a, -v)) == pytest.approx(float(exact), abs=1e-6)


@settings(max_examples=60, deadline=None)
@given(box, box, st.floats(0.5, 20), st.floats(1, 5))
def test_ttc_is_inverse_in_speed(a, b, speed, factor):
    # aimed at the other's centre, so that they always meet
    gap = b[:2] - a[:2]
    assume(float(np.hypot(*gap)) > 1e-3)
    v = speed * gap / np.hypot(*gap)
    slow, fast = float(time_to_collision(a, b, v)), float(time_to_collision(a, b, factor * v))
    assert slow < np.hypot(*gap) / speed
    assert fast <= slow + 1e-9
    assert fast * factor == pytest.approx(slow, rel=1e-3, abs=1e-6)


def test_min_distance():
    # ego front at x = 2 after 1 s at 5 m/s it is at 7; the other's rear at 18
    steps = 11
    assert min_distance(make_trace(steps, [straight(0, 0, 0, 5, steps), (20, 0, 0, 0)])) == pytest.approx(11.0)
    assert min_distance(make_trace(1, [(0, 0, 0, 0), (7, 6, 0, 0)])) == pytest.approx(5.0)


def test_pet_of_crossing_paths():
    # the ego at 10 m/s fills the crossing x in [-1, 1] while its centre is in [-3, 3]: it has left at 3.3 s (from
    # x = -30). The other, from y = -d at 10 m/s, enters |y| <= 1 with its front, so at (d - 3) / 10 s.
    steps = 101
    for d, gap in ((46, 1.0), (56, 2.0), (66, 3.0)):
        trace = make_trace(steps, [straight(-30, 0, 0, 10, steps), straight(0, -d, math.pi / 2, 10, steps)])
        assert post_encroachment_time(trace) == pytest.approx(gap, abs=0.1 + 1e-6)
        swapped = make_trace(steps, [straight(0, -d, math.pi / 2, 10, steps), straight(-30, 0, 0, 10, steps)])
        assert post_encroachment_time(swapped) == post_encroachment_time(trace)


def test_pet_of_following_is_the_time_gap():
    # 34 m behind bumper to bumper at 10 m/s: 3.0 s from the leader's rear to the ego's front
    steps = 101
    trace = make_trace(steps, [straight(0, 0, 0, 10, steps), straight(34, 0, 0, 10, steps)])
    assert post_encroachment_time(trace) == pytest.approx(3.0, abs=0.1 + 1e-6)


def test_pet_without_a_shared_place_or_within_the_cap():
    steps = 201
    apart = make_trace(steps, [straight(0, 0, 0, 10, steps), straight(0, 5, 0, 10, steps)])
    assert post_encroachment_time(apart) == 10.0
    late = make_trace(steps, [straight(-30, 0, 0, 10, steps), straight(0, -170, math.pi / 2, 10, steps)])
    assert post_encroachment_time(late) == 10.0
    assert post_encroachment_time(late, cap=15.0) == pytest.approx(13.4, abs=0.1 + 1e-6)


def test_pet_agrees_with_all_pairs_of_times():
    rng = np.random.Generator(np.random.Philox(5))
    for _ in range(10):
        steps = 40
        bodies = []
        for _ in range(3):
            x, y, yaw = *rng.uniform(-15, 15, 2), rng.uniform(-3, 3)
            bodies.append(straight(x, y, yaw, rng.uniform(2, 12), steps))
        trace = make_trace(steps, bodies)
        shape = np.stack([trace.x, trace.y, trace.yaw, np.full_like(trace.x, 4), np.full_like(trace.x, 2)], -1)
        least = 10.0
        for other in (1, 2):
            hit = obb_distance(shape[:, None, 0].astype(float), shape[None, :, other].astype(float)) <= 0.0
            i, j = np.nonzero(hit)
            least = min(least, np.abs(i - j).min(initial=1000) * 0.1)
        assert post_encroachment_time(trace) == pytest.approx(least)


def test_scene_of_the_ego_alone():
    trace = make_trace(5)
    assert (min_ttc(trace), post_encroachment_time(trace)) == (10.0, 10.0)


def test_the_nearest_of_several_agents():
    def three(*gaps):
        return make_trace(1, [(0, 0, 0, 10), *((gap + 4, 0, 0, 0) for gap in gaps)])

    for gaps in ((9, 3, 6), (3, 9, 6), (9, 6, 3)):
        assert min_distance(three(*gaps)) == pytest.approx(3.0)
        assert min_ttc(three(*gaps)) == pytest.approx(0.3)
    # those that are not there do not count
    active = [[True, True, False, True]]
    there = make_trace(1, [(0, 0, 0, 0), (13, 0, 0, 0), (7, 0, 0, 0), (10, 0, 0, 0)], active=active)
    assert min_distance(there) == pytest.approx(6.0)
    assert np.isinf(ttc(there)).all()


def test_an_ego_that_is_not_there_meets_nobody():
    trace = make_trace(2, [(0, 0, 0, 0), (1, 0, 0, 0)], active=[[False, True], [True, False]])
    assert min_ttc(trace) == 10.0
    assert math.isnan(min_distance(trace))
    # but where it is later, somebody was before
    assert post_encroachment_time(trace) == pytest.approx(0.1)


def test_bodies_that_only_touch_have_overlapped():
    for x, pet in ((4.0, 0.0), (4.001, 10.0)):  # corner at corner
        assert post_encroachment_time(make_trace(1, [(0, 0, 0, 0), (x, 2.0, 0, 0)])) == pet
    for x, pet in ((3.999, 0.0), (4.001, 10.0)):  # bumper at bumper, one long and one short agent beside it
        assert post_encroachment_time(make_trace(1, [(0, 0, 0, 0), (90, 0, 0, 0), (x, 0.0, 0, 0)])) == pet


def test_the_last_step_and_the_cap_count():
    # the other is where the ego was at the start, first in the last row
    def late(steps):
        x = np.where(np.arange(steps) < steps - 1, 300.0, 0.0)
        ego = np.where(np.arange(steps) < 1, 0.0, 600.0)
        return make_trace(steps, [(ego, 0, 0, 0), (x, 0, 0, 0)])

    assert post_encroachment_time(late(31)) == pytest.approx(3.0)
    assert post_encroachment_time(late(101)) == pytest.approx(10.0)
    assert post_encroachment_time(late(31), cap=2.9) == 2.9
    assert min_ttc(make_trace(1, [(0, 0, 0, 10), (44, 0, 0, 0)]), cap=3.0) == 3.0


def test_bodies_side_by_side_that_drive_alike_never_touch():
    """Their distance across the road does not change: no speed along it brings them together."""
    first, second = np.array([0.0, 0.0, 0.0, 4.0, 2.0]), np.array([20.0, 3.0, 0.0, 4.0, 2.0])
    assert time_to_collision(first, second, np.array([5.0, 0.0])) == math.inf
    assert time_to_collision(first, second - [0, 2.5, 0, 0, 0], np.array([5.0, 0.0])) == pytest.approx(16.0 / 5.0)
