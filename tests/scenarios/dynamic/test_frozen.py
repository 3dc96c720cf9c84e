"""Motions in scenario files: enough rows, on a spline, for the world to repeat them within the limits they have."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers.metric_traces import make_trace, straight

from ssad.core.types import Actor, EpisodeTrace, Pose
from ssad.metrics.proven_collisions import Accelerations, peak_accelerations
from ssad.scenarios.dynamic import load_scenarios
from ssad.scenarios.dynamic.frozen import CLOSE, drop_collinear_rows, resample_motion, round_rows, with_motion

SPACING = 0.25
TIME = SPACING * np.arange(33)


def braking_rows() -> np.ndarray:
    """8 s at 14 m/s along x, with a full brake of 7 m/s^2 from 2 s on, then 2 m/s^2 up to 6 m/s."""
    acceleration = np.where(TIME[:-1] < 2.0, 0.0, np.where(TIME[:-1] < 4.0, -7.0, 2.0))
    speed = np.clip(14.0 + SPACING * np.concatenate([[0.0], np.cumsum(acceleration)]), 0.0, None)
    x = np.concatenate([[0.0], np.cumsum(0.5 * SPACING * (speed[1:] + speed[:-1]))])
    return np.stack([TIME, x, np.zeros(33), np.zeros(33)], 1)


def as_driven(trajectory: np.ndarray, seconds: float) -> EpisodeTrace:
    """The trace of an agent that the world puts on its rows at each step, linearly between them."""
    time = 0.1 * np.arange(round(seconds / 0.1) + 1)
    columns = [np.interp(time, trajectory[:, 0], trajectory[:, k]) for k in (1, 2)]
    yaw = np.interp(time, trajectory[:, 0], np.unwrap(trajectory[:, 3]))
    return make_trace(len(time), [straight(0.0, 90.0, 0.0, 0.0, len(time)), (*columns, yaw, 0.0)])


def peaks(trajectory: np.ndarray, seconds: float = 8.0) -> Accelerations:
    measured = peak_accelerations(as_driven(trajectory, seconds), 1)
    assert measured is not None
    return measured


def test_a_motion_of_coarse_rows_is_driven_within_its_limits() -> None:
    rows = braking_rows()
    assert peaks(rows).braking > 12.0  # linear between rows
    smooth = resample_motion(rows)
    assert peaks(smooth).braking == pytest.approx(7.0, abs=0.05)
    assert peaks(smooth).forward == pytest.approx(2.0, abs=0.05)
    assert np.abs(np.interp(TIME, smooth[:, 0], smooth[:, 1]) - rows[:, 1]).max() <= 7.0 * SPACING**2 / 8 + 1e-9
    assert smooth[[0, -1]] == pytest.approx(rows[[0, -1]])
    assert np.diff(smooth[:, 0]) == pytest.approx(0.05)


def test_a_bend_keeps_its_lateral_acceleration_and_its_heading_across_the_jump() -> None:
    angle = 3.0 + 0.5 * TIME  # 8 m/s on a circle of 16 m, through a heading of 180 degrees
    yaw = np.angle(np.exp(1j * angle))
    rows = np.stack([TIME, 16.0 * np.sin(angle), -16.0 * np.cos(angle), yaw], 1)
    smooth = resample_motion(rows)
    assert np.abs(np.diff(smooth[:, 3])).max() == pytest.approx(0.025, abs=1e-6)
    assert peaks(smooth).lateral == pytest.approx(4.0, abs=0.05)


def test_uneven_rows_pass_the_middle_of_each_part_with_its_velocity() -> None:
    rows = np.array([[0.0, 0, 0, 0], [1.0, 4, 0, 0], [1.5, 8, 0, 0], [3.5, 8, 0, 0]])
    smooth = resample_motion(rows, step=0.25)
    x = dict(zip(smooth[:, 0].tolist(), smooth[:, 1].tolist(), strict=True))
    assert (x[0.0], x[0.5], x[1.25], x[2.5], x[3.5]) == pytest.approx((0.0, 2.0, 6.0, 8.0, 8.0))
    assert resample_motion(rows, step=2.0) is rows


def test_an_actor_of_a_saved_scenario_gets_the_rows_of_the_spline() -> None:
    base = load_scenarios("precrash")[0]
    scenario = replace(base, type="Custom", actors=(Actor("car", "car", Pose(0.0, 0.0)),))
    (actor,) = with_motion(scenario, "car", braking_rows()).actors
    rows = np.array(actor.trajectory)
    inside = rows[rows[:, 0] <= 8.0]
    assert len(inside) == 161
    assert peaks(rows).braking == pytest.approx(7.0, abs=0.3)  # rows are rounded to a millimetre
    assert peaks(rows, seconds=12.0).braking == pytest.approx(7.0, abs=0.3)  # the stop at the end is gentler
    assert rows[-1, 0] > scenario.limits.max_steps * 0.1


def test_recorded_rows_that_are_left_out_change_the_acceleration_little() -> None:
    time = 0.1 * np.arange(61)
    speed = 10.0 + 1.5 * np.sin(time)
    x = np.concatenate([[0.0], np.cumsum(0.05 * (speed[1:] + speed[:-1]))])
    rows = np.stack([time, x, np.zeros(61), np.zeros(61)], 1)
    thinned = np.array(drop_collinear_rows(rows))
    assert len(thinned) < len(rows)
    assert np.abs(np.interp(time, thinned[:, 0], thinned[:, 1]) - x).max() <= CLOSE[0]
    assert peaks(np.array(round_rows(rows)), seconds=6.0).forward <= 1.5 + 4 * (CLOSE[0] + 0.0005) / 0.1**2
