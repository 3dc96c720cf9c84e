"""Random traffic of the natural junctions: FREA's rules hold, and draws are reproducible."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ssad.core.errors import RouteError
from ssad.core.lane_graph import LaneGraph
from ssad.core.types import Controller, EpisodeAgent, LaneType, Pose, Route, Scenario, TrafficPlan
from ssad.scenarios.dynamic import scenario_type
from ssad.scenarios.dynamic.knowledge import natural_junction as natural
from ssad.scenarios.dynamic.knowledge._placing import polyline_route, pose_at
from ssad.world.models import model
from tests.scenarios.dynamic.conftest import lane_of, route_over


def traffic(graph: LaneGraph, route: Route, seed: int = 0, plan: TrafficPlan | None = None) -> list[EpisodeAgent]:
    scenario = Scenario("t", "NaturalJunction", graph.name, (Pose(0, 0), Pose(1, 0)), traffic=plan)
    rng = np.random.default_rng(seed)
    return list(scenario_type("NaturalJunction").build(scenario, graph, route, rng))


def test_places_are_on_driving_lanes_outside_junctions(crossroads: LaneGraph) -> None:
    places = natural.spawn_places(crossroads)
    # 16 lanes of 100 m: 88 m are free, which holds four places 25 m apart
    assert len(places) == 16 * 4
    lanes = [p.lane for p in places]
    assert (crossroads.kind[lanes] == LaneType.DRIVING).all()
    assert (crossroads.junction[lanes] == -1).all()
    first = [p.s for p in places if p.lane == lanes[0]]
    assert np.allclose(first, [12.5, 37.5, 62.5, 87.5])


@pytest.mark.parametrize("way", ["straight", "left", "right"])
def test_candidates_keep_freas_rules(way: str, crossroads: LaneGraph, routes: Any) -> None:
    g, route = crossroads, getattr(routes, way)
    found = natural.spawn_candidates(g, route)
    own = {(int(g.road[n]), int(g.lane_id[n])) for n in route.lane}
    for place, pose in found:
        key = (int(g.road[place.lane]), int(g.lane_id[place.lane]))
        assert key not in own
        assert not (key[0] == 13 and key[1] < 0)  # opposite to the ego's start
        near = [math.hypot(pose.x - x, pose.y - y) for x, y in (route.xy[0], route.xy[-1])]
        middle = route.xy[(g.junction[route.lane] >= 0)].mean(axis=0)
        assert near[0] <= 20 or near[1] <= 30 or math.hypot(pose.x - middle[0], pose.y - middle[1]) <= 50
        assert near[0] > 5
    # nothing that the rules allow is left out
    kept = {(p.lane, p.s) for p, _ in found}
    east = [p for p in natural.spawn_places(g) if int(g.road[p.lane]) == 10 and p.lane not in set(route.lane.tolist())]
    inner = [p for p in east if abs(g.at(p.lane, p.s)[0]) < 30]
    assert inner
    assert all((p.lane, p.s) in kept for p in inner)


@pytest.mark.parametrize(
    ("plan", "count"),
    [
        (TrafficPlan(intensity=0.0), 5),
        (TrafficPlan(intensity=1.0), 18),
        (TrafficPlan(intensity=0.0, minimum=0), 0),
        (TrafficPlan(intensity=0.3, minimum=0, maximum=2), 2),
    ],
)
def test_count_is_clipped(plan: TrafficPlan, count: int, crossroads: LaneGraph, routes: Any) -> None:
    agents = traffic(crossroads, routes.straight, plan=plan)
    apart = count if count < 18 else len(agents)  # neighbouring lanes are nearer than 8 m: some places stay empty
    assert len(agents) == apart
    assert len(agents) <= 18


def test_vehicles_drive_on_their_own(crossroads: LaneGraph, routes: Any) -> None:
    agents = traffic(crossroads, routes.left, plan=TrafficPlan(intensity=0.6, wake_distance=40.0))
    assert len(agents) >= 8
    for i, agent in enumerate(agents):
        assert agent.controller == Controller.AUTOPILOT
        assert agent.wake_distance == 40.0
        assert model(agent.model).max_speed > 0
        assert 6.5 <= agent.target_speed <= 9.5
        assert agent.route is not None
        assert np.allclose(agent.route.xy[0], [agent.pose.x, agent.pose.y], atol=0.6)
        for other in agents[:i]:
            assert math.hypot(agent.pose.x - other.pose.x, agent.pose.y - other.pose.y) >= 8.0


def test_draws_are_reproducible_and_differ_by_seed(crossroads: LaneGraph, routes: Any) -> None:
    def key(seed: int) -> list[tuple[str, Pose, float]]:
        return [(a.model, a.pose, a.target_speed) for a in traffic(crossroads, routes.straight, seed)]

    assert key(1) == key(1)
    assert key(1) != key(2)


def test_a_route_off_the_graph_is_an_error(crossroads: LaneGraph, routes: Any) -> None:
    lost = Route(
        routes.straight.xy,
        routes.straight.yaw,
        np.full_like(routes.straight.lane, -1),
        routes.straight.speed_limit,
        routes.straight.width,
    )
    with pytest.raises(RouteError, match="nowhere on the lane graph"):
        traffic(crossroads, lost)


def allowed(graph: LaneGraph, route: Route) -> set[tuple[int, float]]:
    """FREA's rules, written down once more and one place after the other."""
    road = {(int(graph.road[n]), int(graph.lane_id[n])) for n in route.lane}
    first_road, first_id = next(
        (int(graph.road[n]), int(graph.lane_id[n])) for n in route.lane if graph.junction[n] < 0
    )
    middle = route.xy[graph.junction[route.lane] >= 0].mean(axis=0)
    found = set()
    for place in natural.spawn_places(graph):
        x, y, _, _ = graph.at(place.lane, place.s)
        key = (int(graph.road[place.lane]), int(graph.lane_id[place.lane]))
        gap = [math.hypot(x - a, y - b) for a, b in (route.xy[0], route.xy[-1], middle)]
        near = gap[0] <= 20.0 or gap[1] <= 30.0 or gap[2] <= 50.0
        in_the_way = min(math.hypot(x - a, y - b) for a, b in route.xy[:11]) <= 5.0
        if near and not in_the_way and key not in road and not (key[0] == first_road and key[1] * first_id < 0):
            found.add((place.lane, place.s))
    return found


