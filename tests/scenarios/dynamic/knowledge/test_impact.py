"""Actors that are placed by their impact: the ego hits them where the scenario says if nobody acts."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import ConfigError, RouteError
from ssad.core.safeio import parse_yaml_document
from ssad.core.types import EpisodeTrace, Impact, Pose, Scenario
from ssad.drivers.builtin import Blind
from ssad.scenarios.dynamic import build_episode, load_scenarios, scenario_data, scenario_from, with_parameters
from ssad.scenarios.dynamic.knowledge._impact import lateral_offset, route_pose
from ssad.world.roads import load_town, route_along
from ssad.world.rollout import rollout
from ssad.world.world import World

SPEED, DISTANCE = 10.0, 40.0
QUARTER = math.pi / 2
IMPACTS: list[tuple[dict[str, Any], dict[str, Any], float]] = [
    # actor, impact, expected share of the ego's width at the centre of the actor, from the left
    ({}, {"overlap": 0.5}, 0.0),
    ({}, {"overlap": 0.5, "side": "right"}, 1.0),
    ({"speed": 5.0}, {"overlap": 0.25, "side": "right"}, 1.25),
    ({"body": {"width": 1.03}}, {"overlap": 0.25}, 0.0),
    ({}, {"overlap": 1.0}, 0.5),
    ({"speed": 8.0}, {"location": 0.75, "heading": math.pi}, 0.75),
    ({"model": "walker", "speed": 1.4}, {"location": 0.75, "heading": QUARTER}, 0.75),
    ({"model": "walker", "speed": 1.4}, {"location": 0.25, "heading": -QUARTER}, 0.25),
    ({"model": "bicycle", "speed": 4.0}, {"heading": -QUARTER}, 0.5),
]


class Cruise(Blind):
    target_speed = SPEED


def scenario(actor: dict[str, Any], impact: dict[str, Any], **changes: Any) -> Scenario:
    data = {
        "name": "a",
        "type": "Custom",
        "town": "ProvingGround",
        "route": [{"x": 217.0, "y": -5.25}, {"x": 317.0, "y": -5.25}],
        "parameters": {"ego_speed": SPEED},
        "target_speed": SPEED,
        "limits": {"max_steps": 60},
        "actors": [{"name": "target", "model": "car", **actor, "impact": {"distance": DISTANCE, **impact}}],
    }
    return scenario_from({**data, **changes})


@pytest.fixture(scope="module")
def traces() -> list[EpisodeTrace]:
    town = load_town("ProvingGround")
    episodes = [build_episode(scenario(actor, impact), town, seed=0) for actor, impact, _ in IMPACTS]
    return rollout(World(episodes, {town.name: town}), Cruise())


@pytest.mark.parametrize("index", range(len(IMPACTS)))
def test_the_ego_hits_the_actor_there(traces: list[EpisodeTrace], index: int) -> None:
    trace, (*_, share) = traces[index], IMPACTS[index]
    assert trace.end == "collision"
    step = round(DISTANCE / SPEED / trace.dt)
    assert step <= len(trace.x) - 1 <= step + 1  # a touch at the end of a step may show in the next one
    x, y, yaw, length, width = (
        column[step].astype(np.float64) if column.ndim == 2 else column.astype(np.float64)
        for column in (trace.x, trace.y, trace.yaw, trace.length, trace.width)
    )
    turn = yaw[1] - yaw[0]
    forward = math.cos(yaw[0]) * (x[1] - x[0]) + math.sin(yaw[0]) * (y[1] - y[0])
    left = math.cos(yaw[0]) * (y[1] - y[0]) - math.sin(yaw[0]) * (x[1] - x[0])
    half_length = 0.5 * (abs(math.cos(turn)) * length[1] + abs(math.sin(turn)) * width[1])
    assert forward == pytest.approx(0.5 * length[0] + half_length, abs=0.02)
    assert 0.5 - left / width[0] == pytest.approx(share, abs=0.01)


def test_overlap_is_the_covered_share_of_the_ego() -> None:
    ego, half = 1.8, 0.85
    for overlap in (0.0, 0.25, 0.5, 0.75):
        offset = lateral_offset(Impact(DISTANCE, overlap=overlap), ego, half)
        covered = min(0.5 * ego, offset + half) - max(-0.5 * ego, offset - half)
        assert covered / ego == pytest.approx(overlap)
    assert lateral_offset(Impact(DISTANCE, overlap=1.0), ego, half) == 0.0
    assert lateral_offset(Impact(DISTANCE, overlap=0.9), ego, 0.25) == 0.0  # a bicycle


def test_an_actor_follows_a_bending_route() -> None:
    turn = load_scenarios("UnprotectedLeftTurn/00")[0]
    town = load_town(turn.town)
    route = route_along(town, turn.route)
    distance = 0.6 * route.length
    base = scenario({"speed": 4.0}, {"distance": distance, "overlap": 0.5}, town=turn.town)
    bending = replace(base, route=turn.route)
    actor = build_episode(bending, town, seed=0).scenario.actors[0]
    way = 4.0 * distance / SPEED
    expected = route_pose(route, distance + 4.9 - way)
    start = Pose(expected.x - 1.03 * math.sin(expected.yaw), expected.y + 1.03 * math.cos(expected.yaw), expected.yaw)
    assert (actor.pose.x, actor.pose.y, actor.pose.yaw) == pytest.approx((start.x, start.y, start.yaw), abs=1e-6)
    beside = [np.hypot(*(route.xy.astype(np.float64) - point).T).min() for point in actor.path[: int(way / 2)]]
    assert max(abs(distance - 1.03) for distance in beside) < 0.15
    far = replace(bending, actors=(replace(base.actors[0], speed=40.0),))
    with pytest.raises(
        RouteError, match=r"scenario a: actor target: its impact: it would start -\d+ m along a route of"
    ):
        build_episode(far, town, seed=0)


def test_sweeps_and_files_keep_the_impact() -> None:
    text = """\
