"""From a scenario to an episode: where the ego starts, where actors may not stand, and what the type decides."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from ssad.core.errors import ConfigError, RouteError
from ssad.core.types import (
    Actor,
    Body,
    Controller,
    EpisodeLimits,
    Pose,
    Route,
    Scenario,
    SignalPlan,
    SignalState,
    TrafficPlan,
)
from ssad.scenarios.dynamic import build_episode, load_scenarios, scenario_type
from ssad.scenarios.dynamic.episode import _pose_beside_route
from ssad.world.models import model
from ssad.world.roads import load_town

START = Pose(217.0, -5.25)
PLAIN = Scenario("Mine", "Custom", "ProvingGround", (START, Pose(317.0, -5.25)))


def with_car(ahead: float, left: float = 0.0) -> Scenario:
    """A car of the ego's size beside it, metres between the centres."""
    return replace(PLAIN, actors=(Actor("van", "car", Pose(START.x + ahead, START.y + left)),))


def test_nobody_stands_in_the_ego_at_the_start() -> None:
    town, body = load_town("ProvingGround"), model("car")
    ego = build_episode(PLAIN, town, seed=0).agents[0].pose
    nearest = ego.x - START.x + body.length
    for scenario in (with_car(nearest + 0.1), with_car(0.0, body.width + 0.1), with_car(0.0, -body.width - 0.1)):
        assert len(build_episode(scenario, town, seed=0).agents) == 2
    for scenario in (with_car(nearest - 0.1), with_car(0.0), with_car(0.0, body.width - 0.1)):
        with pytest.raises(RouteError, match="scenario Mine: van stands in the ego at the start; move one of them"):
            build_episode(scenario, town, seed=0)


def test_bodies_and_friction_of_a_scenario_are_those_of_its_episode() -> None:
    town, long_body = load_town("ProvingGround"), Body(length=9.0)
    wide = replace(PLAIN, ego_model="suv", ego_body=Body(max_brake=6.0), friction=0.4)
    episode = build_episode(replace(wide, actors=(replace(with_car(20.0).actors[0], body=long_body),)), town, seed=0)
    assert (episode.agents[0].model, episode.agents[0].body) == ("suv", Body(max_brake=6.0))
    assert (episode.agents[1].body, episode.friction) == (long_body, 0.4)
    assert build_episode(wide, town, seed=0).key != build_episode(replace(wide, friction=0.5), town, seed=0).key
    near = build_episode(PLAIN, town, seed=0).agents[0].pose.x - START.x + 0.5 * model("car").length + 3.0
    assert len(build_episode(with_car(near), town, seed=0).agents) == 2
    with pytest.raises(RouteError, match="van stands in the ego"):
        build_episode(replace(PLAIN, actors=(replace(with_car(near).actors[0], body=long_body),)), town, seed=0)


def test_the_one_that_stands_there_is_named() -> None:
    far, near = with_car(30.0).actors[0], replace(with_car(1.0).actors[0], name="kiosk")
    with pytest.raises(RouteError, match="kiosk stands in the ego"):
        build_episode(replace(PLAIN, actors=(far, near)), load_town("ProvingGround"), seed=0)


def test_in_the_nominal_case_only_the_ego_must_be_clear() -> None:
    two = tuple(Actor(name, "cone", Pose(START.x + 30.0, START.y)) for name in ("a", "b"))
    for spread in (0.0, 1.0):
        assert (
            len(build_episode(replace(PLAIN, actors=two), load_town("ProvingGround"), seed=0, spread=spread).agents)
            == 3
        )


