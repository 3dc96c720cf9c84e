"""The Gymnasium faces of the world."""

from __future__ import annotations

import copy
import pickle
from collections.abc import Callable, Sequence
from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from ssad.core.driving import Observation
from ssad.core.errors import ConfigError, UnknownNameError
from ssad.core.types import F32, Controller, Episode, EpisodeAgent, EpisodeLimits, Pose
from ssad.world.env import SingleEnv, VectorEnv
from ssad.world.kernels.data import PerceivedAgents, array_types
from ssad.world.noise import Noise
from ssad.world.world import World
from tests.world.test_world import bank
from tests.world.worlds import DEVICES, GRAPHS, ego, episode, line_route


@pytest.mark.parametrize("observation", ["safebench", "frea"])
@pytest.mark.parametrize("action", ["safebench", "frea", "controls"])
def test_single_env_passes_gymnasiums_checker(observation: str, action: str) -> None:
    check_env(SingleEnv(bank(), GRAPHS, observation=observation, action=action), skip_render_check=True)


def test_vector_env_equals_gymnasiums_sync_vector_env() -> None:
    """The same episodes and actions through Gymnasium's own vectoriser give the same numbers."""
    episodes = [episode(ego(speed=v), key=str(v), limits=EpisodeLimits(max_steps=40)) for v in (2.0, 5.0, 8.0)]
    ours = VectorEnv(episodes[:1], GRAPHS, 3)
    theirs = gym.vector.SyncVectorEnv(
        [lambda: SingleEnv(episodes[:1], GRAPHS)] * 3, autoreset_mode=gym.vector.AutoresetMode.SAME_STEP
    )
    a, _ = ours.reset(seed=1)
    b, _ = theirs.reset(seed=1)
    np.testing.assert_array_equal(a, b)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    rng = np.random.default_rng(0)
    ended = 0
    for _ in range(90):
        actions = rng.uniform(-1, 1, (3, 2)).astype(np.float32) * np.array([1.0, 0.1], np.float32)
        x, y = ours.step(actions), theirs.step(actions)
        for left, right in zip(x[:4], y[:4], strict=True):
            np.testing.assert_array_equal(left, right)
        done = x[2] | x[3]
        ended += int(done.sum())
        for k in np.flatnonzero(done):
            np.testing.assert_array_equal(x[4]["final_obs"][k], y[4]["final_obs"][k])
    assert ended >= 3
    assert isinstance(ours, gym.vector.VectorEnv)


def test_vector_env_is_seeded() -> None:
    env = VectorEnv(bank(), GRAPHS, 8)
    first = env.reset(seed=3)[1]["episode"]
    again = env.reset(seed=3)[1]["episode"]
    other = [tuple(env.reset(seed=k)[1]["episode"]) for k in range(5)]
    assert tuple(first) == tuple(again)
    assert len(set(other)) > 1


def test_unknown_spaces_and_sizes_are_refused() -> None:
    with pytest.raises(ConfigError, match="observation"):
        SingleEnv(bank(), GRAPHS, observation="pixels")
    with pytest.raises(ConfigError, match="action"):
        SingleEnv(bank(), GRAPHS, action="wheel")
    with pytest.raises(ConfigError, match="num_envs"):
        VectorEnv(bank(), GRAPHS, 0)


class Doubter:
    """Driver with a memory: throttle that wanders by a generator of its own."""

    name, controller = "doubter", Controller.EXTERNAL

    def __init__(self) -> None:
        self.random = np.random.default_rng(7)
        self.throttle = 0.5

    def reset(self, episodes: Sequence[Episode]) -> None:
        self.throttle = 0.5

    def act(self, view: Observation) -> F32:
        self.throttle = float(np.clip(self.throttle + self.random.normal(0.0, 0.2), 0.0, 1.0))
        return np.tile(np.array([self.throttle, 0.0, 0.0], np.float32), (len(view.scene), 1))


def make_doubter(name: str) -> Doubter:
    return Doubter()


def doubting_bank() -> list[Episode]:
    """Episodes in three of which another car follows a policy with a memory; in the last it is the world's."""
    route = line_route(100.0, 5.0, 3.5)
    other = EpisodeAgent("o", "car", Controller.FOLLOW, Pose(100.0, 3.5, np.pi), 4.0, 8.0, route=route, policy="doubt")
    others = [other, other, other, replace(other, policy="")]
    return [episode(ego(speed=2.0 + 2.0 * k), other, key=str(k)) for k, other in enumerate(others)]


SEEN = [f"seen.{name}" for name in array_types(PerceivedAgents)]
COPIES = {
    "copy.deepcopy": copy.deepcopy,
    "copy.copy": copy.copy,
    "pickle": lambda environment: pickle.loads(pickle.dumps(environment)),
}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("duplicate", COPIES.values(), ids=COPIES)
def test_copies_step_alike_and_apart(duplicate: Callable[[World], World], device: str) -> None:
    """A copy of a world with noise, a belief and controls continues to the bit, and neither moves the other."""
    noise = Noise(accel=0.8, lapse=0.1, careless=0.1)
    world = World(bank(), GRAPHS, assign=[2, 0, 3, 1, 2], ego=Controller.AUTOPILOT, noise=noise, device=device)
    world.believe(world.truth(), np.array([True, False, False, True, False]))
    for _ in range(7):
        world.step()
    twin = duplicate(world)
    before = world.hashes()
    assert twin.hashes() == before
    assert [name for name in SEEN if not np.array_equal(twin.array(name), world.array(name), equal_nan=True)] == []
    for _ in range(30):
        twin.step()
    assert twin.hashes() != before
    assert world.hashes() == before
    for _ in range(30):
        world.step()
    assert world.hashes() == twin.hashes()
    world.reset([1], episodes=[3])
    twin.reset([1], episodes=[3])
    assert world.hashes() == twin.hashes()


