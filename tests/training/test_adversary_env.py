"""The environment in which adversaries learn is the loop in which they drive."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ssad.core.checkpoints import WeightsCard
from ssad.core.types import Controller, EpisodeAgent, Pose
from ssad.drivers import make_system
from ssad.training.driver import draw_episodes, find_scenarios
from ssad.training.feasibility import FeasibleRegion, body_distance
from ssad.world.policy import PolicyDriver, policy_of, tensors_of
from ssad.world.rollout import Loop
from ssad.world.selection import FreaSelection
from ssad.world.sensors import SENSORS
from ssad.world.world import World
from tests.world.worlds import GRAPHS, ego, episode

pytest.importorskip("stable_baselines3", reason="needs the extra train")
from ssad.training.adversary_env import AdversaryEnv, Conduct


def scenes():
    scenarios, graphs = find_scenarios([f"training/natural/Larkhill_{k:02d}/00" for k in range(6)])
    return draw_episodes(scenarios, graphs, draws=1, seed=0), graphs


def some_policy():
    torch.manual_seed(3)
    layers = [torch.nn.Linear(24, 16), torch.nn.Linear(16, 2)]
    config = {"observation": "adversary", "action": "adversary", "squash": "tanh"}
    return policy_of(WeightsCard("", "", 0, (), config=config), tensors_of(layers), "test")


def environment(monkeypatch, **settings) -> AdversaryEnv:
    episodes, graphs = scenes()
    env = AdversaryEnv(episodes, graphs, len(episodes), ego=make_system("autopilot"), **settings)
    monkeypatch.setattr(env, "_draw", lambda count: np.arange(count, dtype=np.int32))
    return env


def test_an_adversary_drives_in_training_as_it_does_in_the_loop(monkeypatch) -> None:
    policy, env = some_policy(), environment(monkeypatch)
    observation = env.reset()
    episodes, graphs = scenes()
    world = World(episodes, graphs)
    loop = Loop(world, {0: make_system("autopilot"), FreaSelection(count=1): PolicyDriver(policy, name="own")})
    loop.reset()
    seen = 0
    for _ in range(80):
        env.step_async(policy.actions(observation))
        observation, _, _, _ = env.step_wait()
        loop.step()
        if (world.ended() != 0).any():
            break
        np.testing.assert_array_equal(env.world.state().pose, world.state().pose)
        seen += int((world.state().policy == 1).sum())
    assert seen > 30


def test_rows_of_scenes_without_an_adversary_are_empty(monkeypatch) -> None:
    env = environment(monkeypatch)
    observation = env.reset()
    assert not observation.any()  # nobody is chosen at the very start
    released = 0
    for _ in range(120):
        before = env._adversaries.copy()
        env.step_async(np.zeros((6, 2), np.float32))
        observation, reward, done, infos = env.step_wait()
        assert done[before < 0].all()
        assert not reward[before < 0].any()
        assert not observation[env._adversaries < 0].any()
        assert (observation[env._adversaries >= 0, 2] > 1.0).all()  # its own length
        external = env.world.state().controller == Controller.EXTERNAL
        assert external.sum() == (env._adversaries >= 0).sum()
        for b in np.flatnonzero(done & (before >= 0)):
            released += 1
            assert infos[b]["terminal_observation"][2] > 1.0
            assert infos[b]["episode"]["l"] > 0
    assert released >= 3


def test_leaving_the_road_costs(monkeypatch) -> None:
    """Full throttle and full lock leave the road in the end."""
    found = {}
    for cost in (0.0, 0.5):
        env = environment(monkeypatch, off_road=cost, scale=1.0)
        env.reset()
        total = 0.0
        for _ in range(80):
            env.step_async(np.tile(np.array([1.0, 1.0], np.float32), (6, 1)))
            total += float(env.step_wait()[1].sum())
        found[cost] = total
    assert found[0.5] < found[0.0] - 2.0


@pytest.mark.parametrize("reward", ["colliding", "feasible", "lawful", "proving"])
def test_other_rewards_are_paid(monkeypatch, reward: str) -> None:
    env = environment(monkeypatch, reward=reward)
    env.reset()
    paid = []
    for _ in range(60):
        env.step_async(np.full((env.num_envs, 2), (0.5, 0.0), np.float32))
        paid.append(env.step_wait()[1])
    assert np.isfinite(paid).all()
    assert np.abs(paid).max() > 0.0


@pytest.mark.parametrize(
    ("places", "kept"),
    [
        ([(50.0, 0.0, 0.0)] * 5, True),
        ([(50.0, 3.5, 0.0)] * 2 + [(50.0, 0.0, 0.0)], True),  # 0.2 s on the wrong side are forgiven
        ([(50.0, 3.5, 0.0)] * 3 + [(50.0, 0.0, 0.0)], False),
        ([(50.0, 0.0, 0.0), (50.0, 3.5, 0.0)], False),  # on the wrong side now
        ([(50.0, 0.0, 0.0), (50.0, -9.0, 0.0), (50.0, 0.0, 0.0)], False),  # has left the road
        ([(50.0, -9.0, 0.0), (50.0, 0.0, 0.0)], True),  # has come from beside it
        ([(50.0, 0.0, 0.0), (50.0, 0.0, 0.2), (50.0, 0.0, 0.2)], False),  # 5 m/s and 2 rad/s are 10 m/s^2
        ([(50.0, 0.0, 0.0), (60.0, 0.0, 0.0), (50.0, 0.0, 0.0)], False),  # has touched another car
    ],
    ids=["lawful", "briefly wrong", "wrong way", "wrong now", "left the road", "joins", "turns too hard", "touched"],
)
def test_conduct_is_that_of_a_proven_collision(places: list[tuple[float, float, float]], kept: bool) -> None:
    def car(x: float, y: float, yaw: float) -> EpisodeAgent:
        return EpisodeAgent("car", "car", Controller.NONE, Pose(x, y, yaw), speed=5.0)

    conduct = Conduct(1, dt=0.1)
    conduct.begin([0])
    heading = 0.0
    for x, y, yaw in places:
        world = World([episode(ego(x=200.0), car(x, y, yaw), car(60.0, 0.0, 0.0))], GRAPHS)
        world.step()
        state = replace(world.state(), pose=world.state().pose.copy())
        state.pose[0, 1] = x, y, yaw
        alignment = SENSORS["road"](world, np.array([[0, 1]], np.int32))[:, 0]
        is_unflawed = conduct.record(state, np.array([[0, 1]], np.int32), alignment, np.array([heading], np.float32))
        heading = yaw
    assert is_unflawed.tolist() == [kept]


def test_the_region_is_asked_about_the_ego_before_and_after_each_step(monkeypatch) -> None:
    class Gap(FeasibleRegion):
        def value(self, states):
            return body_distance(states).astype(np.float32)

    env = environment(monkeypatch, region=Gap())
    env.reset()
    last = None
    followed = 0
    for _ in range(60):
        before = env._adversaries.copy()
        env.step_async(np.zeros((6, 2), np.float32))
        env.step_wait()
        np.testing.assert_array_equal(env.is_driven, before >= 0)
        assert not env.region_values[:, ~env.is_driven].any()
        if last is not None:
            same = env.is_driven & last[1] & (before == last[2])
            np.testing.assert_array_equal(env.region_values[0, same], last[0][1, same])
            followed += int((same & np.isfinite(env.region_values[0]) & (env.region_values[0] > 0.0)).sum())
        last = env.region_values.copy(), env.is_driven.copy(), before
    assert followed > 10
