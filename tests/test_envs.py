"""Environments by name, as a Gymnasium user makes them."""

from __future__ import annotations

import copy
import pickle
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from ssad.core.errors import ConfigError, UnknownNameError
from ssad.core.types import Actor, Phase, PhaseTrigger, Pose
from ssad.envs import episodes_of, make_sb3
from ssad.scenarios.dynamic import load_scenarios
from ssad.scenarios.dynamic.yamlio import save_scenarios

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


@pytest.mark.parametrize("observation", ["safebench", "traffic"])
def test_a_tree_search_copies_the_environment(observation: str) -> None:
    """Copies of what `gymnasium.make` returns step alike to the bit, also through its wrappers."""
    env = gymnasium.make(ID, scenarios="precrash", observation=observation)
    env.reset(seed=1, options={"scenario": "RightTurn/01"})
    action = np.array([0.4, 0.02], np.float32)
    for _ in range(12):
        env.step(action)
    copies = [copy.deepcopy(env), pickle.loads(pickle.dumps(env))]
    for _ in range(25):
        expected = env.step(action)
        for duplicate in copies:
            found = duplicate.step(action)
            np.testing.assert_array_equal(found[0], expected[0])
            assert found[1:] == expected[1:]
    assert copies[0].unwrapped.world.hashes() == env.unwrapped.world.hashes()
    draws = [other.reset()[1]["episode"] for other in (env, *copies)]
    assert draws == [draws[0]] * 3


def test_a_copy_drives_adversaries_and_policies_on(tmp_path: Path) -> None:
    """Drivers of other agents go with the copy: selected ones, and those that scenarios name."""
    from ssad.scenarios.dynamic.policy.adv_ppo import Adversary
    from ssad.world.selection import FreaSelection

    (scenario,) = load_scenarios("LaneChanging/00")
    path = ((257.0, -5.25), (317.0, -5.25))
    moving = (Phase(6.0, PhaseTrigger("time", 0.0)),)
    actors = (
        Actor("policy", "car", Pose(257.0, -5.25), path=path, policy="ppo", target_speed=6.0),
        Actor("adversary", "car", Pose(229.0, -1.75), path=((229.0, -1.75), (317.0, -1.75)), phases=moving),
    )
    custom = replace(scenario, name="own", type="Custom", trigger=None, parameters={}, actors=actors)
    save_scenarios(tmp_path / "own.yaml", [replace(custom, route=(Pose(217.0, -5.25), Pose(317.0, -5.25)))])
    references = ["RightTurn/00", str(tmp_path / "own.yaml")]
    envs = gymnasium.make_vec(ID, num_envs=3, scenarios=references, drivers={FreaSelection(count=1): Adversary()})
    assert isinstance(envs, gymnasium.vector.VectorEnv)
    envs.reset(seed=3, options={"scenario": ["own", "RightTurn/00", "own"]})
    actions = np.tile(np.array([0.3, 0.0], np.float32), (3, 1))
    for _ in range(10):
        envs.step(actions)
    world = envs.unwrapped.world
    assert world.state().policy[0].tolist() == [-1, 1, 0], "the policy of the scenario, and the adversary, drive"
    duplicate = copy.deepcopy(envs)
    for _ in range(40):
        envs.step(actions)
    for _ in range(40):
        duplicate.step(actions)
    assert world.hashes() == duplicate.unwrapped.world.hashes()


def test_unknown_scenarios_are_named() -> None:
    with pytest.raises(UnknownNameError, match="RightTurn"):
        gymnasium.make(ID, scenarios="RightTurm")


def test_episodes_of_a_set_are_built_once() -> None:
    first, graphs = episodes_of("RightTurn")
    again, same = episodes_of(["RightTurn/01", "RightTurn/00"])
    assert again == [first[1], first[0]]
    assert again[0] is first[1]
    assert graphs["ProvingGround"] is same["ProvingGround"]
    assert episodes_of("RightTurn", seed=1)[0][0] is not first[0]


