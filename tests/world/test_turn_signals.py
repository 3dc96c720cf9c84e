"""Turn signals: before and in turns and lane changes, in the world's state, in observations and in traces."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ssad.core.lane_graph import TURN
from ssad.core.seeding import generator
from ssad.core.top_view import lit_turn_signals
from ssad.core.types import Controller, DriverStyle, Episode, EpisodeAgent, EpisodeLimits, Pose, TurnSignal
from ssad.world.kernels.data import TurnRank
from ssad.world.observation import observe
from ssad.world.roads import load_town, random_route
from ssad.world.rollout import rollout
from ssad.world.turn_signals import BEFORE_TURN, TIME_BEFORE_TURN, turn_sides, turn_signals
from ssad.world.world import World
from tests.world.worlds import episode

CALM = DriverStyle(time_gap=1.5, standstill_gap=2.0, acceleration=1.5, deceleration=1.8, jerk=2.5)
LEFT, RIGHT = int(TurnSignal.LEFT), int(TurnSignal.RIGHT)


def test_the_near_side_is_left_where_traffic_keeps_to_the_left() -> None:
    ranks = np.array([TurnRank.STRAIGHT, TurnRank.RIGHT, TurnRank.LEFT, TurnRank.YIELD + TurnRank.RIGHT], np.float32)
    assert turn_sides(ranks, left_hand=False).tolist() == [0, RIGHT, LEFT, RIGHT]
    assert turn_sides(ranks, left_hand=True).tolist() == [0, LEFT, RIGHT, LEFT]


@pytest.mark.parametrize(
    ("shift", "speed", "distance", "expected"),
    [
        ((0.0, 0.0, 0.0, 0.0), 8.0, 2.0 + BEFORE_TURN - 0.1, RIGHT),
        ((0.0, 0.0, 0.0, 0.0), 8.0, 2.0 + BEFORE_TURN + 0.1, 0),
        ((0.0, 0.0, 0.0, 0.0), 20.0, 2.0 + 20.0 * TIME_BEFORE_TURN - 0.1, RIGHT),
        ((0.0, 0.0, 0.0, 0.0), 20.0, 2.0 + 20.0 * TIME_BEFORE_TURN + 0.1, 0),
        ((0.0, 0.0, 0.0, 0.0), 0.0, 0.0, RIGHT),  # in the junction
        ((120.0, 150.0, 0.0, 1.0), 8.0, 20.0, LEFT),  # decided, not begun
        ((90.0, 120.0, 1.0, 0.0), 8.0, 200.0, RIGHT),
        ((60.0, 90.0, 0.0, 1.0), 8.0, 200.0, 0),  # on the other lane
    ],
)
def test_when_an_agent_indicates(shift: tuple[float, ...], speed: float, distance: float, expected: int) -> None:
    def signal(*, indicates: bool) -> int:
        as_array = lambda value: np.array([[value]], np.float32)  # noqa: E731
        shown = turn_signals(
            shift=as_array(shift),
            along=as_array(100.0),
            speed=as_array(speed),
            junction_distance=as_array(distance),
            turn=np.array([[RIGHT]], np.int8),
            half_length=as_array(2.0),
            indicates=np.array([[indicates]]),
        )
        return int(shown[0, 0])

    assert signal(indicates=True) == expected
    assert signal(indicates=False) == 0


def test_lamps_flash_ninety_times_a_minute() -> None:
    lit = [bool(lit_turn_signals(np.array([LEFT]), 0.01 * step)[0]) for step in range(6000)]
    assert np.count_nonzero(np.diff(np.array(lit, int)) == 1) + 1 == 90
    assert np.mean(lit) == pytest.approx(0.5, abs=0.01)


@pytest.fixture(scope="module")
def turning() -> Episode:
    """An ego that follows its route behind a car with a driver, which turns at several junctions of a town."""
    graph = load_town("Twinford")
    random = generator("turn signals")
    lane = int(np.flatnonzero((graph.junction < 0) & (graph.kind == 1) & (graph.length > 60.0))[3])
    route = random_route(graph, lane, 30.0, 500.0, random)
    behind = random_route(graph, lane, 5.0, 60.0, random)
    poses = [Pose(*map(float, (*way.xy[0], way.yaw[0]))) for way in (behind, route)]
    return replace(
        episode(
            EpisodeAgent("ego", "car", Controller.NONE, poses[0], 0.0, 0.0, route=behind),
            EpisodeAgent("car", "car", Controller.AUTOPILOT, poses[1], 5.0, 12.0, route=route, driver=CALM),
        ),
        town="Twinford",
    )


def test_a_vehicle_indicates_before_and_in_every_turn_of_its_way(turning: Episode) -> None:
    graph, route = load_town("Twinford"), turning.agents[1].route
    assert route is not None
    inside = graph.junction[np.maximum(route.lane, 0)] >= 0
    edges = np.flatnonzero(np.diff(inside.astype(int)))
    expected = np.zeros(len(inside), int)
    last = 0
    for entry, leave in zip(edges[::2] + 1, edges[1::2] + 1, strict=False):
        turn = float(np.angle(np.exp(1j * (route.yaw[min(leave, len(inside) - 1)] - route.yaw[entry - 1]))))
        expected[max(entry - 25, last) : leave - 1] = 0 if abs(turn) < TURN else int(np.sign(turn))
        last = leave
    limits = EpisodeLimits(max_steps=1200, max_time=120.0)
    world = World([replace(turning, limits=limits)], {"Twinford": graph})
    shown = set()
    for _ in range(1000):
        world.step()
        place = int(world.array("progress")[0, 1])
        signal = int(world.state().turn_signal[0, 1])
        if expected[place]:
            assert signal == expected[place]
            shown.add(signal)
    assert shown == {LEFT, RIGHT}
    assert world.state().turn_signal[0, 0] == 0  # nobody drives it


def test_signals_are_in_observations_and_in_traces_of_drivers_alone(turning: Episode) -> None:
    graphs = {"Twinford": load_town("Twinford")}
    uniform = replace(turning, agents=(turning.agents[0], replace(turning.agents[1], driver=None)))
    world = World([turning, uniform], graphs)
    with_driver, without = rollout(world, {})
    assert with_driver.turn_signal.shape == with_driver.x.shape
    assert with_driver.turn_signal[:, 1].any()
    assert not with_driver.turn_signal[:, 0].any()
    assert without.turn_signal.shape == (0, 0)
    world.reset()
    egos = np.array([[0, 0], [1, 0]], np.int32)
    for step in range(1, 200):
        world.step()
        view = observe(world.state(), egos, world.ended() != 0)
        assert view.others_turn_signal is not None
        in_sight = view.others[0, 0, 6] > 0
        assert view.others_turn_signal[0, 0] == (with_driver.turn_signal[step, 1] if in_sight else 0)
    assert view.others_turn_signal.shape == (2, 16)
