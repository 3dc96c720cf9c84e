"""Drivers of the population on a straight road: smooth, each by parameters of its own, and reproducible."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad.core.seeding import generator
from ssad.core.types import F64, Controller, DriverStyle, Episode, EpisodeAgent, Pose, SignalState
from ssad.world.roads import load_town, random_route
from ssad.world.world import World
from tests.world.worlds import NO_PASSING, ego, episode, line_route

CALM = DriverStyle(time_gap=1.5, standstill_gap=2.0, acceleration=1.5, deceleration=1.8, jerk=2.5)
HALF = 2.45  # m, half length of a car


def road(driver: DriverStyle | None, *, speed: float = 0.0, rear: float | None = None) -> Episode:
    """An ego that stands, a car before it with that driver, and perhaps a standing one whose rear is at x = `rear`."""
    car = EpisodeAgent("car", "car", Controller.AUTOPILOT, Pose(20.0, 0.0, 0.0), speed, 12.0, driver=driver)
    agents = [ego(2.0), replace(car, route=line_route(20.0, 390.0))]
    if rear is not None:
        agents.append(EpisodeAgent("parked", "car", Controller.NONE, Pose(rear + HALF, 0.0, 0.0)))
    return episode(*agents)


def drive(test: Episode, seconds: float) -> tuple[F64, F64, F64]:
    """Place of the front, speed and acceleration of the car, in each step."""
    world, rows = World([test], NO_PASSING), []
    for _ in range(round(10 * seconds)):
        world.step()
        rows.append([float(world.array(name)[0, 1].ravel()[0]) for name in ("pose", "speed", "accel")])
    x, speed, acceleration = np.array(rows).T
    return x + HALF, speed, acceleration


def test_a_driver_starts_with_its_jerk_and_acceleration_and_holds_its_speed() -> None:
    _, speed, acceleration = drive(road(CALM), 25.0)
    assert np.abs(np.diff(acceleration)).max() <= 0.1 * CALM.jerk + 1e-3
    # stronger from rest than while following
    assert 1.2 * CALM.acceleration < acceleration.max() < 1.6 * CALM.acceleration
    assert acceleration[speed > 8.0].max() < CALM.acceleration
    assert speed[-1] == pytest.approx(12.0, abs=0.4)


def test_a_driver_stops_behind_a_standing_car_with_its_deceleration_at_its_gap() -> None:
    front, speed, acceleration = drive(road(CALM, speed=12.0, rear=150.0), 25.0)
    assert speed[-1] == 0.0
    assert 150.0 - front[-1] == pytest.approx(CALM.standstill_gap, abs=0.6)
    assert -acceleration.min() < 1.4 * CALM.deceleration


def test_the_uniform_driver_is_that_of_before() -> None:
    _, _, acceleration = drive(road(None), 3.0)
    assert acceleration.max() == pytest.approx(2.5, abs=0.01)  # IDM's, at once
    world = World([road(None)], NO_PASSING)
    world.step()
    assert not world.array("pending").any()


def test_a_driver_waits_its_reaction_time_before_it_starts() -> None:
    _, prompt, _ = drive(road(CALM), 3.0)
    _, slow, _ = drive(road(replace(CALM, reaction_time=1.0)), 3.0)
    delay = int((slow > 0.0).argmax()) - int((prompt > 0.0).argmax())
    assert delay == 10


def test_gaps_are_misjudged_by_the_error_and_the_key_of_the_driver() -> None:
    def gaps(**parts: float) -> F64:
        return drive(road(replace(CALM, **parts), speed=12.0, rear=120.0), 8.0)[0]

    exact = gaps()
    np.testing.assert_allclose(gaps(key=7), exact, atol=0.01)
    first, second = gaps(estimation_error=0.1, key=7), gaps(estimation_error=0.1, key=8)
    assert np.abs(first - exact).max() > 0.1
    assert np.abs(first - second).max() > 0.1


def test_errors_have_the_rate_that_is_asked_for() -> None:
    front, _, _ = drive(road(replace(CALM, errors=1800.0), speed=12.0, rear=150.0), 25.0)
    assert front[-1] > 149.0  # an error in every 2 s: it does not brake
    front, _, _ = drive(road(replace(CALM, errors=0.0), speed=12.0, rear=150.0), 25.0)
    assert front[-1] < 149.0


def test_a_driver_drives_alike_in_any_batch() -> None:
    errant = replace(CALM, reaction_time=0.8, estimation_error=0.08, lane_offset=0.1, key=11)
    tests = [road(errant, rear=150.0), road(CALM), road(replace(errant, key=12), rear=100.0)]
    batch = World(tests, NO_PASSING)
    alone = World(tests[:1], NO_PASSING)
    for _ in range(120):
        batch.step()
        alone.step()
    assert batch.hashes()[0] == alone.hashes()[0]
    assert batch.hashes()[0] != batch.hashes()[2]


def crossing(start: float) -> Episode:
    """A car at 15 m/s along x with priority, and one from the side that starts from rest `start` m before it."""
    side = replace(
        line_route(0.0, 200.0),
        xy=np.stack([np.full(201, 150.0), np.arange(201.0) - 100.0], 1).astype(np.float32),
        yaw=np.full(201, 0.5 * np.pi, np.float32),
    )
    fast = EpisodeAgent("fast", "car", Controller.AUTOPILOT, Pose(20.0, 0.0, 0.0), 15.0, 15.0, driver=CALM)
    slow = EpisodeAgent(
        "slow", "car", Controller.AUTOPILOT, Pose(150.0, -start, 0.5 * np.pi), 6.0, 8.0, driver=CALM, route=side
    )
    return episode(ego(2.0), replace(fast, route=line_route(20.0, 390.0)), slow)


def test_the_uniform_driver_and_that_of_the_population_drive_alike_side_by_side() -> None:
    population = crossing(56.0)
    uniform = replace(population, agents=tuple(replace(agent, driver=None) for agent in population.agents))
    worlds = [World(tests, NO_PASSING) for tests in ([uniform, population], [uniform], [population])]
    assert [world.bank.has_drivers for world in worlds] == [True, False, True]
    for _ in range(60):
        for world in worlds:
            world.step()
    both, alone = worlds[0].hashes(), [world.hashes()[0] for world in worlds[1:]]
    assert both == alone
    assert both[0] != both[1]


def test_who_gives_way_leaves_a_margin_and_stops_beside_the_corridor() -> None:
    world = World([crossing(start) for start in np.arange(54.0, 64.0, 2.0).tolist()], NO_PASSING)
    braking, gap = np.zeros(world.batch), np.full(world.batch, np.inf)
    for _ in range(110):
        world.step()
        pose = world.array("pose")
        braking = np.maximum(braking, -world.array("accel")[:, 1])
        inside = np.abs(pose[:, 2, 1]) < HALF + 1.0
        gap = np.where(inside, np.minimum(gap, np.abs(pose[:, 1, 0] - 150.0)), gap)
    assert braking.max() < 1.0
    assert gap.min() > 9.0


@pytest.mark.parametrize(
    ("state", "beyond", "starts"), [("RED", 1.2, False), ("RED", -0.5, False), ("GREEN", 1.2, True)]
)
def test_who_rests_just_beyond_its_stop_line_waits_for_green(state: str, beyond: float, starts: bool) -> None:
    graph = load_town("Twinford")
    lane, s, signal = int(graph.stop_lane[0]), float(graph.stop_s[0]), int(graph.stop_signal[0])
    front = s + beyond
    route = random_route(graph, lane, front - HALF, 120.0, generator("stop line"))
    pose = Pose(float(route.xy[0, 0]), float(route.xy[0, 1]), float(route.yaw[0]))
    car = EpisodeAgent("car", "car", Controller.AUTOPILOT, pose, 0.0, 12.0, route=route, driver=CALM)
    far = line_route(pose.x + 500.0, pose.x + 600.0)
    bystander = EpisodeAgent("ego", "car", Controller.NONE, Pose(pose.x + 500.0, 0.0, 0.0), route=far)
    forced = dict.fromkeys(np.flatnonzero(~graph.signal_virtual).tolist(), SignalState.RED) | {
        signal: SignalState[state]
    }
    test = replace(episode(bystander, car), town="Twinford", signal_override=forced, override_until=1e6)
    world = World([test], {"Twinford": graph})
    for _ in range(80):
        world.step()
    assert (float(world.array("travelled")[0, 1]) > 5.0) == starts
    assert starts or float(world.array("travelled")[0, 1]) < 0.3