name: a
type: Custom
town: ProvingGround
route: [{x: 217.0, y: -5.25}, {x: 317.0, y: -5.25}]
target_speed: 10.0
parameters: {share: {value: 0.5, range: [0, 1]}, ego_speed: 10}
actors:
- {name: t, model: car, impact: {distance: 30, overlap: share}}
"""
    town = load_town("ProvingGround")
    document = parse_yaml_document(text, "a.yaml")
    nominal = scenario_from(document.data, document)
    built = build_episode(nominal, town, seed=0).scenario
    assert built.actors[0].pose.y == pytest.approx(-5.25 + 1.03)
    assert "pose" not in scenario_data(built)["actors"][0]
    swept = build_episode(with_parameters(built, {"share": 0.25}), town, seed=0)
    assert swept.agents[1].pose.y == swept.scenario.actors[0].pose.y == pytest.approx(-5.25 + 1.545)
    assert build_episode(scenario_from(scenario_data(swept.scenario)), town, seed=0) == swept


@pytest.mark.parametrize(
    ("actor", "impact", "message"),
    [
        ({"pose": {"x": 0, "y": 0}}, {}, r"actors\[0\].pose: an actor with an impact has no pose"),
        ({"path": [[0, 0], [9, 0]]}, {}, r"actors\[0\].path: an actor with an impact has no path"),
        ({"trajectory": [[0, 0, 0, 0], [1, 1, 0, 0]]}, {}, "impact: an actor with a trajectory has no impact"),
        ({}, {"distance": 0.0}, "impact.distance: 0 is outside"),
        ({}, {"location": 4.0}, "impact.location: 4 is outside -2 to 3"),
        ({}, {"overlap": 1.5}, "impact.overlap: 1.5 is outside 0 to 1"),
        ({}, {"overlap": 0.5, "location": 0.2}, "impact.location: give either"),
        ({}, {"ego_speed": 0.0}, "impact.ego_speed: 0 is outside"),
        ({}, {"heading": 90.0}, "impact.heading: 90 is more than a full turn; angles are in radians"),
        ({}, {"sides": "left"}, "impact.sides: unknown key; known: distance, location, overlap, side"),
    ],
)
def test_wrong_impacts_are_refused(actor: dict[str, Any], impact: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        scenario(actor, impact)
