"""Crossing paths that a driver of the population foresees, and its reactions to them, in closed form."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import warp as wp

from benchmarks.traffic import town_routes, traffic
from ssad.core.types import Controller, DriverStyle, Episode, EpisodeAgent, Pose
from ssad.metrics.traffic_statistics import braking_onsets, jerk
from ssad.world.kernels.data import FAR
from ssad.world.kernels.drivers import (
    driver_arrives_after,
    driver_power,
    driver_yields,
    early_distance,
    early_react,
    pedal_change,
)
from ssad.world.kernels.meeting import accelerating_time, gained_time, travel_distance
from ssad.world.roads import load_town
from ssad.world.world import World
from tests.world.worlds import NO_PASSING, ego, episode, line_route

STYLE = wp.vec4(1.5, 2.0, 1.5, 1.8)  # time gap, gap at rest, acceleration, deceleration
DRIVER = DriverStyle(time_gap=1.5, standstill_gap=2.0, acceleration=1.5, deceleration=1.8, jerk=2.5)


@pytest.mark.parametrize(
    ("motion", "time", "expected"),
    [
        ((5.0, 2.0, 9.0, 0.0), 1.0, 6.0),  # 5 t + t^2
        ((5.0, 2.0, 9.0, 0.0), 4.0, 14.0 + 18.0),  # 2 s until 9 m/s, then 2 s at it
        ((5.0, 2.0, 9.0, 1.0), 1.0, 0.0),  # it has not started
        ((8.0, 2.0, 5.0, 0.0), 2.0, 13.0),  # slows down with 1.5 m/s^2
        ((8.0, 2.0, 5.0, 0.0), 3.0, 18.0),
    ],
)
def test_metres_that_a_driver_covers(motion: tuple[float, ...], time: float, expected: float) -> None:
    assert travel_distance(wp.vec4(*motion), time) == pytest.approx(expected)


@pytest.mark.parametrize("speed", [0.0, 3.0, 12.0])
def test_who_accelerates_is_sooner_there(speed: float) -> None:
    time = accelerating_time(speed, 2.0, 30.0)
    assert speed * time + time * time == pytest.approx(30.0, rel=1e-4)
    if speed > 0.0:
        assert gained_time(speed, 2.0, 30.0 / speed) == pytest.approx(time, rel=1e-4)
        assert gained_time(speed, 0.0, 7.0) == 7.0


@pytest.mark.parametrize(("speed", "gap", "time"), [(10.0, 21.0, 2.5), (6.0, 16.0, 3.5), (2.0, 9.0, 3.0)])
def test_a_driver_arrives_when_the_other_one_has_gone(speed: float, gap: float, time: float) -> None:
    react = driver_arrives_after(speed, gap, time, STYLE)
    acceleration = react + driver_power(speed, STYLE)
    covered = speed * time + 0.5 * acceleration * time * time
    assert covered <= gap - 0.99  # a metre before the stretch at the latest
    if react < 0.0:
        assert covered == pytest.approx(gap - 1.0, rel=1e-4)
    assert speed + acceleration * time >= 0.0


def test_a_driver_that_would_have_to_stop_does_not_arrive() -> None:
    assert driver_arrives_after(10.0, 11.0, 2.0, STYLE) == -FAR  # 2 m less than half of 10 m/s times 2 s, and more
    assert driver_arrives_after(10.0, 30.0, FAR, STYLE) == -FAR


def test_the_nearer_a_conflict_the_harder_a_driver_brakes() -> None:
    gaps = np.linspace(4.0, 80.0, 60).tolist()
    react = np.array([driver_yields(10.0, gap, STYLE) for gap in gaps])
    assert (np.diff(react) >= -1e-6).all()
    # with its comfortable deceleration, v^2 / (2 d) before it comes to rest 2 m before the conflict
    comfortable = driver_yields(10.0, 100.0 / (2.0 * 1.8) + 2.0, STYLE) + driver_power(10.0, STYLE)
    assert comfortable == pytest.approx(-1.8, abs=0.01)
    # at rest at the edge it stays there
    assert driver_yields(0.0, 0.5, STYLE) + driver_power(0.0, STYLE) < -0.5


def test_the_jerk_of_a_driver_is_reckoned_with() -> None:
    # from +1.2 to -1.8 m/s^2 with 2.5 m/s^3 takes 1.2 s, of which half is lost
    assert early_distance(40.0, 10.0, 1.2, 2.5, STYLE) == pytest.approx(40.0 - 6.0)
    assert early_distance(40.0, 10.0, -1.8, 2.5, STYLE) == 40.0
    assert early_distance(6.0, 10.0, 1.2, 2.5, STYLE) == 3.0
    # but that alone makes nobody brake hard
    power = driver_power(10.0, STYLE)
    assert early_react(-1.0, -9.0, 10.0, STYLE) + power == pytest.approx(-1.4 * 1.8)
    assert early_react(-8.0, -9.0, 10.0, STYLE) == -9.0 + 1.0


def test_the_foot_leaves_the_throttle_faster_than_it_presses_the_brake() -> None:
    released = 1.0 - pedal_change(-1.0, 1.0, 2.5, 0.1)
    braked = 0.0 - pedal_change(-1.0, 0.0, 2.5, 0.1)
    assert released == pytest.approx(1.8 * braked)
    assert braked == pytest.approx(0.25)


def meeting(start: float) -> Episode:
    """A car at 12 m/s with priority along x, and one from the side at 8 m/s, `start` m before the crossing."""
    side = replace(
        line_route(0.0, 200.0),
        xy=np.stack([np.full(201, 150.0), np.arange(201.0) - 100.0], 1).astype(np.float32),
        yaw=np.full(201, 0.5 * np.pi, np.float32),
    )
    first = EpisodeAgent("first", "car", Controller.AUTOPILOT, Pose(90.0, 0.0, 0.0), 12.0, 12.0, driver=DRIVER)
    second = EpisodeAgent(
        "second", "car", Controller.AUTOPILOT, Pose(150.0, -start, 0.5 * math.pi), 8.0, 8.0, driver=DRIVER, route=side
    )
    return episode(ego(2.0), replace(first, route=line_route(90.0, 390.0)), second)


def test_who_gives_way_slows_down_and_passes_behind() -> None:
    world = World([meeting(start) for start in (42.0, 46.0, 50.0)], NO_PASSING)
    slowest, braking, contact = np.full((3, 3), np.inf), np.zeros((3, 3)), False
    for _ in range(110):
        world.step()
        slowest = np.minimum(slowest, world.array("speed"))
        braking = np.maximum(braking, -world.array("accel"))
        contact |= bool(world.array("touch").any())
    assert not contact
    assert (world.array("pose")[:, 2, 1] > 0.0).all()  # it is through
    assert (slowest[:, 2] > 1.0).all()  # and did not stand
    assert (braking[:, 1] < 0.5).all()  # the other one noticed nothing
    assert (braking[:, 2] < 3.0).all()


def test_the_population_brakes_less_than_uniform_drivers() -> None:
    graph = load_town("Twinford")
    routes = town_routes(graph, 120, 900.0)
    onsets, jerks = {}, {}
    for drivers in ("uniform", "population"):
        world = World([traffic(graph, routes, 30, key=77, green=False, drivers=drivers)], {graph.name: graph})
        rows = []
        for _ in range(500):
            world.step()
            rows.append(world.array("accel")[0].astype(np.float64))
        acceleration = np.array(rows[100:])
        present = np.ones(acceleration.shape, bool)
        onsets[drivers] = braking_onsets(acceleration, present, 4.0)
        jerks[drivers] = float(np.quantile(np.abs(jerk(acceleration, present, world.dt)), 0.99))
    assert onsets["uniform"] > 10
    assert onsets["population"] < 0.1 * onsets["uniform"]
    assert jerks["population"] < 5.0 < jerks["uniform"]
