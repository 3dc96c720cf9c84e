"""Environments by name, as a Gymnasium user makes them."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from ssad.core.errors import UnknownNameError

ID = "ssad.envs:SSAD/Driving-v0"


def test_make_passes_gymnasiums_checker() -> None:
    env = gymnasium.make(ID, scenarios="RedlightRunning")
    check_env(env.unwrapped, skip_render_check=True)


def test_make_vec_runs_the_scenarios_in_one_batch() -> None:
    envs = gymnasium.make_vec(ID, num_envs=16, scenarios=["LaneChanging", "RightTurn/00"], observation="frea")
    assert isinstance(envs, gymnasium.vector.VectorEnv)
    observation, info = envs.reset(seed=1)
    assert observation.shape == (16, 24)
    assert set(info["episode"]) <= set(range(5))
    ends = set()
    for _ in range(150):
        # full speed ahead: everybody meets what its scenario holds, or leaves the road
        actions = np.tile(np.array([1.0, 0.0], np.float32), (16, 1))
        observation, reward, terminated, truncated, info = envs.step(actions)
        assert np.isfinite(observation).all()
        assert np.isfinite(reward).all()
        ends |= {e for e in info.get("end", []) if e}
        assert not (terminated & truncated).any()
    assert "collision" in ends


def test_unknown_scenarios_are_named() -> None:
    with pytest.raises(UnknownNameError, match="RightTurn"):
        gymnasium.make(ID, scenarios="RightTurm")
