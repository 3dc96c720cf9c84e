"""Walkers and cyclists of natural traffic: off by default, keyed, where they belong, and as fast as published."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import ConfigError
from ssad.core.seeding import generator
from ssad.core.types import ENDS, Controller, Episode, EpisodeAgent, LaneType, Pose, Scenario, TrafficPlan
from ssad.drivers.builtin import Autopilot
from ssad.metrics.human_driving import spread
from ssad.scenarios.dynamic import build_episode, load_scenarios
from ssad.scenarios.dynamic.knowledge.natural_junction import APART
from ssad.scenarios.dynamic.knowledge.vulnerable_users import (
    CYCLING_ACCELERATION,
    CYCLING_SPREAD,
    GROUP_SLOWER,
    NEAR,
    closed_crossings,
    cycling_route,
    cyclist,
    draw_walkers,
    group_size,
    walking_speed,
)
from ssad.scenarios.dynamic.schema import check, scenario_data
from ssad.world.kernels.data import WalkStatus
from ssad.world.roads import LaneGraph, load_town, random_route
from ssad.world.roads.crossings import road_crossings
from ssad.world.rollout import rollout
from ssad.world.world import World
from tests.world.roads.test_xodr import lane, lanes, road, section, town
from tests.world.worlds import line_route, straight_graph

SCENARIO = load_scenarios("natural-uniform")[0]
GRAPH = load_town(SCENARIO.town)


def with_plan(**plan: Any) -> Scenario:
    return replace(SCENARIO, traffic=replace(SCENARIO.traffic or TrafficPlan(), **plan))


@pytest.fixture(scope="module")
def crowd() -> Episode:
    return build_episode(with_plan(walkers=12, cyclists=3), GRAPH, seed=3)


def start_distance(first: EpisodeAgent, second: EpisodeAgent) -> float:
    return math.hypot(first.pose.x - second.pose.x, first.pose.y - second.pose.y)


def sidewalk_distance(graph: LaneGraph, points: np.ndarray) -> np.ndarray:
    """Distance of points [n, 2] from the centre line of the nearest sidewalk, m."""
    lanes = np.flatnonzero(graph.kind == LaneType.SIDEWALK)
    lines = [graph.along(int(lane), np.arange(0.0, float(graph.length[lane]), 0.5))[:, :2] for lane in lanes]
    return np.asarray(np.hypot(*(points[:, None] - np.concatenate(lines)[None]).transpose(2, 0, 1)).min(axis=1))


def test_plans_without_walkers_and_cyclists_are_written_as_before() -> None:
    for defaults in (False, True):
        traffic = scenario_data(with_plan(maximum=7), defaults=defaults)["traffic"]
        assert not {"walkers", "cyclists"} & set(traffic)
    assert scenario_data(with_plan(walkers=2))["traffic"]["walkers"] == 2


def test_the_vehicles_do_not_change_with_the_walkers(crowd: Episode) -> None:
    vehicles = build_episode(SCENARIO, GRAPH, seed=3).agents
    for agent, vehicle in zip(crowd.agents, vehicles, strict=False):
        assert agent.route is not None
        assert vehicle.route is not None
        assert replace(agent, route=None) == replace(vehicle, route=None)
        assert np.array_equal(agent.route.xy, vehicle.route.xy)
    assert [agent.model for agent in crowd.agents[len(vehicles) :]] == ["bicycle"] * 3 + ["walker"] * 12


def test_a_draw_depends_on_its_number_alone() -> None:
    draws = [
        build_episode(with_plan(walkers=12, draw=draw), GRAPH, seed=seed) for draw, seed in ((1, 3), (1, 4), (2, 3))
    ]
    poses = [[agent.pose for agent in episode.agents if agent.model == "walker"] for episode in draws]
    assert poses[0] == poses[1]
    assert not set(poses[0]) & set(poses[2])


def test_walkers_start_on_sidewalks_near_the_route(crowd: Episode) -> None:
    walkers = [agent for agent in crowd.agents if agent.model == "walker"]
    points = np.array([(agent.pose.x, agent.pose.y) for agent in walkers])
    assert sidewalk_distance(GRAPH, points).max() < 1.0
    route = crowd.agents[0].route
    assert route is not None
    distances = np.hypot(*(points[:, None] - route.xy[None]).transpose(2, 0, 1)).min(axis=1)
    assert distances.max() < NEAR + 5.0
    assert min(start_distance(*pair) for pair in itertools.combinations(walkers, 2)) > 0.5


def test_walkers_walk_at_their_speed_and_cross_roads_at_crossings(crowd: Episode) -> None:
    walkers = [index for index, agent in enumerate(crowd.agents) if agent.walk is not None]
    assert len(walkers) == 12
    assert any(agent.walk.crossings for agent in crowd.agents if agent.walk is not None)
    world = World([crowd], {GRAPH.name: GRAPH}, ego=Controller.AUTOPILOT)
    shares, far = [], 0.0
    while not world.ended()[0]:
        world.step()
        wished = np.array([crowd.agents[index].target_speed for index in walkers])
        shares.append(world.array("speed")[0, walkers] / wished)
        on_pavement = world.array("walk.status")[0, walkers] == WalkStatus.PAVEMENT
        places = world.array("pose")[0, walkers, :2][on_pavement]
        far = max(far, sidewalk_distance(GRAPH, places).max(initial=0.0)) if len(shares) % 20 == 0 else far
    assert np.median(shares) == pytest.approx(1.0, abs=0.02)
    assert far < 2.0
    assert ENDS[world.ended()[0]] == "complete"


def test_nobody_starts_in_a_body_on_the_pavement(crowd: Episode) -> None:
    route = crowd.agents[0].route
    assert route is not None
    plan = TrafficPlan(walkers=12)
    free = draw_walkers(plan, GRAPH, route, [], 30.0, "key")
    parked = EpisodeAgent("parked", "van", Controller.NONE, free[0].pose)
    drawn = draw_walkers(plan, GRAPH, route, [parked], 30.0, "key")
    assert len(drawn) == 12
    assert min(start_distance(agent, parked) for agent in drawn) > 1.3


def test_walkers_leave_out_crossings_that_never_show_red_long_enough() -> None:
    open_to_all = closed_crossings(GRAPH, 2.0, 0.0)
    at_signals = {number for number, crossing in enumerate(road_crossings(GRAPH)) if crossing.traffic}
    assert at_signals
    assert open_to_all == frozenset()
    assert closed_crossings(GRAPH, 0.3, 0.0) == at_signals
    plan = TrafficPlan(walkers=20)
    slow = [agent for agent in draw_walkers(plan, GRAPH, None, [], 300.0, "key") if agent.walk is not None]
    for agent in slow:
        assert agent.walk is not None
        closed = closed_crossings(GRAPH, agent.speed, 0.0)
        assert not closed & {place.crossing for place in agent.walk.crossings}


def test_groups_are_as_frequent_as_published() -> None:
    sizes = np.array([group_size(generator("sizes", number)) for number in range(1000)])
    low, high = spread("share of walkers in groups")
    assert low < sizes[sizes > 1].sum() / sizes.sum() < high


def test_walkers_are_as_fast_as_published_and_slower_in_groups() -> None:
    alone, together = (
        np.array([walking_speed(size, generator("speed", number)) for number in range(400)]) for size in (1, 2)
    )
    assert abs(alone.mean() - 1.34) < 0.04
    assert abs(alone.std() - 0.26) < 0.03
    assert abs(alone.mean() - together.mean() - GROUP_SLOWER) < 0.04


def test_members_of_a_group_walk_side_by_side_at_one_speed() -> None:
    episode = build_episode(with_plan(walkers=30), GRAPH, seed=1)
    walkers = [agent for agent in episode.agents if agent.model == "walker"]
    pairs = [
        (first, second)
        for first, second in itertools.pairwise(walkers)
        if first.speed == second.speed and start_distance(first, second) < 1.0
    ]
    assert len(pairs) >= 5
    assert all(abs(first.pose.yaw - second.pose.yaw) < 0.5 for first, second in pairs)


def test_cyclists_are_as_fast_as_published_and_keep_apart(crowd: Episode) -> None:
    for agent in (agent for agent in crowd.agents if agent.model == "bicycle"):
        assert agent.controller == Controller.AUTOPILOT
        assert agent.driver is not None
        assert CYCLING_ACCELERATION[0] <= agent.driver.acceleration <= CYCLING_ACCELERATION[1]
        others = [other for other in crowd.agents if other is not agent and other.model != "walker"]
        assert min(start_distance(agent, other) for other in others) >= 0.8 * APART
    route = random_route(GRAPH, 0, 0.0, 100.0, generator("route"))
    speeds = [cyclist("cyclist", route, 0.0, generator("cyclist", number)).target_speed for number in range(400)]
    low, high = spread("cycling speed")
    assert low < np.mean(speeds) < high
    assert np.std(speeds) == pytest.approx(CYCLING_SPREAD, abs=0.1)


def test_cyclists_ride_near_the_edge_of_their_lane_or_on_a_biking_lane() -> None:
    graph = straight_graph()
    route = line_route(0.0, 200.0)
    path = cycling_route(graph, route, 0.9)
    np.testing.assert_allclose(path.xy[:, 1], -(1.75 - 0.9), atol=1e-5)
    assert path.length == pytest.approx(200.0, abs=1.0)
    left_hand = replace(graph, left_hand=np.array([True]))
    np.testing.assert_allclose(cycling_route(left_hand, route, 0.9).xy[:, 1], 1.75 - 0.9, atol=1e-5)
    biking = replace(graph, kind=np.array([LaneType.DRIVING, LaneType.DRIVING, LaneType.BIKING], np.uint8))
    np.testing.assert_allclose(cycling_route(biking, route, 0.9).xy[:, 1], -2.75, atol=1e-5)


def test_a_town_without_sidewalks_has_no_walkers() -> None:
    track = load_town("HighSpeedTrack")
    lane = int(np.flatnonzero((track.kind == LaneType.DRIVING) & (track.junction < 0))[0])
    route = random_route(track, lane, 0.0, 200.0, generator("route"))
    assert draw_walkers(TrafficPlan(walkers=5), track, route, [], 30.0, "key") == []


@pytest.mark.parametrize(
    ("right", "left", "walkers"),
    [
        (lane(-1), "", 0),
        (lanes(-1), lanes(1), 0),
        (lane(-1) + lane(-2, kind="sidewalk"), lanes(1), 4),
    ],
    ids=["one lane", "no sidewalk", "one sidewalk"],
)
def test_natural_traffic_comes_to_any_map_as_far_as_there_is_room(
    tmp_path: Path, right: str, left: str, walkers: int
) -> None:
    """A road of 100 m that ends, without a junction: ways are short, and some kinds have no place."""
    graph = town(tmp_path, road(sections=section(left, right)))
    plan = TrafficPlan(minimum=2, wake_distance=0.0, drivers="population", walkers=4, cyclists=2)
    route = (Pose(10.0, -1.75, 0.0), Pose(90.0, -1.75, 0.0))
    scenario = Scenario("own/0", "FreeDrive", "maps/own.xodr", route, traffic=plan)
    episode = build_episode(scenario, graph, seed=0)
    models = [agent.model for agent in episode.agents[1:]]
    assert models.count("walker") == walkers
    assert "bicycle" in models or not left
    (trace,) = rollout(World([episode], {"maps/own.xodr": graph}), Autopilot())
    assert trace.end != "collision"
    assert trace.route_complete[-1] > 50.0


def test_a_short_way_to_the_end_of_a_road_has_room_for_a_cyclist() -> None:
    track = load_town("Twinford")
    way = random_route(track, int(np.flatnonzero(track.kind == LaneType.DRIVING)[0]), 0.0, 200.0, generator("route"))
    for count in (2, 3, 9, 12, 13, 30):
        columns = {name: getattr(way, name)[:count] for name in ("xy", "yaw", "lane", "speed_limit", "width")}
        short = replace(way, **columns)
        moved = cycling_route(track, short, 0.8)
        assert moved.xy.shape == short.xy.shape
        assert np.hypot(*(moved.xy - short.xy).T).max() < 3.0


@pytest.mark.parametrize(
    ("plan", "problem"),
    [
        ({"walkers": -1}, "-1 is outside 0 to 40"),
        ({"cyclists": 41}, "41 is outside 0 to 40"),
        ({"walkers": 30, "cyclists": 20}, "more than 62"),
    ],
)
def test_impossible_numbers_are_refused(plan: dict[str, int], problem: str) -> None:
    with pytest.raises(ConfigError, match=problem):
        check(with_plan(**plan))