@pytest.mark.parametrize("way", ["straight", "straight_outer", "left", "right", "from_the_north", "inside"])
def test_candidates_are_all_that_freas_rules_allow(way: str, crossroads: LaneGraph, routes: Any) -> None:
    if way == "from_the_north":
        route = route_over(crossroads, [(11, 2), (112, -2), (13, -2)], 88.0)
    elif way == "inside":  # a route that begins in the junction: "the ego's road" is the one after it
        route = route_over(crossroads, [(132, -1), (11, -1)], 5.0)
    else:
        route = getattr(routes, way)
    found = natural.spawn_candidates(crossroads, route)
    assert {(place.lane, place.s) for place, _ in found} == allowed(crossroads, route)
    assert all(pose == pose_at(crossroads, place) for place, pose in found)


@pytest.mark.parametrize(("limit", "away"), [(20.0, "start"), (30.0, "end"), (50.0, "junction"), (5.0, "ego")])
def test_distances_of_the_rules(limit: float, away: str, crossroads: LaneGraph) -> None:
    """One place, on the road to the east, and a route whose start, end or junction is so far from it."""
    place = next(p for p in natural.spawn_places(crossroads) if crossroads.road[p.lane] == 10)
    x, y, _, _ = crossroads.at(place.lane, place.s)
    inside, road = lane_of(crossroads, 132, -1), lane_of(crossroads, 11, -1)
    far = np.array([5000.0, 0.0])

    def kept(distance: float) -> bool:
        there = np.array([x, y - distance])
        # start, twelve more points, one in the junction, end
        xy = np.tile(far, (15, 1)) + np.arange(15)[:, None] * (0.0, 500.0)
        if away == "start":
            xy[0] = there
        elif away == "junction":
            xy[13] = there
        elif away == "end":
            xy[14] = there
        else:
            xy[0], xy[10] = (x, y - 15.0), there
        lane = np.array([road] * 13 + [inside, road], np.int32)
        ones = np.ones(15, np.float32)
        route = Route(xy.astype(np.float32), 0.0 * ones, lane, ones, ones)
        return any(other == place for other, _ in natural.spawn_candidates(crossroads, route))

    near, beyond = kept(limit - 0.01), kept(limit + 0.01)
    assert (near, beyond) == ((False, True) if away == "ego" else (True, False))


