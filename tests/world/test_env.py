"""The Gymnasium faces of the world."""

from __future__ import annotations

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from ssad.core.errors import ConfigError
from ssad.core.types import EpisodeLimits
from ssad.world.env import SingleEnv, VectorEnv
from tests.world.test_world import bank
from tests.world.worlds import GRAPHS, ego, episode


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