@pytest.mark.parametrize(
    ("forward", "left", "turn", "pose"),
    [
        (0.0, 0.0, 0.0, (0.0, 0.0, 0.0)),
        (0.5, 0.0, 0.0, (1.0, 0.0, 0.0)),
        (3.0, 0.5, 0.0, (6.0 - 0.5 * math.sqrt(0.5), 0.5 * math.sqrt(0.5), math.pi / 4)),
        (3.0, 0.0, 0.25, (6.0, 0.0, math.pi / 4 + 0.25)),
        (0.0, 1.5, 0.0, (0.0, 1.5, 0.0)),
        (0.0, 0.0, -0.1, (0.0, 0.0, -0.1)),
        (4.0, 0.0, 0.0, (8.0, 0.0, math.pi / 2)),
        (9.0, 0.0, 0.0, (8.0, 0.0, math.pi / 2)),
    ],
)
def test_the_start_on_a_route(forward: float, left: float, turn: float, pose: tuple[float, ...]) -> None:
    """Points 2 units apart where the route says 1 m: places are found by the route's own spacing."""
    ones = np.ones(5, np.float32)
    xy = np.stack([[0, 2, 4, 6, 8], np.zeros(5)], axis=1).astype(np.float32)
    route = Route(xy, np.array([0, 0, 0, math.pi / 4, math.pi / 2], np.float32), np.zeros(5, np.int32), ones, ones)
    found = _pose_beside_route(route, forward, left, turn)
    assert (found.x, found.y, found.yaw) == pytest.approx(pose, abs=1e-6)
    half = _pose_beside_route(replace(route, spacing=2.0), 2.0 * forward, left, turn)
    assert (half.x, half.y, half.yaw) == pytest.approx((found.x, found.y, found.yaw), abs=1e-6)


def test_what_a_scenario_leaves_open_is_its_types() -> None:
    (scenario,) = load_scenarios("UnprotectedLeftTurn/00")
    town, kind = load_town(scenario.town), scenario_type("UnprotectedLeftTurn")
    episode = build_episode(scenario, town, seed=0)
    assert episode.scenario.signals == kind.signals == SignalPlan("green", "green")
    assert (episode.limits.max_distance, episode.limits.max_steps) == (150.0, 300)
    assert set(episode.signal_override.values()) == {SignalState.GREEN}
    own = replace(scenario, signals=SignalPlan("red", until=4.0), limits=EpisodeLimits(max_steps=7, max_distance=80.0))
    episode = build_episode(own, town, seed=0)
    assert (episode.limits, episode.override_until) == (EpisodeLimits(max_steps=7, max_distance=80.0), 4.0)
    assert set(episode.signal_override.values()) == {SignalState.RED}
    (scenario,) = load_scenarios("natural-unselected/Twinford_00/00")
    scenario, town = replace(scenario, traffic=None), load_town("Twinford")
    assert build_episode(scenario, town, seed=0).scenario.traffic == TrafficPlan()
    few = replace(scenario, traffic=TrafficPlan(minimum=1, maximum=1))
    episode = build_episode(few, town, seed=0)
    assert episode.scenario.traffic == few.traffic
    assert len(episode.agents) == 2


def test_a_draw_of_traffic_is_the_same_for_every_seed() -> None:
    (scenario,) = load_scenarios("natural-unselected/Crossgate_00/00")
    town = load_town("Crossgate")

    def vehicles(draw: int | None, seed: int) -> list[tuple[str, Pose, float]]:
        episode = build_episode(replace(scenario, traffic=TrafficPlan(draw=draw)), town, seed=seed)
        return [(a.model, a.pose, a.target_speed) for a in episode.agents[1:]]

    assert vehicles(4, 0) == vehicles(4, 1) == vehicles(None, 4)
    assert vehicles(4, 0) != vehicles(5, 0)


def test_the_ego_is_driven_from_outside() -> None:
    episode = build_episode(PLAIN, load_town("ProvingGround"), seed=3)
    (ego,) = episode.agents
    assert (ego.name, ego.model, ego.controller, ego.speed) == ("ego", "car", Controller.EXTERNAL, 0.0)
    assert (episode.town, episode.seed, episode.key[:5]) == ("ProvingGround", 3, "Mine@")
    assert len(episode.key) == len("Mine@") + 12


def test_what_is_wrong_names_the_scenario() -> None:
    town = load_town("ProvingGround")
    with pytest.raises(ConfigError, match="scenario Mine: seed: must not be negative"):
        build_episode(replace(PLAIN, seed=-1), town, seed=0)
    with pytest.raises(RouteError, match="scenario Mine: "):
        build_episode(replace(PLAIN, route=(START, Pose(90000.0, 0.0))), town, seed=0)
