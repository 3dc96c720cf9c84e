"""Steering and distance of the lane keeper in closed form."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ssad.core.driving import Belief
from ssad.core.perception import PerceivedLane
from ssad.core.types import AgentKind, SignalState
from ssad.drivers.lane_keeping.control import (
    COMFORT,
    HEADWAY,
    LATERAL_ACCELERATION,
    STANDSTILL,
    bend_speed,
    following_acceleration,
    line_acceleration,
    pursuit_curvature,
    steer_for,
)

STRAIGHT = PerceivedLane(0.0, 0.0, 0.0, 3.5, 1.0)


def view(speed: float, signal: tuple[float, float] = (SignalState.OFF, 1e6)) -> Any:
    return SimpleNamespace(
        pose=np.array([[10.0, 5.0, 0.5 * np.pi]]), speed=np.array([speed]), signal=np.array([signal])
    )


def belief(ahead: float, lateral: float, speed: float) -> Belief:
    """Return one car in front of the ego of `view`, which looks north."""
    pose = np.array([[[10.0 - lateral, 5.0 + ahead, 0.5 * np.pi]]], np.float32)
    kind = np.array([[AgentKind.CAR]], np.int32)
    return Belief(pose, np.array([[speed]], np.float32), np.array([[[4.0, 2.0]]], np.float32), kind)


def test_pursuit_of_a_circle_is_its_curvature() -> None:
    for curvature in (0.02, -0.01):
        # A parabola is a circle up to the fourth order.
        lane = PerceivedLane(0.0, 0.0, curvature, 3.5, 1.0)
        assert pursuit_curvature(lane, 5.0) == pytest.approx(curvature, rel=0.02)
    assert pursuit_curvature(STRAIGHT, 20.0) == 0.0
    assert pursuit_curvature(PerceivedLane(0.5, 0.0, 0.0, 3.5, 1.0), 20.0) > 0.0


def test_steering_turns_the_bicycle_along_the_curvature() -> None:
    wheelbase, lock, curvature = 2.8, 0.6, 0.05
    wheel = steer_for(curvature, wheelbase, lock) * lock
    slip = np.arctan(0.5 * np.tan(wheel))  # the world's kinematic bicycle
    assert 2.0 * np.sin(slip) / wheelbase == pytest.approx(curvature)
    assert steer_for(10.0, wheelbase, 0.1) == 1.0


def test_the_speed_in_a_bend_takes_the_stated_lateral_acceleration() -> None:
    assert bend_speed(PerceivedLane(0.0, 0.0, -0.025, 3.5, 1.0)) ** 2 * 0.025 == pytest.approx(LATERAL_ACCELERATION)


def test_it_keeps_its_gap_and_ignores_other_lanes() -> None:
    size = np.array([4.0, 2.0])
    gap = STANDSTILL + 10.0 * HEADWAY
    # At the desired gap and the same speed the term of the model is 0.
    steady = following_acceleration(view(10.0), belief(gap + 4.0, 0.0, 10.0), 0, STRAIGHT, size)
    assert steady == pytest.approx(0.0, abs=1e-4)
    assert following_acceleration(view(10.0), belief(gap, 0.0, 5.0), 0, STRAIGHT, size) < -1.0
    assert following_acceleration(view(10.0), belief(gap, 3.5, 0.0), 0, STRAIGHT, size) == np.inf
    assert following_acceleration(view(10.0), belief(-10.0, 0.0, 0.0), 0, STRAIGHT, size) == np.inf
    # In a bend to the left the lane is where the other car is.
    bend = PerceivedLane(0.0, 0.0, 2.0 * 3.5 / 20.0**2, 3.5, 1.0)
    assert following_acceleration(view(10.0), belief(20.0, 3.5, 0.0), 0, bend, size) < 0.0


def test_it_stops_at_a_red_light() -> None:
    assert line_acceleration(view(10.0, (SignalState.GREEN, 20.0)), 0, 2.0) == np.inf
    assert line_acceleration(view(10.0, (SignalState.RED, 200.0)), 0, 2.0) == np.inf
    assert line_acceleration(view(10.0, (SignalState.RED, 20.0)), 0, 2.0) == pytest.approx(-(10.0**2) / (2.0 * 17.0))
    # Too late for yellow.
    assert line_acceleration(view(15.0, (SignalState.YELLOW, 15.0)), 0, 2.0) == np.inf
    assert COMFORT > 0.0