@pytest.mark.parametrize("duplicate", COPIES.values(), ids=COPIES)
def test_a_copy_keeps_the_last_controls(duplicate: Callable[[World], World]) -> None:
    world = World(bank(), GRAPHS)
    world.step(np.tile(np.array([0.7, 0.0, 0.1], np.float32), (4, 1)))
    twin = duplicate(world)
    for each in (world, twin):
        for _ in range(5):
            each.step()
    assert world.hashes() == twin.hashes()
    assert world.array("speed")[1, 0] > 1.0


@pytest.mark.parametrize("duplicate", [COPIES["copy.deepcopy"], COPIES["pickle"]], ids=["copy.deepcopy", "pickle"])
def test_copies_of_environments_keep_the_state_of_drivers(duplicate: Callable[[VectorEnv], VectorEnv]) -> None:
    environment = VectorEnv(doubting_bank(), GRAPHS, 4, policies=make_doubter, render_mode="rgb_array")
    environment.reset(seed=2)
    actions = np.tile(np.array([0.6, 0.01], np.float32), (4, 1))
    for _ in range(15):
        environment.step(actions)
    twin = duplicate(environment)
    rows, ended = [], 0
    # One after the other: what they share would show.
    for env in (environment, twin):
        rows.append([env.step(actions) for _ in range(60)])
    for left, right in zip(*rows, strict=True):
        for first, second in zip(left[:4], right[:4], strict=True):
            np.testing.assert_array_equal(first, second)
        ended += int((left[2] | left[3]).sum())
    assert ended, "scenes restarted with episodes that the copy drew too"
    assert environment.world.hashes() == twin.world.hashes()
    assert twin.world.bank is environment.world.bank or duplicate is COPIES["pickle"]
    for left_image, right_image in zip(environment.render() or (), twin.render() or (), strict=True):
        np.testing.assert_array_equal(left_image, right_image)
    np.testing.assert_array_equal(environment.reset()[0], twin.reset()[0])


def named_bank() -> list[Episode]:
    names = ("turn/a", "turn/b", "straight/a", "turn/a")
    named = []
    for number, name in enumerate(names):
        made = episode(ego(speed=float(number)), key=str(number))
        named.append(replace(made, scenario=replace(made.scenario, name=name, group=name.split("/")[0])))
    return named


def test_reset_chooses_a_scenario() -> None:
    single, many = SingleEnv(named_bank(), GRAPHS), VectorEnv(named_bank(), GRAPHS, 3)
    assert single.reset(options={"scenario": "straight/a"})[1]["episode"] == 2
    assert single.reset(options={"episode": 1})[1]["episode"] == 1
    draws = {single.reset(seed=seed, options={"scenario": "turn/a"})[1]["episode"] for seed in range(20)}
    assert draws == {0, 3}, "two episodes of one scenario"
    draws = {single.reset(seed=seed, options={"scenario": "turn"})[1]["episode"] for seed in range(40)}
    assert draws == {0, 1, 3}, "a group"
    assert single.reset(seed=3)[1] == single.reset(seed=3, options={})[1]
    assert many.reset(options={"scenario": "turn/b"})[1]["episode"].tolist() == [1, 1, 1]
    names = ["straight/a", "turn/b", None]
    third = {int(many.reset(seed=seed, options={"scenario": names})[1]["episode"][2]) for seed in range(40)}
    assert third == {0, 1, 2, 3}
    assert many.reset(options={"scenario": names})[1]["episode"][:2].tolist() == [2, 1]


def test_unknown_options_of_reset_are_refused() -> None:
    single, many = SingleEnv(named_bank(), GRAPHS), VectorEnv(named_bank(), GRAPHS, 3)
    with pytest.raises(ConfigError, match=r"unknown option 'scenarios' of reset; known: scenario, episode$"):
        single.reset(options={"scenarios": ["turn/a"]})
    with pytest.raises(ConfigError, match=r"unknown option 'episode' of reset; known: scenario, episodes$"):
        many.reset(options={"episode": 1})
    with pytest.raises(ConfigError, match="one of the options scenario and episode"):
        single.reset(options={"scenario": "turn/a", "episode": 1})
    with pytest.raises(UnknownNameError, match="unknown scenario 'trun/a'; closest: turn/a"):
        single.reset(options={"scenario": "trun/a"})
    with pytest.raises(ConfigError, match="option 'scenario' of reset needs one for each of 3 scenes"):
        many.reset(options={"scenario": ["turn/a", "turn/b"]})
    with pytest.raises(ConfigError, match="one for each of 3 scenes"):
        many.reset(options={"episodes": 2})
    with pytest.raises(ConfigError, match="no such episode; the bank holds 4"):
        single.reset(options={"episode": 4})
