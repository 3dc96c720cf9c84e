"""What learned drivers look at, for any agent, and the rewards they learn from."""

from __future__ import annotations

import numpy as np
import pytest

from ssad.core.types import Controller, EpisodeAgent, Pose
from ssad.world import rewards
from ssad.world.rollout import Loop
from ssad.world.sensors import SENSORS, from_above
from ssad.world.world import World
from tests.world.worlds import GRAPHS, ego, episode, line_route


def car(x: float, y: float = 0.0, yaw: float = 0.0, speed: float = 0.0, **more) -> EpisodeAgent:
    return EpisodeAgent("car", "car", Controller.EXTERNAL, Pose(x, y, yaw), speed=speed, **more)


def agents(*pairs: tuple[int, int]) -> np.ndarray:
    return np.array(pairs, np.int32)


def after_a_step(*episodes) -> World:
    """Lanes and records are known after a step."""
    world = World(episodes, GRAPHS)
    world.step()
    return world


def test_safebench_of_the_car_behind_is_what_it_is_of_an_ego() -> None:
    pair = [car(30.0, speed=4.0, route=line_route(30.0, 200.0)), car(40.0, route=line_route(40.0, 200.0))]
    second = after_a_step(episode(ego(x=200.0), *pair))
    first = after_a_step(episode(ego(x=30.0, speed=4.0, route=line_route(30.0, 200.0)), pair[1]))
    for name in ("safebench", "frea"):
        np.testing.assert_array_equal(
            SENSORS[name](second, agents((0, 1))), SENSORS[name](first, agents((0, 0))), err_msg=name
        )
    np.testing.assert_allclose(SENSORS["safebench"](second, agents((0, 1), (0, 2)))[:, 3], [1.0, 0.0])


def test_the_adversary_sees_itself_the_ego_another_and_its_goal() -> None:
    world = after_a_step(episode(ego(), car(30.0, 3.5, np.pi), car(20.0, 3.5, np.pi), car(300.0)))
    found = SENSORS["adversary"](world, agents((0, 1)))[0].reshape(4, 6)
    size = [4.9, 2.06]
    np.testing.assert_allclose(found[0], [0, 0, *size, 0, 0], atol=1e-5)
    np.testing.assert_allclose(found[1, :4], [20.0, 3.5, *size], atol=1e-4)
    assert abs(found[1, 4]) == pytest.approx(np.pi, abs=1e-5)
    np.testing.assert_allclose(found[2], [10.0, 0.0, *size, 0, 0], atol=1e-4)
    np.testing.assert_allclose(found[3, :4], [13.5, 3.5, 2.0, 2.0], atol=1e-4)
    assert found[3, 5] == pytest.approx(np.hypot(13.5, 3.5), abs=1e-4)
    goal = rewards.goals(world.state())
    np.testing.assert_allclose(goal, [[16.5, 0.0]], atol=1e-4)
    assert rewards.distance_to_goal(world.state(), agents((0, 1)))[0] == pytest.approx(found[3, 5], abs=1e-4)


def test_the_view_from_above_shows_road_route_agents_and_speed() -> None:
    world = after_a_step(episode(ego(speed=10.0), car(30.0, 3.5, np.pi)))
    picture = SENSORS["above"](world, agents((0, 0)))[0]
    assert picture.shape == (4, 64, 64)

    def at(x: float, y: float) -> np.ndarray:
        """Channels at a place of the world; the ego is at (11, 0)."""
        return picture[:, round(63.5 - 2.0 * (x - 11.0 + 8.0)), round(31.5 - 2.0 * y)]

    np.testing.assert_allclose(at(11.0, 0.0), [1.0, 1.0, 0.5, 0.5])
    np.testing.assert_allclose(at(30.0, 3.5), [1.0, 0.0, 1.0, 0.0])
    np.testing.assert_allclose(at(25.0, 0.0), [1.0, 1.0, 0.0, 0.0])
    np.testing.assert_allclose(at(25.0, 12.0), [0.0, 0.0, 0.0, 0.0])
    turned = SENSORS["above"](world, agents((0, 1)))[0]
    # seen from the other car, which faces the ego, the ego is ahead on the left
    assert turned[2, round(63.5 - 2.0 * (19.0 + 8.0)), round(31.5 - 2.0 * 3.5)] == 1.0
    assert from_above(side=32, pixels=1.0)(world, agents((0, 0))).shape == (1, 4, 32, 32)


def test_readings_do_not_depend_on_the_other_rows() -> None:
    world = after_a_step(episode(ego(speed=5.0), car(20.0, 3.5, np.pi)), episode(ego(), car(15.0)))
    everybody = agents((0, 0), (0, 1), (1, 0), (1, 1))
    for name, sensor in SENSORS.items():
        if name == "truth":
            continue  # a belief, of egos alone: see tests/drivers/test_belief.py
        together = sensor(world, everybody).copy()
        for k, row in enumerate(everybody):
            np.testing.assert_array_equal(sensor(world, row[None])[0], together[k], err_msg=name)


