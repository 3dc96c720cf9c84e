"""The sensor `traffic`: own state, the road ahead, who will be on it, and who is near."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad.core.types import Controller, EpisodeAgent, Pose
from ssad.world.sensors import SENSORS
from ssad.world.world import World
from tests.world.worlds import GRAPHS, ego, episode, line_route


def car(x: float, y: float = 0.0, yaw: float = 0.0, speed: float = 0.0, model: str = "car") -> EpisodeAgent:
    return EpisodeAgent("car", model, Controller.NONE, Pose(x, y, yaw), speed, speed)


def row(*agents: EpisodeAgent, **more) -> np.ndarray:
    """What an ego at x = 100 with 8 m/s sees at the start."""
    world = World([episode(ego(100.0, 8.0, **more), *agents)], GRAPHS)
    return SENSORS["traffic"](world, np.array([[0, 0]], np.int32))[0]


def ahead(found: np.ndarray) -> list[float]:
    """m to who is on the route now and after 1, 2, 3 and 4 s; 50: nobody."""
    return (found[19:29:2] * 50.0).round(3).tolist()


def test_own_state_and_road() -> None:
    found = row(pose=Pose(100.0, 1.0, 0.1))
    assert found[[0, 3, 4, 5, 6]] == pytest.approx([0.8, 0.8, 0.5, 0.1, 1.0], abs=1e-3)
    points = found[7:19].reshape(6, 2) * 20.0
    along = np.array([4.0, 8.0, 12.0, 18.0, 26.0, 34.0])
    expected = np.stack([along * np.cos(0.1) - np.sin(0.1), -along * np.sin(0.1) - np.cos(0.1)], 1)
    np.testing.assert_allclose(points, expected, atol=0.05)
    assert row(route=line_route(100.0, 120.0))[6] == pytest.approx(0.4, abs=0.01)
    assert ahead(found) == [50.0] * 5


def test_who_stands_or_drives_ahead() -> None:
    # the rear of a car 4.9 m long, less 1.5 m of air, on points 2 m apart
    assert ahead(row(car(120.0))) == [18.0] * 5
    lead = row(car(110.0, speed=5.0))
    assert ahead(lead) == [8.0, 12.0, 18.0, 22.0, 28.0]
    assert lead[20] == pytest.approx(0.5)
    assert ahead(row(car(110.0, 3.5))) == [50.0] * 5  # the other lane


def test_who_crosses_is_seen_before_it_is_there() -> None:
    crossing = row(car(120.0, -12.0, np.pi / 2, 5.0))
    assert ahead(crossing)[:2] == [50.0, 50.0]
    assert ahead(crossing)[2] == pytest.approx(18.0)
    assert ahead(crossing)[4] == 50.0
    assert abs(crossing[24]) < 0.01  # it does not drive along the route


def test_who_follows_is_not_ahead() -> None:
    assert ahead(row(car(92.0, speed=8.0))) == [50.0] * 5


def test_the_nearest_have_rows_and_those_behind_count_less() -> None:
    found = row(car(92.0), car(112.0), car(110.0, 3.5, np.pi, 4.0, model="bicycle"), car(160.0))
    rows = found[29:].reshape(5, 8)
    assert rows[:3, 0] * 25.0 == pytest.approx([10.0, 12.0, -8.0], abs=1e-3)
    assert rows[0] == pytest.approx([0.4, 0.14, -1.0, 0.0, 0.4, 0.33, 0.3, 1.0], abs=1e-2)
    assert rows[1, 5:] == pytest.approx([4.9 / 5, 1.03, 0.0], abs=1e-2)
    assert not rows[3:].any()  # 60 m is out of sight


def test_it_sees_from_any_seat() -> None:
    other = replace(car(110.0, speed=5.0), route=line_route(110.0, 300.0))
    world = World([episode(ego(100.0, 8.0), other)], GRAPHS)
    found = SENSORS["traffic"](world, np.array([[0, 1]], np.int32))[0]
    assert found[0] == pytest.approx(0.5)
    assert found[29] * 25.0 == pytest.approx(-10.0)