def test_a_picture_from_above_follows_the_ego() -> None:
    from ssad.core.top_view import CONTACT, EGO

    env = gymnasium.make(ID, scenarios="StraightObstacle/00", render_mode="rgb_array", action="controls")
    env.reset(seed=0)
    first = env.render()
    assert isinstance(first, np.ndarray)
    assert (first.shape, first.dtype) == ((540, 960, 3), np.uint8)
    assert (first[270, 480] == EGO).all(), "the ego is in the middle"
    ended = False
    while not ended:
        *_, terminated, truncated, info = env.step(np.array([0.6, 0.0, 0.0], np.float32))
        ended = terminated or truncated
    last = env.render()
    assert isinstance(last, np.ndarray)
    assert (last != first).any(-1).mean() > 0.01
    assert info["end"] == "collision"
    assert (last == CONTACT).all(-1).sum() > 50, "a collision is marked"
    envs = gymnasium.make_vec(ID, num_envs=3, scenarios=["RightTurn/00", "LaneChanging"], render_mode="rgb_array")
    envs.reset(seed=0)
    pictures = envs.render()
    assert pictures is not None
    assert len(pictures) == 3
    assert gymnasium.make(ID, scenarios="RightTurn/00").unwrapped.render() is None
    with pytest.raises(ConfigError, match="unknown render_mode 'ascii'; known: rgb_array, human"):
        gymnasium.make(ID, scenarios="RightTurn/00", disable_env_checker=True).unwrapped.__class__(
            *episodes_of("RightTurn/00"), render_mode="ascii"
        )


def test_a_window_names_the_extra_that_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pygame", None)
    with pytest.raises(ConfigError, match=r"needs pygame; .*--extra window"):
        gymnasium.make(ID, scenarios="RightTurn/00", render_mode="human")


@pytest.mark.slow
def test_a_window_shows_each_step(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    pygame = pytest.importorskip("pygame", reason="needs the extra window")
    env = gymnasium.make(ID, scenarios="RightTurn/00", render_mode="human")
    env.reset(seed=0)
    env.step(np.zeros(2, np.float32))
    assert pygame.display.get_surface().get_size() == (960, 540)
    env.close()
    assert not pygame.display.get_init()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_gymnasium_records_a_video(tmp_path: Path) -> None:
    pytest.importorskip("moviepy", reason="gymnasium writes videos with moviepy")
    from gymnasium.wrappers import RecordVideo

    made = gymnasium.make(ID, scenarios="RightTurn/00", render_mode="rgb_array", action="controls")
    env = RecordVideo(made, str(tmp_path), name_prefix="drive")
    env.reset(seed=0)
    for _ in range(10):
        env.step(np.array([0.5, 0.0, 0.0], np.float32))
    env.close()
    reader = cv2.VideoCapture(str(tmp_path / "drive-episode-0.mp4"))
    found, picture = reader.read()
    assert found
    assert picture.shape == (540, 960, 3)
    assert reader.get(cv2.CAP_PROP_FPS) == 10


def test_stable_baselines3_trains_on_the_scenes_of_one_batch() -> None:
    sb3 = pytest.importorskip("stable_baselines3", reason="needs the extra train")
    from stable_baselines3.common.vec_env import VecEnv

    env = make_sb3(num_envs=8, scenarios=["LaneChanging", "RightTurn"], observation="frea")
    assert isinstance(env, VecEnv)
    env.seed(5)
    plain = gymnasium.make_vec(ID, num_envs=8, scenarios=["LaneChanging", "RightTurn"], observation="frea")
    np.testing.assert_array_equal(env.reset(), plain.reset(seed=5)[0])
    env.set_options({"scenario": "RightTurn/01"})
    chosen = plain.reset(options={"scenario": "RightTurn/01"})
    np.testing.assert_array_equal(env.reset(), chosen[0])
    assert len(set(chosen[1]["episode"].tolist())) == 1
    env.seed(5)
    np.testing.assert_array_equal(env.reset(), plain.reset(seed=5)[0])
    total, length, ended = np.zeros(8), np.zeros(8, int), np.zeros(8, int)
    actions = np.tile(np.array([1.0, 0.0], np.float32), (8, 1))
    for _ in range(220):
        observation, reward, done, infos = env.step(actions)
        expected = plain.step(actions)
        np.testing.assert_array_equal(observation, expected[0])
        np.testing.assert_allclose(reward, expected[1], rtol=1e-6)
        np.testing.assert_array_equal(done, expected[2] | expected[3])
        total, length = total + expected[1], length + 1
        for b in np.flatnonzero(done):
            ended[b] += 1
            np.testing.assert_array_equal(infos[b]["terminal_observation"], expected[4]["final_obs"][b])
            assert infos[b]["TimeLimit.truncated"] == expected[3][b]
            assert infos[b]["episode"]["r"] == pytest.approx(total[b])
            assert infos[b]["episode"]["l"] == length[b]
            assert infos[b]["end"] == expected[4]["end"][b]
            total[b], length[b] = 0.0, 0
        assert all(infos[b] == {} for b in np.flatnonzero(~done))
    assert ended.max() >= 2
    model = sb3.PPO("MlpPolicy", env, n_steps=16, batch_size=64, n_epochs=1, seed=0)
    model.learn(256)
    assert model.num_timesteps == 256