@pytest.mark.parametrize(
    ("y", "speed", "steer", "expected"),
    [
        (0.0, 5.0, 0.0, 5.0),
        (0.0, 9.0, 0.0, 9.0 - 10.0),
        (4.5, 5.0, 0.0, 5.0 - 1.0),
        (0.0, 5.0, 0.2, 5.0 - 5 * 0.04 - 0.2 * 0.2 * 25.0),
    ],
)
def test_safebench_reward(y: float, speed: float, steer: float, expected: float) -> None:
    world = World([episode(ego(speed=speed, pose=Pose(30.0, y), route=line_route(10.0, 210.0)))], GRAPHS)
    world.step(np.array([[0.0, 0.0, steer]], np.float32))
    along = float(world.array("speed")[0, 0] * np.cos(world.array("pose")[0, 0, 2]))
    correction = (along - speed) - 0.2 * steer * (along**2 - speed**2)
    found = rewards.safebench(world.state())[0]
    assert found == pytest.approx(expected + correction, abs=1e-3)
    less = 10.0 if 6.0 < speed <= 8.0 else 0.0
    assert rewards.frea(world.state())[0] == pytest.approx(found - 0.1 - less, abs=1e-5)


def test_a_collision_costs_what_safebench_and_frea_say() -> None:
    world = World([episode(ego(speed=5.0), car(15.2)), episode(ego(speed=5.0))], GRAPHS)
    world.step(np.zeros((2, 3), np.float32))
    assert world.ended().tolist() == [1, 0]
    hit, free = rewards.safebench(world.state())
    assert hit - free == pytest.approx(-1.0)
    hit, free = rewards.frea(world.state())
    assert hit - free == pytest.approx(-10.0)
    hit, free = rewards.driver(world.state())
    assert hit - free == pytest.approx(-100.0)


@pytest.mark.parametrize(("y", "costs"), [(0.4, 0.0), (2.5, 3.0), (-2.5, 3.0 + 5.0), (4.5, 6.0)])
def test_shipped_drivers_learn_to_stay_on_their_route_and_on_the_road(y: float, costs: float) -> None:
    """South of the lane is a sidewalk, north of it the other lane."""
    world = World([episode(ego(speed=5.0, pose=Pose(30.0, y), route=line_route(10.0, 210.0)))], GRAPHS)
    world.step(np.zeros((1, 3), np.float32))
    same = rewards.safebench(world.state())[0] - 0.1
    assert rewards.lane(world.state())[0] == pytest.approx(same - costs, abs=1e-3)
    off = 5.0 if y < -2.0 else 0.0
    assert rewards.driver(world.state())[0] == pytest.approx(same - off, abs=1e-3)


def test_the_adversarys_reward_and_equation_6_as_printed() -> None:
    near_goal, pushing, alone = car(16.5, 1.0), car(60.0, speed=1.0), car(100.0, 3.5, np.pi, speed=5.0)
    world = World([episode(ego(), near_goal, pushing, car(64.9), alone)], GRAPHS)
    who = agents((0, 1), (0, 2), (0, 4))
    before = rewards.distance_to_goal(world.state(), who)
    world.step(np.zeros((1, 5, 3), np.float32))
    now = rewards.distance_to_goal(world.state(), who)
    found = rewards.adversary(world.state(), who, before)
    gain = before - now
    assert gain[2] == pytest.approx(0.5, abs=0.01)
    np.testing.assert_allclose(found, gain + np.array([15.0, -15.0, 0.0]), atol=1e-6)
    np.testing.assert_allclose(
        rewards.adversary(world.state(), who, before, literal=True), -gain + np.array([-15.0, 15.0, 0.0]), atol=1e-6
    )
    assert rewards.adversary(world.state(), who, before + 9.0)[2] == 1.0  # a goal that jumps earns no more


def test_equation_5_wants_the_ego_near_adversaries_apart_and_on_the_road() -> None:
    def cost(*others: EpisodeAgent) -> float:
        world = after_a_step(episode(ego(), *others, *[car(350.0)] * (3 - len(others))))
        mask = np.zeros((1, 4), bool)
        mask[0, 1 : 1 + len(others)] = True
        return float(rewards.collision_cost(world.state(), mask)[0])

    assert cost(car(20.0)) == pytest.approx(10.0 - 4.9, abs=1e-3)
    assert cost(car(20.0), car(60.0)) == pytest.approx(5.1 - 3.0 * 1.25, abs=1e-3)
    assert cost(car(20.0), car(25.4)) == pytest.approx(5.1 - 3.0 * 0.5, abs=1e-3)
    assert cost(car(20.0, -30.0)) == pytest.approx(20.0 + np.hypot(5.1, 30.0 - 2.06), abs=1e-3)
    assert cost() == 0.0


def test_equation_5_pays_for_what_brings_the_bodies_together() -> None:
    world = after_a_step(episode(ego(), car(20.0, yaw=np.pi, speed=5.0)))
    who = agents((0, 1))
    before = rewards.cost_of(world.state(), who).copy()
    world.step()
    assert rewards.colliding(world.state(), who, before)[0] == pytest.approx(0.5, abs=0.05)


