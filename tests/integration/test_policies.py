"""Actors that a driver of a name acts for, as their scenario says."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest

from ssad.core.errors import ConfigError, RouteError, UnknownNameError
from ssad.core.traces import first_difference
from ssad.core.types import Actor, Controller, Episode, EpisodeLimits, Pose, Scenario
from ssad.drivers import make_system
from ssad.drivers.careful.grade import grade_collision
from ssad.scenarios.dynamic.episode import build_episode
from ssad.scenarios.dynamic.schema import check
from ssad.scenarios.dynamic.yamlio import read_scenarios, save_scenarios
from ssad.world.env import VectorEnv
from ssad.world.roads.library import load_town
from ssad.world.rollout import rollout
from ssad.world.world import World

TOWN = load_town("ProvingGround")
GRAPHS = {TOWN.name: TOWN}


def scenario(name: str = "one", **changes: object) -> Scenario:
    """A car 25 m ahead of the ego, with a driver of its own and a way."""
    path = ((242.0, -5.25), (317.0, -5.25))
    car = Actor("car", "car", Pose(242.0, -5.25), path=path, policy="autopilot", target_speed=6.0)
    parked = Actor("parked", "van", Pose(290.0, -12.0))
    route = (Pose(217.0, -5.25), Pose(317.0, -5.25))
    made = Scenario(
        f"Policies/{name}",
        "Custom",
        TOWN.name,
        route,
        actors=(parked, replace(car, **changes)),
        limits=EpisodeLimits(max_steps=60),
    )
    check(made)
    return made


def built(name: str = "one", **changes: object) -> Episode:
    return build_episode(scenario(name, **changes), TOWN, seed=0)


class Straight:
    """Full throttle; counts whom it drives."""

    name, controller = "straight", Controller.EXTERNAL

    def __init__(self) -> None:
        self.rows: list[list[tuple[int, int]]] = []
        self.resets = 0

    def reset(self, episodes) -> None:
        self.resets += 1

    def act(self, view):
        self.rows.append(list(zip(view.scene.tolist(), view.agent.tolist(), strict=True)))
        return np.tile(np.array([1.0, 0.0, 0.0], np.float32), (len(view.scene), 1))


def drive(*episodes: Episode, drivers=None, policies=make_system):
    return rollout(World(episodes, GRAPHS), drivers or make_system("blind"), policies=policies)


def test_the_driver_of_the_name_acts_for_the_actor() -> None:
    (told,) = drive(built())
    plain = replace(built(), agents=tuple(replace(agent, policy="") for agent in built().agents))
    (taken,) = drive(plain, drivers={0: make_system("blind"), 2: make_system("autopilot")}, policies=None)
    assert first_difference(told, taken) is None
    assert told.speed[:, 2].max() == pytest.approx(6.0, abs=0.5)
    assert (told.speed[:, 1] == 0).all()
    assert told.x[-1, 2] > 260.0


def test_each_scene_follows_its_own_policy_whatever_the_batch() -> None:
    made: dict[str, Straight] = {}

    def policies(name: str):
        made[name] = Straight()
        return made[name] if name == "mine:Driver" else make_system(name)

    one, two = built("one", policy="mine:Driver"), built("two")
    together = drive(one, two, policies=policies)
    assert made["mine:Driver"].resets == 1
    assert {row for rows in made["mine:Driver"].rows for row in rows} == {(0, 2)}
    for episode, trace in zip((one, two), together, strict=True):
        assert first_difference(drive(episode, policies=policies)[0], trace) is None
    assert together[0].speed[:, 2].max() > 1.5 * together[1].speed[:, 2].max()


def test_who_is_named_in_the_call_goes_before_the_policy() -> None:
    mine = Straight()
    (trace,) = drive(built(), drivers={0: make_system("blind"), 2: mine})
    assert len(mine.rows) == len(trace.x) - 1
    assert trace.speed[:, 2].max() > 8.0
    late = Straight()

    def after_two_seconds(state):
        mask = np.zeros(state.active.shape, bool)
        mask[:, 2] = (state.time > 1.95) & (state.time < 3.95)
        return mask

    (trace,) = drive(built(), drivers={0: make_system("blind"), after_two_seconds: late})
    assert len(late.rows) == 20
    assert trace.speed[:20, 2].max() < 6.6 < trace.speed[40, 2]
    assert trace.speed[-1, 2] < trace.speed[40, 2] - 1.0, "the Autopilot has it back"


def test_without_policies_it_is_said_what_to_give() -> None:
    with pytest.raises(ConfigError, match="follows the policy 'autopilot': say who makes drivers, policies="):
        drive(built(), policies=None)
    with pytest.raises(UnknownNameError, match="autopilto"):
        drive(built(policy="autopilto"))
    env = VectorEnv([built()], GRAPHS, 1, policies=make_system)
    env.reset(seed=0)
    for _ in range(10):
        env.step(env.action_space.sample() * 0)
    assert env.world.state().speed[0, 2] > 0.5


def test_environments_by_name_know_the_drivers(tmp_path: Path) -> None:
    save_scenarios(tmp_path / "one.yaml", [scenario()])
    env = gymnasium.make("ssad.envs:SSAD/Driving-v0", scenarios=str(tmp_path / "one.yaml"), disable_env_checker=True)
    env.reset(seed=0)
    for _ in range(10):
        env.step(0 * env.action_space.sample())
    assert env.unwrapped.world.state().speed[0, 2] > 0.5


def test_a_collision_with_them_is_graded_with_them_at_the_wheel() -> None:
    class Stay(Straight):
        def act(self, view):
            return 0.0 * super().act(view)

    ahead = replace(built(path=()), limits=EpisodeLimits(max_steps=80))
    (trace,) = rollout(World([ahead], GRAPHS), make_system("blind"), policies=lambda name: Stay())
    assert trace.end == "collision"
    found = grade_collision(ahead, TOWN, trace, policies=lambda name: Stay())
    assert found.exact
    assert found.avoids["cc"]
    # who drives on where it stood is not what was met: the replay says so
    assert not grade_collision(ahead, TOWN, trace, policies=lambda name: Straight()).exact


def test_a_scenario_with_a_policy_round_trips(tmp_path: Path) -> None:
    save_scenarios(tmp_path / "one.yaml", [scenario()])
    assert read_scenarios(tmp_path / "one.yaml") == (scenario(),)
    assert "policy: autopilot" in (tmp_path / "one.yaml").read_text()


def test_walkers_go_their_own_line_and_vehicles_along_lanes() -> None:
    line = ((250.0, -12.0), (250.0, -8.0))
    agent = built(model="walker", target_speed=1.5, pose=Pose(*line[0], 1.57), path=line).agents[2]
    assert agent.route is not None
    assert np.array_equal(agent.route.lane, np.full(5, -1))
    assert built().agents[2].route.lane.min() >= 0
    with pytest.raises(RouteError, match="actor car: town 'ProvingGround': key point 1"):
        built(path=((242.0, -5.25), (242.0, 90.0)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"trajectory": ((0.0, 242.0, -5.25, 0.0), (1.0, 243.0, -5.25, 0.0)), "path": ()}, "neither phases nor"),
        ({"target_speed": 0.0}, "outside 0 to 50 m/s"),
        ({"target_speed": 60.0}, "outside 0 to 50 m/s"),
        ({"policy": ""}, "only an actor with a policy has one"),
        ({"model": "cone"}, "nobody drives a cone"),
    ],
)
def test_what_is_no_policy(changes: dict, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        scenario(**changes)
