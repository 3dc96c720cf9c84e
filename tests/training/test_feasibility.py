"""The feasible region: what it is a function of, what it learns offline, and its use as a critic of PPO."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from ssad.core.checkpoints import load_card
from ssad.core.errors import ConfigError, FormatError
from ssad.core.types import Controller, EpisodeAgent, Pose
from ssad.drivers import make_system
from ssad.training.adversary import AdversaryPlan, run_adversary_training
from ssad.training.driver import draw_episodes, find_scenarios
from ssad.training.feasibility import (
    SHIPPED,
    FeasibleRegion,
    RegionPlan,
    RegionRecipe,
    Transitions,
    body_distance,
    record_transitions,
    region_states,
    run_region_training,
    train_region,
)
from ssad.world.world import World
from tests.world.worlds import GRAPHS, ego, episode

ONE = ("training/natural/Larkhill_00/00",)


def car(x: float, y: float = 0.0, yaw: float = 0.0, speed: float = 0.0) -> EpisodeAgent:
    return EpisodeAgent("car", "car", Controller.NONE, Pose(x, y, yaw), speed=speed)


def test_a_state_holds_the_ego_the_adversary_and_the_nearest_other() -> None:
    world = World([episode(ego(speed=5.0), car(30.0), car(18.0, 3.5, np.pi), car(60.0))], GRAPHS)
    nearest = region_states(world.state(), np.array([0])).reshape(3, 6)
    np.testing.assert_allclose(nearest[0], [0, 0, 4.9, 2.06, 0, 5.0], atol=1e-5)
    np.testing.assert_allclose(nearest[1, :4], [8.0, 3.5, 4.9, 2.06], atol=1e-4)
    np.testing.assert_allclose(nearest[2, :2], [20.0, 0.0], atol=1e-4)
    chosen = region_states(world.state(), np.array([0]), np.array([1])).reshape(3, 6)
    np.testing.assert_allclose(chosen[[1, 2], 0], [20.0, 8.0], atol=1e-4)
    far = region_states(world.state(), np.array([0]), np.array([3])).reshape(3, 6)
    assert not far[1].any()  # more than 25 m away
    np.testing.assert_allclose(body_distance(nearest.reshape(1, 18)), [np.hypot(8.0 - 4.9, 3.5 - 2.06)], atol=1e-4)
    assert body_distance(np.zeros((1, 18), np.float32)).tolist() == [np.inf]


def drives(count: int) -> Transitions:
    """A car that stands 15 m before an ego at 10 m/s: by braking it stops in time, by going on it touches it."""
    random = np.random.default_rng(0)
    distance = random.uniform(0.0, 20.0, count).astype(np.float32)
    speed = random.choice(np.array([0.0, 5.0, 10.0], np.float32), count)
    brakes = random.random(count) < 0.5

    def rows(gap: np.ndarray, v: np.ndarray) -> np.ndarray:
        state = np.zeros((count, 3, 6), np.float32)
        state[:, :2, 2:4] = 4.9, 2.06
        state[:, 0, 5], state[:, 1, 0] = v, gap + 4.9
        return state.reshape(count, 18)

    next_speed = np.where(brakes, np.maximum(speed - 5.0, 0.0), speed)
    next_distance = np.maximum(distance - 0.5 * speed, 0.0)
    is_last = distance <= 0.1
    action = np.stack([~brakes, brakes, np.zeros(count)], 1).astype(np.float32)
    return Transitions(rows(distance, speed), action, rows(next_distance, next_speed), is_last)


@pytest.fixture(scope="module")
def region() -> FeasibleRegion:
    recipe = RegionRecipe(steps=800, batch=128, hidden=(32,), lr=1e-2, gamma=0.9, unsafe=10.0, tau=0.1)
    return train_region(drives(4000), recipe)


@pytest.mark.parametrize(
    ("gap", "speed", "is_feasible"),
    [(15.0, 10.0, True), (18.0, 5.0, True), (0.05, 10.0, False), (1.0, 10.0, False), (6.0, 0.0, True)],
)
def test_a_state_is_feasible_where_some_driving_in_the_data_stays_clear(
    region: FeasibleRegion, gap: float, speed: float, is_feasible: bool
) -> None:
    """Steps of 0.5 s in which the ego keeps its speed or loses 5 m/s: from 10 m/s it needs 7.5 m."""
    state = np.zeros((1, 3, 6), np.float32)
    state[0, :2, 2:4] = 4.9, 2.06
    state[0, 0, 5], state[0, 1, 0] = speed, gap + 4.9
    assert bool(region.value(state.reshape(1, 18))[0] <= 0.0) == is_feasible


def test_drives_are_recorded_up_to_their_contacts() -> None:
    scenarios, graphs = find_scenarios(ONE)
    episodes = draw_episodes(scenarios, graphs, draws=2, seed=0)
    options = {"count": 300, "scenes": 8, "evasions": 0.1}
    data = record_transitions(episodes, graphs, make_system("blind"), None, seed=1, **options)
    assert len(data) >= 300
    assert (data.state[:, 8] > 0.0).all()  # somebody is near
    assert (body_distance(data.state[data.is_last]) <= 0.1).all()
    held = (data.action[:, 1] == 1.0) | (data.action[:, 0] == 1.0)
    assert 0.05 < held.mean() < 1.0  # evasions, which brake or accelerate fully
    again = record_transitions(episodes, graphs, make_system("blind"), None, seed=1, **options)
    np.testing.assert_array_equal(again.next_state, data.next_state)


def test_a_region_is_trained_and_is_the_critic_of_an_adversary(tmp_path: Path) -> None:
    pytest.importorskip("stable_baselines3", reason="needs the extra train")
    changes = (("transitions", 200), ("steps", 20), ("scenes", 8), ("draws", 1), ("hidden", (8,)))
    plan = RegionPlan(tmp_path, ONE, ("blind",), ("none",), changes)
    (line,) = run_region_training(plan, report=lambda text: None)
    path = tmp_path / "feasible-region.safetensors"
    assert str(path) in line
    card, _ = load_card(path)
    assert card.config["hidden"] == [8]
    assert card.command.startswith(f"ssad train feasible-region --scenarios {ONE[0]} --egos blind --adversaries none")
    small = (("steps", 256), ("scenes", 8), ("rollout", 16), ("batch", 32), ("validate", 1000), ("hidden", (16,)))
    attack = AdversaryPlan("frea", tmp_path / "frea", "blind", ONE, ONE, changes=(*small, ("draws", 1)), region=path)
    list(run_adversary_training(attack, report=lambda text: None))
    trained, _ = load_card(tmp_path / "frea" / "frea.safetensors")
    assert trained.config["region"] == card.hash[:12]
    assert trained.config["reward"] == "lawful"
    assert {"00_proven", "00_CR"} <= set(trained.metrics)


def test_wrong_regions_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="adv-ddpg learns by ddpg: leave out --region"):
        list(run_adversary_training(AdversaryPlan("adv-ddpg", tmp_path, region=SHIPPED)))
    with pytest.raises(ConfigError, match="there is no setting 'fun'"):
        list(run_region_training(RegionPlan(tmp_path, changes=(("fun", 1),))))
    policy = Path("src/ssad/scenarios/dynamic/policy/weights/adv-ppo-paper.safetensors").resolve()
    with pytest.raises(FormatError, match="these are not the weights of"):
        FeasibleRegion.load(policy)


def test_the_shipped_region_tells_touching_from_apart() -> None:
    region, (card, _) = FeasibleRegion.load(), load_card(SHIPPED)
    assert card.metrics["touching"] > card.metrics["apart"] + 0.2
    state = np.zeros((2, 3, 6), np.float32)
    state[:, :2, 2:4] = 4.9, 2.06
    state[:, 0, 5], state[0, 1, 0], state[1, 1, 0] = 6.0, 5.2, 24.0
    near, far = region.value(state.reshape(2, 18))
    assert near > far


def test_advantages_are_those_of_the_reward_where_the_ego_has_a_way_out() -> None:
    pytest.importorskip("stable_baselines3", reason="needs the extra train")
    from ssad.training.feasible_ppo import compose_advantages

    reward = np.array([[1.0, -1.0, 1.0, -1.0]], np.float32)
    feasibility = np.array([[4.0, 0.0, 0.0, -4.0]], np.float32)
    before = np.array([[-1.0, 0.5, -1.0, -1.0]], np.float32)
    after = np.array([[-1.0, -1.0, 0.5, -1.0]], np.float32)
    driven = np.array([[True, True, True, False]])
    advantage = compose_advantages(reward, feasibility, before, after, driven)[0]
    mean, spread = reward[0, :3].mean(), reward[0, :3].std()
    assert advantage[0] == pytest.approx((1.0 - mean) / spread, rel=1e-4)
    mean, spread = feasibility[0, :3].mean(), feasibility[0, :3].std()
    np.testing.assert_allclose(advantage[1:3], (feasibility[0, 1:3] - mean) / spread, rtol=1e-4)
    assert advantage[3] == 0.0


def test_the_buffer_adds_up_what_steps_give_back() -> None:
    pytest.importorskip("stable_baselines3", reason="needs the extra train")
    from types import SimpleNamespace

    from gymnasium import spaces

    from ssad.training.feasible_ppo import FeasibleBuffer

    box = spaces.Box(-1.0, 1.0, (1,), np.float32)
    source = SimpleNamespace(region_values=np.zeros((2, 1), np.float32), is_driven=np.ones(1, bool))
    buffer = FeasibleBuffer(3, box, box, "cpu", gae_lambda=0.5, gamma=0.8, n_envs=1, environment=source)
    values, starts = [(1.0, 0.5), (0.5, 2.0), (3.0, 1.0)], [1.0, 0.0, 1.0]
    for (before, after), start in zip(values, starts, strict=True):
        source.region_values = np.array([[before], [after]], np.float32)
        one = np.zeros((1, 1), np.float32)
        buffer.add(one, one, np.zeros(1), np.array([start]), torch.zeros(1), torch.zeros(1))
    buffer.compute_returns_and_advantage(torch.zeros(1), np.array([True]))
    expected = np.array([0.5 + 0.4 * -1.5, -1.5, 2.0])  # the third step is of another episode
    np.testing.assert_allclose(buffer.advantages[:, 0], (expected - expected.mean()) / expected.std(), rtol=1e-4)
    assert not buffer.returns.any()