def test_a_contact_is_paid_if_a_careful_driver_would_have_avoided_it() -> None:
    world = after_a_step(episode(ego(), car(14.5)), episode(ego(), car(14.5)), episode(ego(), car(20.0), car(24.0)))
    who = agents((0, 1), (1, 1), (2, 1))
    before = rewards.distance_to_goal(world.state(), who) + 0.5
    paid = rewards.feasible(world.state(), who, before, np.array([True, False, True]))
    np.testing.assert_allclose(paid, 0.15 + np.array([30.0, -10.0, -15.0]), atol=1e-6)
    off = after_a_step(episode(ego(), car(40.0, -30.0)))
    cost = rewards.feasible(
        off.state(),
        agents((0, 1)),
        rewards.distance_to_goal(off.state(), agents((0, 1))),
        np.array([False]),
        off_road=0.5,
    )
    assert cost[0] == pytest.approx(-0.5)


def test_the_environment_takes_any_reward_and_other_drivers() -> None:
    from ssad.drivers.builtin import Blind
    from ssad.world.env import VectorEnv

    second = car(40.0, 0.0, route=line_route(40.0, 300.0))
    one = [episode(ego(), second)]
    env = VectorEnv(one, GRAPHS, 2, reward=lambda state: state.pose[:, 1, 0].astype(float), drivers={1: Blind()})
    env.reset(seed=0)
    for _ in range(30):
        _, reward, *_ = env.step(np.zeros((2, 2), np.float32))
    assert (reward > 50.0).all()


def test_a_loop_without_drivers_passes_controls_on() -> None:
    world = World([episode(ego())], GRAPHS)
    loop = Loop(world, {})
    loop.reset()
    loop.step(np.array([[[1.0, 0.0, 0.0]]], np.float32))
    assert world.array("speed")[0, 0] > 0.0


def test_the_road_is_seen_with_its_direction_and_its_edges() -> None:
    lawful, wrong, beside, across = car(30.0), car(60.0, 3.5), car(90.0, -9.0), car(120.0, 0.0, np.pi / 2)
    reversing = car(150.0, speed=-2.0)
    world = World([episode(ego(), lawful, wrong, beside, across, reversing)], GRAPHS)
    readings = SENSORS["road"](world, agents(*((0, number) for number in range(1, 6))))
    np.testing.assert_allclose(readings[:, 0], [1.0, -1.0, -2.0, 0.0, -1.0], atol=1e-5)
    ahead = readings[:, 1:].reshape(5, 4, 5)  # agent, station, from 4 m on the left to 4 m on the right
    np.testing.assert_allclose(ahead[0], [[-1.0, -1.0, 1.0, -1.0, -1.0]] * 4, atol=1e-5)
    np.testing.assert_allclose(ahead[2], -1.0, atol=1e-5)
    np.testing.assert_allclose(ahead[3, 3], -1.0, atol=1e-5)  # 20 m north of a road that is 5.25 m wide
    together = SENSORS["adversary-on-road"](world, agents((0, 1)))[0]
    np.testing.assert_array_equal(together[24:], readings[0])
    np.testing.assert_allclose(together[:24:6], SENSORS["adversary"](world, agents((0, 1)))[0, ::6] / 10.0, atol=1e-6)


def test_lawful_adversaries_pay_for_the_road_and_for_the_direction_of_traffic() -> None:
    world = World([episode(ego(), car(40.0, speed=4.0), car(70.0, 3.5, speed=4.0), car(100.0, -9.0))], GRAPHS)
    who = agents((0, 1), (0, 2), (0, 3))
    before = rewards.distance_to_goal(world.state(), who)
    world.step(np.zeros((1, 4, 3), np.float32))
    alignment = SENSORS["road"](world, who)[:, 0]
    assert rewards.drives_against(world.state(), who, alignment).tolist() == [False, True, False]
    paper = rewards.adversary(world.state(), who, before)
    reward = rewards.lawful(world.state(), who, before, alignment, off_road=0.5, against=2.0)
    np.testing.assert_allclose(paper - reward, [0.0, 2.0, 0.5], atol=1e-6)


@pytest.mark.parametrize("proven", [True, False])
def test_a_contact_with_the_ego_is_paid_by_what_it_proves(proven: bool) -> None:
    world = World([episode(ego(speed=5.0), car(15.2), car(60.0, speed=1.0), car(64.9))], GRAPHS)
    who = agents((0, 1), (0, 2))
    before = rewards.distance_to_goal(world.state(), who)
    world.step(np.zeros((1, 4, 3), np.float32))
    alignment = SENSORS["road"](world, who)[:, 0]
    judged = np.array([proven, False])
    reward = rewards.proving(world.state(), who, before, alignment, judged)
    progress = 0.3 * np.clip(before - rewards.distance_to_goal(world.state(), who), -1.0, 1.0)
    np.testing.assert_allclose(reward - progress, [30.0 if proven else -3.0, -15.0], atol=1e-6)