def test_what_stands_ahead_of_the_ego_after_10_m_does_not_count(crossroads: LaneGraph, routes: Any) -> None:
    route = route_over(crossroads, [(13, 1), (132, -1), (11, -1)], 60.0)
    kept = {
        (int(crossroads.road[p.lane]), int(crossroads.lane_id[p.lane]), p.s)
        for p, _ in natural.spawn_candidates(crossroads, route)
    }
    # in the lane beside the ego's, 2.5 m and 27.5 m ahead of it: 3.5 m aside, so only the first is in the way
    assert (13, 2, 62.5) not in kept
    assert (13, 2, 87.5) in kept


def test_long_vehicles_turn_only_where_they_can() -> None:

    def bend(radius: float) -> Route:
        return replace(straight, yaw=(np.arange(51) / radius).astype(np.float32))

    straight = polyline_route(np.array([[0.0, 0.0], [50.0, 0.0]]))
    for name in ("car", "bus", "truck", "motorcycle"):
        body = model(name)
        assert natural.fits_route(name, straight)
        # half the length times the slip, k wheelbase / 2, and half the width may reach 2.2 m
        tightest = 0.25 * body.length * body.wheelbase / (2.2 - 0.5 * body.width)
        assert natural.fits_route(name, bend(1.05 * tightest))
        assert not natural.fits_route(name, bend(0.95 * tightest))
    # a single kink is spread over 3 m
    kink = replace(straight, yaw=np.where(np.arange(51) < 25, 0.0, 0.09).astype(np.float32))
    assert natural.fits_route("bus", kink) == natural.fits_route("bus", bend(3.0 / 0.09))
    # and points 2 m apart are half as bent
    wide = replace(bend(10.0), spacing=2.0)
    assert (natural.fits_route("bus", bend(10.0)), natural.fits_route("bus", wide)) == (
        False,
        natural.fits_route("bus", bend(20.0)),
    )


def test_the_mix_of_vehicles() -> None:
    assert natural._MIX == {
        "car": 0.30,
        "suv": 0.20,
        "coupe": 0.12,
        "compact": 0.18,
        "van": 0.06,
        "motorcycle": 0.07,
        "truck": 0.04,
        "bus": 0.03,
    }


def test_speeds_are_those_of_the_parameters_and_of_the_road(crossroads: LaneGraph, routes: Any) -> None:
    def speeds(graph: LaneGraph, seeds: int, **parameters: float) -> list[float]:
        plan = TrafficPlan(intensity=1.0)
        scenario = Scenario("t", "NaturalJunction", "T", (Pose(0, 0), Pose(1, 0)), parameters=parameters, traffic=plan)
        build = scenario_type("NaturalJunction").build
        agents = [
            a for seed in range(seeds) for a in build(scenario, graph, routes.straight, np.random.default_rng(seed))
        ]
        return [a.target_speed for a in agents]

    found = speeds(crossroads, 8, speed=6.0, speed_spread=3.0)
    assert 3.0 <= min(found) < 3.3
    assert 8.7 < max(found) <= 9.0
    assert np.mean(found) == pytest.approx(6.0, abs=0.7)
    assert set(speeds(crossroads, 1, speed=6.0, speed_spread=0.0)) == {6.0}
    slow = replace(crossroads, speed_limit=np.full(crossroads.lane_count, 5.0, np.float32))
    assert set(speeds(slow, 1, speed=6.0, speed_spread=0.0)) == {5.0}


def test_short_roads_hold_one_vehicle_or_none(crossroads: LaneGraph) -> None:
    def places(length: float) -> list[float]:
        graph = replace(crossroads, s=crossroads.s * np.float32(length / 100.0))
        return [p.s for p in natural.spawn_places(graph) if p.lane == 0]

    assert places(11.9) == []
    assert places(12.1) == pytest.approx([6.05], abs=1e-3)
    assert places(36.9) == pytest.approx([18.45], abs=1e-3)
    assert places(37.1) == pytest.approx([6.05, 31.05], abs=1e-3)


def test_agents_have_names_and_a_route_of_their_own(crossroads: LaneGraph, routes: Any) -> None:
    agents = traffic(crossroads, routes.straight, plan=TrafficPlan(intensity=1.0))
    assert [a.name for a in agents] == [f"{a.model} {k}" for k, a in enumerate(agents, 1)]
    for agent in agents:
        assert agent.route is not None
        lane = crossroads.road[agent.route.lane[-1]]
        # 400 m, or the end of the road
        assert agent.route.length > 395.0 or lane in (10, 11, 12, 13)
